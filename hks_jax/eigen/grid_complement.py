"""Solves with K − λᵢM on the complement of known eigenvectors of a grid's pencil, all in JAX.

The method is that of `hks_jax.eigen.complement`: conjugate gradients, preconditioned with a factorisation of K − σM for
each group of neighbouring eigenvalues. Groups are made by index and not by value, so that shapes are static: by Weyl's
law eigenvalues are spread evenly enough for that. The factorisations depend on the matrices alone, and serve all
products with a Jacobian at one point.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.eigen.complement import group_numbers
from hks_jax.eigen.conjugate_gradients import conjugate_gradients, first_beyond
from hks_jax.eigen.dissection import Dissection, dissect
from hks_jax.eigen.multifrontal import Factorisation, factorise
from hks_jax.eigen.products import combine, inner_products
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import GridSpace

_BLOCK = 32
"""Rows solved at once."""
_MEMORY = 5e8
"""Bytes that factorisations may take together."""


class _Groups(NamedTuple):
    """How rows are grouped; static.

    Attributes:
        of_block: (blocks,) the group of each block of rows.
        first: (groups,) the first row of each group.
        last: (groups,) its last row.
    """

    of_block: Int[np.ndarray, " blocks"]
    first: Int[np.ndarray, " groups"]
    last: Int[np.ndarray, " groups"]


def prepare(pencil: Pencil, values: Float[Array, " p"], k: int, tolerance: float) -> Factorisation:
    """Factorise K − σM for each group of the first k of p eigenvalues; the results are stacked."""
    assert isinstance(pencil.space, GridSpace)
    dissection = dissect(pencil.space)
    groups = _group(dissection, values, k, tolerance)
    # Between the distances a and b from Λ the geometric mean leaves the least condition.
    beyond = first_beyond(values)
    targets = beyond - jnp.sqrt((beyond - values[groups.first]) * (beyond - values[groups.last]))
    factors = jax.lax.map(partial(factorise, dissection, pencil), _apart(values, targets))
    return Factorisation(dissection, factors.downward, factors.upward, factors.negative)


@partial(jax.jit, static_argnames="tolerance")
def solve(
    factors: Factorisation,
    pencil: Pencil,
    values: Float[Array, " p"],
    vectors: Float[Array, "p n_dof"],
    rhs: Float[Array, "k n_dof"],
    tolerance: float,
) -> Float[Array, "k n_dof"]:
    """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; rows that do not converge are NaN.

    Args:
        factors: from `prepare`, for as many rows.
        pencil: K and M.
        values: (p,) the lowest eigenvalues, ascending.
        vectors: (p, n_dof) their M-orthonormal eigenvectors Φ; Q = I − MΦΦᵀ.
        rhs: (k, n_dof), k ≤ p; row i belongs to λᵢ.
        tolerance: reduction of the error in the energy norm, relative to the largest row.
    """
    k, beyond = rhs.shape[0], first_beyond(values)
    # What rounded eigenvectors leave to be solved beyond their own accuracy is noise.
    tolerance = max(tolerance, 100 * float(jnp.finfo(rhs.dtype).eps))
    images = jax.lax.map(pencil.mass.apply, vectors, batch_size=_BLOCK)
    rhs = rhs - combine(inner_products(vectors, rhs), images)
    size = jnp.sqrt(jnp.sum(rhs * rhs / pencil.mass.diagonal(), axis=1))
    # Small rows need fewer digits, or none; where λᵢ is near Λ the operator amplifies more.
    share = size / jnp.maximum(jnp.max(size), jnp.finfo(rhs.dtype).tiny) * (beyond / (beyond - values[:k]))
    wanted = jnp.where(share > tolerance, jnp.minimum(tolerance / jnp.maximum(share, tolerance), 0.1), jnp.inf)

    of_block = _group(factors.dissection, values, k, tolerance).of_block
    blocks = of_block.size
    spare = blocks * _BLOCK - k  # rows that fill the last block up, with nothing to solve

    def solve_block(block: tuple[Array, Array, Array, Array]) -> Array:
        g, shifts, b, wanted = block
        matrices = jax.tree.map(lambda stacked: stacked[g], (factors.downward, factors.upward, factors.negative))
        factor = Factorisation(factors.dissection, *matrices)

        def precondition(r: Array) -> Array:
            z = factor.solve(r)
            return z - combine(inner_products(images, z), vectors)

        return conjugate_gradients(pencil, precondition, shifts, b, wanted, beyond)

    parts = (
        jnp.asarray(of_block),
        jnp.pad(values[:k], (0, spare)).reshape(blocks, _BLOCK),
        jnp.pad(rhs, ((0, spare), (0, 0))).reshape(blocks, _BLOCK, -1),
        jnp.pad(wanted, (0, spare), constant_values=jnp.inf).reshape(blocks, _BLOCK),
    )
    return jax.lax.map(solve_block, parts).reshape(blocks * _BLOCK, -1)[:k]


def _group(dissection: Dissection, values: Float[Array, " p"], k: int, tolerance: float) -> _Groups:
    """Group blocks of the rows 0 … k−1 whose distance from Λ, by Weyl's law in 2D, is of one order."""
    start = np.arange(0, k, _BLOCK)
    end = np.minimum(start + _BLOCK, k)
    distance = values.size + 1 - (start + end - 1) / 2
    entries = sum(own.size * (own.shape[1] + 2 * boundary.shape[1]) for own, boundary, *_ in dissection.levels)
    room = max(int(_MEMORY / (entries * values.dtype.itemsize)), 1)
    number = group_numbers(distance, k, tolerance, room)
    _, first, of_block = np.unique(number, return_index=True, return_inverse=True)
    return _Groups(of_block, start[first], np.append(start[first[1:]], k) - 1)


def _apart(values: Float[Array, " p"], targets: Float[Array, " groups"]) -> Float[Array, " groups"]:
    """Return the middles of gaps in the spectrum near the targets, so that no shift is an eigenvalue."""
    below = -0.1 * jnp.where(values[-1] > 0, values[-1], 1)
    if values.size == 1:
        return jnp.broadcast_to(below, targets.shape)
    gaps = jnp.diff(values)
    typical = (values[-1] - values[0]) / (values.size - 1)
    distance = jnp.abs(values[:-1] + gaps / 2 - targets[:, None])
    nearest = jnp.argmin(jnp.where(gaps >= 0.1 * typical, distance, jnp.inf), axis=1)
    return jnp.where(typical > 0, values[nearest] + gaps[nearest] / 2, below)
