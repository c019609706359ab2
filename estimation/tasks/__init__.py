"""Calibration tasks: a Problem in, a frozen Result out, no guess required."""
