"""The outside world: links with deadlines, and per device a codec and a driver."""
