"""Simulation studies over poses, seeds and parameter errors, on all cores or on a cluster."""
