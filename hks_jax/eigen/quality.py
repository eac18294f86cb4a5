"""How well eigenpairs are known: their defects, and what rounding alone makes of eigenvalues."""

import jax
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


def quotients_and_defects(
    pencil: Pencil, vectors: Float[Array, "m n_dof"], block: int
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Return λ = φᵀKφ / φᵀMφ and ‖Kφ − λMφ‖ / ‖Mφ‖ of vectors, of which there are several blocks."""
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()

    def measure(rows: Float[Array, "block n_dof"]) -> tuple[Array, Array]:
        columns = jax.lax.optimization_barrier(rows.T)
        force, image = stiffness(columns), mass(columns)
        values = jnp.sum(columns * force, axis=0) / jnp.sum(columns * image, axis=0)
        return values, jnp.linalg.norm(force - values * image, axis=0) / jnp.linalg.norm(image, axis=0)

    values, defects = jax.lax.map(measure, vectors.reshape(-1, block, vectors.shape[1]))
    return values.ravel(), defects.ravel()


def indistinct(pencil: Pencil, dtype: np.dtype) -> Float[Array, ""]:
    """Return the distance below which rounding in K alone makes two eigenvalues one: 4 ε λ_max.

    4·max(Kᵢᵢ/Mᵢᵢ) is λ_max on a uniform grid in 2D and 3D.
    """
    return 4 * jnp.finfo(dtype).eps * 4 * jnp.max(pencil.stiffness.diagonal() / pencil.mass.diagonal())
