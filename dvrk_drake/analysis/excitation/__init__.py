"""Designs motions that excite the dynamics of an arm."""
