"""Reproduction of the paper's experiments; `reports.reproduction` compares them with the published numbers."""
