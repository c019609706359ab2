"""Arms: codec and driver of each."""
