"""Finite differences of nodal values along a grid axis: derivatives of polynomials that fit a row of nodes."""

from fractions import Fraction
from functools import lru_cache
from math import factorial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.traced import is_traced

NODES = {2: 7, 4: 11, 6: 13}
"""The number of nodes of a row, for derivatives up to the second, fourth and sixth order."""
_LOWER = 2
"""The greatest reduction of the order of accuracy."""
DEGREE = 4
"""The degree of the polynomial in a row near a side, for the first and second derivative."""


# The polynomial of a centred row interpolates, and by symmetry derivatives of even order gain an order of convergence.
# A polynomial that interpolates one-sidedly amplifies noise 10 times more. So near sides the polynomial has a lower
# degree than the number of nodes allows, and fits in the sense of least squares: of all weights that are exact for
# polynomials of this degree, its weights have the least Euclidean norm. The norm is the factor from the standard
# deviation of independent noise to that of the derivative. For the second derivative, the norm is 3.5 in a centred row
# and 4.4, 1.6 and 0.6 at the first, second and third node of a shifted row.
#
# For the fourth and sixth derivative, a shifted row would either amplify noise or have a truncation error that only
# very fine grids make small. These derivatives have centred rows only.
@lru_cache
def stencils(highest: int, lower: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the stencils of the derivatives up to the order `highest`: the centred one first, others by their shift.

    The order of accuracy is lower by 2 · `lower` in the centred row, which leaves out `lower` nodes at each end, and by
    `lower` in the others.

    Row i of the offsets (n, nodes) and entry [i, order] of the weights (n, highest + 1, nodes) belong to stencil i, for
    unit spacing.
    """
    n = NODES[highest]
    shifts = sorted(range(-n + 1, 1), key=lambda shift: abs(2 * shift + n - 1)) if highest == 2 else [-(n // 2)]
    offsets = np.add.outer(shifts, np.arange(n)).astype(np.int32)
    inner = slice(lower, n - lower)
    centred = np.pad(_weights(offsets[0][inner], n - 1 - 2 * lower, highest), ((0, 0), (lower, lower)))
    return offsets, np.stack([centred, *(_weights(run, DEGREE - lower, highest) for run in offsets[1:])])


def _weights(run: np.ndarray, degree: int, highest: int) -> Float[np.ndarray, "orders nodes"]:
    """Return the weights of the derivatives at 0 of the polynomial that is fitted to a row of nodes."""
    # Polynomials pᵢ, orthogonal on the row, give the weights Σᵢ pᵢ⁽ᵏ⁾(0) pᵢ(x)/⟨pᵢ, pᵢ⟩. Fractions make them exact:
    # rounded weights would not annihilate constants, and the sixth derivative would amplify this error.
    powers = np.array([[Fraction(int(x)) ** k for k in range(degree + 1)] for x in run])
    total = np.zeros((degree + 1, len(run)), dtype=object)
    known: list[tuple[np.ndarray, np.ndarray]] = []
    for coefficients, values in zip(np.eye(degree + 1, dtype=int).astype(object), powers.T, strict=True):
        for c, v in known:
            share = (values @ v) / (v @ v)
            coefficients, values = coefficients - share * c, values - share * v
        known.append((coefficients, values))
        total = total + np.outer(coefficients, values / (values @ values))
    return np.array([factorial(k) * total[k] for k in range(highest + 1)], dtype=float)


def differentiate(
    values: Float[Array, "*shape_and_components"],
    inside: Bool[np.ndarray, "*shape"],
    axis: int,
    orders: range,
    highest: int,
    spacing: float,
    wraps: bool,
    lower: Any = 0,
) -> tuple[list[Float[Array, "*shape_and_components"]], Bool[np.ndarray, "*shape"]]:
    """Return derivatives of nodal values along a grid axis, one per order, and the nodes where they are known.

    `lower` is that of `stencils`, at most 2, and may be traced. Only values at nodes inside the domain are used.
    Derivatives are 0 where no stencil of `highest` lies in the domain.
    """
    offsets, tables_of = stencils(highest)[0], np.stack([stencils(highest, i)[1] for i in range(_LOWER + 1)])
    weights = jnp.asarray(tables_of, values.dtype)[lower] if is_traced(lower) else tables_of[lower]
    n, d = inside.shape[axis], inside.ndim
    along = [n if a == axis else 1 for a in range(d)]
    # Without a mask, all grid lines along the axis have the same stencils, which are chosen for one line.
    choice, valid = _choose(np.ones(along, dtype=bool) if inside.all() else inside, offsets, axis, wraps)
    expand = tuple(range(d, jnp.ndim(values)))
    rows = np.expand_dims(choice, expand)
    nodes = np.expand_dims(np.arange(n, dtype=np.int32).reshape(along), expand)
    shifts, totals = jnp.asarray(offsets), [jnp.zeros_like(values) for _ in orders]
    tables = [jnp.asarray(weights[:, order] / spacing**order, values.dtype) for order in orders]
    for column in range(offsets.shape[1]):
        neighbours = jnp.take_along_axis(values, (nodes + shifts[rows, column]) % n, axis=axis)
        totals = [total + table[rows, column] * neighbours for total, table in zip(totals, tables, strict=True)]
    valid = np.broadcast_to(valid, inside.shape)
    # Unknown derivatives are zero and not NaN, since 0·NaN would spoil the gradient of known derivatives.
    return [jnp.where(np.expand_dims(valid, expand), total, 0) for total in totals], valid


def centred_nodes(inside: Bool[np.ndarray, "*shape"], wraps: tuple[bool, ...]) -> Bool[np.ndarray, "*shape"]:
    """Return the nodes at which the first and second derivative along each axis have the centred row."""
    offsets = stencils(2)[0]
    return np.logical_and.reduce([_choose(inside, offsets, axis, w)[0] == 0 for axis, w in enumerate(wraps)])


def _choose(
    inside: np.ndarray, offsets: np.ndarray, axis: int, wraps: bool
) -> tuple[np.ndarray, Bool[np.ndarray, "*shape"]]:
    """Return for each node the first stencil with all nodes inside, or 0, and whether such a stencil exists."""
    reach = int(np.abs(offsets).max())
    width = [(reach, reach) if a == axis else (0, 0) for a in range(inside.ndim)]
    padded = np.pad(inside, width, mode="wrap") if wraps else np.pad(inside, width)
    n = inside.shape[axis]

    def shifted(offset: np.integer) -> np.ndarray:
        return padded.take(np.arange(reach + offset, reach + offset + n), axis=axis)

    fits = [np.logical_and.reduce([shifted(offset) for offset in run]) for run in offsets]
    return np.argmax(fits, axis=0).astype(np.int32), np.logical_or.reduce(fits)
