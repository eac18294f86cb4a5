"""The multifrontal LDLᵀ factorisation of K − σM, for linear solves, and for eigenvalue counts by its inertia.

The computation is batched dense algebra, with one batch for each level of the nested dissection. In 2D, a factorisation
takes O(N^1.5) operations and a solve O(N log N), in O(log N) sequential steps. The code runs on every device, under
`jit` and `vmap`.
"""

import math
from collections.abc import Callable
from itertools import accumulate
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Inexact, Int

from hks_jax.arrays import Scalar
from hks_jax.compilation import jit_quickly
from hks_jax.linear import lapack
from hks_jax.linear.dissection import Dissection, Level, Merged
from hks_jax.linear.products import batched_with_columns, gram, matmul
from hks_jax.linear.symmetric_inverse import symmetric_inverses
from hks_jax.linear.symmetric_pencil import SymmetricPencil

CONTRACTION = 0.1
"""The largest convergence rate of iterative refinement at which the inertia of a factorisation is accepted."""

Blocks = tuple[Array, ...]
"""A batch of dense blocks for each level."""


class Factorisation(eqx.Module):
    """The multifrontal factorisation K − σM = LDLᵀ.

    A front consists of the block A of the nodes that it eliminates, the block C of its boundary nodes, and the block B
    that couples the boundary nodes to the eliminated nodes. Eliminating the block A leaves the Schur complement C −
    BA⁻¹Bᵀ. If several shifts σ are factorised together, arrays have an additional leading axis.
    """

    dissection: Dissection  # the elimination tree
    # A⁻¹ stacked on BA⁻¹, (fronts, s + r, s), for each level of the tree that solves use
    downward: tuple[Float[Array, "... _fronts _s_plus_r _s"], ...]
    upward: tuple[Float[Array, "... _fronts _s _r"], ...]  # (BA⁻¹)ᵀ, (fronts, s, r)
    # pivots: their product is the determinant, and their signs give the inertia of K − σM; padding has pivots 1
    pivots: Float[Array, "... pivots"]

    @property
    def arrays(self) -> tuple[Blocks, Blocks, Array]:
        """All arrays except the dissection, which XLA would copy if compiled functions returned it."""
        return self.downward, self.upward, self.pivots

    @property
    def negative(self) -> Int[Array, "..."]:
        """The number of negative eigenvalues, which equals the number of the pencil's eigenvalues below σ."""
        return jnp.sum(self.pivots < 0, axis=-1)

    @jax.jit
    def solve(self, rhs: Float[Array, "n_dof b"]) -> Float[Array, "n_dof b"]:
        """Solve (K − σM) x = rhs for each column."""
        tree = self.dissection.merged or self.dissection
        x, _ = _substituted(tree.levels, self.downward, self.upward, rhs)
        return taken(x, tree.order)


class Trial(NamedTuple):
    """The measured accuracy of a factorisation."""

    sound: Bool[Array, ""]  # whether the factors have the inertia of K − σM
    # ‖b − (K − σM)x‖/‖b‖ of solutions x for random b, which estimates the convergence rate of iterative refinement
    rate: Scalar
    # the largest ‖(K − σM)x − b‖/‖Mx‖ of M-orthonormal solutions x, a lower bound for the residuals of eigenpairs near
    # σ; measured residuals are 1 to 15 times as large as this bound, rarely up to 40 times
    error: Scalar


# If the shift is an eigenvalue of a subdomain, a pivot vanishes. A small pivot δ causes Schur complements of size 1/δ
# and, because the next front is inverted explicitly, rounding errors of ε/δ². Replacing δ by the least allowed pivot
# changes the matrix by at most twice this pivot. Rounding errors and the change are equal and bounded if the least
# allowed pivot is near ε^(1/3) (static pivoting, Li and Demmel 1998). In measurements, ε^(3/8) as the least allowed
# pivot gives the best eigenvalue counts. A first factorisation replaces no pivots, as small pivots may be harmless.
def factorise(dissection: Dissection, matrix: Float[Array, " m"], least: Scalar | None = None) -> Factorisation:
    """Factorise a symmetric matrix, without pivoting between fronts; `try_out` measures the accuracy.

    The matrix is given by its entries on the sparsity pattern, as from `SymmetricPencil.shifted`. Pivots smaller than
    ``least``, relative to the entries of the front, are replaced by ±``least``.
    """
    return Factorisation(dissection, *_eliminate(dissection, matrix, least))


