"""Recordings of arms: data, file formats, conversion."""
