"""Kernels for CUDA devices that fuse the operations of block Lanczos on blocks of a few long columns.

Orthogonalisation computes inner products of columns, and combines the columns with coefficients from these products.
XLA launches four kernels for this task: for partial sums of the inner products, for their sum, for the coefficients,
and for the combined columns. This module launches only two kernels. The first kernel computes the partial sums. In the
second kernel, each thread block adds all partial sums, computes the coefficients, and combines its rows of the columns.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.linear import accelerators

LARGEST = 32
"""The largest number of columns of a block."""
_SMALLEST = 8
_NUMBERS = 1 << 13
"""The number of running sums that one thread block of a kernel accumulates in parallel."""
_PARTS, _ROWS = 256, 512
"""The maximal number of partial sums, and the least number of rows per partial sum."""

Block = Float[Array, "n b"]
Small = Float[Array, "b b"]
Parts = Float[Array, "parts b b"]
"""Matrices whose sum is a small matrix, such as xᵀy."""


def parts_of_products(x: Block, y: Block) -> Parts:
    """Return matrices whose sum is xᵀy, one for each range of rows."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    (n, b), size = x.shape, accelerators.padded_size(x.shape[1], _SMALLEST)
    tile = max(_NUMBERS // size**2, 1)
    parts, rows = _divided(n, tile)

    def kernel(x: Any, y: Any, products: Any) -> None:
        index = jax.lax.broadcasted_iota(jnp.int32, (tile, size), 0)
        column = jax.lax.broadcasted_iota(jnp.int32, (tile, size), 1)
        left_over = n - pl.program_id(0) * rows

        def add(number: Array, total: Array) -> Array:
            own = pl.ds(number * tile, tile)
            inside = (number * tile + index < left_over) & (column < b)
            left = triton.load(x.at[own, :], mask=inside, other=0)
            right = triton.load(y.at[own, :], mask=inside, other=0)
            return total + left[:, :, None] * right[:, None, :]

        total = jax.lax.fori_loop(0, rows // tile, add, jnp.zeros((tile, size, size), products.dtype))
        triton.store(products.at[:, :], jnp.sum(total, axis=0), mask=_square(size, b))

    block = pl.BlockSpec((rows, size), lambda i: (i, 0))
    return pl.pallas_call(
        kernel,
        grid=(parts,),
        in_specs=[block, block],
        out_specs=pl.BlockSpec((None, size, size), lambda i: (i, 0, 0)),
        out_shape=jax.ShapeDtypeStruct((parts, b, b), x.dtype),
        compiler_params=triton.CompilerParams(num_warps=8, num_stages=1),
        interpret=accelerators.INTERPRETED,
        name="parts_of_products",
    )(x, y)


def remainder(x: Block, block: Block, parts: Parts, before: tuple[Block, Small] | None = None) -> tuple[Block, Small]:
    """Return the block x − yD and the matrix D, where y is ``block`` and D is the sum of ``parts``.

    If ``before`` = (u, C) is given, return x − yS − uC and S instead, where S is the symmetric part of D.
    """
    columns, matrices = ((x, block), ()) if before is None else ((x, block, before[0]), before[1:])

    def small(total: Array, *matrices: Array) -> tuple[_Terms, Array]:
        total = (total + total.T) / 2 if matrices else total
        return [[(0, None), (1, -total), *((2, -matrix) for matrix in matrices)]], total

    (rest,), total = _combined(small, parts, matrices, columns, 1, "remainder")
    return rest, total


def orthonormal(parts: Parts, columns: tuple[Block, ...], before: Small) -> tuple[tuple[Block, ...], Small]:
    """Factorise G = FFᵀ, the sum of ``parts``; return each block in ``columns`` times F⁻ᵀ, and ``before`` times F.

    If G = xᵀMx, the columns of xF⁻ᵀ are M-orthonormal. A pivoted Cholesky factorisation of G, scaled to unit diagonal,
    gives the factor F. Pivots below rounding level, as of linearly dependent columns, are raised to this level.
    """
    b = len(before)
    floor = b * float(jnp.finfo(before.dtype).eps)

    def small(total: Array, before: Array) -> tuple[_Terms, Array]:
        size = total.shape[0]
        diagonal, inside = _identity(size), _square(size, b)
        norms = jnp.sqrt(jnp.sum(jnp.where(diagonal, total, 0), axis=1))
        norms = jnp.where(norms > 0, norms, 1)
        scaled = jnp.where(diagonal & ~inside, 1, total / norms[:, None] / norms[None, :])
        lower, inverted = _pivoted_cholesky(scaled, floor, b)
        change = inverted / norms[:, None]
        return [[(number, change)] for number in range(len(columns))], _product(before, norms[:, None] * lower)

    return _combined(small, parts, (before,), columns, len(columns), "orthonormal")


def agree(dtype: Any) -> bool:
    """Return whether these kernels are correct on this GPU; see `accelerators.kernels_agree`."""

    def compare() -> list[tuple[Any, Any]]:
        rng, n, b = np.random.default_rng(0), 3 * _ROWS + 5, 7
        x, y, z = (rng.standard_normal((n, b)).astype(dtype) for _ in range(3))
        mix = rng.standard_normal((b, b)).astype(dtype)
        parts = parts_of_products(jnp.asarray(x), jnp.asarray(y))
        products = (x.T @ y + y.T @ x) / 2
        rest, total = remainder(jnp.asarray(x), jnp.asarray(y), parts, (jnp.asarray(z), jnp.asarray(mix)))
        found = [(np.sum(np.asarray(parts), axis=0), x.T @ y), (total, products)]
        found.append((rest, x - y @ products - z @ mix))
        squares = parts_of_products(jnp.asarray(x), jnp.asarray(x))
        (unit,), factor = orthonormal(squares, (jnp.asarray(x),), jnp.asarray(np.eye(b, dtype=dtype)))
        # NumPy computes these products, because JAX's default precision on GPUs has only three digits.
        q, r = np.asarray(unit), np.asarray(factor).T
        return [*found, (q.T @ q, np.eye(b, dtype=dtype)), (q @ r, x)]

    return accelerators.kernels_agree("block Lanczos", dtype, compare)


_Terms = list[list[tuple[int, Array | None]]]
"""Each output block is a sum of terms (index of an input block, matrix factor); None is the identity."""


def _combined(
    small: Callable[..., tuple[_Terms, Array]],
    parts: Parts,
    matrices: tuple[Small, ...],
    columns: tuple[Block, ...],
    wanted: int,
    name: str,
) -> tuple[tuple[Block, ...], Small]:
    """Return combinations of blocks, and a matrix; ``small`` computes coefficients and matrix from the summed parts."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    (n, b), size, dtype = columns[0].shape, accelerators.padded_size(columns[0].shape[1], _SMALLEST), parts.dtype
    tile, several = max(_NUMBERS // size**2, 1), max(_NUMBERS // size**2 // 8, 1)
    programs, rows = _divided(n, tile)

    def kernel(*references: Any) -> None:
        first_column, first_result = 1 + len(matrices), 1 + len(matrices) + len(columns)
        parts, own_matrices = references[0], references[1:first_column]
        blocks, results = references[first_column:first_result], references[first_result:-1]
        square, first = _square(size, b), pl.program_id(0) == 0
        left_over = n - pl.program_id(0) * rows

        def add(number: Array, total: Array) -> Array:
            which = number * several + jax.lax.broadcasted_iota(jnp.int32, (several, size, size), 0)
            inside = (which < count) & square[None]
            part = triton.load(parts.at[pl.ds(number * several, several), :, :], mask=inside, other=0)
            return total + jnp.sum(part, axis=0)

        total = jax.lax.fori_loop(0, -(-count // several), add, jnp.zeros((size, size), dtype))
        loaded = [triton.load(matrix.at[:, :], mask=square, other=0) for matrix in own_matrices]
        terms, matrix = small(total, *loaded)
        triton.store(references[-1].at[:, :], matrix, mask=square & first)
        index = jax.lax.broadcasted_iota(jnp.int32, (tile, size), 0)
        column = jax.lax.broadcasted_iota(jnp.int32, (tile, size), 1)

        def combine(number: Array, _: None) -> None:
            own = pl.ds(number * tile, tile)
            inside = (number * tile + index < left_over) & (column < b)
            given = [triton.load(block.at[own, :], mask=inside, other=0) for block in blocks]
            for result, sums in zip(results, terms, strict=True):
                products = [given[k] if mix is None else _product(given[k], mix) for k, mix in sums]
                triton.store(result.at[own, :], sum(products[1:], products[0]), mask=inside)

        jax.lax.fori_loop(0, rows // tile, combine, None)

    count = len(parts)
    whole = pl.BlockSpec((size, size), lambda i: (0, 0))
    block = pl.BlockSpec((rows, size), lambda i: (i, 0))
    *results, matrix = pl.pallas_call(
        kernel,
        grid=(programs,),
        in_specs=[
            pl.BlockSpec((-(-count // several) * several, size, size), lambda i: (0, 0, 0)),
            *[whole] * len(matrices),
            *[block] * len(columns),
        ],
        out_specs=[*[block] * wanted, whole],
        out_shape=[*[jax.ShapeDtypeStruct((n, b), dtype)] * wanted, jax.ShapeDtypeStruct((b, b), dtype)],
        compiler_params=triton.CompilerParams(num_warps=8, num_stages=1),
        interpret=accelerators.INTERPRETED,
        name=name,
    )(parts, *matrices, *columns)
    return tuple(results), matrix


def _divided(n: int, tile: int) -> tuple[int, int]:
    """Return the number of programs for n rows, and the number of rows of each, a multiple of ``tile``."""
    rows = max(-(-n // _PARTS), min(_ROWS, n))
    rows = -(-rows // tile) * tile
    return -(-n // rows), rows


def _identity(size: int) -> Bool[Array, "size size"]:
    index = jax.lax.broadcasted_iota(jnp.int32, (size,), 0)
    return index[:, None] == index[None, :]


def _square(size: int, b: int) -> Bool[Array, "size size"]:
    """Return the mask of the entries of a padded matrix that belong to the matrix itself."""
    index = jax.lax.broadcasted_iota(jnp.int32, (size,), 0)
    return (index < b)[:, None] & (index < b)[None, :]


def _product(x: Float[Array, "m s"], y: Float[Array, "s s"]) -> Float[Array, "m s"]:
    return jnp.sum(x[:, :, None] * y[None, :, :], axis=1)


def _pivoted_cholesky(a: Small, floor: float, rank: int) -> tuple[Small, Small]:
    """Return the first ``rank`` columns of F and of F⁻ᵀ, where A = FFᵀ; pivots below ``floor`` are raised to ``floor``.

    In the k-th pivot row p of the factor F, the entries F[p, j] are 0 for j > k. Column p of the equation CFᵀ = I
    therefore gives the k-th column of C = F⁻ᵀ from earlier columns: F[p, k] C[:, k] = e_p − Σ_{j<k} F[p, j] C[:, j].
    """
    index = jax.lax.broadcasted_iota(jnp.int32, (a.shape[0],), 0)

    def eliminate(k: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        a, left, factor, inverse = state
        diagonal = jnp.sum(jnp.where(_identity(len(a)), a, 0), axis=1)
        chosen = index == jax.lax.argmax(jnp.where(left > 0, diagonal, -jnp.inf), 0, jnp.int32)
        root = jnp.sqrt(jnp.maximum(jnp.sum(jnp.where(chosen, diagonal, 0), axis=0), floor))
        column = jnp.sum(jnp.where(chosen[None, :], a, 0), axis=1) / root
        column = jnp.where(chosen, root, jnp.where(left > 0, column, 0))
        before = jnp.sum(jnp.where(chosen[:, None], factor, 0), axis=0)
        its_inverse = (chosen.astype(a.dtype) - jnp.sum(inverse * before[None, :], axis=1)) / root
        is_pivot = (index == k)[None, :]
        factor = jnp.where(is_pivot, column[:, None], factor)
        inverse = jnp.where(is_pivot, its_inverse[:, None], inverse)
        return a - column[:, None] * column[None, :], jnp.where(chosen, 0, left), factor, inverse

    # Padding rows are never pivots.
    left = (index < rank).astype(a.dtype)
    zeros = jnp.zeros_like(a)
    _, _, factor, inverse = jax.lax.fori_loop(0, rank, eliminate, (a, left, zeros, zeros))
    return factor, inverse
