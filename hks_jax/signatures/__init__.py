"""From eigenpairs to scalar fields: signatures, kernels, distances, and what a truncated spectrum can resolve."""
