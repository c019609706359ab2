"""Noise identification from repeated measurements: by source, and at poses never measured."""
