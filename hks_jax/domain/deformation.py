"""The metric of a deformation: the right Cauchy–Green tensor of its gradient."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.checks import real_array
from hks_jax.domain.grid import Grid
from hks_jax.traced import is_traced


def right_cauchy_green(name: str, grid: Grid, F: Any) -> Float[Array, "*shape d d"]:
    """Return C = FᵀF of gradients (*shape, m, d), m ≥ d; the identity outside the mask.

    Raises:
        ValueError: wrong shape; square gradients whose determinant is not positive.
    """
    gradients = real_array(name, F)
    d = grid.dimension
    shape, (m, n) = gradients.shape[:-2], gradients.shape[-2:] if gradients.ndim >= 2 else (0, 0)
    if shape != grid.shape or n != d or m < d:
        expected = (*grid.shape, d, d)
        raise ValueError(
            f"{name}: got shape {gradients.shape}; expected (*grid.shape, d, d) = {expected}, one gradient per node, "
            "or more rows than columns for a map into a space of more dimensions"
        )
    if m == d and not is_traced(gradients):
        _require_positive_determinant(name, np.asarray(gradients, np.float64), grid)
    inside = grid.inside[..., None, None]
    safe = jnp.where(inside, gradients, jnp.eye(m, d, dtype=gradients.dtype))
    return jnp.einsum("...ki,...kj->...ij", safe, safe, precision="highest")


def _require_positive_determinant(name: str, gradients: Float[np.ndarray, "*shape d d"], grid: Grid) -> None:
    finite = grid.inside & np.isfinite(gradients).all(axis=(-2, -1))  # others are refused with the metric
    determinants = np.linalg.det(np.where(finite[..., None, None], gradients, np.eye(grid.dimension)))
    bad = finite & (determinants <= 0)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name}: {int(bad.sum())} of {int(grid.inside.sum())} gradients have a determinant that is not positive "
            f"(the first at node {first}, {determinants[first]:.3g}); expected deformations that turn nothing inside "
            f"out. Check that {name}[..., i, j] is ∂yᵢ/∂xⱼ, or exclude these nodes by the grid's mask"
        )
