"""Reproduction of the paper's experiments (Rutfield et al., WPI 2015).

`reports.reproduction` compares the results with the published numbers.
"""
