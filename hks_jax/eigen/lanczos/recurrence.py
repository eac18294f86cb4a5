"""Block Lanczos for the eigenvalues nearest to a shift."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.lanczos.basis import Basis, begin, combined, within, write
from hks_jax.eigen.lanczos.columns import orthonormal, recur, without
from hks_jax.linear import accelerators, lapack
from hks_jax.linear.multifrontal import Factorisation
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import combine, products_with_columns
from hks_jax.traced import is_traced

_STRETCH = 16
"""Called plainly, how many steps are one computation on a CPU, between which it can be interrupted."""


class ShiftedSolve(NamedTuple):
    """How to apply (K − σM)⁻¹.

    Attributes:
        factor: the factorisation of K − σM.
        shift: σ.
        passes: how often to solve: once, or again with the defect, where the factorisation is inaccurate; at most twice
            on accelerators. None: once, for which nothing else is compiled.
    """

    factor: Factorisation
    shift: Float[Array, ""]
    passes: Int[Array, ""] | None


class _Blocks(NamedTuple):
    """Two neighbouring blocks of the basis, and the image under M of the latter."""

    before: Float[Array, "n_dof b"]
    block: Float[Array, "n_dof b"]
    image: Float[Array, "n_dof b"]
    coupling: Float[Array, "b b"]


class _Recurrence(NamedTuple):
    """What has been computed so far.

    Attributes:
        basis: known eigenvectors and the blocks so far, M-orthonormal rows; the rest is zero.
        blocks: the last two blocks, of which the latter is not yet in the basis.
        matrix: the blocks on the diagonal of the block tridiagonal matrix VᵀM(K − σM)⁻¹MV, and those below it.
    """

    basis: Basis
    blocks: _Blocks
    matrix: Float[Array, "steps two b b"]


def block_lanczos(
    pencil: SymmetricPencil,
    shifted: ShiftedSolve,
    start: Float[Array, "n_dof b"],
    known: Float[Array, "w n_dof"],
    room: int,
    steps: int | Int[Array, ""],
    wanted: int,
) -> tuple[Float[Array, " wanted"], Float[Array, "wanted n_dof"]]:
    """Run Lanczos on (K − σM)⁻¹M, orthogonal to known eigenvectors.

    Neighbouring blocks are kept orthogonal by the recurrence, and in double precision two at a time by one pass against
    the whole basis, which reads it from memory half as often and leaves it M-orthonormal to rounding.
    The steps are a loop of XLA's.

    Args:
        pencil: K and M.
        shifted: how to solve with K − σM.
        start: the first block, any vectors.
        known: M-orthonormal eigenvectors, or zero rows; w a multiple of b, 0 where nothing is known.
        room: for how many blocks there is room; static.
        steps: how many blocks to compute, even; traced, as many as there is room for.
        wanted: how many Ritz pairs to return.

    Returns:
        The Ritz values θ = 1/(λ − σ), largest magnitude first, and M-orthonormal Ritz vectors; zero where there are
        fewer.
    """
    state = _begin(pencil, start, known, room)

    def advance(state: _Recurrence, first: int, last: int) -> _Recurrence:
        return _advance(pencil, shifted, state, len(known), first, last)

    if is_traced(shifted):
        # All of them in one loop: were its length to differ within a batch, each turn would copy all of the state.
        steps, state = room, advance(state, 0, room)
    else:
        steps = int(steps)
        if shifted.passes is not None and int(shifted.passes) == 1:
            shifted = shifted._replace(passes=None)
        if accelerators.at_hand():
            for done in range(0, steps, 2):
                state = _advance_by_two(pencil, shifted, state, len(known), done)
        else:
            for done in range(0, steps, _STRETCH):
                state = advance(state, done, min(done + _STRETCH, steps))
    return _ritz_pairs(state, len(known), steps, wanted)


@jit_quickly(static_argnames="room")
def _begin(
    pencil: SymmetricPencil, start: Float[Array, "n_dof b"], known: Float[Array, "w n_dof"], room: int
) -> _Recurrence:
    """Return the state before the first step: the first block is orthogonal to what is known."""
    mass, block, b = pencil.mass.of_columns(), start, start.shape[1]
    for _ in range(2 if len(known) else 0):
        block = block - combine(products_with_columns(known, mass(block)).T, known).T
        block, _, _ = orthonormal(mass, block)
    block, image, _ = orthonormal(mass, block)
    basis = begin(known, len(known) + room * b, b)
    none, matrix = jnp.zeros((b, b), start.dtype), jnp.zeros((room, 2, b, b), start.dtype)
    return _Recurrence(basis, _Blocks(jnp.zeros_like(block), block, image, none), matrix)


@jit_quickly(static_argnames="offset", donate_argnames="state")
def _advance(
    pencil: SymmetricPencil,
    shifted: ShiftedSolve,
    state: _Recurrence,
    offset: int,
    first: int | Array,
    last: int | Array,
) -> _Recurrence:
    """Take the steps from the first to before the last; their blocks begin at the basis' row ``offset``."""
    every = _every(state.blocks.block.dtype)
    if accelerators.at_hand():
        # Whether to project is known of every step in two. How often to solve is asked once, and not in each step, for
        # which the host would wait.
        def by_two(shifted: ShiftedSolve, state: _Recurrence) -> _Recurrence:
            steps = _stepping(pencil, shifted, offset)
            return jax.lax.fori_loop(
                first // 2, last // 2, lambda two, state: steps(2 * two, state, (every == 1, True)), state
            )

        assert shifted.passes is not None
        once = partial(by_two, shifted._replace(passes=None))
        return jax.lax.cond(_in_any(shifted.passes > 1), partial(by_two, shifted), once, state)
    steps = _stepping(pencil, shifted, offset)
    return jax.lax.fori_loop(
        first, last, lambda number, state: steps(number, state, ((number + 1) % every == 0,)), state
    )


