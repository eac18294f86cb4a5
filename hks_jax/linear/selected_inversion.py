"""Selected inversion: the entries of the inverse of a sparse symmetric matrix on its sparsity pattern.

The method is that of Takahashi, Fagan and Chin (1973), on the elimination tree. Let A be the block of the nodes that a
front eliminates, let B be the block that couples the front's boundary nodes to them, and let C = BA⁻¹. The inverse G of
the whole matrix has blocks G_own at the eliminated nodes, G_b at the boundary nodes, and G_b,own between both:

    G_own = A⁻¹ + Cᵀ G_b C,    G_b,own = −G_b C.

All boundary nodes of a front belong to its parent front. The recursion therefore goes from the first separator down to
the cells, and each level needs only blocks of G from the level above. The recursion takes about as many operations as
the factorisation, O(N^1.5) in 2D and O(N²) in 3D (Lin and others, SelInv, ACM TOMS 37, 2011).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from hks_jax.linear import lapack
from hks_jax.linear.dissection import Dissection
from hks_jax.linear.multifrontal import eliminate, gather_symmetric, taken
from hks_jax.linear.products import matmul

Eliminated = list[tuple[Inexact[Array, "_fronts _s _s"], Inexact[Array, "_fronts _r _s"]]]
"""The matrices (A⁻¹, BA⁻¹) of the fronts of each level."""


def inverse_entries(
    dissection: Dissection, matrix: Inexact[Array, " m"], diagonal: bool = True
) -> Inexact[Array, " entries"]:
    """Eliminate a symmetric matrix, real or complex (not Hermitian), and return `selected` entries of its inverse.

    The elimination does not pivot between fronts. Elimination without pivoting is safe if the real or imaginary part of
    the matrix is definite, because then no Schur complement is singular. The function is differentiable in both modes;
    reverse mode stores several copies of the factors.
    """
    return selected(dissection, eliminate(dissection, matrix, lambda blocks, _: _inverses(blocks)), diagonal)


def selected(dissection: Dissection, eliminated: Eliminated, diagonal: bool) -> Inexact[Array, " m"]:
    """Return the inverse's diagonal (n_dof,), or its blocks (fronts, s + r, s) as in `Dissection.places`."""
    parts = []
    known: Array | None = None
    for number, (level, (inverse, coupling)) in enumerate(zip(dissection.levels, eliminated, strict=True)):
        boundary = jnp.zeros((1, 0, 0), inverse.dtype)
        if known is not None:
            boundary = gather_symmetric(known, jnp.asarray(level.boundary)[None])[0]
        beside = -matmul(boundary, coupling)
        last = number == len(dissection.levels) - 1
        if diagonal and last:  # cells need only their diagonal
            own = jnp.diagonal(inverse, axis1=1, axis2=2) - jnp.sum(coupling * beside, axis=1)
        else:
            block = inverse - matmul(coupling.mT, beside)
            if not last:
                known = jnp.block([[block, beside.mT], [beside, boundary]])
            own = jnp.diagonal(block, axis1=1, axis2=2) if diagonal else jnp.concatenate([block, beside], axis=1)
        parts.append(own.reshape(-1))
    whole = jnp.concatenate(parts)
    return taken(whole, dissection.order) if diagonal else whole


def inversion_cost(dissection: Dissection) -> tuple[float, float]:
    """Estimate the number of floating-point operations of a complex selected inversion, and of entries in memory."""
    operations = entries = most = 0.0
    for level in dissection.levels:
        fronts, whole, s = level.shape
        r = whole - s
        operations += 8.0 * fronts * s * (s * s + 2 * s * r + 2 * r * r)
        entries += fronts * whole * s
        most = max(most, fronts * whole * whole)
    return operations, entries + 2 * most


@jax.custom_jvp
def _inverses(matrices: Inexact[Array, "m n n"]) -> Inexact[Array, "m n n"]:
    return jax.vmap(lapack.inverse)(matrices)


@_inverses.defjvp
def _inverses_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # Since d(A⁻¹) = −A⁻¹ dA A⁻¹ contains only A⁻¹ and dA, reverse mode stores only the inverse A⁻¹.
    inverse = _inverses(*primals)
    return inverse, -matmul(inverse, *tangents, inverse)
