"""Block Lanczos for the eigenvalues nearest to a shift."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.lanczos import krylov_basis
from hks_jax.eigen.lanczos.krylov_basis import Basis, Block, Small, orthonormal
from hks_jax.linear import accelerators, lapack
from hks_jax.linear.multifrontal import Factorisation
from hks_jax.linear.products import matmul, products_with_columns
from hks_jax.linear.symmetric_pencil import SymmetricPencil
from hks_jax.traced import is_traced

_STRETCH = 16
"""The number of Lanczos steps per compiled call outside `jit` on a CPU; a user can interrupt between two calls."""

Known = Float[Array, "w n_dof"]
RitzPairs = tuple[Float[Array, " ritz"], Float[Array, "ritz n_dof"]]
"""Ritz values θ = 1/(λ − σ) by descending magnitude, and M-orthonormal Ritz vectors, padded with zeros."""


class ShiftedSolve(NamedTuple):
    """The data for applying (K − σM)⁻¹."""

    factor: Factorisation  # the factorisation of K − σM
    shift: Float[Array, ""]  # σ
    passes: Int[Array, ""] | None  # the number of solves per step: 1, or 2 with refinement; None means always 1


class _Recurrence(NamedTuple):
    basis: Basis  # M-orthonormal rows: the known eigenvectors, then the blocks so far; the other rows are zero
    before: Block  # the last block in the basis
    block: Block  # the next block, which is not yet in the basis
    image: Block  # the product of M and `block`
    coupling: Small  # the matrix that couples `before` and `block`
    # the diagonal and subdiagonal blocks of the block tridiagonal matrix VᵀM(K − σM)⁻¹MV, where V has the blocks so far
    matrix: Float[Array, "steps two b b"]


def block_lanczos(
    pencil: SymmetricPencil,
    shifted: ShiftedSolve,
    start: Block,  # any vectors, from which the first block is made
    known: Known,  # M-orthonormal eigenvectors or zero rows; their number w is 0 or a multiple of the block size b
    room: int,  # the maximal number of blocks; static
    steps: int | Int[Array, ""],  # the number of blocks to compute, even; under `jit`, `room` blocks are computed
    wanted: int,
) -> RitzPairs:
    """Run block Lanczos on (K − σM)⁻¹M, orthogonal to known eigenvectors.

    The recurrence keeps consecutive blocks orthogonal. In double precision, only every second step orthogonalises
    against the whole basis, but for two blocks at once. The basis is then read half as often as with orthogonalisation
    in every step, and stays M-orthonormal to rounding.
    """
    state, traced = _begin(pencil, start, known, room), is_traced(shifted)
    # Under `jit`, `room` steps are taken, because each step would copy the state if the number varied in a batch.
    steps = room if traced else int(steps)
    if not traced and shifted.passes is not None and int(shifted.passes) == 1:
        shifted = shifted._replace(passes=None)
    # On accelerators, a compiled call has two steps and no loop, so that the host never waits for the device.
    alone = accelerators.at_hand() and not traced
    stretch = room if traced else 2 if alone else _STRETCH
    for done in range(0, steps, stretch):
        state = _advance(pencil, shifted, state, len(known), alone, done, min(done + stretch, steps))
    return _ritz_pairs(state, len(known), steps, wanted)


@jit_quickly(static_argnames="room")
def _begin(pencil: SymmetricPencil, start: Block, known: Known, room: int) -> _Recurrence:
    mass, block, b = pencil.mass.of_columns(), start, start.shape[1]
    for _ in range(2 if len(known) else 0):
        block = block - matmul(products_with_columns(known, mass(block)).T, known).T
        block, _, _ = orthonormal(mass, block)
    block, image, _ = orthonormal(mass, block)
    basis = krylov_basis.begin(known, len(known) + room * b, b)
    none, matrix = jnp.zeros((b, b), start.dtype), jnp.zeros((room, 2, b, b), start.dtype)
    return _Recurrence(basis, jnp.zeros_like(block), block, image, none, matrix)


@jit_quickly(static_argnames=("offset", "alone"), donate_argnames="state")
def _advance(
    pencil: SymmetricPencil,
    shifted: ShiftedSolve,
    state: _Recurrence,
    offset: int,
    alone: bool,  # whether there are only two steps, which need no loop
    first: int | Array,
    last: int | Array,
) -> _Recurrence:
    """Take the Lanczos steps ``first``, …, ``last`` − 1, whose blocks begin at row ``offset`` of the basis."""
    # If an eigenvalue is close to the shift, its Ritz value θ may be 1000 times as large as the others, and a step
    # amplifies rounding errors along its eigenvector 1000 times. So in float32, every step orthogonalises against the
    # whole basis.
    every = 2 if state.block.dtype == jnp.float64 else 1
    two = accelerators.at_hand()

    def advance(shifted: ShiftedSolve, state: _Recurrence) -> _Recurrence:
        steps = _stepping(pencil, shifted, offset)

        def turn(number: Array, state: _Recurrence) -> _Recurrence:
            if two:  # it is static which of two steps orthogonalises against the basis
                return steps(2 * number, state, (every == 1, True))
            return steps(number, state, ((number + 1) % every == 0,))

        ends = (first // 2, last // 2) if two else (first, last)
        return turn(jnp.asarray(ends[0]), state) if alone else jax.lax.fori_loop(*ends, turn, state)

    if two and not alone and shifted.passes is not None:
        # Outside the loop, the condition on the number of passes makes the host wait for the device only once.
        once = partial(advance, shifted._replace(passes=None))
        return jax.lax.cond(_in_any(shifted.passes > 1), partial(advance, shifted), once, state)
    return advance(shifted, state)


def _stepping(
    pencil: SymmetricPencil, shifted: ShiftedSolve, offset: int
) -> Callable[[Array, _Recurrence, tuple[bool | Array, ...]], _Recurrence]:
    """Return a function that takes a few Lanczos steps; flags tell which steps orthogonalise against the basis."""
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    factor, shift, passes = shifted

    def solve(rhs: Block) -> Block:
        if passes is None:
            return factor.solve(rhs)

        def residual_of(x: Array) -> Array:
            return rhs - (stiffness(x) - shift * mass(x))

        if accelerators.at_hand():
            x = factor.solve(rhs)
            return x + factor.solve(residual_of(x))

        # A loop over the passes compiles the triangular solves only once.
        def refine(done: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            x, residual = state
            x = x + factor.solve(residual)
            return x, jax.lax.cond(done < passes - 1, residual_of, lambda _: residual, x)

        return jax.lax.fori_loop(0, passes, refine, (jnp.zeros_like(rhs), rhs))[0]

    def step(number: Array, state: _Recurrence, now: bool | Array) -> tuple[_Recurrence, Array]:
        # Write the current block into the basis, and compute the next block.
        basis, before, block, image, coupling, matrix = state
        b = block.shape[1]
        onward, diagonal = krylov_basis.recur(block, image, before, coupling, solve(image))
        row = offset + b * number

        def project(block: Array, onward: Array) -> tuple[Array, Array]:
            parts = krylov_basis.within(basis, jnp.concatenate([image, mass(onward)], axis=1), row)
            block = block - parts[:, :b]
            return block, krylov_basis.without(block, image, onward - parts[:, b:])

        if not isinstance(now, bool):
            block, onward = jax.lax.cond(now, project, lambda block, onward: (block, onward), block, onward)
        elif now:
            block, onward = project(block, onward)
        following, its_image, coupling = orthonormal(mass, onward)
        basis = krylov_basis.write(basis, block, row)
        return _Recurrence(basis, block, following, its_image, coupling, matrix), jnp.stack([diagonal, coupling])

    def steps(number: Array, state: _Recurrence, projecting: tuple[bool | Array, ...]) -> _Recurrence:
        entries = []
        for ahead, now in enumerate(projecting):
            state, entry = step(number + ahead, state, now)
            entries.append(entry)
        matrix = jax.lax.dynamic_update_slice_in_dim(state.matrix, jnp.stack(entries), number, axis=0)
        return state._replace(matrix=matrix)

    return steps


# If a condition varies within a batch, XLA computes both branches for all problems. An unnecessary refinement does no
# harm, so the whole batch takes one branch.
@jax.custom_batching.custom_vmap
def _in_any(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """Return the condition or, under `vmap`, whether the condition holds for any problem of the batch."""
    return condition


@_in_any.def_vmap
def _in_any_of_batch(size: int, batched: list[bool], conditions: Bool[Array, " batch"]) -> tuple[Bool[Array, ""], bool]:
    return jnp.any(conditions), False


@jit_quickly(static_argnames=("offset", "wanted"))
def _ritz_pairs(state: _Recurrence, offset: int, steps: int | Int[Array, ""], wanted: int) -> RitzPairs:
    room, _, b, _ = state.matrix.shape
    i = jnp.arange(room)
    diagonal, below = state.matrix[:, 0], state.matrix[:-1, 1]
    # The coupling matrix after the last step belongs to a block outside the basis, so it is set to zero.
    below = jnp.where((i[:-1] < steps - 1)[:, None, None], below, 0)
    full = jnp.zeros((room, b, room, b), below.dtype).at[i, :, i, :].set(diagonal)
    full = full.at[i[:-1], :, i[1:], :].set(below)
    full = full.at[i[1:], :, i[:-1], :].set(jnp.swapaxes(below, 1, 2))
    theta, modes = lapack.eigh(full.reshape(room * b, room * b))
    order = jnp.argsort(-jnp.abs(theta))[:wanted]
    return theta[order], krylov_basis.combined(jnp.pad(modes[:, order].T, ((0, 0), (offset, 0))), state.basis)