# Let A = K − σM be the given matrix, and F = A + E the computed LDLᵀ with the rounding error E. If the spectral radius
# of EF⁻¹ is below one, then F − tE = (1 − tEF⁻¹)F is nonsingular for all t in [0, 1]. No eigenvalue crosses zero
# between F (t = 0) and A (t = 1), so that F and A have equal inertia. A solution x = F⁻¹b has the residual b − Ax =
# EF⁻¹b. Solving again with the residual as right-hand side is a step of power iteration for EF⁻¹. If the first residual
# is tiny, one step suffices, as a random b has a component of order 1/√n along every direction.
@jit_quickly()
def try_out(factor: Factorisation, pencil: SymmetricPencil, shift: Scalar, b: Float[Array, "n_dof b"]) -> Trial:
    """Measure the accuracy of a factorisation with random right-hand sides b."""
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    tiny = CONTRACTION / math.sqrt(len(b))

    def in_doubt(state: Any) -> Bool[Array, ""]:
        turn, rates, _, _ = state
        return (turn == 0) | ((turn == 1) & (rates[0] >= tiny) & (rates[0] < CONTRACTION))

    def solve(state: Any) -> tuple[Array, Array, Array, Array]:
        turn, rates, error, b = state
        x = factor.solve(b)
        image = mass(x)
        residual = b - (stiffness(x) - shift * image)
        rates = rates.at[turn].set(jnp.linalg.norm(residual) / jnp.linalg.norm(b))
        return turn + 1, rates, jnp.where(turn == 0, _error(x, image, residual), error), residual

    none = jnp.full(2, jnp.inf, b.dtype)
    _, (first, further), error, _ = jax.lax.while_loop(in_doubt, solve, (jnp.zeros((), int), none, none[0], b))
    return Trial((first < tiny) | ((first < CONTRACTION) & (further < CONTRACTION)), first, error)


def _error(x: Float[Array, "n b"], image: Float[Array, "n b"], residual: Float[Array, "n b"]) -> Scalar:
    """Return `Trial.error`, given solutions x, Mx, and residuals."""
    # Solutions are dominated by the eigenvector nearest to the shift, so errors are measured on orthonormal vectors.
    products = gram(x, image)
    norms = jnp.sqrt(jnp.diagonal(products))
    # For such a small matrix, the inverse is accurate enough and faster than a long triangular solve.
    inverse = lapack.inverse_cholesky(products / norms[None] / norms[:, None]) / norms[None]
    residuals, images = (jnp.linalg.norm(matmul(y, inverse.T), axis=0) for y in (residual, image))
    return jnp.max(residuals / images)


@jit_quickly()
def _eliminate(
    dissection: Dissection, matrix: Float[Array, " m"], least: Scalar | None
) -> tuple[Blocks, Blocks, Float[Array, " pivots"]]:
    """Return ``downward``, ``upward`` and ``pivots`` of `Factorisation`."""
    pivots = []

    def inverted(blocks: Array, sizes: Array) -> Array:
        inverses, some = symmetric_inverses(blocks, None if least is None else least * sizes)
        pivots.append(some.ravel())
        return inverses

    levels = eliminate(dissection, matrix, inverted)
    downward = tuple(jnp.concatenate(level, axis=1) for level in levels)
    upward = tuple(coupling.mT for _, coupling in levels)
    if dissection.merged is not None:
        downward, upward = _merged(dissection.levels, dissection.merged, downward, upward)
    return downward, upward, jnp.concatenate(pivots)


def _merged(levels: tuple[Level, ...], merged: Merged, downward: Blocks, upward: Blocks) -> tuple[Blocks, Blocks]:
    """Return ``downward`` and ``upward`` of the merged tree, from solves with the identity on the right-hand side."""
    inverses, couplings, first = [], [], 0
    for rows, places in zip(merged.rows, merged.places, strict=True):
        (fronts, s), group = places.shape, slice(first, first + len(rows))
        first = group.stop
        if len(rows) == 1:
            inverses.append(downward[group][0])
            couplings.append(upward[group][0])
            continue
        within = tuple(Level(own, *level[1:]) for own, level in zip(rows, levels[group], strict=True))
        identity = jnp.tile(jnp.eye(s, dtype=downward[0].dtype), (fronts, 1))
        x, passed = _substituted(within, downward[group], upward[group], identity)
        inverse = x.at[places].get(mode="fill", fill_value=0, wrap_negative_indices=False)
        inverses.append(jnp.concatenate([inverse, -passed], axis=1))
        couplings.append(-passed.mT)
    return tuple(inverses), tuple(couplings)


