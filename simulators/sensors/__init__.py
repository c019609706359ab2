"""Simulated sensors: their side of the wire."""
