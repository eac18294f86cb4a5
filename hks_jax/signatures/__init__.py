"""Scalar fields from eigenpairs: signatures, kernels, distances, and estimates of the truncation error."""
