"""Recordings to models: signals, check, identification, validation, payload, recalibration."""
