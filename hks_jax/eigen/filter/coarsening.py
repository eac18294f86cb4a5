"""Galerkin coarsening of a pencil of stencils to every second node of each axis.

An iteration on the fine grid starts from the interpolated eigenfunctions of the coarse grid.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.fem.nodal import NodalPencil, lump, to_columns, to_rows
from hks_jax.fem.space import axis_colours
from hks_jax.fem.stencil import Stencil

_COLUMNS = 16
"""The number of columns in one product."""


@jax.jit
def coarsen(fine: NodalPencil) -> NodalPencil:
    """Return PᵀKP and PᵀMP, where P interpolates from every second node of each axis."""
    every_second = (slice(None, None, 2),) * len(fine.shape)
    free, domain = fine.free[every_second], fine.domain[every_second]
    shape = free.shape
    axes = [_axis_colours(n, wraps) for n, wraps in zip(shape, fine.periodic, strict=True)]
    counts = [int(own.max()) + 1 for _, own, _ in axes]
    padded = -(-math.prod(counts) // _COLUMNS) * _COLUMNS
    # The only constants of the program are arrays along axes. The barrier prevents constant folding.
    colours, of_neighbour = _colouring(jax.lax.optimization_barrier([jnp.asarray(axis) for axis in axes]), counts)
    indicators = (colours.ravel() == np.arange(padded, dtype=np.int32)[:, None]).reshape(-1, _COLUMNS, colours.size)
    indicators, of_neighbour = jax.lax.optimization_barrier((indicators, of_neighbour))

    def images(rows: Bool[Array, "b coarse"]) -> tuple[Float[Array, "b coarse"], ...]:
        x = to_columns(rows.astype(fine.lumped.dtype), shape)
        raised, restrict = interpolate(fine, x), jax.linear_transpose(partial(interpolate, fine), x)
        return tuple(to_rows(*restrict(image)) for image in fine.products()(raised))

    def coupled(images: Float[Array, "blocks b coarse"]) -> Stencil:
        # Basis functions of one colour have disjoint neighbourhoods. So the image of the sum of these functions at a
        # node is the entry that couples the node to the nearest function.
        entries = jnp.take_along_axis(images.reshape(padded, *shape), jnp.maximum(of_neighbour, 0), axis=0)
        return Stencil(jnp.where(of_neighbour >= 0, entries, 0), fine.periodic)

    stiffness, mass = map(coupled, jax.lax.map(images, indicators))
    return lump(stiffness, mass, free, domain)


def interpolate(fine: NodalPencil, x: Float[Array, "*coarse b"]) -> Float[Array, "*shape b"]:
    """Interpolate multilinearly from every second node, constantly beyond the rim; zero at nodes not free."""
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


def _axis_colours(n: int, wraps: bool) -> Int[np.ndarray, "3 n"]:
    """Return the colours along an axis of the previous node, the node itself and the next node; −1 for no node."""
    own = axis_colours(n, 3, wraps)
    rimmed = np.pad(own, 1, mode="wrap") if wraps else np.pad(own, 1, constant_values=-1)
    return np.stack([rimmed[:-2], own, rimmed[2:]]).astype(np.int32)


def _colouring(
    axes: Sequence[Int[Array, "3 _n"]], counts: Sequence[int]
) -> tuple[Int[Array, "*shape"], Int[Array, "offsets *shape"]]:
    """Return a colouring in which neighbours differ, and for each offset the neighbour's colour (−1 if none)."""
    d = len(axes)
    number: Any = np.zeros((1,) * (2 * d), np.int32)
    exists: Any = np.ones((1,) * (2 * d), bool)
    for axis, (colours, count) in enumerate(zip(axes, counts, strict=True)):
        is_own = [i == axis for i in range(d)]
        along = colours.reshape([3 if own else 1 for own in is_own] + [-1 if own else 1 for own in is_own])
        number, exists = number * count + along, exists & (along >= 0)
    number = (number + 1) * exists.astype(np.int32) - 1
    number = number.reshape(3**d, *number.shape[d:])
    return number[3**d // 2], number
