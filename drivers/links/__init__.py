"""Transport: ports and buses with deadlines, and the protocols that many devices share."""
