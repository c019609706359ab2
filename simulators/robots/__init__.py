"""Simulated arms: their side of the wire."""
