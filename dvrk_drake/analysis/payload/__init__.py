"""Estimation of a payload from two recordings of the same motion."""
