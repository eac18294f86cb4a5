"""Block Lanczos for the eigenvalues nearest to a shift."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.basis import Basis, begin, combined, within, write
from hks_jax.eigen.multifrontal import Factorisation
from hks_jax.eigen.products import combine, gram, products_with_columns, times
from hks_jax.fem.operators import OfColumns
from hks_jax.fem.pencil import Pencil
from hks_jax.traced import is_traced

_STRETCH = 16
"""Called plainly, how many steps are one computation, between which it can be interrupted."""


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
        accurate: whether the first solve was; until then it is taken for so.
    """

    basis: Basis
    blocks: _Blocks
    diagonal: Float[Array, "steps b b"]
    below: Float[Array, "steps b b"]
    accurate: Bool[Array, ""]


def block_lanczos(
    pencil: Pencil,
    factor: Factorisation,
    start: Float[Array, "n_dof b"],
    known: Float[Array, "w n_dof"],
    room: int,
    steps: int | Int[Array, ""],
    wanted: int,
    shift: Float[Array, ""],
    allowed: Float[Array, ""],
) -> tuple[Float[Array, " wanted"], Float[Array, "wanted n_dof"], Bool[Array, ""]]:
    """Run Lanczos on (K − σM)⁻¹M, orthogonal to known eigenvectors.

    Neighbouring blocks are kept orthogonal by the recurrence, and two at a time by one pass against the whole basis,
    which reads it from memory half as often and leaves it M-orthonormal to rounding. The steps are a loop of XLA's.

    Args:
        pencil: K and M.
        factor: the factorisation of K − σM.
        start: the first block, any vectors.
        known: M-orthonormal eigenvectors, or zero rows; w a multiple of b.
        room: for how many blocks there is room; static.
        steps: how many blocks to compute, even; traced, as many as there is room for.
        wanted: how many Ritz pairs to return.
        shift: σ.
        allowed: up to which relative defect a solve is accurate.

    Returns:
        The Ritz values θ = 1/(λ − σ), largest magnitude first; M-orthonormal Ritz vectors; zero where there are
        fewer. And whether the first solve was accurate: where it was not, there may be no more than that step.
    """
    state = _begin(pencil, start, known, room)

    def advance(state: _State, first: int, last: int) -> _State:
        return _advance(pencil, factor, state, shift, allowed, len(known), first, last)

    if is_traced(factor):
        # All of them in one loop: were its length to differ within a batch, each turn would copy all of the state.
        steps, state = room, advance(state, 0, room)
    else:
        state, done, steps = advance(state, 0, 1), 1, int(steps)
        while state.accurate and done < steps:
            state, done = advance(state, done, min(done + _STRETCH, steps)), done + _STRETCH
    theta, vectors = _ritz_pairs(state, len(known), steps, wanted)
    return theta, vectors, state.accurate


@jit_quickly(static_argnames="room")
def _begin(pencil: Pencil, start: Float[Array, "n_dof b"], known: Float[Array, "w n_dof"], room: int) -> _State:
    """Return the state before the first step: the first block is orthogonal to what is known."""
    mass, block, b = pencil.mass.of_columns(), start, start.shape[1]
    for _ in range(2):
        block = block - combine(products_with_columns(known, mass(block)).T, known).T
        block, image, _ = _orthonormal(mass, block)
    basis = begin(known, len(known) + room * b, b)
    none, matrix = jnp.zeros((b, b), start.dtype), jnp.zeros((room, b, b), start.dtype)
    return _State(basis, _Blocks(jnp.zeros_like(block), block, image, none), matrix, matrix, jnp.ones((), bool))


@jit_quickly(static_argnames="offset", donate_argnames="state")
def _advance(
    pencil: Pencil,
    factor: Factorisation,
    state: _State,
    shift: Float[Array, ""],
    allowed: Float[Array, ""],
    offset: int,
    first: int | Array,
    last: int | Array,
) -> _State:
    """Take the steps from the first to before the last; their blocks begin at the basis' row ``offset``."""
    stiffness, mass, b = pencil.stiffness.of_columns(), pencil.mass.of_columns(), state.blocks.block.shape[1]

    def step(number: Array, state: _State) -> _State:
        # Write the last block into the basis, and find the one that follows it.
        _, block, image, _ = state.blocks
        solved = factor.solve_columns(image)
        diagonal, rest = _recur(state.blocks, solved)
        row = offset + b * number

        def good() -> Bool[Array, ""]:
            defect = stiffness(solved) - shift * mass(solved) - image
            return jnp.linalg.norm(defect) <= allowed * jnp.linalg.norm(image)

        def project(block: Array, rest: Array) -> tuple[Array, Array]:
            parts = within(state.basis, jnp.concatenate([image, mass(rest)], axis=1), row)
            block, rest = block - parts[:b].T, rest - parts[b:].T
            return block, rest - times(block, gram(image, rest))

        block, rest = jax.lax.cond(number % 2 == 1, project, lambda block, rest: (block, rest), block, rest)
        following, its_image, coupling = _orthonormal(mass, rest)
        return _State(
            write(state.basis, block, row),
            _Blocks(block, following, its_image, coupling),
            state.diagonal.at[number].set(diagonal),
            state.below.at[number].set(coupling),
            jax.lax.cond(number == 0, good, lambda: state.accurate),
        )

    return jax.lax.fori_loop(first, last, step, state)


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


@jit_quickly(static_argnames=("offset", "wanted"))
def _ritz_pairs(
    state: _State, offset: int, steps: int | Int[Array, ""], wanted: int
) -> tuple[Float[Array, " wanted"], Float[Array, "wanted n_dof"]]:
    room, b, _ = state.diagonal.shape
    i = jnp.arange(room)
    # The last block is coupled to one that is not in the basis.
    below = jnp.where((i < steps - 1)[:, None, None], state.below, 0)[:-1]
    full = jnp.zeros((room, b, room, b), below.dtype).at[i, :, i, :].set(state.diagonal)
    full = full.at[i[:-1], :, i[1:], :].set(below)
    full = full.at[i[1:], :, i[:-1], :].set(jnp.swapaxes(below, 1, 2))
    theta, modes = jnp.linalg.eigh(full.reshape(room * b, room * b))
    order = jnp.argsort(-jnp.abs(theta))[:wanted]
    return theta[order], combined(jnp.pad(modes[:, order].T, ((0, 0), (offset, 0))), state.basis)
