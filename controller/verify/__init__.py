"""Proof on demand: coverage over random cells, and Monte Carlo of a cell's own plan."""
