"""Products of blocks of vectors, arranged for speed in XLA, and quadratic forms in many vectors."""

from collections.abc import Callable
from functools import partial, reduce
from operator import add
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import library_of
from hks_jax.linear import accelerators
from hks_jax.linear.linear_map import with_transpose

_MANY, _TERMS = 512, 40
"""On CPUs, batched products are summed term by term if at least ``_MANY`` matrices have at most ``_TERMS`` columns. For
smaller batches or larger matrices, compiling these sums would take longer than they save."""
_ROWS, _LARGE = (4, 5, 3, 7, 2), 1 << 18
"""If an array has at least ``_LARGE`` entries, groups of its rows are multiplied together in the cache. The size of a
group is the first number in ``_ROWS`` that divides the number of rows, because remaining rows would be copied."""


def products_with_columns(basis: Float[Array, "m n"], columns: Float[Array, "n c"]) -> Float[Array, "m c"]:
    """Return the inner products of the rows of ``basis`` with the columns.

    For long contractions, XLA's CPU kernels are many times faster if the left factor is the larger one. The
    optimisation barrier keeps XLA from exchanging the factors ``basis`` and ``columns``.
    """
    return jax.lax.optimization_barrier(matmul(basis, columns))


def inner_products(basis: Float[Array, "m n"], block: Float[Array, "b n"]) -> Float[Array, "b m"]:
    """Return the inner products (b, m) of the rows of ``block`` with the rows of ``basis``."""
    if len(basis) < len(block):
        return products_with_columns(block, basis.T)  # the larger factor on the left
    return jax.lax.optimization_barrier(products_with_columns(basis, block.T).T)


def matmul(*factors: Any) -> Any:
    """Return the product of (batches of) matrices of JAX or NumPy, on every device in the precision of their dtype."""
    return reduce(np.matmul if library_of(*factors) is np else partial(jnp.matmul, precision="highest"), factors)


def batched_with_columns(matrices: Float[Array, "m i j"], columns: Float[Array, "m j b"]) -> Float[Array, "m i b"]:
    """Return the products of a batch of matrices with a few columns each.

    XLA's CPU kernels compute all products of small matrices in one thread. So for many matrices, sums are written out
    term by term, which XLA distributes over all threads.
    """
    if accelerators.at_hand() or len(matrices) < _MANY or matrices.shape[2] > _TERMS:
        return matmul(matrices, columns)
    # XLA might fuse the computation of ``columns`` into the sum, and repeat this computation for each row of a matrix.
    # A `cond` with equal results of both branches prevents the fusion.
    return jax.lax.cond(jnp.isfinite(columns[0, 0, 0]), _written_out, matmul, matrices, columns)


def _written_out(matrices: Float[Array, "m i j"], columns: Float[Array, "m j b"]) -> Float[Array, "m i b"]:
    return reduce(add, (matrices[:, :, j : j + 1] * columns[:, j : j + 1] for j in range(matrices.shape[2])))


# The derivative with respect to parameters of ``function`` is a sum over the rows. XLA fuses this sum if the rows are
# written out one by one; as a reduction, the sum would be many times slower on CPUs. `jax.checkpoint` recomputes
# intermediate results of ``function``, because storing them would take several arrays as large as ``rows``.
def of_each_row(
    function: Callable[[Float[Array, "*shape"]], Float[Array, "*shape"]], rows: Float[Array, "b *shape"]
) -> Float[Array, "b *shape"]:
    """Apply a linear function to each row of the array ``rows``."""

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
    """Return the inner products xᵀy of columns."""
    return matmul(x.T, y)


def of_each_column(x: Any, y: Any) -> Any:
    """Return the inner product of each column of x with the same column of y, for arrays (n, b) of JAX or NumPy.

    If x is a product with a stencil, XLA's CPU compiler would fuse a sum of entries with half of the stencil's terms,
    and store the others: three times the memory and four times the time. It does not fuse a matrix product.
    """
    return matmul(x.T, y).diagonal()


def even_size(count: int, most: int) -> int:
    """Return the block size for dividing ``count`` items into the fewest blocks of equal size, at most ``most``."""
    return -(-count // -(-count // most))


def row_blocks(
    count: int, size: int
) -> tuple[Int[np.ndarray, " blocks"], tuple[Int[np.ndarray, " count"], Int[np.ndarray, " count"]]]:
    """Return the first row of each block (the last block may overlap), and each row's block and place in it."""
    starts = np.minimum(np.arange(0, count, size), count - size)
    block = np.arange(count) // size
    return starts, (block, np.arange(count) - starts[block])


def aligned(x: Array, like: ArrayLike) -> Array:
    """Return x with leading axes of length 1 up to the rank of ``like``, because a user may forbid rank promotion."""
    return jnp.expand_dims(x, tuple(range(jnp.ndim(like) - x.ndim)))


_OF_MATRIX, _BLOCKS = 64, 8
"""The least number of rows in a block of a matrix, and the maximal number of blocks, which are compiled separately."""
_POINTS = 2048
"""The number of points x in a step of `quadratic_forms`; a few hundred vectors at so many points fit into the cache."""


# Since C is symmetric, only its upper triangle is used, in blocks of rows. Entries to the right of a block's diagonal
# square count twice. A block is omitted if no function from its first row on matters for C. The outermost loop runs
# over groups of points x, so that the values φᵢ(x) are read from memory only once.
def quadratic_forms(
    matrices: Float[Array, "m k k"], vectors: Float[Array, "k n"], matters: Bool[Array, "m k"]
) -> Float[Array, "m n"]:
    """Return Σᵢⱼ Cᵢⱼ φᵢ(x) φⱼ(x) for each matrix C; not differentiable with respect to φ.

    ``matters`` states for each matrix C which functions φᵢ matter. If neither φᵢ nor φⱼ matters, Cᵢⱼ may count as zero.
    """
    (m, k), n = matters.shape, vectors.shape[1]
    size, width = min(max(_OF_MATRIX, -(-k // _BLOCKS)), k), min(_POINTS, n)
    first, (starts, _) = np.arange(0, k, size), row_blocks(n, width)
    past_last = jnp.max(jnp.where(matters, np.arange(1, k + 1), 0), axis=1)
    # Sort the matrices by descending number of blocks that they use, and count the matrices that use each block.
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
            own = jnp.where(start + np.arange(width) >= number * width, own, 0)  # counts each point once
            results = []
            for i, count, block in zip(first, counts, blocks, strict=True):

                def add(turn: Array, block: Array, right: Array = some[i:]) -> Array:
                    one = order[turn]
                    weighted = right[: block.shape[2]] * own[one][None]
                    return block.at[one].add(matmul(right, weighted.T))

                results.append(jax.lax.fori_loop(0, count, add, block))
            return results

        none = [jnp.zeros((m, k - i, min(size, k - i)), vectors.dtype) for i in first]
        return [block.mT for block in jax.lax.fori_loop(0, len(starts), add_points, none)]

    square = np.arange(k) // size == np.arange(k)[:, None] // size
    triangle = jnp.where(square, matrices, 2 * matrices)
    return with_transpose(forms, transpose, [triangle[:, i : i + size, i:] for i in first])
