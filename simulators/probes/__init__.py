"""Simulated touch inputs: their side of the wire."""
