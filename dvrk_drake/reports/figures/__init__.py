"""Plots results as PNG files. Only `dvrk_drake.reports` imports Matplotlib."""
