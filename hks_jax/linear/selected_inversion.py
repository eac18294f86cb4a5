"""The inverse of a sparse symmetric matrix, where the matrix has entries: selected inversion.

Takahashi, Fagan and Chin (1973), here on the elimination tree. Once a front with own block A and coupling B to its
boundary is eliminated, the inverse G of the whole matrix satisfies there, with C = BA⁻¹,

    G_own = A⁻¹ + Cᵀ G_b C,    G_b,own = −G_b C,

G_b its block at the boundary. A front's boundary lies among the own and boundary nodes of the front above it, so that
from the first separator down to the cells each level finds what it needs in the one above. That takes about as many
operations as the factorisation, O(N^1.5) in 2D and O(N²) in 3D: L. Lin and others, SelInv, ACM Trans. Math. Softw. 37
(2011).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from hks_jax.linear import lapack
from hks_jax.linear.dissection import Dissection
from hks_jax.linear.multifrontal import eliminate, gather_symmetric, taken
from hks_jax.linear.products import matmul, transposed

Eliminated = list[tuple[Inexact[Array, "_fronts _s _s"], Inexact[Array, "_fronts _r _s"]]]
"""(A⁻¹, BA⁻¹) of each level's fronts."""


class Cost(NamedTuple):
    """What selected inversion of one matrix takes."""

    operations: float  # floating-point operations in complex arithmetic
    entries: float  # how many numbers are kept at once: the factors, and the inverse on two levels


def diagonal_of_inverse(dissection: Dissection, matrix: Inexact[Array, " m"]) -> Inexact[Array, " n_dof"]:
    """Return the diagonal of the inverse of a symmetric matrix, real or complex (not Hermitian).

    There is no pivoting from one front to the next: for matrices whose real or imaginary part is definite, of which no
    Schur complement is singular. Differentiable in both modes; for the transpose some copies of the factors are kept.
    """
    return selected(dissection, eliminated_differentiably(dissection, matrix), diagonal=True)


def eliminated_differentiably(dissection: Dissection, matrix: Inexact[Array, " m"]) -> Eliminated:
    """Return what `eliminate` does, with blocks inverted by a rule that is differentiable any number of times."""
    return eliminate(dissection, matrix, lambda blocks, _: _inverses(blocks))


def selected(dissection: Dissection, eliminated: Eliminated, diagonal: bool) -> Inexact[Array, " m"]:
    """Return the inverse's diagonal, (n_dof,), or its columns (fronts, s + r, s) as `Dissection.places` counts them."""
    parts = []
    known: Array | None = None
    for number, (level, (inverse, coupling)) in enumerate(zip(dissection.levels, eliminated, strict=True)):
        boundary = jnp.zeros((1, 0, 0), inverse.dtype)
        if known is not None:
            boundary = gather_symmetric(known, jnp.asarray(level.boundary)[None])[0]
        beside = -matmul(boundary, coupling)
        last = number == len(dissection.levels) - 1
        if diagonal and last:  # of the cells, nothing else is wanted
            own = jnp.diagonal(inverse, axis1=1, axis2=2) - jnp.sum(coupling * beside, axis=1)
        else:
            block = inverse - matmul(transposed(coupling), beside)
            if not last:
                known = jnp.block([[block, transposed(beside)], [beside, boundary]])
            own = jnp.diagonal(block, axis1=1, axis2=2) if diagonal else jnp.concatenate([block, beside], axis=1)
        parts.append(own.reshape(-1))
    whole = jnp.concatenate(parts)
    return taken(whole, dissection.order) if diagonal else whole


def inversion_cost(dissection: Dissection) -> Cost:
    """Estimate what `diagonal_of_inverse` takes."""
    operations = entries = most = 0.0
    for level in dissection.levels:
        fronts, whole, s = level.shape
        r = whole - s
        operations += 8.0 * fronts * s * (s * s + 2 * s * r + 2 * r * r)
        entries += fronts * whole * s
        most = max(most, fronts * whole * whole)
    return Cost(operations, entries + 2 * most)


@jax.custom_jvp
def _inverses(matrices: Inexact[Array, "m n n"]) -> Inexact[Array, "m n n"]:
    return jax.vmap(lapack.inverse)(matrices)


@_inverses.defjvp
def _inverses_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # d(A⁻¹) = −A⁻¹ dA A⁻¹: nothing but the inverse is kept for the transpose.
    inverse = _inverses(*primals)
    return inverse, -matmul(inverse, *tangents, inverse)
