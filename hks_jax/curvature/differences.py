"""Sixth-order differences of nodal values: at each node the most central stencil that fits in the domain."""

from functools import lru_cache
from math import factorial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

MINIMUM_NODES = 8
"""The widest stencil: a one-sided second derivative of sixth order."""


@lru_cache
def stencils(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the stencils of sixth order for the derivative of the given order, 1 or 2, in order of preference.

    A centred stencil of 7 nodes gains an order from its symmetry when the derivative is the second; shifted ones
    need 8 there.

    Returns:
        offsets, int (n, 8), and weights, float64 (n, 8), for unit spacing; shorter stencils are padded with offset 0
        and weight 0.
    """
    width = 6 + order
    centred = np.arange(-3, 4)
    shifted = [run for s in range(-width + 1, 1) if not set(centred) <= set(run := np.arange(s, s + width))]
    runs = [centred, *sorted(shifted, key=lambda run: abs(run.sum()))]
    offsets = np.zeros((len(runs), MINIMUM_NODES), dtype=np.int32)
    weights = np.zeros((len(runs), MINIMUM_NODES))
    for row, run in enumerate(runs):
        for column, node in enumerate(run):
            # The derivative at 0 of the Lagrange polynomial of this node; products of small integers are exact.
            others = run[run != node]
            offsets[row, column] = node
            weights[row, column] = factorial(order) * np.poly(others)[-1 - order] / np.prod(node - others)
    return offsets, weights


def differentiate(
    values: Float[Array, "*shape_and_components"],
    inside: Bool[np.ndarray, "*shape"],
    axis: int,
    order: int,
    spacing: float,
    wraps: bool,
) -> tuple[Float[Array, "*shape_and_components"], Bool[np.ndarray, "*shape"]]:
    """Differentiate nodal values along one grid axis.

    Args:
        values: (*shape, …) nodal values, possibly tensors.
        inside: the nodes that may be read.
        axis: the grid axis.
        order: 1 or 2.
        spacing: the distance between nodes along the axis.
        wraps: whether the axis is periodic, with node n equal to node 0.

    Returns:
        the derivative, 0 where no stencil fits, and the nodes where one does, bool (*shape).
    """
    offsets, weights = stencils(order)
    n, d = inside.shape[axis], inside.ndim
    along = [n if a == axis else 1 for a in range(d)]
    # Without a mask all grid lines are alike, and one line of indices serves them all.
    choice, valid = _choose(np.ones(along, dtype=bool) if inside.all() else inside, offsets, axis, wraps)
    expand = tuple(range(d, jnp.ndim(values)))
    rows = np.expand_dims(choice, expand)
    nodes = np.expand_dims(np.arange(n, dtype=np.int32).reshape(along), expand)
    table, shifts = jnp.asarray(weights / spacing**order, values.dtype), jnp.asarray(offsets)
    total = jnp.zeros_like(values)
    for column in range(MINIMUM_NODES):
        index = (nodes + shifts[rows, column]) % n
        total += table[rows, column] * jnp.take_along_axis(values, index, axis=axis)
    valid = np.broadcast_to(valid, inside.shape)
    # Zero and not NaN where nothing is known: NaN here would survive, as 0·NaN, in the gradient of what is known.
    return jnp.where(np.expand_dims(valid, expand), total, 0), valid


def _choose(
    inside: np.ndarray, offsets: np.ndarray, axis: int, wraps: bool
) -> tuple[np.ndarray, Bool[np.ndarray, "*shape"]]:
    """Return the first stencil all of whose nodes are inside (0 where none is), and where there is one."""
    reach = MINIMUM_NODES - 1
    width = [(reach, reach) if a == axis else (0, 0) for a in range(inside.ndim)]
    padded = np.pad(inside, width, mode="wrap") if wraps else np.pad(inside, width)
    n = inside.shape[axis]

    def shifted(offset: np.integer) -> np.ndarray:
        return padded.take(np.arange(reach + offset, reach + offset + n), axis=axis)

    fits = [np.logical_and.reduce([shifted(offset) for offset in run]) for run in offsets]
    return np.argmax(fits, axis=0).astype(np.int32), np.logical_or.reduce(fits)
