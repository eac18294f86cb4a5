"""Dense symmetric pencils: checks of users' matrices, and the reduction A − λB to a standard problem by Cholesky."""

from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.checks import real_array
from hks_jax.linear import lapack
from hks_jax.traced import is_traced


@jax.custom_jvp
def standard_form(a: Float[Array, "n n"], b: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
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
    of_a, of_b = (_product(inverse, tangent, inverse.T) for tangent in tangents)
    p = jnp.tril(of_b) - jnp.diag(jnp.diagonal(of_b)) / 2
    change = _product(p, reduced)
    return (reduced, factor), (of_a - change - change.T, _product(factor, p))


@jax.custom_jvp
def transposed_solve(factor: Float[Array, "n n"], columns: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return L⁻ᵀ times the columns."""
    return lapack.triangular_solve(factor, columns, transpose=True)


# Lᵀx = c: ẋ = L⁻ᵀ(ċ − L̇ᵀx).
@transposed_solve.defjvp
def _transposed_solve_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    x, (d_factor, d_columns) = transposed_solve(*primals), tangents
    return x, _product(_triangular_inverse(primals[0]).T, d_columns - _product(d_factor.T, x))


# (L⁻¹)˙ = −L⁻¹L̇L⁻¹.
@jax.custom_jvp
def _triangular_inverse(factor: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return lapack.triangular_solve(factor, jnp.eye(len(factor), dtype=factor.dtype))


@_triangular_inverse.defjvp
def _triangular_inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = _triangular_inverse(*primals)
    return inverse, -_product(inverse, *tangents, inverse)


def _product(*matrices: Float[Array, "_ _"]) -> Float[Array, "_ _"]:
    return reduce(partial(jnp.matmul, precision="highest"), matrices)


def pencil_eigh(
    a: Float[Array, "n n"], b: Float[Array, "n n"], k: int | None = None
) -> tuple[Float[Array, " k"], Float[Array, "n k"]]:
    """Return the k lowest eigenvalues of a pencil, or all, and B-orthonormal eigenvectors in columns.

    Not differentiable.
    """
    reduced, factor = standard_form(a, b)
    values, vectors = lapack.eigh(reduced)
    return values[:k], transposed_solve(factor, vectors[:, :k])


def checked_standard_form(A: Any, B: Any) -> tuple[Float[Array, "n n"], Float[Array, "n n"] | None]:
    """Check A and B as users pass them, and return the standard form of their symmetric parts; without B, A and None.

    Raises:
        ValueError: see `hks_jax.eigh`.
    """
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


def _symmetric(name: str, matrix: Any) -> Float[Array, "n n"]:
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
