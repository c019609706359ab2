"""Surfaces from points alone: orthogonal-distance least squares without a start, with covariance."""
