"""Dense symmetric pencils: all eigenpairs, with derivatives that are finite where eigenvalues are equal.

A pencil becomes a matrix by Cholesky's factorisation.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.checks import real_array, require_number
from hks_jax.linear import lapack
from hks_jax.linear.products import matmul
from hks_jax.traced import is_traced

Matrix = Float[Array, "n n"]
Values = Float[Array, " n"]


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
def differentiable_eigh(tolerance: float | None, a: Matrix) -> tuple[Values, Matrix]:
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
    change = matmul(vectors.T, matmul(tangents[0], vectors))
    rotation = (change + change.T) / 2 * _inverse_gaps(tolerance, values)
    return (values, vectors), (jnp.diagonal(change), matmul(vectors, rotation))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _inverse_gaps(tolerance: float | None, values: Values) -> Matrix:
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


def _gaps(tolerance: float | None, values: Values) -> tuple[Matrix, Bool[Array, "n n"]]:
    """Return λⱼ − λᵢ in row i and column j, and where it is not zero but for the tolerance."""
    gap = values[None] - values[:, None]
    return gap, jnp.abs(gap) > (tolerance or 0) * jnp.max(jnp.abs(values))


@jax.custom_jvp
def standard_form(a: Matrix, b: Matrix) -> tuple[Matrix, Matrix]:
    """Return L⁻¹AL⁻ᵀ and the lower triangular L of B = LLᵀ; NaN where B is not positive definite.

    Where w is an eigenvector of the first, L⁻ᵀw is one of Av = λBv.
    """
    factor = lapack.cholesky(b)
    half = lapack.triangular_solve(factor, a)
    return lapack.triangular_solve(factor, half.T), factor


# With P lower triangular and L̇ = LP, Ḃ = L̇Lᵀ + LL̇ᵀ says P + Pᵀ = L⁻¹ḂL⁻ᵀ; and Ċ = L⁻¹ȦL⁻ᵀ − PC − CPᵀ of C = L⁻¹AL⁻ᵀ.
@standard_form.defjvp
def _standard_form_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[tuple, tuple]:
    reduced, factor = standard_form(*primals)
    inverse = _triangular_inverse(factor)
    of_a, of_b = (matmul(inverse, tangent, inverse.T) for tangent in tangents)
    p = jnp.tril(of_b) - jnp.diag(jnp.diagonal(of_b)) / 2
    change = matmul(p, reduced)
    return (reduced, factor), (of_a - change - change.T, matmul(factor, p))


@jax.custom_jvp
def transposed_solve(factor: Matrix, columns: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return L⁻ᵀ times the columns."""
    return lapack.transposed_solve(factor, columns)


# Lᵀx = c: ẋ = L⁻ᵀ(ċ − L̇ᵀx).
@transposed_solve.defjvp
def _transposed_solve_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    x, (d_factor, d_columns) = transposed_solve(*primals), tangents
    return x, matmul(_triangular_inverse(primals[0]).T, d_columns - matmul(d_factor.T, x))


# (L⁻¹)˙ = −L⁻¹L̇L⁻¹.
@jax.custom_jvp
def _triangular_inverse(factor: Matrix) -> Matrix:
    return lapack.triangular_solve(factor, jnp.eye(len(factor), dtype=factor.dtype))


@_triangular_inverse.defjvp
def _triangular_inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = _triangular_inverse(*primals)
    return inverse, -matmul(inverse, *tangents, inverse)


def pencil_eigh(a: Matrix, b: Matrix, k: int | None = None) -> tuple[Float[Array, " k"], Float[Array, "n k"]]:
    """Return the k lowest eigenvalues, or all, and B-orthonormal eigenvectors in columns; not differentiable."""
    reduced, factor = standard_form(a, b)
    values, vectors = lapack.eigh(reduced)
    return values[:k], transposed_solve(factor, vectors[:, :k])


def checked_standard_form(A: Any, B: Any) -> tuple[Matrix, Matrix | None]:
    """Return the standard form of the symmetric parts, checked as `hks_jax.eigh` says; without B, A and None."""
    a = _symmetric("A", A)
    if B is None:
        return a, None
    b = _symmetric("B", B)
    if b.shape != a.shape or b.dtype != a.dtype:
        raise ValueError(f"B: got {b.dtype}{list(b.shape)}; expected what A is, {a.dtype}{list(a.shape)}")
    reduced, factor = standard_form(a, b)
    if not is_traced(factor) and not np.isfinite(factor).all():
        least = np.linalg.eigvalsh(np.asarray(b))[0]
        raise ValueError(
            f"B: its Cholesky factorisation broke down, its least eigenvalue is {least:.3g}; expected a positive "
            "definite matrix. If it is A that is, exchange them: the eigenvalues become their reciprocals"
        )
    return (reduced + reduced.T) / 2, factor


def _symmetric(name: str, matrix: Any) -> Matrix:
    """Return the symmetric part of one matrix of a user."""
    array = real_array(name, matrix)
    if array.ndim != 2 or array.shape[0] != array.shape[1] or array.size == 0:
        raise ValueError(f"{name}: got shape {array.shape}; expected (n, n), one square matrix: jax.vmap takes several")
    if array.dtype not in (jnp.float32, jnp.float64):
        raise ValueError(f"{name}: got dtype {array.dtype}; expected float32 or float64")
    if not is_traced(array):
        _require_symmetric(name, np.asarray(array))
    return (array + array.T) / 2


def _require_symmetric(name: str, array: np.ndarray) -> None:
    """Raise ValueError unless the entries are finite, and symmetric but for noise."""
    finite = np.isfinite(array)
    if not finite.all():
        i, j = np.argwhere(~finite)[0]
        raise ValueError(f"{name}: got {array[i, j]} in row {i}, column {j}; expected finite numbers")
    skew = np.abs(array - array.T)
    i, j = sorted(np.unravel_index(np.argmax(skew), skew.shape))
    largest = np.abs(array).max()
    limit = np.sqrt(np.finfo(array.dtype).eps)
    if skew[i, j] > limit * largest:
        raise ValueError(
            f"{name}: unsymmetric, most of all in row {i}, column {j}: {array[i, j]:.6g} there, and "
            f"{array[j, i] - array[i, j]:.2g} more in row {j}, column {i}; expected a symmetric matrix, but for "
            f"{limit:.2g} of its largest entry, {largest:.6g}. Pass ({name} + {name}.T) / 2 if the difference is noise"
        )
