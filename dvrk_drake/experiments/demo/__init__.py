"""Demonstrations of `dvrk-drake demo`."""
