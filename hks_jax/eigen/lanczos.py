"""Block Lanczos for the eigenvalues nearest to a shift."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.eigen.basis import Basis, begin, combined, within, write
from hks_jax.eigen.multifrontal import Factorisation
from hks_jax.eigen.products import combine, gram, products_with_columns, times
from hks_jax.fem.operators import OfColumns
from hks_jax.fem.pencil import Pencil
from hks_jax.traced import is_traced

_STRETCH = 8
"""Called plainly, how many pairs of steps are one computation, between which it can be interrupted."""


class _Blocks(NamedTuple):
    """Two neighbouring blocks of the basis, and the image under M of the latter."""

    before: Float[Array, "n_dof b"]
    block: Float[Array, "n_dof b"]
    image: Float[Array, "n_dof b"]
    coupling: Float[Array, "b b"]


class _State(NamedTuple):
    """What has been computed so far.

    Attributes:
        basis: known eigenvectors and the blocks so far, M-orthonormal rows; the rest is zero.
        blocks: the last two blocks, of which the latter is not yet in the basis.
        diagonal: the blocks on the diagonal of the block tridiagonal matrix VᵀM(K − σM)⁻¹MV.
        below: the blocks below it.
    """

    basis: Basis
    blocks: _Blocks
    diagonal: Float[Array, "room 2 b b"]
    below: Float[Array, "room 2 b b"]


def block_lanczos(
    pencil: Pencil,
    factor: Factorisation,
    start: Float[Array, "b n_dof"],
    known: Float[Array, "w n_dof"],
    room: int,
    pairs: Int[Array, ""],
    wanted: int,
) -> tuple[Float[Array, " wanted"], Float[Array, "wanted n_dof"]]:
    """Run Lanczos on (K − σM)⁻¹M, orthogonal to known eigenvectors.

    Neighbouring blocks are kept orthogonal by the recurrence, and two at a time by one pass against the whole basis,
    which reads it from memory half as often and leaves it M-orthonormal to rounding. The steps are a loop of XLA's.

    Args:
        pencil: K and M.
        factor: the factorisation of K − σM.
        start: the first block, any vectors.
        known: M-orthonormal eigenvectors, or zero rows; w a multiple of b.
        room: for how many pairs of blocks there is room; static.
        pairs: how many pairs of blocks to compute.
        wanted: how many Ritz pairs to return.

    Returns:
        The Ritz values θ = 1/(λ − σ), largest magnitude first, and M-orthonormal Ritz vectors; zero where there are
        fewer.
    """
    state = _begin(pencil, start, known, room)
    if is_traced(factor):
        state = _advance(pencil, factor, state, len(known), 0, pairs)
    else:
        for first in range(0, int(pairs), _STRETCH):
            state = _advance(pencil, factor, state, len(known), first, min(first + _STRETCH, int(pairs)))
    return _ritz_pairs(state, len(known), pairs, wanted)


@partial(jax.jit, static_argnames="room")
def _begin(pencil: Pencil, start: Float[Array, "b n_dof"], known: Float[Array, "w n_dof"], room: int) -> _State:
    """Return the state before the first step: the first block is orthogonal to what is known."""
    mass, block, b = pencil.mass.of_columns(), start.T, len(start)
    for _ in range(2):
        block = block - combine(products_with_columns(known, mass(block)).T, known).T
        block, image, _ = _orthonormal(mass, block)
    basis = begin(known, len(known) + 2 * room * b, b)
    none, matrix = jnp.zeros((b, b), start.dtype), jnp.zeros((room, 2, b, b), start.dtype)
    return _State(basis, _Blocks(jnp.zeros_like(block), block, image, none), matrix, matrix)


@partial(jax.jit, static_argnames="offset", donate_argnames="state")
def _advance(
    pencil: Pencil, factor: Factorisation, state: _State, offset: int, first: int | Array, last: int | Array
) -> _State:
    """Take the pairs of steps from the first to before the last; their blocks begin at the basis' row ``offset``."""
    mass, b = pencil.mass.of_columns(), state.blocks.block.shape[1]

    def two_steps(pair: Array, state: _State) -> _State:
        # Write the last block and one more into the basis, and find the block that follows these.
        row = offset + 2 * b * pair
        _, block, image, _ = state.blocks
        diagonal, rest = _recur(state.blocks, factor.solve_columns(image))
        middle, image, coupling = _orthonormal(mass, rest)
        diagonal_2, rest = _recur(_Blocks(block, middle, image, coupling), factor.solve_columns(image))
        basis = write(state.basis, block, row)
        parts = within(basis, jnp.concatenate([image, mass(rest)], axis=1), row + b)
        middle, rest = middle - parts[:b].T, rest - parts[b:].T
        rest = rest - times(middle, gram(image, rest))
        basis = write(basis, middle, row + b)
        following, image, coupling_2 = _orthonormal(mass, rest)
        return _State(
            basis,
            _Blocks(middle, following, image, coupling_2),
            state.diagonal.at[pair].set(jnp.stack([diagonal, diagonal_2])),
            state.below.at[pair].set(jnp.stack([coupling, coupling_2])),
        )

    return jax.lax.fori_loop(first, last, two_steps, state)


