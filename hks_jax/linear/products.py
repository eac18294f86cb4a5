"""Products of blocks of vectors, as XLA computes them fastest, and quadratic forms in many of them."""

from collections.abc import Callable
from functools import partial, reduce
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Inexact, Int

from hks_jax.linear import accelerators
from hks_jax.linear.linear_map import with_transpose

_MANY, _TERMS = 512, 40
"""For how many matrices, of how many columns at most, products on a CPU are written out: others take longer to compile
than they gain."""
_ROWS, _LARGE = (4, 5, 3, 7, 2), 1 << 18
"""How many rows of an array of so many numbers are multiplied at a time, which stay in the cache: the first of these by
which their number can be divided, as what were left over would have to be copied."""


def products_with_columns(basis: Float[Array, "m n"], columns: Float[Array, "n c"]) -> Float[Array, "m c"]:
    """Return the inner products.

    XLA's CPU kernels for a long contraction are many times faster with the large factor on the left: the barrier keeps
    XLA from turning the product round.
    """
    return jax.lax.optimization_barrier(matmul(basis, columns))


def inner_products(basis: Float[Array, "m n"], block: Float[Array, "b n"]) -> Float[Array, "b m"]:
    """Return the inner products with rows, as what comes after takes them fastest: the small factor on the left."""
    if len(basis) < len(block):
        return products_with_columns(block, basis.T)  # the larger factor on the left
    return jax.lax.optimization_barrier(products_with_columns(basis, block.T).T)


def matmul(*factors: Inexact[Array, "*batch _ _"]) -> Inexact[Array, "*batch _ _"]:
    """Return the product of matrices, or of batches of them, in the precision of their entries on every device."""
    return reduce(partial(jnp.matmul, precision="highest"), factors)


def batched_with_columns(matrices: Float[Array, "m i j"], columns: Float[Array, "m j b"]) -> Float[Array, "m i b"]:
    """Return the products of a batch of matrices with a few columns each.

    XLA's CPU kernels compute all products of small matrices in one thread: those of many are a loop over sums that are
    written out term by term, which is dealt out to all threads.
    """
    if accelerators.at_hand() or len(matrices) < _MANY or matrices.shape[2] > _TERMS:
        return matmul(matrices, columns)
    # Computed as part of the loop, the columns would be computed anew for each row. A condition XLA computes apart from
    # what comes before it; both ways are right.
    return jax.lax.cond(jnp.isfinite(columns[0, 0, 0]), _written_out, matmul, matrices, columns)


def _written_out(matrices: Float[Array, "m i j"], columns: Float[Array, "m j b"]) -> Float[Array, "m i b"]:
    return reduce(add, (matrices[:, :, j : j + 1] * columns[:, j : j + 1] for j in range(matrices.shape[2])))


def transposed(x: Inexact[Array, "m i j"]) -> Inexact[Array, "m j i"]:
    """Return the transposes of a batch of matrices."""
    return jnp.swapaxes(x, 1, 2)


# Written out row by row, the derivative by what the function depends on, which sums over the rows, is a fused sum and
# not a reduction, which XLA does many times slower on CPUs. What the function makes of a row is made again in it: kept,
# it would be several arrays of the size of all rows.
def of_each_row(
    function: Callable[[Float[Array, "*shape"]], Float[Array, "*shape"]], rows: Float[Array, "b *shape"]
) -> Float[Array, "b *shape"]:
    """Return a linear function of each row."""

    @jax.checkpoint
    def of_some(some: Float[Array, "c *shape"]) -> Float[Array, "c *shape"]:
        return jnp.stack([function(row) for row in some])

    count, *shape = rows.shape
    size = next((size for size in _ROWS if count % size == 0), _ROWS[0])
    if rows.size < _LARGE or count < size:
        return jax.checkpoint(jax.vmap(function))(rows)
    rest = count % size
    done = jax.lax.map(of_some, rows[: count - rest].reshape(-1, size, *shape)).reshape(-1, *shape)
    return jnp.concatenate([done, of_some(rows[count - rest :])]) if rest else done


def gram(x: Float[Array, "n b"], y: Float[Array, "n c"]) -> Float[Array, "b c"]:
    """Return the inner products of columns."""
    return matmul(x.T, y)


def even_size(count: int, most: int) -> int:
    """Return the size of as few blocks as can be, none larger than the most, if all are of one size."""
    return -(-count // -(-count // most))


def row_blocks(
    count: int, size: int
) -> tuple[Int[np.ndarray, " blocks"], tuple[Int[np.ndarray, " count"], Int[np.ndarray, " count"]]]:
    """Return the first rows of blocks, the last of which may overlap, and where each row is: (block, row within)."""
    starts = np.minimum(np.arange(0, count, size), count - size)
    block = np.arange(count) // size
    return starts, (block, np.arange(count) - starts[block])


def aligned(x: Array, like: ArrayLike) -> Array:
    """Return x with axes before its own, as many as ``like`` has: `jax_numpy_rank_promotion` may forbid to add them."""
    return jnp.expand_dims(x, tuple(range(jnp.ndim(like) - x.ndim)))


_OF_MATRIX, _BLOCKS = 64, 8
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

    Of C's entries between functions that do not matter for it some may be taken for zero.
    """
    (m, k), n = matters.shape, vectors.shape[1]
    size, width = min(max(_OF_MATRIX, -(-k // _BLOCKS)), k), min(_POINTS, n)
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
                    return total.at[one].add(jnp.sum(right[: block.shape[1]] * matmul(block[one], right), axis=0))

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
                    return block.at[one].add(matmul(right, weighted.T))

                results.append(jax.lax.fori_loop(0, count, add, block))
            return results

        none = [jnp.zeros((m, k - i, min(size, k - i)), vectors.dtype) for i in first]
        return [transposed(block) for block in jax.lax.fori_loop(0, len(starts), add_points, none)]

    square = np.arange(k) // size == np.arange(k)[:, None] // size
    triangle = jnp.where(square, matrices, 2 * matrices)
    return with_transpose(forms, transpose, [triangle[:, i : i + size, i:] for i in first])
