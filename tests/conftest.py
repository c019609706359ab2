"""Helpers shared by tests of several packages live in tests/support."""
