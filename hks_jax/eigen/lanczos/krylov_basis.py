"""A growing M-orthonormal Krylov basis, and operations on its blocks."""

from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.linear import accelerators, lapack
from hks_jax.linear.operators import OfColumns
from hks_jax.linear.products import gram, matmul, products_with_columns

_PIECE = 128
"""The number of basis vectors per `Piece`. Projections use whole pieces of the basis, and skip empty pieces."""
_SMALL = 1e-7
"""The largest components that may be projected out in single precision; the remainder is then at rounding level."""
_NODES = 2048
"""The number of degrees of freedom per step of `combined`: operands and results fit into the cache."""


class Piece(NamedTuple):
    """Rows of the basis, with a copy in single precision if the rows are in double precision."""

    rows: Float[Array, "rows n_dof"]
    single: Float[Array, "rows n_dof"] | None


Basis = tuple[Piece, ...] | Float[Array, "n_dof rows"]
Block = Float[Array, "n_dof b"]
Small = Float[Array, "b b"]


def begin(known: Float[Array, "w n_dof"], size: int, block: int) -> Basis:
    """Return a basis that begins with the known vectors and has room for ``size`` rows; the other rows are zero.

    The number of known vectors and ``size`` are multiples of ``block``, the number of vectors that `write` appends. On
    accelerators, the basis is a single array, because skipping its unused parts would take longer than computing with
    them. On accelerators, basis vectors are columns, as in Lanczos blocks, so that no kernel has to transpose.
    """
    if accelerators.at_hand():
        return jnp.pad(known.T, ((0, 0), (0, size - len(known))))
    step = max(_PIECE // block, 1) * block
    pieces = []
    for at in range(0, size, step):
        rows = known[at : at + step]
        rows = jnp.pad(rows, ((0, min(step, size - at) - len(rows)), (0, 0)))
        pieces.append(Piece(rows, None if rows.dtype == jnp.float32 else rows.astype(jnp.float32)))
    return tuple(pieces)


def write(basis: Basis, block: Block, row: Int[Array, ""]) -> Basis:
    """Write the b columns of a block as rows of the basis, from ``row`` on, which is a multiple of b."""
    if not isinstance(basis, tuple):
        return jax.lax.dynamic_update_slice_in_dim(accelerators.row_by_row(basis), block, row, axis=1)
    # The barrier keeps XLA from transposing the block again for each piece of the basis.
    block, written = jax.lax.optimization_barrier(block.T), []
    for piece, at in zip(basis, _starts(basis), strict=True):
        size = len(piece.rows)
        inside, place = (row >= at) & (row < at + size), jnp.clip(row - at, 0, size - len(block))
        single = None if piece.single is None else _put(piece.single, block, place, inside)
        written.append(Piece(_put(piece.rows, block, place, inside), single))
    return tuple(written)


# One step of shift-invert Lanczos amplifies a block's component along a converged eigenvector 10 to 100 times. So in
# two steps, rounding errors in a block x grow to components c = VᵀMx of 1e-14 to 1e-9 along the basis V. The sums for c
# need double precision, because their rounding errors would otherwise be as large as c. Single precision suffices to
# subtract the projection Vc from x, unless c is large because the shift is close to an eigenvalue.
def within(basis: Basis, images: Float[Array, "n_dof c"], filled: Int[Array, ""]) -> Float[Array, "n_dof c"]:
    """Return VVᵀMx, the projection of columns x on the first ``filled`` basis vectors V, given ``images`` = Mx."""
    if not isinstance(basis, tuple):
        return matmul(accelerators.row_by_row(basis), gram(basis, images))
    used = [filled > at for at in _starts(basis)]

    def none(rows: Array, x: Array) -> Float[Array, "rows c"]:
        return jnp.zeros((len(rows), x.shape[1]), x.dtype)

    products = [
        jax.lax.cond(filled_piece, products_with_columns, none, piece.rows, images)
        for filled_piece, piece in zip(used, basis, strict=True)
    ]

    def taken(pieces: list[Array]) -> Float[Array, "c n_dof"]:
        dtype = pieces[0].dtype
        parts = jnp.zeros(images.shape[::-1], dtype)
        for filled_piece, product, rows in zip(used, products, pieces, strict=True):
            mix = product.T.astype(dtype)
            parts = jax.lax.cond(filled_piece, lambda m, r, p: p + matmul(m, r), lambda m, r, p: p, mix, rows, parts)
        return parts.astype(images.dtype)

    whole = [piece.rows for piece in basis]
    single = [piece.single for piece in basis if piece.single is not None]
    if not single:
        return taken(whole).T
    small: Bool[Array, ""] = jnp.max(jnp.abs(jnp.concatenate(products))) < _SMALL
    return jax.lax.cond(small, lambda: taken(single), lambda: taken(whole)).T


def combined(mix: Float[Array, "q m"], basis: Basis) -> Float[Array, "q n_dof"]:
    """Return linear combinations of all rows of the basis."""
    if not isinstance(basis, tuple):
        return matmul(mix, basis.T)
    n = basis[0].rows.shape[1]
    width = min(_NODES, n)
    mixes = jnp.split(mix, _starts(basis)[1:], axis=1)

    def some(number: Array, sums_so_far: Float[Array, "q n_dof"]) -> Float[Array, "q n_dof"]:
        at = jnp.minimum(number * width, n - width)  # the last two ranges of nodes may overlap
        parts = [jax.lax.dynamic_slice_in_dim(piece.rows, at, width, axis=1) for piece in basis]
        sums = sum(map(matmul, mixes, parts), jnp.zeros((), mix.dtype))
        return jax.lax.dynamic_update_slice_in_dim(sums_so_far, sums, at, axis=1)

    return jax.lax.fori_loop(0, -(-n // width), some, jnp.zeros((len(mix), n), mix.dtype))


def _starts(basis: Basis) -> list[int]:
    return list(accumulate((len(piece.rows) for piece in basis[:-1]), initial=0))


def _put(
    rows: Float[Array, "rows n_dof"], block: Float[Array, "b n_dof"], place: Int[Array, ""], inside: Bool[Array, ""]
) -> Float[Array, "rows n_dof"]:
    block = block.astype(rows.dtype)
    # A loop of at most one iteration writes only to the block's piece of the basis; a mask would write to every piece.
    return jax.lax.fori_loop(
        0, inside.astype(int), lambda _, rows: jax.lax.dynamic_update_slice_in_dim(rows, block, place, axis=0), rows
    )


def recur(block: Block, image: Block, before: Block, coupling: Small, x: Block) -> tuple[Block, Small]:
    """Orthogonalise x = (K − σM)⁻¹M · block against the block and the previous block; also return blockᵀMx."""
    diagonal = gram(image, x)
    diagonal = (diagonal + diagonal.T) / 2
    return x - matmul(block, diagonal) - matmul(before, coupling), diagonal


def without(block: Block, image: Block, x: Block) -> Block:
    """Orthogonalise x against the M-orthonormal columns of a block, whose image under M is given."""
    return x - matmul(block, gram(image, x))


def orthonormal(mass: OfColumns, x: Block) -> tuple[Block, Block, Small]:
    """Return M-orthonormal columns y, My, and the factor R of x = yRᵀ.

    The Gram matrix is factorised twice by its eigenvalues. Divisors have a lower bound, so that no entry becomes
    infinite.
    """
    y, total = x, jnp.asarray(np.eye(x.shape[1], dtype=x.dtype))  # a constant, so that nothing computes it
    for _ in range(2):
        image = mass(y)
        factor, change = _factored(gram(y, image))
        y = matmul(y, change)
        total = matmul(total, factor)
    return y, matmul(image, change), total


def _factored(products: Small) -> tuple[Small, Small]:
    """Return F and F⁻ᵀ, where FFᵀ = G is the Gram matrix."""
    norms = jnp.sqrt(jnp.diagonal(products))
    norms = jnp.where(norms > 0, norms, 1)
    sizes, mix = lapack.eigh(products / norms[None] / norms[:, None])
    sizes = jnp.sqrt(jnp.maximum(sizes, jnp.finfo(products.dtype).eps * sizes[-1]))
    return norms[:, None] * mix * sizes[None], mix / sizes[None] / norms[:, None]
