"""The heat kernel of a warped three-dimensional torus to rounding error, by a Fourier method of its own."""

from collections.abc import Callable

import numpy as np


def warped_hks(
    times: np.ndarray, a: Callable[[np.ndarray], np.ndarray], b: Callable[[np.ndarray], np.ndarray], n: int, modes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return v (n,), n odd, and the HKS (n_times, n) of a(v)²dx² + b(v)²dy² + dv², all of period 2π.

    With φ = e^{i(lx + my)} ψ(v) the eigenproblem is one in v for each l and m,
    ∫ ab ψ'χ' + ab (l²/a² + m²/b²) ψχ = λ ∫ ab ψχ, here in trigonometric polynomials on n equidistant nodes.
    """
    v = 2 * np.pi * np.arange(n) / n
    gap = np.subtract.outer(np.arange(n), np.arange(n))
    derivative = np.where(gap == 0, 0, 0.5 * (-1.0) ** gap / np.where(gap == 0, 1, np.sin(np.pi * gap / n)))
    area, l = a(v) * b(v), np.arange(modes, dtype=float)  # noqa: E741
    frequency = l[:, None, None] ** 2 / a(v) ** 2 + l[:, None] ** 2 / b(v) ** 2
    twice = np.where(l == 0, 1.0, 2.0)
    scaled = derivative / np.sqrt(area)
    operator = scaled.T * area @ scaled + frequency[..., None] * np.eye(n)
    values, functions = np.linalg.eigh(operator)
    squares = functions**2 / (area * 2 * np.pi / n)[:, None]
    decay = np.exp(-times[:, None, None, None] * values)
    return v, np.einsum("l,m,lmvj,tlmj->tv", twice, twice, squares, decay, optimize=True) / (2 * np.pi) ** 2
