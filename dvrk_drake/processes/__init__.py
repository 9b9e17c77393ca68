"""Separate processes that communicate over LCM and run in real time."""
