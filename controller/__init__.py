"""The cell: cell file, sequence, gates, store, daemon, console and report."""
