"""The daemon: owns the cell, and lets console, page and scripts in through a unix socket."""
