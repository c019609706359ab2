"""Proof of stated uncertainties: Monte Carlo after JCGM 101, and coverage counted over many cells."""
