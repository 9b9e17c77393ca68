"""Identification and validation of static models from poses."""
