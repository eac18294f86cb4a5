"""Solves on the complement of known eigenvectors, which derivatives need."""
