"""All eigenpairs of a dense symmetric pencil, with derivatives that are finite where eigenvalues are equal."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hks_jax.checks import require_number
from hks_jax.linear import lapack
from hks_jax.linear.standard_form import checked_standard_form, transposed_solve


class DenseEigenpairs(NamedTuple):
    """Eigenpairs of a dense symmetric matrix or pencil: ``values, vectors = hj.eigh(A)``."""

    eigenvalues: Float[Array, " n"]
    """Ascending."""
    eigenvectors: Float[Array, "n n"]
    """One in each column, orthonormal, or with vᵢᵀBvⱼ = δᵢⱼ."""


def eigh(A: Any, B: Any = None, *, multiplet_tolerance: float | None = None) -> DenseEigenpairs:
    """Compute all eigenpairs of Av = λv, or of Av = λBv, of dense symmetric matrices, differentiably.

    Derivatives, forward and reverse, are never NaN. They are exact, also at multiple eigenvalues, for functions of
    whole multiplets: sums of f(λ) over all copies, such as tr f(A), and the projectors on eigenspaces. Where an
    eigenvalue is simple, they are those of its own eigenvalue and eigenvector.

    The derivative of one eigenvector of a multiple eigenvalue does not exist: here it is that which has no rotation
    within the eigenspace; and that of one of its eigenvalues is one diagonal entry of VᵀȦV. **From these the derivative
    of V f(Λ) Vᵀ does not come out at a multiple eigenvalue: use `matrix_function`**, which is exact everywhere. No rule
    could do it: at A = I the derivative along Ȧ is f'(1) Ȧ, but what Λ̇ and a rotation of V give is diagonal in V.

    Nearly equal eigenvalues have eigenvectors that are accurate to about ε|λ|/gap, and so are their derivatives here.
    What is computed from a whole cluster loses these digits too, unless `multiplet_tolerance` declares it a multiplet.

    Second derivatives are exact where all eigenvalues are simple, and NaN elsewhere.

    Args:
        A: (n, n), symmetric, float32 or float64. Derivatives are those of its symmetric part.
        B: (n, n), symmetric positive definite; None: the identity.
        multiplet_tolerance: eigenvalues nearer to each other than this, relative to the largest magnitude, count as
            equal in derivatives. None: 4nε, about as much as rounding moves them apart.

    Returns:
        (n,) eigenvalues, ascending, and (n, n) eigenvectors in columns.

    Raises:
        ValueError: entries that are NaN or infinite, complex or of another precision; shapes that are not square or
            differ; a matrix that is unsymmetric by more than √ε of its largest entry (by how much, and where); B not
            positive definite. What is traced cannot be looked at: there NaN comes out, and the symmetric part is taken.
    """
    if multiplet_tolerance is not None:
        require_number("multiplet_tolerance", multiplet_tolerance, 1, inclusive=True)
    a, factor = checked_standard_form(A, B)
    tolerance = 4 * len(a) * float(jnp.finfo(a.dtype).eps) if multiplet_tolerance is None else multiplet_tolerance
    values, vectors = differentiable_eigh(float(tolerance), a)
    return DenseEigenpairs(values, vectors if factor is None else transposed_solve(factor, vectors))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def differentiable_eigh(
    tolerance: float | None, a: Float[Array, "n n"]
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Return the eigenvalues of a symmetric matrix, ascending, and orthonormal eigenvectors in columns.

    With a tolerance, derivatives are those of `eigh`. Without one they are NaN where eigenvalues are equal.
    """
    return lapack.eigh(a)


# From AV = VΛ and VᵀV = I, with G = VᵀȦV,
#
#     λ̇ᵢ = Gᵢᵢ,    V̇ = VΩ,    Ωᵢⱼ = Gᵢⱼ/(λⱼ − λᵢ) for i ≠ j.
#
# Ω is antisymmetric, and what it does between vectors of one eigenspace cancels in the derivative of VₑVₑᵀ, the
# projector on it: there it may be set to zero. So may it in that of tr f(A) = Σ f(λᵢ), where no vector enters. The
# derivative of 1/gap, which second derivatives take, is NaN there: a sum like Σᵢ f'(λᵢ) Gᵢᵢ changes with what this rule
# leaves out.
@differentiable_eigh.defjvp
def _eigh_jvp(tolerance: float | None, primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple, tuple]:
    values, vectors = differentiable_eigh(tolerance, primals[0])
    change = jnp.matmul(tangents[0], vectors, precision="highest")
    change = jnp.matmul(vectors.T, change, precision="highest")
    rotation = (change + change.T) / 2 * _inverse_gaps(tolerance, values)
    return (values, vectors), (jnp.diagonal(change), jnp.matmul(vectors, rotation, precision="highest"))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _inverse_gaps(tolerance: float | None, values: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Return 1/(λⱼ − λᵢ), and 0, or without a tolerance NaN, where λᵢ and λⱼ count as equal."""
    gap, apart = _gaps(tolerance, values)
    equal = 0 if tolerance is not None else jnp.where(jnp.eye(len(values), dtype=bool), 0, jnp.nan)
    return jnp.where(apart, 1 / jnp.where(apart, gap, 1), equal)


@_inverse_gaps.defjvp
def _inverse_gaps_jvp(tolerance: float | None, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    values, change = primals[0], tangents[0]
    gap, apart = _gaps(tolerance, values)
    slope = jnp.where(apart, -1 / jnp.square(jnp.where(apart, gap, 1)), jnp.nan)
    slope = jnp.where(jnp.eye(len(values), dtype=bool), 0, slope)
    return _inverse_gaps(tolerance, values), slope * (change[None] - change[:, None])


def _gaps(tolerance: float | None, values: Float[Array, " n"]) -> tuple[Float[Array, "n n"], Bool[Array, "n n"]]:
    """Return λⱼ − λᵢ in row i and column j, and where it is not zero but for the tolerance."""
    gap = values[None] - values[:, None]
    return gap, jnp.abs(gap) > (tolerance or 0) * jnp.max(jnp.abs(values))
