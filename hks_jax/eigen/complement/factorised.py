"""Solves with K − λᵢM on the complement of known eigenvectors, all in JAX.

The method is that of `hks_jax.eigen.complement.common`: conjugate gradients, preconditioned with a factorisation of
K − σM for each group of neighbouring eigenvalues. Groups are made by index and not by value, so that shapes are static:
by Weyl's law eigenvalues are spread evenly enough for that. The factorisations depend on the matrices alone, and serve
all products with a Jacobian at one point.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.eigen.complement.adjoint import Adjoint
from hks_jax.eigen.complement.common import (
    attainable,
    definite_product,
    first_beyond,
    group_numbers,
    norms,
    shifts_between,
    wanted_errors,
)
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.multifrontal import Factorisation, factorise
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import combine, inner_products, products_with_columns

_BLOCK = 16
"""Rows solved at once."""
_CHUNK = 128
"""Rows that the known eigenvectors are taken out of at once."""
_WINDOW = 32
"""Eigenvectors next to a shift that every step takes out."""
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


class FactorisedAdjoint(Adjoint[SymmetricPencil]):
    """Conjugate gradients, preconditioned with a factorisation of K − σM for each group of neighbouring eigenvalues.

    For any pencil that can be factorised: grids, above all in 2D, meshes, sparse matrices.

    Attributes:
        tolerance: to what the error is reduced, in the energy norm, relative to the largest row.
    """

    tolerance: float = eqx.field(default=1e-8, static=True)

    def prepare(self, pencil: SymmetricPencil, values: Float[Array, " p"], k: int) -> Factorisation:
        """Factorise K − σM for each group of the first k of p eigenvalues; the results are stacked."""
        dissection = dissect(pencil.pattern)
        # Compiled without the dissection: what a compiled function hands through is copied.
        return Factorisation(dissection, *_factorise(dissection, pencil, values, k, self.tolerance))

    def solve(
        self,
        prepared: Factorisation,
        pencil: SymmetricPencil,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`."""
        return _solve(prepared, pencil, values, vectors, rhs, self.tolerance)


@partial(jax.jit, static_argnames=("k", "tolerance"))
def _factorise(
    dissection: Dissection, pencil: SymmetricPencil, values: Float[Array, " p"], k: int, tolerance: float
) -> tuple[tuple[Array, ...], tuple[Array, ...], Int[Array, " groups"]]:
    groups = _group(dissection, values, k, tolerance)
    beyond = first_beyond(values)
    shifts = shifts_between(values, beyond - values[groups.last], beyond - values[groups.first])
    factors = jax.lax.map(lambda shift: factorise(dissection, pencil.shifted(shift)), shifts)
    return factors.downward, factors.upward, factors.negative


@partial(jax.jit, static_argnames="tolerance")
def _solve(
    factors: Factorisation,
    pencil: SymmetricPencil,
    values: Float[Array, " p"],
    vectors: Float[Array, "p n_dof"],
    rhs: Float[Array, "k n_dof"],
    tolerance: float,
) -> Float[Array, "k n_dof"]:
    k, beyond, window = rhs.shape[0], first_beyond(values), min(_WINDOW, values.size)
    tolerance, lumped = attainable(tolerance, rhs.dtype), pencil.mass.diagonal()
    of_block = _group(factors.dissection, values, k, tolerance).of_block
    chunks = -(-k // _CHUNK)
    blocks = -(-of_block.size // chunks)
    before = jax.lax.map(lambda b: norms(b[None], lumped)[0], rhs)
    largest = jnp.max(before)

    def taken_out(b: Float[Array, "rows n_dof"]) -> Float[Array, "rows n_dof"]:
        return b - pencil.mass.apply(combine(inner_products(vectors, b), vectors))

    def solve_block(block: tuple[Array, Array, Array, Array]) -> Array:
        g, shifts, b, wanted = block
        matrices = jax.tree.map(lambda stacked: stacked[g], (factors.downward, factors.upward, factors.negative))
        factor = Factorisation(factors.dissection, *matrices)

        nearest = jnp.clip(factor.negative - window // 2, 0, values.size - window)
        near = jax.lax.dynamic_slice_in_dim(vectors, nearest, window)
        near_images = pencil.mass.apply(near)

        # Where r has some φⱼ by rounding, (K − λᵢM)(K − σM)⁻¹ multiplies it by (λⱼ − λᵢ)/(λⱼ − σ): by much for those
        # next to σ alone, which is why no others are taken out before the end.
        def precondition(r: Array) -> Array:
            z = factor.solve_columns(r)
            return z - combine(products_with_columns(near_images, z).T, near).T

        return conjugate_gradients(definite_product(pencil, shifts, beyond), precondition, b.T, wanted).T

    # Known eigenvectors are taken out of many rows at once, and no array but the solution is as large as they are.
    def solve_chunk(chunk: tuple[Array, Array, Array, Array]) -> Array:
        g, at, shifts, before = chunk
        b = rhs.at[at].get(mode="clip")
        left = taken_out(b)
        amplification = beyond / (beyond - shifts)
        wanted = wanted_errors(before, norms(left, lumped), largest, amplification, tolerance, rhs.dtype)
        wanted = jnp.where(at < k, wanted, jnp.inf)
        parts = g, *(x.reshape(blocks, _BLOCK, *x.shape[1:]) for x in (shifts, left, wanted))
        x = jax.lax.map(solve_block, parts).reshape(b.shape)
        return x - combine(inner_products(vectors, pencil.mass.apply(x)), vectors)

    # The last chunk is filled up with rows in which there is nothing to solve.
    at = np.arange(chunks * blocks * _BLOCK).reshape(chunks, -1)
    number = np.pad(of_block, (0, chunks * blocks - of_block.size), mode="edge").reshape(chunks, -1)
    shifts, before = (x[np.minimum(at, k - 1)] for x in (values, before))
    x = jax.lax.map(solve_chunk, (jnp.asarray(number), jnp.asarray(at), shifts, before))
    return x.reshape(at.size, -1)[:k]


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
