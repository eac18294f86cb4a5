"""Decompositions of one small dense matrix, of which `vmap` makes a loop on CPUs: batches given to LAPACK can hang.

jaxlib 0.10.0 to 0.11.0 deal LAPACK's work on a batch out to the CPU's pool of threads and wait, in the thread that does
so, until the others are done (`ParallelBatchMap`). Where that thread belongs to the pool itself and every other one
waits likewise, nobody is left to do the work. This takes as many calls beside each other as the pool has threads: two
computations that do not depend on each other, or two devices made out of one CPU. On two cores the smallest program is

    @jax.jit
    def hangs(factors):  # (2, 64, 32, 32); within the first hundred calls
        return [solve_triangular(a, jnp.broadcast_to(jnp.eye(32), a.shape), lower=True) for a in factors]

and batched `cholesky`, `eigh`, `inv` or `qr` do the same behind a product, or four of them without one. A call on one
matrix, with less than 2·10⁵ operations or on a pool of one thread works at once and waits for nobody. So every
computation of this package calls LAPACK through this file, matrix by matrix, and a user's own batch beside ours finds
threads that do its work.
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from hks_jax.linear.loops import one_by_one

P = ParamSpec("P")
T = TypeVar("T")


def _matrix_by_matrix(function: Callable[P, T]) -> Callable[P, T]:
    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        return one_by_one(function, (), *args)

    return call


@_matrix_by_matrix
def eigh(a: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Return the eigenvalues of a symmetric matrix, ascending, and orthonormal eigenvectors in columns.

    Only the lower triangle is read. Not differentiable, as is nothing here: `hks_jax.linear.dense_eigh` has the rule.
    """
    vectors, values = jax.lax.linalg.eigh(a, symmetrize_input=False)
    return values, vectors


@_matrix_by_matrix
def cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the lower triangular L of A = LLᵀ, computed from A's lower triangle; NaN where A is not definite."""
    return jax.lax.linalg.cholesky(a, symmetrize_input=False)


@_matrix_by_matrix
def triangular_solve(factor: Float[Array, "n n"], columns: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return L⁻¹ times the columns, L lower triangular."""
    return jax.lax.linalg.triangular_solve(factor, columns, left_side=True, lower=True)


@_matrix_by_matrix
def transposed_solve(factor: Float[Array, "n n"], columns: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return L⁻ᵀ times the columns, L lower triangular."""
    return jax.lax.linalg.triangular_solve(factor, columns, left_side=True, lower=True, transpose_a=True)


@_matrix_by_matrix
def inverse_cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return L⁻¹ of A = LLᵀ; NaN where A is not definite."""
    factor = jax.lax.linalg.cholesky(a, symmetrize_input=False)
    return jax.lax.linalg.triangular_solve(factor, jnp.eye(len(a), dtype=a.dtype), left_side=True, lower=True)


@_matrix_by_matrix
def inverse(a: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    """Return A⁻¹, A real or complex."""
    return jnp.linalg.inv(a)


@_matrix_by_matrix
def orthonormal_columns(a: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Return Q of A = QR, n ≥ m."""
    return jnp.linalg.qr(a)[0]
