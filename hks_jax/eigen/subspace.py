"""Rayleigh–Ritz in a subspace of nodal functions kept as rows, block by block, so that memory is bounded."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.eigen.coarsening import Level
from hks_jax.eigen.products import combine, inner_products
from hks_jax.fem.columns import stencil_product, to_columns, to_rows

_CHUNK = 1 << 14
"""Nodes rotated at once."""


class Measured(NamedTuple):
    """What the rows of a subspace are, each (m,): ‖Kx − θMx‖/‖Mx‖ and the lumped quotient xᵀKx / xᵀDx."""

    defects: Float[Array, " m"]
    lumped_values: Float[Array, " m"]


def block_of(x: Float[Array, "m nodes"], number: Array, block: int, shape: tuple[int, ...]) -> Float[Array, "*shape b"]:
    """Return a block of the rows as columns."""
    return to_columns(jax.lax.dynamic_slice_in_dim(x, number * block, block), shape)


@partial(jax.jit, static_argnames=("periodic", "block"), donate_argnames="x")
def rayleigh_ritz(
    level: Level, periodic: tuple[bool, ...], block: int, x: Float[Array, "m nodes"]
) -> tuple[Float[Array, " m"], Float[Array, "m nodes"]]:
    """Return the Ritz values, ascending, and the M-orthonormal Ritz vectors in place of the rows."""
    m, nodes = x.shape

    def products(number: Array) -> tuple[Array, Array]:
        columns = block_of(x, number, block, level.shape)
        image, moved = (stencil_product(matrix, columns, periodic) for matrix in (level.stiffness, level.mass))
        return inner_products(x, to_rows(image)), inner_products(x, to_rows(moved))

    stiffness, mass = (p.reshape(m, m) for p in jax.lax.map(products, jnp.arange(m // block)))
    factor = jnp.linalg.cholesky((mass + mass.T) / 2)
    half = jax.scipy.linalg.solve_triangular(factor, (stiffness + stiffness.T) / 2, lower=True)
    values, mix = jnp.linalg.eigh(jax.scipy.linalg.solve_triangular(factor, half.T, lower=True))
    mix = jax.scipy.linalg.solve_triangular(factor, mix, lower=True, trans=1).T

    def rotate(number: Array, x: Array) -> Array:
        rotated = combine(mix, jax.lax.dynamic_slice_in_dim(x, number * _CHUNK, _CHUNK, axis=1))
        return jax.lax.dynamic_update_slice_in_dim(x, rotated, number * _CHUNK, axis=1)

    whole = nodes // _CHUNK
    if whole:
        x = jax.lax.fori_loop(0, whole, rotate, x)
    if nodes % _CHUNK:
        x = x.at[:, whole * _CHUNK :].set(combine(mix, x[:, whole * _CHUNK :]))
    return values, x


@partial(jax.jit, static_argnames=("periodic", "block"))
def measure(
    level: Level, periodic: tuple[bool, ...], block: int, values: Float[Array, " m"], x: Float[Array, "m nodes"]
) -> Measured:
    """Return how good the pairs are."""

    def of_block(number: Array) -> tuple[Array, Array]:
        columns = block_of(x, number, block, level.shape)
        theta = jax.lax.dynamic_slice_in_dim(values, number * block, block)
        image, moved = (stencil_product(matrix, columns, periodic) for matrix in (level.stiffness, level.mass))
        axes = tuple(range(columns.ndim - 1))
        defect = jnp.sqrt(jnp.sum((image - theta * moved) ** 2, axes) / jnp.sum(moved**2, axes))
        lumped = jnp.sum(columns * image, axes) / jnp.sum(level.lumped[..., None] * columns**2, axes)
        return defect, lumped

    return Measured(*(v.ravel() for v in jax.lax.map(of_block, jnp.arange(values.size // block))))
