"""Checks of a recording before identification."""
