"""Reproduces the figures and tables of the paper. Each module creates one or more sections of a page."""
