"""The inverses of a batch of symmetric indefinite matrices together with their inertia."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Inverses = tuple[Float[Array, "m n n"], Float[Array, "m n"]]

_BLOCK = 32
_SMALL, _LARGE = 32, 256


def symmetric_inverses(matrices: Float[Array, "m n n"]) -> Inverses:
    """Return the inverses, and for each matrix numbers of which as many are negative as eigenvalues.

    Not finite where a matrix is singular. On CPUs by LAPACK's eigenvalues, elsewhere by elimination, which takes far
    fewer of the operations that are slow there.
    """
    return jax.lax.platform_dependent(matrices, cpu=by_eigenvalues, default=by_elimination)


def by_eigenvalues(matrices: Float[Array, "m n n"]) -> Inverses:
    """Invert the eigenvalues; of the many small matrices and the few large ones, those of two halves.

    Each halving takes a quarter of the time, but the halves may be singular where the whole is not.
    """
    n = matrices.shape[1]
    if n <= _SMALL // 2 or _SMALL < n <= _LARGE:
        vectors, values = jax.lax.linalg.eigh(matrices, symmetrize_input=False)
        return _product(vectors / values[:, None, :], _transposed(vectors)), values
    half = n // 2
    first, values = by_eigenvalues(matrices[:, :half, :half])
    coupling = _product(matrices[:, half:, :half], first)
    schur = matrices[:, half:, half:] - _product(coupling, matrices[:, :half, half:])
    last, others = by_eigenvalues((schur + _transposed(schur)) / 2)
    beside = -_product(last, coupling)
    first = first - _product(_transposed(coupling), beside)
    whole = jnp.block([[first, _transposed(beside)], [beside, last]])
    return whole, jnp.concatenate([values, others], axis=1)


def by_elimination(matrices: Float[Array, "m n n"]) -> Inverses:
    """Sweep the matrices block by block.

    Sweeping a block P of A turns it into −P⁻¹, and the rest into the Schur complement of P; once all blocks are swept,
    A has become −A⁻¹. By Sylvester's law of inertia as many of the pivots are negative as eigenvalues of A.
    """
    m, n, _ = matrices.shape
    size = min(n, _BLOCK)
    whole = -(-n // size) * size
    a = jnp.broadcast_to(jnp.eye(whole, dtype=matrices.dtype), (m, whole, whole)).at[:, :n, :n].set(matrices)

    def sweep(number: Array, state: Inverses) -> Inverses:
        a, pivots = state
        at = number * size
        rows = jax.lax.dynamic_slice_in_dim(a, at, size, axis=1)
        inverses, found = _sweep_rows(jax.lax.dynamic_slice_in_dim(rows, at, size, axis=2))
        scaled = _product(inverses, rows)
        a = a - _product(_transposed(rows), scaled)
        a = jax.lax.dynamic_update_slice_in_dim(a, scaled, at, axis=1)
        a = jax.lax.dynamic_update_slice_in_dim(a, _transposed(scaled), at, axis=2)
        a = jax.lax.dynamic_update_slice(a, -inverses, (0, at, at))
        return a, jax.lax.dynamic_update_slice_in_dim(pivots, found, at, axis=1)

    a, pivots = jax.lax.fori_loop(0, whole // size, sweep, (a, jnp.zeros((m, whole), a.dtype)))
    return -a[:, :n, :n], pivots[:, :n]


def _sweep_rows(matrices: Float[Array, "m n n"]) -> Inverses:
    """Sweep one row at a time, always the one with the largest diagonal entry left; return with them the pivots."""
    m, n, _ = matrices.shape
    index = jnp.arange(n)

    def sweep(_: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        a, swept, pivots = state
        diagonal = jnp.diagonal(a, axis1=1, axis2=2)
        here = index == jnp.argmax(jnp.where(swept, -1, jnp.abs(diagonal)), axis=1)[:, None]
        column = jnp.sum(jnp.where(here[:, None, :], a, 0), axis=2)
        pivot = jnp.sum(jnp.where(here, diagonal, 0), axis=1)[:, None]
        row = jnp.where(here, -1, column) / pivot
        a = a - jnp.where(here, 0, column)[:, :, None] * row[:, None, :]
        a = jnp.where(here[:, :, None], row[:, None, :], jnp.where(here[:, None, :], row[:, :, None], a))
        return a, swept | here, jnp.where(here, pivot, pivots)

    state = matrices, jnp.zeros((m, n), bool), jnp.zeros((m, n), matrices.dtype)
    a, _, pivots = jax.lax.fori_loop(0, n, sweep, state)
    return -a, pivots


def _product(x: Float[Array, "m i j"], y: Float[Array, "m j k"]) -> Float[Array, "m i k"]:
    return jnp.matmul(x, y, precision="highest")


def _transposed(x: Float[Array, "m i j"]) -> Float[Array, "m j i"]:
    return jnp.swapaxes(x, 1, 2)
