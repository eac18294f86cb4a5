"""Weyl's law: about how many eigenvalues lie below one, and about where that of a number lies."""

import math
from typing import TypeVar

import numpy as np
from jaxtyping import Array, Float

Real = TypeVar("Real", float, Float[np.ndarray, " n"])
Volume = TypeVar("Volume", float, Float[Array, ""])


def weyl(count: float, volume: Volume, dimension: int) -> Volume:
    """Return about where the eigenvalue of that number lies, by the first term of `weyl_number`."""
    constant = 4 * math.pi if dimension == 2 else (6 * math.pi**2) ** (2 / 3)
    return constant * (count / volume) ** (2 / dimension)


def weyl_number(values: Real, volume: float, dimension: int, rim: float = 0.0) -> Real:
    """Return about how many eigenvalues lie below a λ ≥ 0, by two terms (Ivrii 1980).

    In 2D N(λ) ≈ (A λ + L √λ)/4π with the area A, in 3D N(λ) ≈ V λ^(3/2)/6π² + S λ/16π. L or S is the length or the area
    of the natural part of the rim, less that of its Dirichlet part.
    """
    if dimension == 2:
        return (volume * values + rim * values**0.5) / (4 * math.pi)
    return volume * values**1.5 / (6 * math.pi**2) + rim * values / (16 * math.pi)
