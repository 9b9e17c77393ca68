"""Simulated effects of an arm, such as friction and cables, for `ArmStation`. See `models.effects_schema`."""
