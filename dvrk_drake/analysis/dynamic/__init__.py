"""Identification and validation of full dynamic models from motions."""
