"""Identification from static poses, and how good it is."""
