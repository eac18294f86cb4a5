"""Spectrum slicing by block Lanczos on factorisations."""
