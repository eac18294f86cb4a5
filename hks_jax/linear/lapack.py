"""Decompositions of single small dense matrices. On CPUs `vmap` becomes a loop, because batched LAPACK calls can hang.

jaxlib 0.10.0 to 0.11.0 distribute a batch of LAPACK calls over the CPU's thread pool, and the calling thread waits for
them (`ParallelBatchMap`). If waiting threads occupy the whole thread pool, no thread executes the LAPACK calls. On two
cores, two independent batched calls in one program hang within a hundred calls. A LAPACK call on one matrix does not
wait. This package calls LAPACK only through this module, matrix by matrix, so that a user's batched calls find threads.
"""

from collections.abc import Callable
from functools import partial, wraps
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from hks_jax.linear.loops import one_by_one

P = ParamSpec("P")
T = TypeVar("T")


def _matrix_by_matrix(function: Callable[P, T]) -> Callable[P, T]:
    return wraps(function)(partial(one_by_one, function, ()))


@_matrix_by_matrix
def eigh(a: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Return the eigenvalues of a symmetric matrix, ascending, and orthonormal eigenvectors in columns.

    Only the lower triangle is read. No function of this file is differentiable; see `hks_jax.linear.dense_eigh`.
    """
    vectors, values = jax.lax.linalg.eigh(a, symmetrize_input=False)
    return values, vectors


@_matrix_by_matrix
def cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the lower triangular L with A = LLᵀ, from the lower triangle of A; NaN if A is not positive definite."""
    return jax.lax.linalg.cholesky(a, symmetrize_input=False)


@_matrix_by_matrix
def triangular_solve(factor: Float[Array, "n n"], columns: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return L⁻¹ times the columns, where L is lower triangular."""
    return jax.lax.linalg.triangular_solve(factor, columns, left_side=True, lower=True)


@_matrix_by_matrix
def transposed_solve(factor: Float[Array, "n n"], columns: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return L⁻ᵀ times the columns, where L is lower triangular."""
    return jax.lax.linalg.triangular_solve(factor, columns, left_side=True, lower=True, transpose_a=True)


@_matrix_by_matrix
def inverse_cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return L⁻¹ with A = LLᵀ; NaN if A is not positive definite."""
    factor = jax.lax.linalg.cholesky(a, symmetrize_input=False)
    return jax.lax.linalg.triangular_solve(factor, jnp.eye(len(a), dtype=a.dtype), left_side=True, lower=True)


@_matrix_by_matrix
def inverse(a: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    """Return A⁻¹ of a real or complex matrix."""
    return jnp.linalg.inv(a)


@_matrix_by_matrix
def orthonormal_columns(a: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return the orthonormal factor Q of A = QR, where n ≥ m."""
    return jnp.linalg.qr(a)[0]
