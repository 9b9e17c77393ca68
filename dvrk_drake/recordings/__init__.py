"""Recordings of arms: data, file formats and conversion."""
