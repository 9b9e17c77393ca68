"""Figures in one style, as PNG files. Matplotlib is imported here only."""
