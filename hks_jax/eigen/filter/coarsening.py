"""Galerkin coarsening of a pencil of stencils to every second node of each axis.

An iteration on the fine grid starts from the interpolated eigenfunctions of the coarse grid.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.compilation import jit_quickly
from hks_jax.fem.halo import neighbours, with_rim
from hks_jax.fem.nodal import NodalPencil, lump, to_columns, to_rows
from hks_jax.fem.space import axis_colours
from hks_jax.fem.stencil import Stencil

_COLUMNS = 8


@jit_quickly()
def coarsen(fine: NodalPencil) -> NodalPencil:
    """Return PᵀKP and PᵀMP, where P interpolates from every second node of each axis."""
    every_second = (slice(None, None, 2),) * len(fine.shape)
    free, domain = fine.free[every_second], fine.domain[every_second]
    shape = free.shape
    axes = [axis_colours(n, 3, wraps) for n, wraps in zip(shape, fine.periodic, strict=True)]
    counts = [int(axis.max()) + 1 for axis in axes]
    padded = -(-math.prod(counts) // _COLUMNS) * _COLUMNS
    # Neighbouring nodes have different colours; the colour of a neighbour that does not exist is −1. Only the colours
    # along single axes are constants of the program: `optimization_barrier` keeps XLA from computing larger constants.
    colours = jnp.zeros((), jnp.float32)
    along = jax.lax.optimization_barrier([jnp.asarray(axis, jnp.float32) for axis in axes])
    for axis, (own, count) in enumerate(zip(along, counts, strict=True)):
        colours = colours * count + jnp.expand_dims(own, [other for other in range(len(shape)) if other != axis])
    of_neighbour = jnp.stack([*neighbours(with_rim(colours + 1, fine.periodic), len(shape))]).astype(jnp.int32) - 1
    indicators = colours.ravel()[None] == np.arange(padded, dtype=np.float32)[:, None]
    indicators = indicators.reshape(-1, _COLUMNS, colours.size)
    indicators, of_neighbour = jax.lax.optimization_barrier((indicators, of_neighbour))

    def images(rows: Bool[Array, "b coarse"]) -> tuple[Float[Array, "b coarse"], ...]:
        x = to_columns(rows.astype(fine.lumped.dtype), shape)
        raised, restrict = interpolate(fine, x), jax.linear_transpose(partial(interpolate, fine), x)
        return tuple(to_rows(*restrict(image)) for image in fine.products()(raised))

    def coupled(images: Float[Array, "blocks b coarse"]) -> Stencil:
        # Basis functions of one colour have disjoint neighbourhoods. So at each node, the image of the sum of all basis
        # functions of one colour is the entry that couples the node to the only neighbouring function of this colour.
        entries = jnp.take_along_axis(images.reshape(padded, *shape), jnp.maximum(of_neighbour, 0), axis=0)
        return Stencil(jnp.where(of_neighbour >= 0, entries, 0), fine.periodic)

    stiffness, mass = map(coupled, jax.lax.map(images, indicators))
    return lump(stiffness, mass, free, domain)


def interpolate(fine: NodalPencil, x: Float[Array, "*coarse b"]) -> Float[Array, "*shape b"]:
    """Interpolate multilinearly from every second node, with constants beyond the last; 0 at nodes that are not
    free."""
    every_second = (slice(None, None, 2),) * len(fine.shape)
    weights = _interpolate(fine.domain[every_second][..., None].astype(x.dtype), fine.shape, fine.periodic)
    x = _interpolate(jnp.where(fine.free[every_second][..., None], x, 0), fine.shape, fine.periodic)
    return jnp.where(fine.free[..., None], x / jnp.where(weights > 0, weights, 1), 0)


def _interpolate(x: Float[Array, "*coarse b"], shape: tuple[int, ...], periodic: tuple[bool, ...]) -> Array:
    for axis, (n, wraps) in enumerate(zip(shape, periodic, strict=True)):
        first, rest = jnp.split(x, [1], axis)
        end = first if wraps else jax.lax.slice_in_dim(x, -1, None, axis=axis)
        following = jnp.concatenate([rest, end], axis)
        both = jnp.stack([x, (x + following) / 2], axis + 1)
        merged = both.reshape(*x.shape[:axis], -1, *x.shape[axis + 1 :])
        x = jax.lax.slice_in_dim(merged, 0, n, axis=axis)
    return x
