"""Block Lanczos for the eigenvalues nearest to a shift."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.eigen.multifrontal import Factorisation
from hks_jax.eigen.products import combine, inner_products
from hks_jax.fem.pencil import Pencil
from hks_jax.traced import is_traced

_CHUNK = 128
"""Called plainly, the basis grows by so many rows at a time: projecting on rows that are still empty costs as much."""


class _Blocks(NamedTuple):
    """Two neighbouring blocks of the basis, and the image under M of the latter."""

    before: Float[Array, "b n_dof"]
    block: Float[Array, "b n_dof"]
    image: Float[Array, "b n_dof"]
    coupling: Float[Array, "b b"]


class _Projected(NamedTuple):
    """Blocks of the block tridiagonal matrix VᵀM(K − σM)⁻¹MV, two on the diagonal and two below it."""

    diagonal: Float[Array, "2 b b"]
    below: Float[Array, "2 b b"]


def block_lanczos(
    pencil: Pencil,
    factor: Factorisation,
    start: Float[Array, "b n_dof"],
    known: Float[Array, "w n_dof"],
    steps: int,
    wanted: int,
) -> tuple[Float[Array, " wanted"], Float[Array, "wanted n_dof"]]:
    """Run Lanczos on (K − σM)⁻¹M, orthogonal to known eigenvectors.

    Neighbouring blocks are kept orthogonal by the recurrence, and two at a time by one pass against the whole basis,
    which reads it from memory half as often and leaves it M-orthonormal to rounding. Traced, the steps are a loop of
    XLA's over a basis of fixed size; called plainly, a loop here, over one that grows.

    Args:
        pencil: K and M.
        factor: the factorisation of K − σM.
        start: the first block, any vectors.
        known: M-orthonormal eigenvectors, or zero rows.
        steps: how many blocks; even.
        wanted: how many Ritz pairs to return.

    Returns:
        The Ritz values θ = 1/(λ − σ), largest magnitude first, and M-orthonormal Ritz vectors.
    """
    b = start.shape[0]
    pairs = steps // 2
    blocks = _begin(pencil, start, known)
    if is_traced(factor):
        empty = jnp.zeros((pairs, 2, b, b), start.dtype)

        def body(j: int, state: tuple[Array, _Blocks, _Projected]) -> tuple[Array, _Blocks, _Projected]:
            rows, blocks, matrix = state
            (_, rows), blocks, part = _two_steps(pencil, factor, [known, rows], blocks, 2 * j * b)
            return rows, blocks, _Projected(*(all_.at[j].set(one) for all_, one in zip(matrix, part, strict=True)))

        state = jnp.zeros((steps * b, start.shape[1]), start.dtype), blocks, _Projected(empty, empty)
        rows, _, matrix = jax.lax.fori_loop(0, pairs, body, state)
        basis = [known, rows]
    else:
        basis, parts = [known], []
        size = max(_CHUNK // (2 * b), 1) * 2 * b
        for row in range(0, steps * b, 2 * b):
            if row % size == 0:
                basis.append(jnp.zeros((min(size, steps * b - row), start.shape[1]), start.dtype))
            basis, blocks, part = _two_steps(pencil, factor, basis, blocks, row % size)
            parts.append(part)
        matrix = jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
    return _ritz_pairs(matrix, basis[1:], wanted)


def _two_steps(
    pencil: Pencil, factor: Factorisation, basis: list[Array], blocks: _Blocks, row: int | Array
) -> tuple[list[Array], _Blocks, _Projected]:
    """Write the last block and one more into the basis, and return the block that follows these."""
    b = blocks.block.shape[0]
    diagonal, rest = _recur(blocks, factor.solve(blocks.image))
    middle, image, coupling = _orthonormal(pencil, rest)
    diagonal_2, rest = _recur(_Blocks(blocks.block, middle, image, coupling), factor.solve(image))
    basis = [*basis[:-1], _write(basis[-1], blocks.block, row)]
    both, images = _join(pencil, middle, image, rest)
    for rows in basis:
        both = _project(rows, both, images)
    middle, rest = _part(both, image)
    basis = [*basis[:-1], _write(basis[-1], middle, row + b)]
    following, image, coupling_2 = _orthonormal(pencil, rest)
    part = _Projected(jnp.stack([diagonal, diagonal_2]), jnp.stack([coupling, coupling_2]))
    return basis, _Blocks(middle, following, image, coupling_2), part


@jax.jit
def _begin(pencil: Pencil, start: Float[Array, "b n_dof"], known: Float[Array, "w n_dof"]) -> _Blocks:
    """Return the first block."""
    block = start
    for _ in range(2):
        block, image, _ = _orthonormal(pencil, _project(known, block, pencil.mass.apply(block)))
    return _Blocks(jnp.zeros_like(block), block, image, jnp.zeros((len(start), len(start)), start.dtype))


@jax.jit
def _recur(blocks: _Blocks, x: Float[Array, "b n_dof"]) -> tuple[Float[Array, "b b"], Float[Array, "b n_dof"]]:
    """Return what x = (K − σM)⁻¹M · block has in the block itself, and x without that block and the one before."""
    before, block, image, coupling = blocks
    diagonal = inner_products(image, x)
    diagonal = (diagonal + diagonal.T) / 2
    return diagonal, x - combine(diagonal, block) - combine(coupling.T, before)


@jax.jit
def _orthonormal(pencil: Pencil, x: Float[Array, "b n_dof"]) -> tuple[Array, Array, Float[Array, "b b"]]:
    """Return M-orthonormal rows y, My, and the factor R of x = Ry."""
    total = jnp.eye(x.shape[0], dtype=x.dtype)
    for _ in range(2):
        image = pencil.mass.apply(x)
        gram = inner_products(x, image)
        norms = jnp.sqrt(jnp.diagonal(gram))
        norms = jnp.where(norms > 0, norms, 1)
        sizes, mix = jnp.linalg.eigh(gram / norms / norms[:, None])
        sizes = jnp.sqrt(jnp.maximum(sizes, jnp.finfo(x.dtype).eps * sizes[-1]))
        change = (mix / sizes / norms[:, None]).T
        x = combine(change, x)
        total = jnp.matmul(total, norms[:, None] * mix * sizes, precision="highest")
    return x, combine(change, image), total


@jax.jit
def _project(basis: Float[Array, "rows n_dof"], x: Array, image: Array) -> Array:
    """Return x, whose image under M is given, orthogonal to the basis."""
    return x - combine(inner_products(basis, image), basis)


@jax.jit
def _join(pencil: Pencil, middle: Array, image: Array, rest: Array) -> tuple[Array, Array]:
    """Return two blocks as one, and their images under M."""
    return jnp.concatenate([middle, rest]), jnp.concatenate([image, pencil.mass.apply(rest)])


@jax.jit
def _part(both: Array, image: Array) -> tuple[Array, Array]:
    """Return two blocks apart, the latter orthogonal to the former, whose image under M is given."""
    middle, rest = jnp.split(both, 2)
    return middle, rest - combine(inner_products(image, rest), middle)


@partial(jax.jit, donate_argnums=0)
def _write(basis: Float[Array, "rows n_dof"], block: Float[Array, "b n_dof"], row: int | Array) -> Array:
    return jax.lax.dynamic_update_slice_in_dim(basis, block, row, axis=0)


@partial(jax.jit, static_argnames="wanted")
def _ritz_pairs(
    matrix: _Projected, basis: list[Float[Array, "rows n_dof"]], wanted: int
) -> tuple[Float[Array, " wanted"], Float[Array, "wanted n_dof"]]:
    pairs, _, b, _ = matrix.diagonal.shape
    steps = 2 * pairs
    diagonal, below = matrix.diagonal.reshape(steps, b, b), matrix.below.reshape(steps, b, b)[:-1]
    full = jnp.zeros((steps, b, steps, b), diagonal.dtype)
    i = jnp.arange(steps)
    full = full.at[i, :, i, :].set(diagonal)
    full = full.at[i[:-1], :, i[1:], :].set(below)
    full = full.at[i[1:], :, i[:-1], :].set(jnp.swapaxes(below, 1, 2))
    theta, modes = jnp.linalg.eigh(full.reshape(steps * b, steps * b))
    order = jnp.argsort(-jnp.abs(theta))[:wanted]
    ends = np.cumsum([len(rows) for rows in basis])[:-1]
    mixes = jnp.split(modes[:, order].T, ends, axis=1)
    vectors = jnp.zeros((), diagonal.dtype)
    for mix, rows in zip(mixes, basis, strict=True):
        vectors = vectors + combine(mix, rows)
    return theta[order], vectors
