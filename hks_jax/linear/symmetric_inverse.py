"""Inverses of a batch of symmetric indefinite matrices, together with their inertia."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.linear import accelerators, lapack
from hks_jax.linear.products import even_size, matmul

Matrices = Float[Array, "m n n"]
Pivots = Float[Array, " m"]
Inverses = tuple[Matrices, Float[Array, "m n"]]

_BLOCK, _BLOCKS, _LARGE = 48, 4, 2048
"""On CPUs, matrices of up to ``_BLOCK`` rows are inverted by their eigenvalues. Larger matrices of up to ``_LARGE``
rows are swept in about ``_BLOCKS`` blocks."""
_ROWS = 32
"""The largest size of blocks that are swept row by row."""
_MANY = 128
"""Batches of at least this size usually are definite, because the spectra of small subdomains are above the shift."""


def symmetric_inverses(matrices: Matrices, least: Pivots | None = None) -> Inverses:
    """Return the inverse of each matrix A, and pivots, whose product is det A and whose signs give the inertia.

    Pivots smaller than ``least`` are replaced by ±``least``. Without ``least``, the inverse of a singular matrix is not
    finite. On CPUs, large batches, which are usually definite, are inverted by LAPACK's Cholesky factors, and small
    batches by eigenvalues. On accelerators, where both methods are slow, all batches are inverted by elimination.
    """
    none = jnp.zeros(len(matrices), matrices.dtype) if least is None else least
    if not accelerators.at_hand():  # avoids tracing unused branches
        return (by_cholesky_factors if len(matrices) >= _MANY else by_eigenvalues)(matrices, none)
    return jax.lax.platform_dependent(matrices, none, cpu=by_eigenvalues, default=by_elimination)


def by_cholesky_factors(matrices: Matrices, least: Pivots) -> Inverses:
    """Invert by Cholesky factors or, if a pivot is small or not positive, by eigenvalues in three times the time."""
    inverses = jax.vmap(lapack.inverse_cholesky)(matrices)
    pivots = jnp.diagonal(inverses, axis1=1, axis2=2) ** -2
    return jax.lax.cond(
        jnp.all(pivots > least[:, None]),  # pivots are NaN if a matrix is not definite
        lambda: (matmul(inverses.mT, inverses), pivots),
        lambda: by_eigenvalues(matrices, least),
    )


def by_eigenvalues(matrices: Matrices, least: Pivots) -> Inverses:
    """Invert small matrices by their eigenvalues, and others by sweeping blocks, which are inverted recursively.

    Large blocks are in turn swept in small blocks, which needs few passes over the matrix. A matrix of more than
    ``_LARGE`` rows is inverted as a 2 × 2 block matrix instead, which takes fewer operations.
    """
    n = matrices.shape[1]
    if n <= _BLOCK:
        values, vectors = jax.vmap(lapack.eigh)(matrices)
        values = _away_from_zero(values, least[:, None])
        return matmul(vectors / values[:, None, :], vectors.mT), values
    if n <= _LARGE:
        size = even_size(n, max(_BLOCK, n // _BLOCKS))
        return _by_blocks(by_eigenvalues, size, matrices, least)
    half = n // 2
    first, values = by_eigenvalues(matrices[:, :half, :half], least)
    coupling = matmul(matrices[:, half:, :half], first)
    schur = matrices[:, half:, half:] - matmul(coupling, matrices[:, :half, half:])
    last, others = by_eigenvalues((schur + schur.mT) / 2, least)
    beside = -matmul(last, coupling)
    first = first - matmul(coupling.mT, beside)
    whole = jnp.block([[first, beside.mT], [beside, last]])
    return whole, jnp.concatenate([values, others], axis=1)


def by_elimination(matrices: Matrices, least: Pivots) -> Inverses:
    """Sweep the matrices block by block, and each block row by row."""
    size = min(matrices.shape[1], _ROWS)
    return _by_blocks(jax.vmap(_sweep), size, matrices, least)


def _by_blocks(invert: Callable[[Array, Array], Inverses], size: int, matrices: Matrices, least: Pivots) -> Inverses:
    """Sweep the matrices in blocks of one size. ``invert`` inverts the blocks."""
    m, n, _ = matrices.shape
    whole = -(-n // size) * size
    a = jnp.broadcast_to(jnp.eye(whole, dtype=matrices.dtype), (m, whole, whole)).at[:, :n, :n].set(matrices)

    def sweep(number: Array, state: Inverses) -> Inverses:
        a, pivots = state
        at = number * size
        rows = jax.lax.dynamic_slice_in_dim(a, at, size, axis=1)
        inverses, of_block = invert(jax.lax.dynamic_slice_in_dim(rows, at, size, axis=2), least)
        return _swept(a, rows, inverses, at), jax.lax.dynamic_update_slice_in_dim(pivots, of_block, at, axis=1)

    a, pivots = jax.lax.fori_loop(0, whole // size, sweep, (a, jnp.zeros((m, whole), a.dtype)))
    # Each padding row has a pivot 1, but larger pivots may be listed after these pivots. From index n − 1 on, at most
    # one pivot is not positive, so that the product of these pivots keeps the determinant and the inertia.
    last = jnp.prod(pivots[:, n - 1 :], axis=1, keepdims=True)
    return -a[:, :n, :n], jnp.concatenate([pivots[:, : n - 1], last], axis=1)


# Sweeping a diagonal block P of a symmetric matrix A replaces P by −P⁻¹, and replaces the block of the other rows and
# columns by the Schur complement of P. If all diagonal blocks are swept, the result is −A⁻¹. By Sylvester's law of
# inertia, A has as many negative eigenvalues as negative pivots. Let U be the rows of A through P with P replaced by
# −I, and A₀ be A with zeros in the rows and columns of P. The swept matrix A₀ − UᵀP⁻¹U takes two matrix products.
def _swept(a: Matrices, rows: Float[Array, "m s n"], inverses: Float[Array, "m s s"], at: Int[Array, ""]) -> Matrices:
    """Sweep the block that begins at row ``at``, given its inverse."""
    index, own = jnp.arange(a.shape[1], dtype=at.dtype), at + jnp.arange(rows.shape[1], dtype=at.dtype)
    inside = (index >= at) & (index < at + rows.shape[1])
    rows = jnp.where(inside, -(index[None] == own[:, None]).astype(a.dtype), rows)
    change = matmul(rows.mT, matmul(inverses, rows))
    return jnp.where(inside, 0, jnp.where(inside[:, None], 0, a)) - change


def _away_from_zero(pivots: Float[Array, "..."], least: Float[Array, "..."]) -> Float[Array, "..."]:
    return jnp.where(jnp.abs(pivots) < least, jnp.where(pivots < 0, -least, least), pivots)


def _sweep(a: Float[Array, "n n"], least: Float[Array, ""]) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """Return the inverse and the pivots of one matrix. Each step sweeps the remaining row with the largest pivot."""
    n = a.shape[0]
    index = jnp.arange(n)

    def sweep(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        a, diagonal, left, pivots_so_far = state
        chosen = index == jnp.argmax(jnp.where(left > 0, jnp.abs(diagonal), -1))
        column = jnp.sum(jnp.where(chosen[None, :], a, 0), axis=1)
        pivot = _away_from_zero(jnp.sum(jnp.where(chosen, diagonal, 0), axis=0), least)
        row = jnp.where(chosen, -1, column) / pivot
        a = a - jnp.where(chosen, 0, column)[:, None] * row[None, :]
        a = jnp.where(chosen[:, None], row[None, :], jnp.where(chosen[None, :], row[:, None], a))
        diagonal = jnp.where(chosen, row, diagonal - column * row)
        return a, diagonal, jnp.where(chosen, 0, left), jnp.where(chosen, pivot, pivots_so_far)

    diagonal = jnp.diagonal(a)
    start = a, diagonal, jnp.ones_like(diagonal), jnp.zeros_like(diagonal)
    a, _, _, pivots_so_far = jax.lax.fori_loop(0, n, sweep, start)
    return -a, pivots_so_far
