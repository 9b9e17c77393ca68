"""Analysis of recordings: signals, checks, identification, validation, payload and recalibration."""
