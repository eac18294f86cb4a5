"""Linear algebra of symmetric matrices that knows no domain."""
