"""Analysis of recordings: signals, checks, identification, validation, payload and recalibration.

Many comments on constants state what half or twice the value changes. `benchmarks/thresholds.py` measures it.
"""
