"""The inverses of symmetric indefinite matrices together with their inertia."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Inverse = tuple[Float[Array, "n n"], Float[Array, " n"]]

_BLOCK = 32
_SMALL, _LARGE = 32, 256


def symmetric_inverses(matrices: Float[Array, "m n n"]) -> tuple[Float[Array, "m n n"], Float[Array, "m n"]]:
    """Return the inverses, and for each matrix numbers of which as many are negative as eigenvalues.

    Not finite where a matrix is singular. On CPUs by LAPACK's eigenvalues, elsewhere by elimination, which takes far
    fewer of the operations that are slow there.
    """
    return jax.lax.platform_dependent(matrices, cpu=jax.vmap(by_eigenvalues), default=jax.vmap(by_elimination))


def by_eigenvalues(matrix: Float[Array, "n n"]) -> Inverse:
    """Invert the eigenvalues; of the many small matrices and the few large ones, those of two halves.

    Each halving takes a quarter of the time, but the halves may be singular where the whole is not.
    """
    n = matrix.shape[0]
    if n <= _SMALL // 2 or _SMALL < n <= _LARGE:
        vectors, values = jax.lax.linalg.eigh(matrix, symmetrize_input=False)
        return jnp.matmul(vectors / values, vectors.T, precision="highest"), values
    half = n // 2
    first, values = by_eigenvalues(matrix[:half, :half])
    coupling = jnp.matmul(matrix[half:, :half], first, precision="highest")
    schur = matrix[half:, half:] - jnp.matmul(coupling, matrix[:half, half:], precision="highest")
    last, others = by_eigenvalues((schur + schur.T) / 2)
    beside = -jnp.matmul(last, coupling, precision="highest")
    first = first - jnp.matmul(coupling.T, beside, precision="highest")
    return jnp.block([[first, beside.T], [beside, last]]), jnp.concatenate([values, others])


def by_elimination(matrix: Float[Array, "n n"]) -> Inverse:
    """Sweep the matrix block by block.

    Sweeping a block P of A turns it into −P⁻¹, and the rest into the Schur complement of P; once all blocks are swept,
    A has become −A⁻¹. By Sylvester's law of inertia as many of the pivots are negative as eigenvalues of A.
    """
    n = matrix.shape[0]
    size = min(n, _BLOCK)
    count = -(-n // size)
    a = jnp.eye(count * size, dtype=matrix.dtype).at[:n, :n].set(matrix)

    def sweep(number: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        a, pivots = state
        at = number * size
        rows = jax.lax.dynamic_slice_in_dim(a, at, size, axis=0)
        inverse, found = _sweep_rows(jax.lax.dynamic_slice_in_dim(rows, at, size, axis=1))
        scaled = jnp.matmul(inverse, rows, precision="highest")
        a = a - jnp.matmul(rows.T, scaled, precision="highest")
        a = jax.lax.dynamic_update_slice_in_dim(a, scaled, at, axis=0)
        a = jax.lax.dynamic_update_slice_in_dim(a, scaled.T, at, axis=1)
        a = jax.lax.dynamic_update_slice(a, -inverse, (at, at))
        return a, jax.lax.dynamic_update_slice_in_dim(pivots, found, at, axis=0)

    a, pivots = jax.lax.fori_loop(0, count, sweep, (a, jnp.zeros(count * size, a.dtype)))
    # Those of the padding are one.
    return -a[:n, :n], pivots[:n]


@jax.jit
def _sweep_rows(matrix: Float[Array, "n n"]) -> Inverse:
    """Sweep one row at a time, always the one with the largest diagonal entry left; return with it the pivots."""
    n = matrix.shape[0]
    index = jnp.arange(n)

    def sweep(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        a, swept, pivots = state
        diagonal = jnp.diagonal(a)
        here = index == jnp.argmax(jnp.where(swept, -1, jnp.abs(diagonal)))
        column = jnp.sum(jnp.where(here, a, 0), axis=1)
        pivot = jnp.sum(jnp.where(here, diagonal, 0))
        row = jnp.where(here, -1, column) / pivot
        a = a - jnp.where(here, 0, column)[:, None] * row
        a = jnp.where(here[:, None], row, jnp.where(here, row[:, None], a))
        return a, swept | here, jnp.where(here, pivot, pivots)

    state = matrix, jnp.zeros(n, bool), jnp.zeros(n, matrix.dtype)
    a, _, pivots = jax.lax.fori_loop(0, n, sweep, state)
    return -a, pivots
