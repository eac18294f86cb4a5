"""Rayleigh–Ritz in a subspace of nodal functions kept as rows, block by block, so that memory is bounded."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.eigen.filter.coarsening import GridLevel
from hks_jax.eigen.filter.sharing import first_of, total
from hks_jax.fem.columns import product_with_rim, side_by_side, stencil, to_columns
from hks_jax.fem.halo import Slabs
from hks_jax.linear.accelerators import row_by_row
from hks_jax.linear.products import combine
from hks_jax.linear.standard_form import pencil_eigh

_CHUNK = 1 << 14
"""Nodes rotated at once."""


class Measured(NamedTuple):
    """What the rows of a subspace are, each (m,): ‖Kx − θMx‖/‖Mx‖ and the lumped quotient xᵀKx / xᵀDx."""

    defects: Float[Array, " m"]
    lumped_values: Float[Array, " m"]


def block_of(x: Float[Array, "m nodes"], number: Array, block: int, shape: tuple[int, ...]) -> Float[Array, "*shape b"]:
    """Return a block of the rows as columns."""
    return to_columns(row_by_row(jax.lax.dynamic_slice_in_dim(x, number * block, block)), shape)


def local_level(level: GridLevel, slabs: Slabs | None) -> GridLevel:
    """Return the level on this device's slab."""
    if slabs is None:
        return level
    d = len(slabs.shape)
    return GridLevel(*(slabs.own(a, a.ndim - d) for a in level))


@partial(jax.jit, static_argnames=("periodic", "block", "slabs"), donate_argnames="x")
def rayleigh_ritz(
    level: GridLevel, periodic: tuple[bool, ...], block: int, x: Float[Array, "m nodes"], slabs: Slabs | None = None
) -> tuple[Float[Array, " m"], Float[Array, "m nodes"]]:
    """Return the Ritz values, ascending, and the M-orthonormal Ritz vectors in place of the rows.

    With ``slabs``, level and rows are those of this device's slab.
    """
    m, nodes = x.shape

    images_of = _images(level, periodic, slabs)

    def products(number: Array) -> tuple[Array, ...]:
        images = images_of(block_of(x, number, block, level.shape))
        # As columns: were they turned into rows, XLA would compute the stencils in that order, seven times slower.
        return tuple(combine(x, image.reshape(nodes, block)) for image in images)

    both = total(slabs, jax.lax.map(products, jnp.arange(m // block)))
    stiffness, mass = (jnp.moveaxis(p, 0, 1).reshape(m, m) for p in both)
    values, vectors = pencil_eigh((stiffness + stiffness.T) / 2, (mass + mass.T) / 2)
    values, mix = first_of(slabs, values), first_of(slabs, vectors.T)

    def rotate(number: Array, x: Array) -> Array:
        rotated = combine(mix, jax.lax.dynamic_slice_in_dim(x, number * _CHUNK, _CHUNK, axis=1))
        return jax.lax.dynamic_update_slice_in_dim(x, rotated, number * _CHUNK, axis=1)

    whole = nodes // _CHUNK
    if whole:
        x = jax.lax.fori_loop(0, whole, rotate, x)
    if nodes % _CHUNK:
        x = x.at[:, whole * _CHUNK :].set(combine(mix, x[:, whole * _CHUNK :]))
    return values, x


@partial(jax.jit, static_argnames=("periodic", "block", "slabs"))
def measure(
    level: GridLevel,
    periodic: tuple[bool, ...],
    block: int,
    values: Float[Array, " m"],
    x: Float[Array, "m nodes"],
    slabs: Slabs | None = None,
) -> Measured:
    """Return how good the pairs are."""
    images_of = _images(level, periodic, slabs)

    def of_block(number: Array) -> tuple[Array, ...]:
        columns = block_of(x, number, block, level.shape)
        theta = jax.lax.dynamic_slice_in_dim(values, number * block, block)
        image, moved = images_of(columns)
        products = (image - theta * moved) ** 2, moved**2, columns * image, level.lumped[..., None] * columns**2
        return tuple(jnp.sum(p, tuple(range(columns.ndim - 1))) for p in products)

    sums = total(slabs, jax.lax.map(of_block, jnp.arange(values.size // block)))
    defect, moved, energy, lumped = (s.ravel() for s in sums)
    return Measured(jnp.sqrt(defect / moved), energy / lumped)


def _images(
    level: GridLevel, periodic: tuple[bool, ...], slabs: Slabs | None
) -> Callable[[Float[Array, "*shape b"]], tuple[Float[Array, "*shape b"], Float[Array, "*shape b"]]]:
    """Return the function from columns to their products with K and M: to be made outside the loop it is for."""
    if slabs is None:
        stiffness, mass = stencil(level.stiffness, periodic), stencil(level.mass, periodic)
        return lambda columns: (stiffness(columns), mass(columns))
    coefficients, diagonal = side_by_side(level.stiffness), level.mass.shape[0] == 1
    of_mass = level.mass[0][..., None] if diagonal else side_by_side(level.mass)

    def images(columns: Float[Array, "*shape b"]) -> tuple[Float[Array, "*shape b"], Float[Array, "*shape b"]]:
        rimmed = slabs.with_halo(columns)
        return product_with_rim(coefficients, rimmed), of_mass * columns if diagonal else product_with_rim(
            of_mass, rimmed
        )

    return images
