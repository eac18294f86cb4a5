"""How well eigenpairs are known: their defects, and what rounding alone makes of eigenvalues."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.fem.pencil import Pencil

ROWS = 8
"""How many vectors to look at together: what is computed from them stays in the cache."""


def relative_defect(pencil: Pencil, value: Float[Array, ""], vector: Float[Array, " n_dof"]) -> Float[Array, ""]:
    """Return ‖Kφ − λMφ‖ / ‖Mφ‖."""
    image = pencil.mass.apply(vector)
    return jnp.linalg.norm(pencil.stiffness.apply(vector) - value * image) / jnp.linalg.norm(image)


def rayleigh_quotient(pencil: Pencil, vector: Float[Array, " n_dof"]) -> Float[Array, ""]:
    """Return φᵀKφ / φᵀMφ."""
    return jnp.sum(vector * pencil.stiffness.apply(vector)) / jnp.sum(vector * pencil.mass.apply(vector))


def indistinct(pencil: Pencil, dtype: np.dtype) -> Float[Array, ""]:
    """Return the distance below which rounding in K alone makes two eigenvalues one: 4 ε λ_max.

    4·max(Kᵢᵢ/Mᵢᵢ) is λ_max on a uniform grid in 2D and 3D.
    """
    return 4 * jnp.finfo(dtype).eps * 4 * jnp.max(pencil.stiffness.diagonal() / pencil.mass.diagonal())
