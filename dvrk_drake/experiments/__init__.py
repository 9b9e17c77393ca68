"""Simulated experiments: scenarios, studies, tuning, transparency, the paper's figures, the demo."""
