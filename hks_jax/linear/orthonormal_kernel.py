"""The Cholesky factor of a small Gram matrix, and its inverse, in one launch of a kernel, for CUDA devices."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LARGEST = 32
_SMALLEST = 16


def cholesky_and_inverse(
    products: Float[Array, "b b"], interpret: bool = False
) -> tuple[Float[Array, "b b"], Float[Array, "b b"]]:
    """Return F with FFᵀ = G, and F⁻ᵀ: with G the inner products of columns x, those of xF⁻ᵀ are the identity.

    The columns are scaled to length one first, and taken in the order of what the ones before leave of them; of those
    that depend on the ones before, to rounding, the least length that rounding tells from zero is kept.

    Args:
        products: G, at most 32 rows.
        interpret: whether to run on any device by XLA's operations instead, for tests.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    b, dtype = products.shape[0], products.dtype
    # Triton's arrays have powers of two for sizes: what is beyond the matrix is the identity.
    size = max(_SMALLEST, 1 << (b - 1).bit_length())
    floor = b * float(jnp.finfo(dtype).eps)

    def kernel(matrix, factor, inverse) -> None:  # type: ignore[no-untyped-def]  # references of Pallas'
        index = jax.lax.broadcasted_iota(jnp.int32, (size,), 0)
        within = index < b
        both = within[:, None] & within[None, :]
        a = triton.load(matrix.at[:, :], mask=both, other=0)
        on_diagonal = index[:, None] == index[None, :]
        a = jnp.where(on_diagonal & ~both, 1, a)
        norms = jnp.sqrt(jnp.sum(jnp.where(on_diagonal, a, 0), axis=1))
        norms = jnp.where(norms > 0, norms, 1)
        lower, inverted = _pivoted_cholesky(a / norms[:, None] / norms[None, :], floor, b)
        triton.store(factor.at[:, :], norms[:, None] * lower, mask=both)
        triton.store(inverse.at[:, :], inverted / norms[:, None], mask=both)

    block = pl.BlockSpec((size, size), lambda: (0, 0))
    return pl.pallas_call(
        kernel,
        in_specs=[block],
        out_specs=[block, block],
        out_shape=[jax.ShapeDtypeStruct((b, b), dtype)] * 2,
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="cholesky_and_inverse",
    )(products)


def _pivoted_cholesky(
    a: Float[Array, "n n"], floor: float, rank: int
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Return F with FFᵀ = A but for pivots that are raised to the floor, and F⁻ᵀ; the first ``rank`` columns of both.

    The k-th column of C = F⁻ᵀ follows from CFᵀ = I, whose column for the k-th row p chosen has no terms beyond: F[p, k]
    times it is e_p less those of the columns before.
    """
    index = jax.lax.broadcasted_iota(jnp.int32, (a.shape[0],), 0)

    def eliminate(k: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        a, left, factor, inverse = state
        diagonal = jnp.sum(jnp.where(index[:, None] == index[None, :], a, 0), axis=1)
        chosen = index == jax.lax.argmax(jnp.where(left > 0, diagonal, -jnp.inf), 0, jnp.int32)
        root = jnp.sqrt(jnp.maximum(jnp.sum(jnp.where(chosen, diagonal, 0), axis=0), floor))
        column = jnp.sum(jnp.where(chosen[None, :], a, 0), axis=1) / root
        column = jnp.where(chosen, root, jnp.where(left > 0, column, 0))
        before = jnp.sum(jnp.where(chosen[:, None], factor, 0), axis=0)
        its_inverse = (chosen.astype(a.dtype) - jnp.sum(inverse * before[None, :], axis=1)) / root
        is_pivot = (index == k)[None, :]
        factor, inverse = (
            jnp.where(is_pivot, column[:, None], factor),
            jnp.where(is_pivot, its_inverse[:, None], inverse),
        )
        return a - column[:, None] * column[None, :], jnp.where(chosen, 0, left), factor, inverse

    # What is beyond the matrix is never chosen.
    left = (index < rank).astype(a.dtype)
    zeros = jnp.zeros_like(a)
    _, _, factor, inverse = jax.lax.fori_loop(0, rank, eliminate, (a, left, zeros, zeros))
    return factor, inverse
