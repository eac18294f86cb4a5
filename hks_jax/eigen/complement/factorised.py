"""Solves with K − λᵢM on the complement of known eigenvectors, all in JAX.

The method is that of `hks_jax.eigen.complement.common`: conjugate gradients, preconditioned with a factorisation of
K − σM for each group of neighbouring eigenvalues. Groups are made by index and not by value, so that shapes are static:
by Weyl's law eigenvalues are spread evenly enough for that. The factorisations depend on the matrices alone, and serve
all products with a Jacobian at one point.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.eigen.complement.adjoint import Adjoint
from hks_jax.eigen.complement.common import (
    amplification,
    attainable,
    definite_product,
    first_beyond,
    group_numbers,
    shifts_between,
)
from hks_jax.eigen.complement.in_blocks import cleaned, projected, solve_in_blocks, without_known
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.multifrontal import Factorisation, factorise
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import products_with_columns, times

BLOCK = 16
"""Rows solved at once."""
WINDOW = 32
"""Eigenvectors next to a shift that every step takes out."""
_GROWTH = 4e7
"""By what rounding in the direction of known eigenvectors grows at most: 1e4 to 1e5 as a rule, measured."""
_MEMORY = 5e8
"""Bytes that factorisations may take together."""


Factors = tuple[tuple[Array, ...], tuple[Array, ...], Int[Array, " groups"]]


class Groups(NamedTuple):
    """How rows are grouped; static.

    Attributes:
        first: (groups,) the first row of each group.
        last: (groups,) its last row.
    """

    first: Int[np.ndarray, " groups"]
    last: Int[np.ndarray, " groups"]


class FactorisedAdjoint(Adjoint[SymmetricPencil]):
    """Conjugate gradients, preconditioned with a factorisation of K − σM for each group of neighbouring eigenvalues.

    For any pencil that can be factorised: grids, above all in 2D, meshes, sparse matrices.

    Attributes:
        tolerance: to what the error is reduced, in the energy norm, relative to the largest row.
        solves: how often one preparation serves, about. Many solves are worth more factorisations.
    """

    tolerance: float = eqx.field(default=1e-8, static=True)
    solves: int = eqx.field(default=1, static=True)

    def prepare(self, pencil: SymmetricPencil, values: Float[Array, " p"], k: int) -> Factorisation:
        """Factorise K − σM for each group of the first k of p eigenvalues; the results are stacked."""
        dissection = dissect(pencil.pattern)
        # Compiled without the dissection: what a compiled function hands through is copied.
        return Factorisation(dissection, *_factorise(dissection, pencil, values, k, self))

    def solve(
        self,
        prepared: Factorisation,
        pencil: SymmetricPencil,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`."""
        return _solve(prepared, pencil, values, vectors, rhs, self)


@partial(jax.jit, static_argnames=("k", "adjoint"))
def _factorise(
    dissection: Dissection, pencil: SymmetricPencil, values: Float[Array, " p"], k: int, adjoint: FactorisedAdjoint
) -> Factors:
    groups = _group(dissection, values, k, adjoint)
    beyond = first_beyond(values)
    shifts = shifts_between(values, beyond - values[groups.last], beyond - values[groups.first])
    return factorise_each(dissection, pencil, shifts)


def factorise_each(dissection: Dissection, pencil: SymmetricPencil, shifts: Float[Array, " groups"]) -> Factors:
    """Return the fields of the stacked factorisations of K − σM, without the dissection."""
    factors = jax.lax.map(lambda shift: factorise(dissection, pencil.shifted(shift)), shifts)
    return factors.downward, factors.upward, factors.negative


def one_of(factors: Factorisation, group: Int[Array, ""]) -> Factorisation:
    """Return one of the stacked factorisations."""
    matrices = jax.tree.map(lambda stacked: stacked[group], (factors.downward, factors.upward, factors.negative))
    return Factorisation(factors.dissection, *matrices)


@partial(jax.jit, static_argnames="adjoint")
def _solve(
    factors: Factorisation,
    pencil: SymmetricPencil,
    values: Float[Array, " p"],
    vectors: Float[Array, "p n_dof"],
    rhs: Float[Array, "k n_dof"],
    adjoint: FactorisedAdjoint,
) -> Float[Array, "k n_dof"]:
    k, beyond, window = rhs.shape[0], first_beyond(values), min(WINDOW, values.size)
    tolerance = attainable(adjoint.tolerance, rhs.dtype)
    clean = without_known(pencil, vectors)

    def of_group(group: Int[Array, ""]) -> tuple[Factorisation, Array, Array]:
        factor = one_of(factors, group)
        nearest = jnp.clip(factor.negative - window // 2, 0, values.size - window)
        near = jax.lax.dynamic_slice_in_dim(vectors, nearest, window)
        return factor, near.T, pencil.mass.apply(near)

    def solve_block(group: tuple[Factorisation, Array, Array], b: Array, wanted: Array, shifts: Array) -> Array:
        factor, near, near_images = group

        # Where r has some φⱼ by rounding, (K − λᵢM)(K − σM)⁻¹ multiplies it by (λⱼ − λᵢ)/(λⱼ − σ): by much for those
        # next to σ above all, which is why no others are taken out before the end, or before that makes it start again.
        def precondition(r: Array) -> Array:
            z = factor.solve_columns(r)
            return z - times(near, products_with_columns(near_images, z))

        product = definite_product(pencil, shifts, beyond)
        return conjugate_gradients(product, precondition, b, wanted, clean=clean).converged

    left, wanted = projected(pencil, vectors, rhs, tolerance, amplification(values, k))
    first = _group(factors.dissection, values, k, adjoint).first
    x = solve_in_blocks(of_group, solve_block, BLOCK, first, left, wanted, values[:k])
    return x if _GROWTH * jnp.finfo(rhs.dtype).eps <= tolerance else cleaned(pencil, vectors, x)


def _group(dissection: Dissection, values: Float[Array, " p"], k: int, adjoint: FactorisedAdjoint) -> Groups:
    """Group blocks of rows whose distance from Λ, by Weyl's law in 2D, is of one order."""

    def distance(row: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        return values.size + 1 - row

    return group_blocks(dissection, distance, values.dtype, k, adjoint.tolerance, adjoint.solves)


def group_blocks(
    dissection: Dissection,
    distance_of: Callable[[Float[np.ndarray, " m"]], Float[np.ndarray, " m"]],
    dtype: np.dtype,
    k: int,
    tolerance: float,
    solves: int = 1,
) -> Groups:
    """Group blocks of the rows 0 … k−1, each by what its middle row has for a distance; see `group_numbers`."""
    start = np.arange(0, k, BLOCK)
    end = np.minimum(start + BLOCK, k)
    distance = distance_of((start + end - 1) / 2)
    entries = sum(own.size * (own.shape[1] + 2 * boundary.shape[1]) for own, boundary, *_ in dissection.levels)
    room = max(int(_MEMORY / (entries * dtype.itemsize)), 1)
    number = group_numbers(distance, k * solves, attainable(tolerance, dtype), room)
    _, first = np.unique(number, return_index=True)
    return Groups(start[first], np.append(start[first[1:]], k) - 1)
