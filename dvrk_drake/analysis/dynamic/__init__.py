"""Identification of the full dynamics from motions, and how good it is."""
