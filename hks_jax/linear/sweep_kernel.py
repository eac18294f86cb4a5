"""The inverses of many small symmetric indefinite matrices in one launch of a kernel, for CUDA devices.

Written with XLA's operations, each of the n pivots of a matrix is half a dozen launches, of some 4 µs each whatever
they do. Here a matrix is one program, which keeps it in registers from the first pivot to the last.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.linear.accelerators import padded_size

LARGEST = 64
"""Rows of the largest matrix: 4 warps, 32 numbers in each thread."""

_SMALLEST = 16


def invert_in_registers(
    matrices: Float[Array, "m n n"],
    least: Float[Array, " m"],
    at: Int[Array, ""] | None = None,
    rows: int | None = None,
    interpret: bool = False,
) -> tuple[Float[Array, "m s s"], Float[Array, "m s"]]:
    """Return the inverses of blocks on the diagonal, and their pivots, as `sweep_rows` of `symmetric_inverse` does.

    Args:
        matrices: symmetric.
        least: smaller pivots are replaced by it, with their sign.
        at: the first row of the blocks, an int32; None is 0.
        rows: how many rows they have, at most `LARGEST`; None is all of them.
        interpret: whether to run on any device by XLA's operations instead, for tests.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    m, n, _ = matrices.shape
    rows = n if rows is None else rows
    at = jnp.zeros((), jnp.int32) if at is None else at
    # Triton's arrays have powers of two for sizes: what is beyond the block is the identity.
    size = padded_size(rows, _SMALLEST)

    def kernel(first, matrix, least, inverse, pivots) -> None:  # type: ignore[no-untyped-def]  # references of Pallas'
        index = jax.lax.broadcasted_iota(jnp.int32, (size,), 0)
        within = index < rows
        both = within[:, None] & within[None, :]
        own = pl.ds(first[0], size)
        a = triton.load(matrix.at[own, own], mask=both, other=0)
        identity = (index[:, None] == index[None, :]) & ~both
        inverted, pivots_so_far = _sweep(jnp.where(identity, 1, a), least[...])
        triton.store(inverse.at[:, :], inverted, mask=both)
        triton.store(pivots.at[:], pivots_so_far, mask=within)

    return pl.pallas_call(
        kernel,
        grid=(m,),
        in_specs=[
            pl.BlockSpec((1,), lambda _: (0,)),
            pl.BlockSpec((None, n, n), lambda i: (i, 0, 0)),
            pl.BlockSpec((None, 1), lambda i: (i, 0)),
        ],
        out_specs=[pl.BlockSpec((None, size, size), lambda i: (i, 0, 0)), pl.BlockSpec((None, size), lambda i: (i, 0))],
        out_shape=[
            jax.ShapeDtypeStruct((m, rows, rows), matrices.dtype),
            jax.ShapeDtypeStruct((m, rows), matrices.dtype),
        ],
        compiler_params=triton.CompilerParams(num_warps=max(size * size // 1024, 1), num_stages=1),
        interpret=interpret,
        name="symmetric_inverses",
    )(at[None], matrices, least[:, None])


def _sweep(a: Float[Array, "n n"], least: Float[Array, " 1"]) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """Sweep one row at a time, always the one with the largest diagonal entry left."""
    n = a.shape[0]
    index = jax.lax.broadcasted_iota(jnp.int32, (n,), 0)

    def sweep(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        a, diagonal, left, pivots_so_far = state
        chosen = index == jax.lax.argmax(jnp.where(left > 0, jnp.abs(diagonal), -1), 0, jnp.int32)
        column = jnp.sum(jnp.where(chosen[None, :], a, 0), axis=1)
        pivot = jnp.sum(jnp.where(chosen, diagonal, 0), axis=0)
        pivot = jnp.where(jnp.abs(pivot) < least, jnp.where(pivot < 0, -least, least), pivot)
        row = jnp.where(chosen, -1, column) / pivot
        a = a - jnp.where(chosen, 0, column)[:, None] * row[None, :]
        a = jnp.where(chosen[:, None], row[None, :], jnp.where(chosen[None, :], row[:, None], a))
        diagonal = jnp.where(chosen, row, diagonal - column * row)
        return a, diagonal, jnp.where(chosen, 0, left), jnp.where(chosen, pivot, pivots_so_far)

    diagonal = jnp.sum(jnp.where(index[:, None] == index[None, :], a, 0), axis=1)
    a, _, _, pivots_so_far = jax.lax.fori_loop(
        0, n, sweep, (a, diagonal, jnp.ones_like(diagonal), jnp.zeros_like(diagonal))
    )
    return -a, pivots_so_far
