"""Block Lanczos for the eigenvalues nearest to a shift."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.lanczos.basis import Basis, begin, combined, within, write
from hks_jax.linear import accelerators, orthonormal_kernel
from hks_jax.linear.multifrontal import Factorisation
from hks_jax.linear.operators import OfColumns
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import combine, gram, products_with_columns, times
from hks_jax.traced import is_traced

_STRETCH = 16
"""Called plainly, how many steps are one computation on a CPU, between which it can be interrupted."""


class ShiftedSolve(NamedTuple):
    """How to apply (K − σM)⁻¹.

    Attributes:
        factor: the factorisation of K − σM.
        shift: σ.
        passes: how often to solve: once, or again with the defect, where the factorisation is inaccurate.
    """

    factor: Factorisation
    shift: Float[Array, ""]
    passes: int | Int[Array, ""]


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
        diagonal: the blocks on the diagonal of the block tridiagonal matrix VᵀM(K − σM)⁻¹MV.
        below: the blocks below it.
    """

    basis: Basis
    blocks: _Blocks
    diagonal: Float[Array, "steps b b"]
    below: Float[Array, "steps b b"]


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
        known: M-orthonormal eigenvectors, or zero rows; w a multiple of b.
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
    elif accelerators.at_hand():
        steps, passes = int(steps), int(shifted.passes)
        for done in range(0, steps, 2):
            state = _advance_by_two(pencil, shifted.factor, shifted.shift, state, len(known), done, passes)
    else:
        steps = int(steps)
        for done in range(0, steps, _STRETCH):
            state = advance(state, done, min(done + _STRETCH, steps))
    return _ritz_pairs(state, len(known), steps, wanted)


@jit_quickly(static_argnames="room")
def _begin(
    pencil: SymmetricPencil, start: Float[Array, "n_dof b"], known: Float[Array, "w n_dof"], room: int
) -> _Recurrence:
    """Return the state before the first step: the first block is orthogonal to what is known."""
    mass, block, b = pencil.mass.of_columns(), start, start.shape[1]
    for _ in range(2):
        block = block - combine(products_with_columns(known, mass(block)).T, known).T
        block, image, _ = _orthonormal(mass, block)
    basis = begin(known, len(known) + room * b, b)
    none, matrix = jnp.zeros((b, b), start.dtype), jnp.zeros((room, b, b), start.dtype)
    return _Recurrence(basis, _Blocks(jnp.zeros_like(block), block, image, none), matrix, matrix)


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
    step, every = _stepping(pencil, shifted, offset), _every(state.blocks.block.dtype)
    if accelerators.at_hand():
        # Whether to project is known of every step in two.
        def two(number: Array, state: _Recurrence) -> _Recurrence:
            return step(2 * number + 1, step(2 * number, state, every == 1), True)

        return jax.lax.fori_loop(first // 2, last // 2, two, state)
    return jax.lax.fori_loop(first, last, lambda number, state: step(number, state, (number + 1) % every == 0), state)


@jit_quickly(static_argnames=("offset", "passes"), donate_argnames="state")
def _advance_by_two(
    pencil: SymmetricPencil,
    factor: Factorisation,
    shift: Float[Array, ""],
    state: _Recurrence,
    offset: int,
    first: int | Array,
    passes: int,
) -> _Recurrence:
    """Take two steps without a loop or a condition, so that nothing has to wait for the device."""
    step, number = _stepping(pencil, ShiftedSolve(factor, shift, passes), offset), jnp.asarray(first)
    return step(number + 1, step(number, state, _every(state.blocks.block.dtype) == 1), True)


def _stepping(
    pencil: SymmetricPencil, shifted: ShiftedSolve, offset: int
) -> Callable[[Array, _Recurrence, bool | Array], _Recurrence]:
    """Return how to take a step: of its number, the state, and whether to project on the whole basis."""
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    factor, shift, passes = shifted

    def solve(rhs: Float[Array, "n_dof b"]) -> Float[Array, "n_dof b"]:
        def refine(done: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            x, defect = state
            x = x + factor.solve_columns(defect)
            again = done < passes - 1
            return x, jax.lax.cond(again, lambda: rhs - (stiffness(x) - shift * mass(x)), lambda: defect)

        def refined(_: Array, x: Array) -> Array:
            return x + factor.solve_columns(rhs - (stiffness(x) - shift * mass(x)))

        if accelerators.at_hand():
            return jax.lax.fori_loop(0, passes - 1, refined, factor.solve_columns(rhs))
        return jax.lax.fori_loop(0, passes, refine, (jnp.zeros_like(rhs), rhs))[0]

    def step(number: Array, state: _Recurrence, now: bool | Array) -> _Recurrence:
        # Write the last block into the basis, and find the one that follows it.
        _, block, image, _ = state.blocks
        b = block.shape[1]
        solved = solve(image)
        diagonal, onward = _recur(state.blocks, solved)
        row = offset + b * number

        def project(block: Array, onward: Array) -> tuple[Array, Array]:
            parts = within(state.basis, jnp.concatenate([image, mass(onward)], axis=1), row)
            block, onward = block - parts[:b].T, onward - parts[b:].T
            return block, onward - times(block, gram(image, onward))

        if not isinstance(now, bool):
            block, onward = jax.lax.cond(now, project, lambda block, onward: (block, onward), block, onward)
        elif now:
            block, onward = project(block, onward)
        following, its_image, coupling = _orthonormal(mass, onward)
        return _Recurrence(
            write(state.basis, block, row),
            _Blocks(block, following, its_image, coupling),
            state.diagonal.at[number].set(diagonal),
            state.below.at[number].set(coupling),
        )

    return step


def _every(dtype: np.dtype) -> int:
    """Return after how many steps to project on the whole basis.

    Next to the shift an eigenvalue's θ may be a thousand times as large as the others, and what rounding leaves of its
    eigenvector in a block grows as much in a step: in single precision there is room for one.
    """
    return 2 if jnp.finfo(dtype).bits == 64 else 1


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
        factor, change = _factored(products)
        x = times(x, change)
        total = times(total, factor)
    return x, times(image, change), total


def _factored(products: Float[Array, "b b"]) -> tuple[Float[Array, "b b"], Float[Array, "b b"]]:
    """Return F with FFᵀ = G, the inner products, and F⁻ᵀ, of what rounding leaves: nothing becomes infinite.

    By eigenvalues; where kernels compile, for which these take long, by a pivoted Cholesky factorisation.
    """
    if accelerators.kernels_compile() and len(products) <= orthonormal_kernel.LARGEST:
        kernel = orthonormal_kernel.cholesky_and_inverse
        return jax.lax.platform_dependent(products, cuda=kernel, default=_factored_by_eigenvalues)
    return _factored_by_eigenvalues(products)


def _factored_by_eigenvalues(products: Float[Array, "b b"]) -> tuple[Float[Array, "b b"], Float[Array, "b b"]]:
    norms = jnp.sqrt(jnp.diagonal(products))
    norms = jnp.where(norms > 0, norms, 1)
    sizes, mix = jnp.linalg.eigh(products / norms / norms[:, None])
    sizes = jnp.sqrt(jnp.maximum(sizes, jnp.finfo(products.dtype).eps * sizes[-1]))
    return norms[:, None] * mix * sizes, mix / sizes / norms[:, None]


@jit_quickly(static_argnames=("offset", "wanted"))
def _ritz_pairs(
    state: _Recurrence, offset: int, steps: int | Int[Array, ""], wanted: int
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
