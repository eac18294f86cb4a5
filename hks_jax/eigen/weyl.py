"""Weyl's law, to guess where in the spectrum to look."""

import numpy as np
from jaxtyping import Array, Float


def weyl(count: float, volume: Float[Array, ""], dimension: int) -> Float[Array, ""]:
    """Return about where the eigenvalue of that number lies: N(λ) ≈ (λ/4π)·area, or (λ^(3/2)/6π²)·volume in 3D."""
    constant = 4 * np.pi if dimension == 2 else (6 * np.pi**2) ** (2 / 3)
    return constant * (count / volume) ** (2 / dimension)
