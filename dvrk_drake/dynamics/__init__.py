"""Equations of motion of an arm: symbolic gravity, base parameters, drive effects and identified models."""
