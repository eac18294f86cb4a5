"""All eigenpairs of dense symmetric pencils, with derivatives that are finite at multiple eigenvalues.

A Cholesky factorisation of B reduces Av = λBv to a standard eigenvalue problem.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.checks import real_array, require_number
from hks_jax.linear import lapack
from hks_jax.linear.operators import require_symmetric
from hks_jax.linear.products import matmul
from hks_jax.traced import is_traced

Matrix = Float[Array, "n n"]
Values = Float[Array, " n"]


class DenseEigenpairs(NamedTuple):
    """Eigenpairs of a dense symmetric matrix or pencil: ``values, vectors = hj.eigh(A)``."""

    eigenvalues: Float[Array, " n"]
    """The eigenvalues in ascending order."""
    eigenvectors: Float[Array, "n n"]
    """The eigenvectors as columns: orthonormal or, for a pencil, with vᵢᵀBvⱼ = δᵢⱼ."""


def eigh(A: Any, B: Any = None, *, multiplet_tolerance: float | None = None) -> DenseEigenpairs:
    """Compute all eigenpairs of Av = λv, or of Av = λBv, of dense symmetric matrices, differentiably.

    First derivatives, forward and reverse, are never NaN. Derivatives of simple eigenvalues and their eigenvectors are
    exact. At multiple eigenvalues, derivatives of projectors on eigenspaces are exact, and so are derivatives of sums
    of f(λ) that include all equal eigenvalues, such as tr f(A).

    A single eigenvector of a multiple eigenvalue has no derivative. The derivative that this function defines for
    eigenvectors contains no rotation within an eigenspace. The derivatives of eigenvalues are the diagonal entries of
    VᵀȦV, where Ȧ is the change of A. The derivative of V f(Λ) Vᵀ through V and Λ is therefore **wrong at multiple
    eigenvalues: use `matrix_function`**, which is exact at all eigenvalues.

    Eigenvectors of nearly equal eigenvalues, and derivatives of these eigenvectors, have errors of about ε|λ|/gap,
    where ε is the machine precision. Derivatives of functions of a whole cluster of eigenvalues also have errors of
    about ε|λ|/gap, unless all gaps within the cluster are below `multiplet_tolerance`.

    Second derivatives are exact if all eigenvalues are simple, and NaN otherwise.

    Args:
        A: (n, n), symmetric, float32 or float64. Derivatives are with respect to the symmetric part of A.
        B: (n, n), symmetric positive definite; None means the identity.
        multiplet_tolerance: eigenvalues count as equal in derivatives if they differ by less than this, relative to the
            largest |λ|. None means 4nε, about the effect of rounding.

    Returns:
        (n,) eigenvalues, ascending, and (n, n) eigenvectors in columns.

    Raises:
        ValueError: entries are NaN, infinite, complex, or of another precision; a matrix is not square, or the shapes
            differ; a matrix is unsymmetric by more than √ε of its largest entry; B is not positive definite. Traced
            values are not checked: the result may be NaN, and the symmetric part is used.

    Examples:
        >>> values, vectors = hj.eigh(jnp.array([[2.0, 1.0], [1.0, 2.0]]))
        >>> print(values.round())
        [1. 3.]
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

    If ``tolerance`` is a number, derivatives are those of `eigh`; if it is None, they are NaN at equal eigenvalues.
    """
    return lapack.eigh(a)


# Let G = VᵀȦV, where Ȧ is the change of A. The equations AV = VΛ and VᵀV = I give the changes of Λ and V:
#
#     λ̇ᵢ = Gᵢᵢ,    V̇ = VΩ,    Ωᵢⱼ = Gᵢⱼ/(λⱼ − λᵢ) for i ≠ j.
#
# In the derivative of VₑVₑᵀ, the projector on an eigenspace, the entries of the antisymmetric matrix Ω within the
# eigenspace cancel, so that the derivative rule may set these entries to zero. The derivative of tr f(A) = Σ f(λᵢ) does
# not contain the matrix Ω. Second derivatives, such as that of Σᵢ f'(λᵢ) Gᵢᵢ, depend on the entries of Ω that are set
# to zero; at equal eigenvalues, `_inverse_gaps` therefore has the derivative NaN.
@differentiable_eigh.defjvp
def _eigh_jvp(tolerance: float | None, primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple, tuple]:
    values, vectors = differentiable_eigh(tolerance, primals[0])
    change = matmul(vectors.T, matmul(tangents[0], vectors))
    rotation = (change + change.T) / 2 * _inverse_gaps(tolerance, values)
    return (values, vectors), (jnp.diagonal(change), matmul(vectors, rotation))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _inverse_gaps(tolerance: float | None, values: Values) -> Matrix:
    """Return 1/(λⱼ − λᵢ), with 0 on the diagonal. Equal eigenvalues give 0, or NaN if ``tolerance`` is None."""
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
    """Return λⱼ − λᵢ in row i and column j, and whether its magnitude exceeds the tolerance."""
    gap = values[None] - values[:, None]
    return gap, jnp.abs(gap) > (tolerance or 0) * jnp.max(jnp.abs(values))


@jax.custom_jvp
def standard_form(a: Matrix, b: Matrix) -> tuple[Matrix, Matrix]:
    """Return L⁻¹AL⁻ᵀ and the lower triangular L with B = LLᵀ; NaN if B is not positive definite.

    If w is an eigenvector of L⁻¹AL⁻ᵀ, then L⁻ᵀw is an eigenvector of Av = λBv.
    """
    factor = lapack.cholesky(b)
    half = lapack.triangular_solve(factor, a)
    return lapack.triangular_solve(factor, half.T), factor


# Write the change of the Cholesky factor L as L̇ = LP, where the matrix P is lower triangular. The change Ḃ = L̇Lᵀ +
# LL̇ᵀ of B gives the equation P + Pᵀ = L⁻¹ḂL⁻ᵀ for P. The matrix C = L⁻¹AL⁻ᵀ has the change Ċ = L⁻¹ȦL⁻ᵀ − PC − CPᵀ.
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
    """Return L⁻ᵀ times the columns, where L is the lower triangular ``factor``."""
    return lapack.transposed_solve(factor, columns)


# If Lᵀx = c, then ẋ = L⁻ᵀ(ċ − L̇ᵀx).
@transposed_solve.defjvp
def _transposed_solve_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    x, (d_factor, d_columns) = transposed_solve(*primals), tangents
    return x, matmul(_triangular_inverse(primals[0]).T, d_columns - matmul(d_factor.T, x))


# The derivative of L⁻¹ is −L⁻¹L̇L⁻¹.
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
    """Check A and B as `hks_jax.eigh` documents, and return their `standard_form`; without B, return A and None."""
    a = _symmetric("A", A)
    if B is None:
        return a, None
    b = _symmetric("B", B)
    if b.shape != a.shape or b.dtype != a.dtype:
        raise ValueError(f"B: got {b.dtype}{list(b.shape)}; expected {a.dtype}{list(a.shape)}, as for A")
    reduced, factor = standard_form(a, b)
    if not is_traced(factor) and not np.isfinite(factor).all():
        least = np.linalg.eigvalsh(np.asarray(b))[0]
        raise ValueError(
            f"B: got a matrix whose least eigenvalue is {least:.3g}; expected a positive definite matrix. If A is "
            "positive definite, exchange A and B: the eigenvalues become their reciprocals"
        )
    return (reduced + reduced.T) / 2, factor


def _symmetric(name: str, matrix: Any) -> Matrix:
    array = real_array(name, matrix)
    if array.ndim != 2 or array.shape[0] != array.shape[1] or array.size == 0:
        raise ValueError(f"{name}: got shape {array.shape}; expected (n, n). Use jax.vmap for several matrices")
    if not is_traced(array):
        entries, limit = np.asarray(array), float(jnp.finfo(array.dtype).eps) ** 0.5
        with np.errstate(invalid="ignore"):
            symmetric = np.abs(entries - entries.T).max() <= limit * np.abs(entries).max()
        if not symmetric:
            rows, cols = np.indices(entries.shape).reshape(2, -1)
            remedy = f"Pass ({name} + {name}.T) / 2 if this is noise"
            require_symmetric(name, entries.ravel(), (rows, cols), len(entries), remedy, limit)
    return (array + array.T) / 2
