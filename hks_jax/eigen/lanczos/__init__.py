"""Spectrum slicing by shift-invert block Lanczos."""