def eliminate(
    dissection: Dissection, matrix: Inexact[Array, " m"], invert: Callable[[Array, Array], Array]
) -> list[tuple[Inexact[Array, "fronts s s"], Inexact[Array, "fronts r s"]]]:
    """Eliminate a symmetric matrix, real or complex, from the cells up to the first separator.

    The function ``invert`` returns the inverses of symmetric blocks (fronts, s, s), given these blocks and the largest
    absolute value of each front's entries. The result contains A⁻¹ and BA⁻¹ of the fronts of each level. The block A of
    eliminated nodes and the block B that couples boundary nodes to them include Schur complements of child fronts.
    """
    start = list(accumulate((math.prod(level.shape) for level in dissection.levels), initial=0))
    needed = matrix if dissection.entries is None else taken(matrix, dissection.entries)
    entries = _put(jnp.zeros(start[-1], matrix.dtype), dissection.places, needed)
    padded = _put(entries, dissection.padding, jnp.ones((), entries.dtype))
    eliminated = []
    schur: Array | None = None
    for number, level in reversed(list(enumerate(dissection.levels))):
        _, _, s = level.shape
        own = slice(start[number], start[number + 1])
        blocks, beyond = padded[own].reshape(level.shape), jnp.zeros((), entries.dtype)
        sizes = jnp.max(jnp.abs(entries[own]).reshape(level.shape[0], -1), axis=1, initial=0)
        if schur is not None:
            first, second = gather_symmetric(schur, jnp.asarray(level.children))
            added = first + second
            blocks, beyond = blocks + added[:, :, :s], added[:, s:, s:]
        inverse = invert(blocks[:, :s], sizes)
        coupling = matmul(blocks[:, s:], inverse)
        schur = beyond - matmul(coupling, blocks[:, s:].mT)
        eliminated.append((inverse, coupling))
    return eliminated[::-1]


def _substituted(
    levels: tuple[Level, ...], downward: Blocks, upward: Blocks, rhs: Float[Array, "n b"]
) -> tuple[Float[Array, "m b"], Float[Array, "fronts r b"]]:
    """Return the solution that is zero at the first level's boundary nodes, and its residual at these nodes."""
    width = rhs.shape[1]
    own: list[Array] = []
    passed: Array | None = None
    for level, matrix in zip(levels[::-1], downward[::-1], strict=True):
        s = level.own.shape[1]
        force, onward = taken(rhs, level.own), jnp.zeros((), rhs.dtype)
        if passed is not None:
            # If a child front does not contain a node, the node's index refers to the appended row of zeros.
            padded = jnp.pad(passed.reshape(-1, width), ((0, 1), (0, 0)))
            total = sum((taken(padded, places) for places in level.children), jnp.zeros((), rhs.dtype))
            force, onward = force + total[:, :s], total[:, s:]
        product = batched_with_columns(matrix, force)
        own.append(product[:, :s])
        passed = onward - product[:, s:]
    assert passed is not None
    solutions, boundary = [own.pop()], jnp.zeros_like(passed)
    for level, matrix in zip(levels[1:], upward[1:], strict=True):
        above = jnp.concatenate([solutions[-1], boundary], axis=1).reshape(-1, width)
        boundary = taken(above, level.boundary)
        solutions.append(own.pop() - batched_with_columns(matrix, boundary))
    return jnp.concatenate([x.reshape(-1, width) for x in solutions]), passed


def taken(x: Inexact[Array, "n *b"], index: Int[ArrayLike, "*m"]) -> Inexact[Array, "*m_and_b"]:
    """Return the indexed rows of x. Indices out of range give arbitrary rows, which callers multiply by zero."""
    return x.at[index].get(mode="clip", wrap_negative_indices=False)


def _put(x: Inexact[Array, " n"], index: Int[ArrayLike, " m"], values: Inexact[Array, "*m"]) -> Inexact[Array, " n"]:
    return x.at[index].set(values, unique_indices=True, wrap_negative_indices=False)


def gather_symmetric(
    blocks: Inexact[Array, "blocks r r"], index: Int[Array, "children fronts m"]
) -> Inexact[Array, "children fronts m m"]:
    """Return submatrices of symmetric blocks (r, r), given flat row indices block·r + i; zero for padding."""
    n, r = blocks.shape[:2]
    valid = index < n * r
    # Gathering complete rows, and then columns of these, is faster than gathering single entries.
    rows = jnp.where(valid[..., None], taken(blocks.reshape(-1, r), index), 0)
    columns = jnp.take_along_axis(rows, (index % r)[:, :, None, :], axis=3, mode="clip")
    return jnp.where(valid[:, :, None, :], columns, 0)
