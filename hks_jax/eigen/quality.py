"""How well eigenpairs are known: their defects, and what rounding alone makes of eigenvalues."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.fem.pencil import Pencil

_ROWS = 8
"""How many vectors to look at together: what is computed from them stays in the cache."""


def values_and_defects(
    pencil: Pencil, vectors: Float[Array, "m n_dof"], values: Float[Array, " m"] | None = None
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Return λ, if not given the Rayleigh quotient φᵀKφ / φᵀMφ, and ‖Kφ − λMφ‖ / ‖Mφ‖ of each vector."""
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    m, size = len(vectors), min(_ROWS, len(vectors))
    starts = np.minimum(np.arange(0, m, size), m - size)  # the last may overlap the one before

    def measure(start: Array) -> tuple[Array, Array]:
        columns = jax.lax.optimization_barrier(jax.lax.dynamic_slice_in_dim(vectors, start, size).T)
        force, image = stiffness(columns), mass(columns)
        if values is None:
            here = jnp.sum(columns * force, axis=0) / jnp.sum(columns * image, axis=0)
        else:
            here = jax.lax.dynamic_slice_in_dim(values, start, size)
        return here, jnp.linalg.norm(force - here * image, axis=0) / jnp.linalg.norm(image, axis=0)

    found_values, defects = jax.lax.map(measure, jnp.asarray(starts))
    block = np.arange(m) // size
    place = block, np.arange(m) - starts[block]
    return found_values[place], defects[place]


def indistinct(pencil: Pencil, dtype: np.dtype) -> Float[Array, ""]:
    """Return the distance below which rounding in K alone makes two eigenvalues one: 4 ε λ_max.

    4·max(Kᵢᵢ/Mᵢᵢ) is λ_max on a uniform grid in 2D and 3D.
    """
    return 4 * jnp.finfo(dtype).eps * 4 * jnp.max(pencil.stiffness.diagonal() / pencil.mass.diagonal())
