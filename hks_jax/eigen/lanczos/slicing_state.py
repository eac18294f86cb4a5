"""The problem, the static settings and the changing state of spectrum slicing."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.linear.loops import by_column_ranges
from hks_jax.linear.pencil import SymmetricPencil

_NODES = 1 << 16
"""The number of degrees of freedom for which the stored eigenvectors are reordered at once."""

Stored = Float[Array, "capacity n_dof"]


class Problem(NamedTuple):
    """A pencil, and estimates of its spectrum. No eigenvalue is negative."""

    pencil: SymmetricPencil  # K and M
    first: Float[Array, ""]  # the first shift
    spacing: Float[Array, ""]  # the expected mean gap of eigenvalues
    lowest: Float[Array, ""]  # the expected lowest nonzero eigenvalue
    unit: Float[Array, ""]  # the least number by which residuals are divided in relative residuals


class Plan(NamedTuple):
    """The static settings of spectrum slicing."""

    wanted: int  # the number of eigenpairs
    block: int  # the number of vectors per Lanczos block
    slice_size: int  # the expected number of eigenvalues per slice, half of them below its shift
    max_slices: int  # the maximal number of factorisations
    tolerance: float  # the relative residual at which a pair counts as converged
    nulls: int  # the number of wanted eigenvalues that are known to be zero

    @property
    def steps(self) -> int:
        """The maximal number of Lanczos blocks in a slice."""
        return self.steps_for(self.slice_size)

    def steps_for(self, size: Any) -> Any:
        """Return the number of Lanczos blocks, rounded up to even, for ``size`` eigenvalues to converge."""
        # In measurements, m Lanczos vectors in blocks of b gave about (m − 12 b)/2.1 pairs with residuals below 1e-8.
        return 2 * -(-(21 * size + 120 * self.block) // (20 * self.block))

    @property
    def ritz(self) -> int:
        """The number of Ritz pairs examined in each slice, a multiple of the block size."""
        return min(self.steps, -(-self.slice_size * 6 // 5 // self.block)) * self.block

    @property
    def window(self) -> int:
        """The number of known eigenvectors to which a slice stays orthogonal, so that it does not find them again.
        Eigenvectors far from the shift may be omitted, because Lanczos finds the near ones first.
        """
        size = max(self.slice_size // 4, min(self.slice_size // 2, 48))
        return -(-size // self.block) * self.block

    @property
    def capacity(self) -> int:
        """The maximal number of stored eigenpairs."""
        return self.wanted + self.block + self.ritz


class SlicingState(NamedTuple):
    """The state of spectrum slicing, except eigenvectors. A pair is called known if it was computed and accepted."""

    values: Float[Array, " capacity"]  # known eigenvalues in the order of acceptance, padded with infinity
    known: Int[Array, ""]  # the number of known pairs
    shift: Float[Array, ""]  # the next shift
    # the number of eigenvalues below the shift, by inertia; −1 if the factorisation was too inaccurate
    below: Int[Array, ""]
    multiple: Bool[Array, ""]  # whether many copies of one multiple eigenvalue are probably missing
    far: Float[Array, ""]  # the last shift at which too many eigenvalues were missing for a search
    far_below: Int[Array, ""]  # the number of eigenvalues below `far`; 0 at first
    reached: Float[Array, ""]  # the end of the range from zero in which no eigenvalue seems to be missing
    complete_below: Float[Array, ""]  # inertia certifies that every eigenvalue below this number is known
    start: Float[Array, "n_dof block"]  # the start block of the next Lanczos run
    noise: Float[Array, "n_dof block"]  # independent normal random numbers
    slices: Int[Array, ""]  # the number of factorisations so far
    moved: Int[Array, ""]  # the number of consecutive moves of the shift because of inaccurate factorisations
    passes: Int[Array, ""]  # the number of solves per step: 1, or 2 with a refinement step
    stuck: Bool[Array, ""]  # whether the last search found none of the missing pairs
    finished: Bool[Array, ""]  # whether all wanted pairs are known and certified


@jit_quickly(static_argnames="plan")
def first_state(problem: Problem, plan: Plan) -> tuple[SlicingState, Stored]:
    """Return the initial state, without known pairs, and storage for eigenvectors."""
    n, dtype = problem.pencil.size, problem.pencil.stiffness.dtype
    noise = jax.random.normal(jax.random.key(0), (n, plan.block), dtype)
    state = SlicingState(
        values=jnp.full(plan.capacity, jnp.inf, dtype),
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
    return state, jnp.zeros((plan.capacity, n), dtype)


@jit_quickly(static_argnames="plan")
def unfinished(plan: Plan, state: SlicingState) -> Bool[Array, ""]:
    """Return whether another slice is needed and allowed."""
    return ~state.finished & (state.slices < plan.max_slices)


def crowded(plan: Plan, state: SlicingState) -> Bool[Array, ""]:
    """Return whether to discard some known pairs, because the storage is full or the search is stuck."""
    return state.stuck | (state.known > plan.capacity - plan.ritz)


@jit_quickly(static_argnames="plan", donate_argnames="vectors")
def make_room(plan: Plan, state: SlicingState, vectors: Stored) -> tuple[SlicingState, Stored]:
    """Discard the highest known pairs to make room for a search; if stuck, discard all pairs above ``reached``."""
    order = jnp.argsort(state.values)
    count = jnp.where(state.stuck, jnp.sum(state.values <= state.reached), state.known)
    count = jnp.minimum(count, plan.capacity - plan.ritz)
    kept = jnp.arange(plan.capacity) < count
    values = jnp.where(kept, state.values[order], jnp.inf)
    vectors = by_column_ranges(lambda part: jnp.where(kept[:, None], part[order], 0), _NODES, vectors)
    return state._replace(values=values, known=count), vectors
