"""Simulated effects, such as friction and cables, of an arm in a plant. See `models.effects_schema`."""
