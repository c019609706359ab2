"""Planning: which measurements to take, so that the gated quantity becomes known well enough."""
