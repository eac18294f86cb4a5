"""Subspace iteration by Chebyshev filters, without a factorisation."""