def _recur(blocks: _Blocks, x: Float[Array, "n_dof b"]) -> tuple[Float[Array, "b b"], Float[Array, "n_dof b"]]:
    """Return what x = (K − σM)⁻¹M · block has in the block itself, and x without that block and the one before."""
    before, block, image, coupling = blocks
    diagonal = gram(image, x)
    diagonal = (diagonal + diagonal.T) / 2
    return diagonal, x - times(block, diagonal) - times(before, coupling)


def _orthonormal(
    mass: OfColumns, x: Float[Array, "n_dof b"]
) -> tuple[Float[Array, "n_dof b"], Float[Array, "n_dof b"], Float[Array, "b b"]]:
    """Return M-orthonormal columns y, My, and the factor R of x = yRᵀ."""
    total = jnp.eye(x.shape[1], dtype=x.dtype)
    for _ in range(2):
        image = mass(x)
        products = gram(x, image)
        norms = jnp.sqrt(jnp.diagonal(products))
        norms = jnp.where(norms > 0, norms, 1)
        sizes, mix = jnp.linalg.eigh(products / norms / norms[:, None])
        sizes = jnp.sqrt(jnp.maximum(sizes, jnp.finfo(x.dtype).eps * sizes[-1]))
        change = mix / sizes / norms[:, None]
        x = times(x, change)
        total = times(total, norms[:, None] * mix * sizes)
    return x, times(image, change), total


@partial(jax.jit, static_argnames=("offset", "wanted"))
def _ritz_pairs(
    state: _State, offset: int, pairs: Int[Array, ""], wanted: int
) -> tuple[Float[Array, " wanted"], Float[Array, "wanted n_dof"]]:
    room, _, b, _ = state.diagonal.shape
    steps = 2 * room
    i = jnp.arange(steps)
    # The last block is coupled to one that is not in the basis.
    below = jnp.where((i < 2 * pairs - 1)[:, None, None], state.below.reshape(steps, b, b), 0)[:-1]
    full = jnp.zeros((steps, b, steps, b), below.dtype)
    full = full.at[i, :, i, :].set(state.diagonal.reshape(steps, b, b))
    full = full.at[i[:-1], :, i[1:], :].set(below)
    full = full.at[i[1:], :, i[:-1], :].set(jnp.swapaxes(below, 1, 2))
    theta, modes = jnp.linalg.eigh(full.reshape(steps * b, steps * b))
    order = jnp.argsort(-jnp.abs(theta))[:wanted]
    return theta[order], combined(jnp.pad(modes[:, order].T, ((0, 0), (offset, 0))), state.basis)
