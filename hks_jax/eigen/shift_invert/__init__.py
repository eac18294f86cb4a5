"""Solvers on the host, by SciPy."""
