"""Quadratic forms Σᵢⱼ Cᵢⱼ φᵢ(x) φⱼ(x) at many points x, for several symmetric matrices C."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.linear.linear_map import with_transpose
from hks_jax.linear.products import combine, row_blocks, transposed

_ROWS, _BLOCKS = 64, 8
"""At least how many rows of C are taken together, and at most how often: each time is compiled apart."""
_POINTS = 2048
"""Points at which the vectors, of a few hundred functions, stay in the cache."""


# Of C the upper triangle is enough, in blocks of rows from the diagonal on: what is beside their first square counts
# twice. Where only the first few functions matter, blocks beyond the last of them are left out. A few points at a time,
# the vectors are read from memory once for all matrices and blocks.
def quadratic_forms(
    matrices: Float[Array, "m k k"], vectors: Float[Array, "k n"], matters: Bool[Array, "m k"]
) -> Float[Array, "m n"]:
    """Return Σᵢⱼ Cᵢⱼ φᵢ(x) φⱼ(x) for each C; not differentiable with respect to φ.

    Args:
        matrices: C; of its entries between functions that do not matter some may be taken for zero.
        vectors: φ.
        matters: which functions matter, for each C.
    """
    (m, k), n = matters.shape, vectors.shape[1]
    size, width = min(max(_ROWS, -(-k // _BLOCKS)), k), min(_POINTS, n)
    first, (starts, _) = np.arange(0, k, size), row_blocks(n, width)
    past_last = jnp.max(jnp.where(matters, np.arange(1, k + 1), 0), axis=1)
    # Matrices in the order of how many of their blocks count, and how many have the first block, the second …
    order, counts = jnp.argsort(-past_last), jnp.sum(past_last[None] > first[:, None], axis=1)

    def at_points(number: Array) -> tuple[Array, Float[Array, "k width"]]:
        start = jnp.asarray(starts)[number]
        return start, jax.lax.optimization_barrier(jax.lax.dynamic_slice_in_dim(vectors, start, width, axis=1))

    def forms(blocks: list[Float[Array, "m _i _j"]]) -> Float[Array, "m n"]:
        def put(number: Array, values: Array) -> Array:
            start, some = at_points(number)
            total = jnp.zeros((m, width), vectors.dtype)
            for i, count, block in zip(first, counts, blocks, strict=True):

                def add(turn: Array, total: Array, block: Array = block, right: Array = some[i:]) -> Array:
                    one = order[turn]
                    return total.at[one].add(jnp.sum(right[: block.shape[1]] * combine(block[one], right), axis=0))

                total = jax.lax.fori_loop(0, count, add, total)
            return jax.lax.dynamic_update_slice_in_dim(values, total, start, axis=1)

        return jax.lax.fori_loop(0, len(starts), put, jnp.zeros((m, n), vectors.dtype))

    def transpose(weights: Float[Array, "m n"]) -> list[Float[Array, "m _i _j"]]:
        def add_points(number: Array, blocks: list[Array]) -> list[Array]:
            start, some = at_points(number)
            own = jax.lax.dynamic_slice_in_dim(weights, start, width, axis=1)
            own = jnp.where(start + np.arange(width) >= number * width, own, 0)  # each point once
            results = []
            for i, count, block in zip(first, counts, blocks, strict=True):

                def add(turn: Array, block: Array, right: Array = some[i:]) -> Array:
                    one = order[turn]
                    weighted = right[: block.shape[2]] * own[one][None]
                    return block.at[one].add(jnp.matmul(right, weighted.T, precision="highest"))

                results.append(jax.lax.fori_loop(0, count, add, block))
            return results

        none = [jnp.zeros((m, k - i, min(size, k - i)), vectors.dtype) for i in first]
        return [transposed(block) for block in jax.lax.fori_loop(0, len(starts), add_points, none)]

    square = np.arange(k) // size == np.arange(k)[:, None] // size
    triangle = jnp.where(square, matrices, 2 * matrices)
    return with_transpose(forms, transpose, [triangle[:, i : i + size, i:] for i in first])