@jit_quickly(static_argnames="offset", donate_argnames="state")
def _advance_by_two(
    pencil: SymmetricPencil, shifted: ShiftedSolve, state: _Recurrence, offset: int, first: int | Array
) -> _Recurrence:
    """Take two steps without a loop or a condition, so that nothing has to wait for the device."""
    steps = _stepping(pencil, shifted, offset)
    return steps(jnp.asarray(first), state, (_every(state.blocks.block.dtype) == 1, True))


def _stepping(
    pencil: SymmetricPencil, shifted: ShiftedSolve, offset: int
) -> Callable[[Array, _Recurrence, tuple[bool | Array, ...]], _Recurrence]:
    """Return how to take steps: of the first one's number, the state, and whether each projects on the whole basis."""
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    factor, shift, passes = shifted

    def solve(rhs: Float[Array, "n_dof b"]) -> Float[Array, "n_dof b"]:
        if passes is None:
            return factor.solve_columns(rhs)
        last = passes - 1

        def defect_of(x: Array) -> Array:
            return rhs - (stiffness(x) - shift * mass(x))

        def refine(done: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            x, defect = state
            x = x + factor.solve_columns(defect)
            return x, jax.lax.cond(done < last, defect_of, lambda _: defect, x)

        if accelerators.at_hand():
            x = factor.solve_columns(rhs)
            return x + factor.solve_columns(defect_of(x))
        return jax.lax.fori_loop(0, passes, refine, (jnp.zeros_like(rhs), rhs))[0]

    def step(
        number: Array, basis: Basis, blocks: _Blocks, now: bool | Array
    ) -> tuple[Basis, _Blocks, Float[Array, "two b b"]]:
        # Write the last block into the basis, and find the one that follows it.
        before, block, image, coupling = blocks
        b = block.shape[1]
        onward, diagonal = recur(block, image, before, coupling, solve(image))
        row = offset + b * number

        def project(block: Array, onward: Array) -> tuple[Array, Array]:
            parts = within(basis, jnp.concatenate([image, mass(onward)], axis=1), row)
            block = block - parts[:, :b]
            return block, without(block, image, onward - parts[:, b:])

        if not isinstance(now, bool):
            block, onward = jax.lax.cond(now, project, lambda block, onward: (block, onward), block, onward)
        elif now:
            block, onward = project(block, onward)
        following, its_image, coupling = orthonormal(mass, onward)
        blocks = _Blocks(block, following, its_image, coupling)
        return write(basis, block, row), blocks, jnp.stack([diagonal, coupling])

    def steps(number: Array, state: _Recurrence, projecting: tuple[bool | Array, ...]) -> _Recurrence:
        basis, blocks, entries = state.basis, state.blocks, []
        for ahead, now in enumerate(projecting):
            basis, blocks, entry = step(number + ahead, basis, blocks, now)
            entries.append(entry)
        matrix = jax.lax.dynamic_update_slice_in_dim(state.matrix, jnp.stack(entries), number, axis=0)
        return _Recurrence(basis, blocks, matrix)

    return steps


# Of a condition that differs within a batch both branches would be computed, for all of it. To solve again is right
# where it is not needed, too.
@jax.custom_batching.custom_vmap
def _in_any(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """Return a condition; within a batch, whether it holds for any problem of it."""
    return condition


@_in_any.def_vmap
def _in_any_of_batch(size: int, batched: list[bool], conditions: Bool[Array, " batch"]) -> tuple[Bool[Array, ""], bool]:
    return jnp.any(conditions), False


def _every(dtype: np.dtype) -> int:
    """Return after how many steps to project on the whole basis.

    Next to the shift an eigenvalue's θ may be a thousand times as large as the others, and what rounding leaves of its
    eigenvector in a block grows as much in a step: in single precision there is room for one.
    """
    return 2 if jnp.finfo(dtype).bits == 64 else 1


@jit_quickly(static_argnames=("offset", "wanted"))
def _ritz_pairs(
    state: _Recurrence, offset: int, steps: int | Int[Array, ""], wanted: int
) -> tuple[Float[Array, " wanted"], Float[Array, "wanted n_dof"]]:
    room, _, b, _ = state.matrix.shape
    i = jnp.arange(room)
    diagonal, below = state.matrix[:, 0], state.matrix[:-1, 1]
    # The last block is coupled to one that is not in the basis.
    below = jnp.where((i[:-1] < steps - 1)[:, None, None], below, 0)
    full = jnp.zeros((room, b, room, b), below.dtype).at[i, :, i, :].set(diagonal)
    full = full.at[i[:-1], :, i[1:], :].set(below)
    full = full.at[i[1:], :, i[:-1], :].set(jnp.swapaxes(below, 1, 2))
    theta, modes = lapack.eigh(full.reshape(room * b, room * b))
    order = jnp.argsort(-jnp.abs(theta))[:wanted]
    return theta[order], combined(jnp.pad(modes[:, order].T, ((0, 0), (offset, 0))), state.basis)
