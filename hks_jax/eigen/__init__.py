"""Eigensolvers with a common interface, and their results."""
