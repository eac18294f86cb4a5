"""Masks of nodes or elements for computations, which should not have them for constants.

Called plainly, compiled computations take masks as arguments, whatever they are. Where a user compiles a whole program
they would be part of it: there a mask is computed if it is a box, as all masks of whole grids are, from what is along
its axes.
"""

from collections.abc import Sequence
from functools import lru_cache, reduce
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from hks_jax.fem.space import GridSpace
from hks_jax.traced import is_traced


def mask_for(values: Any, mask: Bool[np.ndarray, "*shape"]) -> Bool[np.ndarray | Array, "*shape"]:
    """Return a mask for a computation with some values."""
    axes = _box(mask) if is_traced(values) else None
    return mask if axes is None else _outer([axis[None] for axis in axes])[0]


def couplings_for(values: Any, space: GridSpace) -> Bool[np.ndarray | Array, "offsets *shape"] | None:
    """Tell for which offsets and nodes both ends are free, for a computation with some values.

    None where these are traced and all nodes of the domain are free, so that nothing is to be eliminated.
    """
    if not is_traced(values):
        return free_couplings(space)
    if (space.free == space.domain).all():
        return None
    axes = _box(space.free)
    if axes is None:
        return free_couplings(space)
    rimmed = [
        np.pad(axis, 1, mode="wrap" if wraps else "constant") for axis, wraps in zip(axes, space.periodic, strict=True)
    ]
    return _outer(
        [np.stack([axis & end[s : s + axis.size] for s in range(3)]) for axis, end in zip(axes, rimmed, strict=True)]
    )


@lru_cache(maxsize=16)
def free_couplings(space: GridSpace) -> Bool[np.ndarray, "offsets *shape"]:
    """Tell for which offsets and nodes both ends are free."""
    free, d = space.free, space.dimension
    for axis, wraps in enumerate(space.periodic):
        widths = [(1, 1) if a == axis else (0, 0) for a in range(d)]
        free = np.pad(free, widths, mode="wrap" if wraps else "constant")
    starts = product((0, 1, 2), repeat=d)
    shape = space.node_shape
    return np.stack(
        [space.free & free[tuple(slice(s, s + n) for s, n in zip(start, shape, strict=True))] for start in starts]
    )


def _box(mask: Bool[np.ndarray, "*shape"]) -> list[Bool[np.ndarray, " _n"]] | None:
    """Return which places along each axis are in a mask, of which it is the product; None if it is not."""
    d = mask.ndim
    axes = [np.asarray(mask.any(axis=tuple(a for a in range(d) if a != axis))) for axis in range(d)]
    return axes if mask[np.ix_(*axes)].all() else None


def _outer(axes: Sequence[Bool[np.ndarray, "_m _n"]]) -> Bool[Array, "ms *ns"]:
    """Return products of what is along each axis, (m₁, n₁), (m₂, n₂), …: (m₁m₂⋯, n₁, n₂, …)."""
    d, shapes = len(axes), np.array([axis.shape for axis in axes]).T
    whole = tuple(map(int, shapes.ravel()))
    result = jnp.ones((), bool)
    if not all(axis.all() for axis in axes):
        # Behind the barrier the compiler does not compute with them, place by place.
        known = jax.lax.optimization_barrier([jnp.asarray(axis) for axis in axes])
        places = [tuple(n if i % d == axis else 1 for i, n in enumerate(whole)) for axis in range(d)]
        result = reduce(jnp.logical_and, [axis.reshape(place) for axis, place in zip(known, places, strict=True)])
    return jnp.broadcast_to(result, whole).reshape(-1, *whole[d:])
