"""How well eigenpairs are known: their defects, and what rounding alone makes of eigenvalues."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.linear.pencil import SymmetricPencil

_ROWS = 8
"""How many vectors to look at together: what is computed from them stays in the cache."""


def values_and_defects(
    pencil: SymmetricPencil, vectors: Float[Array, "m n_dof"], values: Float[Array, " m"] | None = None
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Return λ, if not given the Rayleigh quotient φᵀKφ / φᵀMφ, and ‖Kφ − λMφ‖ / ‖Mφ‖ of each vector."""
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    m, size = len(vectors), min(_ROWS, len(vectors))
    starts = np.minimum(np.arange(0, m, size), m - size)  # the last may overlap the one before

    def measure(start: Array) -> tuple[Array, Array]:
        columns = jax.lax.optimization_barrier(jax.lax.dynamic_slice_in_dim(vectors, start, size).T)
        force, image = stiffness(columns), mass(columns)
        if values is None:
            quotients = jnp.sum(columns * force, axis=0) / jnp.sum(columns * image, axis=0)
        else:
            quotients = jax.lax.dynamic_slice_in_dim(values, start, size)
        return quotients, jnp.linalg.norm(force - quotients * image, axis=0) / jnp.linalg.norm(image, axis=0)

    all_values, defects = jax.lax.map(measure, jnp.asarray(starts))
    block = np.arange(m) // size
    place = block, np.arange(m) - starts[block]
    return all_values[place], defects[place]


def quality(
    pencil: SymmetricPencil,
    values: Float[Array, " k"],
    vectors: Float[Array, "k n_dof"],
    unit: Float[Array, ""],
    tolerance: float,
) -> tuple[Float[Array, " k"], Bool[Array, " k"], Float[Array, " k"]]:
    """Return residuals relative to the eigenvalues, whether they are small enough, and what rounding alone makes.

    Eigenvalues smaller than ``unit`` are measured by it.
    """
    _, defect = values_and_defects(pencil, vectors, values)
    scale = jnp.maximum(jnp.abs(values), jnp.abs(unit))
    scale = jnp.where(scale > 0, scale, 1)
    residuals, rounding = defect / scale, indistinct(pencil, values.dtype) / scale
    # Rounding excuses a residual of a per cent at most: beyond that, the pair is not known, whatever the reason.
    return residuals, residuals <= jnp.maximum(tolerance, jnp.minimum(rounding, 0.01)), rounding


def indistinct(pencil: SymmetricPencil, dtype: np.dtype) -> Float[Array, ""]:
    """Return the distance below which rounding in K alone makes two eigenvalues one: 4 ε λ_max.

    4·max(Kᵢᵢ/Mᵢᵢ) is λ_max on a uniform grid in 2D and 3D.
    """
    return 4 * jnp.finfo(dtype).eps * 4 * jnp.max(pencil.stiffness.diagonal() / pencil.mass.diagonal())
