"""The other end of the wire: a simulated world and the devices in it."""
