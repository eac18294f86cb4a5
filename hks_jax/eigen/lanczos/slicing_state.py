"""What spectrum slicing knows between two slices, and the sizes of its computation."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.linear.pencil import SymmetricPencil

_NODES = 1 << 16
"""Degrees of freedom of all eigenvectors that are moved at once."""

Stored = Float[Array, "capacity n_dof"]


class Problem(NamedTuple):
    """A pencil, and what is known of its spectrum beforehand. The eigenvalues sought are counted from zero upwards."""

    pencil: SymmetricPencil  # K and M
    first: Float[Array, ""]  # the first shift
    spacing: Float[Array, ""]  # the mean distance of eigenvalues to expect
    lowest: Float[Array, ""]  # how large to expect the lowest one that is not zero
    unit: Float[Array, ""]  # residuals of eigenvalues that are smaller than this are measured by it
    negative: Int[Array, ""]  # how many eigenvalues are negative, and not sought


class Plan(NamedTuple):
    """The sizes of a computation; static."""

    wanted: int  # how many eigenpairs
    block: int  # vectors per Lanczos block
    slice_size: int  # eigenvalues that a slice is expected to find, half of them below its shift
    max_slices: int  # factorisations before giving up
    tolerance: float  # relative residual that counts as converged
    nulls: int  # how many of the wanted eigenvalues are zero, by what is known of the matrices

    @property
    def steps(self) -> int:
        """Lanczos blocks that a slice takes at most."""
        return int(steps_for(self, self.slice_size))

    @property
    def ritz(self) -> int:
        """Ritz pairs looked at in each slice, in whole blocks."""
        return min(self.steps, -(-self.slice_size * 6 // 5 // self.block)) * self.block

    @property
    def window(self) -> int:
        """Known eigenvectors that a slice stays orthogonal to, so as not to find them again.

        Those far away are not found before what is nearer, but of a large multiplet a slice finds only a part.
        """
        size = max(self.slice_size // 4, min(self.slice_size // 2, 48))
        return -(-size // self.block) * self.block

    @property
    def capacity(self) -> int:
        """Room for eigenpairs."""
        return self.wanted + self.block + self.ritz


# Measured: of m Lanczos vectors in blocks of b about (m − 12 b)/2.1 converge to 1e-8.
def steps_for(plan: Plan, size: int | Int[Array, ""]) -> int | Int[Array, ""]:
    """Return the number of Lanczos blocks, even, that finds a number of eigenvalues."""
    return 2 * -(-(21 * size + 120 * plan.block) // (20 * plan.block))


class SlicingState(NamedTuple):
    """What is known between two slices."""

    values: Float[Array, " capacity"]  # known eigenvalues in the order found; infinite where there is none
    vectors: Stored | None  # their M-orthonormal eigenvectors; None where they are handed over apart
    known: Int[Array, ""]  # how many there are
    shift: Float[Array, ""]  # where to cut next
    # eigenvalues from zero to the shift, by the inertia of the factorisation there; −1 if that is not trusted
    below: Int[Array, ""]
    multiple: Bool[Array, ""]  # whether many of them are not known, and copies of one eigenvalue
    far: Float[Array, ""]  # the last shift below which there were too many to search there,
    far_below: Int[Array, ""]  # and how many; 0 before there is one
    reached: Float[Array, ""]  # known up to this without a gap, as far as is known
    complete_below: Float[Array, ""]  # every eigenvalue below it is known, by the inertia of a factorisation
    start: Float[Array, "n_dof block"]  # where Lanczos starts next
    noise: Float[Array, "n_dof block"]  # independent normal numbers
    slices: Int[Array, ""]  # factorisations so far
    moved: Int[Array, ""]  # how often in a row the shift was moved because the factorisation was inaccurate there
    passes: Int[Array, ""]  # how often to solve: once, or again with the residual
    stuck: Bool[Array, ""]  # whether the last search found none of the missing pairs
    finished: Bool[Array, ""]  # whether all is found and certified


@jit_quickly(static_argnames="plan")
def first_state(problem: Problem, plan: Plan) -> SlicingState:
    """Return the state in which nothing is known."""
    n, dtype = problem.pencil.size, problem.pencil.stiffness.dtype
    noise = jax.random.normal(jax.random.key(0), (n, plan.block), dtype)
    return SlicingState(
        values=jnp.full(plan.capacity, jnp.inf, dtype),
        vectors=jnp.zeros((plan.capacity, n), dtype),
        known=jnp.zeros((), int),
        shift=problem.first,
        below=jnp.full((), -1, int),
        multiple=jnp.zeros((), bool),
        far=jnp.zeros((), dtype),
        far_below=jnp.zeros((), int),
        reached=jnp.zeros((), dtype),
        complete_below=jnp.zeros((), dtype),
        start=noise,
        noise=noise,
        slices=jnp.zeros((), int),
        moved=jnp.zeros((), int),
        passes=jnp.ones((), int),
        stuck=jnp.zeros((), bool),
        finished=jnp.zeros((), bool),
    )


@jit_quickly(static_argnames="plan")
def unfinished(plan: Plan, state: SlicingState) -> Bool[Array, ""]:
    """Return whether to go on: not all is found, and there are tries left."""
    return ~state.finished & (state.slices < plan.max_slices)


def crowded(plan: Plan, state: SlicingState) -> Bool[Array, ""]:
    """Return whether to forget some known pairs: there is no room for those of a search, or it is stuck."""
    return state.stuck | (state.known > plan.capacity - plan.ritz)


def make_room(plan: Plan, state: SlicingState) -> SlicingState:
    """Forget the highest of the known eigenpairs, which are more than wanted; if stuck, all above what was reached."""
    assert state.vectors is not None
    return _with_room(plan, state.vectors, state._replace(vectors=None))


@jit_quickly(static_argnames="plan", donate_argnames="vectors")
def _with_room(plan: Plan, vectors: Stored, state: SlicingState) -> SlicingState:
    order = jnp.argsort(state.values)
    count = jnp.where(state.stuck, jnp.sum(state.values <= state.reached), state.known)
    count = jnp.minimum(count, plan.capacity - plan.ritz)
    kept = jnp.arange(plan.capacity) < count
    return state._replace(
        values=jnp.where(kept, state.values[order], jnp.inf), vectors=_reordered(vectors, order, kept), known=count
    )


def _reordered(vectors: Stored, order: Int[Array, " capacity"], kept: Bool[Array, " capacity"]) -> Stored:
    """Return the rows in that order, zero where none is kept: in place where they may be overwritten."""

    def some(at: int | Array, width: int, vectors: Array) -> Array:
        part = jax.lax.dynamic_slice_in_dim(vectors, at, width, axis=1)
        return jax.lax.dynamic_update_slice_in_dim(vectors, jnp.where(kept[:, None], part[order], 0), at, axis=1)

    n = vectors.shape[1]
    whole = n // _NODES
    if whole:
        vectors = jax.lax.fori_loop(0, whole, lambda number, x: some(number * _NODES, _NODES, x), vectors)
    return some(whole * _NODES, n % _NODES, vectors) if n % _NODES else vectors
