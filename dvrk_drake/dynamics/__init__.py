"""Equations of motion of an arm: symbolic gravity, base parameters, joint effects, identified models."""
