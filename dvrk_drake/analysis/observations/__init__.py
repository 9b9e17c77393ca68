"""Preparation of recordings: times, faults, filtering, resampling, static segments, repetitions and folds."""
