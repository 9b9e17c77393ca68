"""Plots results as PNG files. Only this package imports Matplotlib."""
