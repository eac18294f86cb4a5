"""Dense symmetric pencils: checks of what users pass, and the reduction A − λB to a standard problem by Cholesky."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from hks_jax.checks import real_array
from hks_jax.traced import is_traced


def standard_form(a: Float[Array, "n n"], b: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Return L⁻¹AL⁻ᵀ and the lower triangular L of B = LLᵀ; NaN where B is not positive definite.

    Where w is an eigenvector of the first, L⁻ᵀw is one of Av = λBv.
    """
    factor = jnp.linalg.cholesky(b)
    half = solve_triangular(factor, a, lower=True)
    return solve_triangular(factor, half.T, lower=True), factor


def transposed_solve(factor: Float[Array, "n n"], columns: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return L⁻ᵀ times the columns."""
    return solve_triangular(factor, columns, trans="T", lower=True)


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
            f"{name}: unsymmetric, most of all in row {i}, column {j}: {array[i, j]:.6g} there, and {array[j, i]:.6g} "
            f"in row {j}, column {i}; expected a symmetric matrix, but for {limit:.2g} of its largest entry, "
            f"{largest:.6g}. Pass ({name} + {name}.T) / 2 if the difference is noise"
        )
