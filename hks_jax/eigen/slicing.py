"""Spectrum slicing: the lowest eigenpairs of a pencil, interval by interval, none missed.

Each slice factorises K − σM at a shift σ a little above what is known already. The inertia says how many eigenvalues
lie below σ; block Lanczos, kept orthogonal to the known eigenvectors near by, finds them and about as many above. What
converged is known from then on. A last factorisation above the last eigenvalue wanted is the certificate: as many
eigenvalues as are known lie below it. Few vectors at a time keep orthogonalisation cheap, however many are wanted.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.dissection import Dissection
from hks_jax.eigen.lanczos import block_lanczos
from hks_jax.eigen.multifrontal import Factorisation, factorise
from hks_jax.eigen.quality import indistinct, values_and_defects
from hks_jax.eigen.weyl import weyl
from hks_jax.fem.pencil import Pencil

_GROWTH = 2e6
"""How far rounding may have grown: with ten times as much, eigenpairs no longer converge to 1e-8."""

_MOVES = 3
"""How often in a row to move a shift at which the factorisation is inaccurate, before it must do."""


class Plan(NamedTuple):
    """The sizes of a computation; static.

    Attributes:
        wanted: how many eigenpairs.
        block: vectors per Lanczos block.
        slice_size: eigenvalues that a slice is expected to find, half of them below its shift.
        max_slices: factorisations before giving up.
    """

    wanted: int
    block: int
    slice_size: int
    max_slices: int

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


def steps_for(plan: Plan, size: int | Int[Array, ""]) -> int | Int[Array, ""]:
    """Return how many Lanczos blocks, an even number, find so many eigenvalues.

    Measured: of m Lanczos vectors in blocks of b about (m − 12 b)/2.1 converge to 1e-8.
    """
    return 2 * -(-(21 * size + 120 * plan.block) // (20 * plan.block))


class State(NamedTuple):
    """What is known between two slices.

    Attributes:
        values: (capacity,) known eigenvalues in the order found; infinite where there is none.
        vectors: (capacity, n_dof) their M-orthonormal eigenvectors; None where they are handed over apart.
        known: how many there are.
        shift: where to cut next.
        front: known up to here without a gap, as far as is known.
        complete_below: every eigenvalue below it is known, by the inertia of a factorisation.
        start: (n_dof, block) where Lanczos starts next.
        noise: (n_dof, block) independent normal numbers.
        slices: factorisations so far.
        moved: how often in a row the shift was moved because the factorisation was inaccurate there.
        finished: whether all is found and certified.
    """

    values: Float[Array, " capacity"]
    vectors: Float[Array, "capacity n_dof"] | None
    known: Int[Array, ""]
    shift: Float[Array, ""]
    front: Float[Array, ""]
    complete_below: Float[Array, ""]
    start: Float[Array, "n_dof block"]
    noise: Float[Array, "n_dof block"]
    slices: Int[Array, ""]
    moved: Int[Array, ""]
    finished: Bool[Array, ""]


def first_state(pencil: Pencil, plan: Plan) -> State:
    """Return the state in which nothing is known, the first shift chosen by Weyl's law."""
    n, d, dtype = pencil.space.n_dof, pencil.space.dimension, pencil.stiffness.dtype
    noise = jax.random.normal(jax.random.key(0), (n, plan.block), dtype)
    shift = weyl(min(plan.wanted, plan.slice_size) / 2 + 1, pencil.volume, d)
    return State(
        values=jnp.full(plan.capacity, jnp.inf, dtype),
        vectors=jnp.zeros((plan.capacity, n), dtype),
        known=jnp.zeros((), int),
        shift=shift.astype(dtype),
        front=jnp.zeros((), dtype),
        complete_below=jnp.zeros((), dtype),
        start=noise,
        noise=noise,
        slices=jnp.zeros((), int),
        moved=jnp.zeros((), int),
        finished=jnp.zeros((), bool),
    )


def unfinished(plan: Plan, state: State) -> Bool[Array, ""]:
    """Return whether to go on: not all is found, and there are tries left."""
    return ~state.finished & (state.slices < plan.max_slices)


def crowded(plan: Plan, state: State) -> Bool[Array, ""]:
    """Return whether there is no room for what a search may find."""
    return state.known > plan.capacity - plan.ritz


def make_room(plan: Plan, state: State) -> State:
    """Forget the highest of the known eigenpairs, which are more than wanted."""
    assert state.vectors is not None
    order = jnp.argsort(state.values)
    kept = jnp.arange(plan.capacity) < plan.capacity - plan.ritz
    return state._replace(
        values=jnp.where(kept, state.values[order], jnp.inf),
        vectors=jnp.where(kept[:, None], state.vectors[order], 0),
        known=jnp.minimum(state.known, plan.capacity - plan.ritz),
    )


def cut(
    pencil: Pencil, dissection: Dissection, plan: Plan, state: State
) -> tuple[Factorisation, Bool[Array, ""], State]:
    """Factorise at the state's shift; return with it whether to search there, and the state if not."""
    factor = factorise(dissection, pencil, state.shift)
    here, rest = _consider(factor.negative, plan, state._replace(vectors=None))
    return factor, here, rest._replace(vectors=state.vectors)


@jit_quickly(static_argnames="plan")
def _consider(negative: Int[Array, ""], plan: Plan, state: State) -> tuple[Bool[Array, ""], State]:
    """Return whether to search at the state's shift, and the state if not."""
    below = jnp.sum(state.values < state.shift)
    missing = negative - below
    finished = (missing == 0) & (below >= plan.wanted)
    too_many = missing > plan.slice_size
    nearer = state.front + plan.slice_size / (2.5 * jnp.maximum(missing, 1)) * (state.shift - state.front)
    state = state._replace(
        slices=state.slices + 1,
        finished=finished,
        complete_below=jnp.where(missing == 0, state.shift, state.complete_below),
        shift=jnp.where(too_many, nearer, state.shift),
    )
    return ~(finished | too_many), state


def search(pencil: Pencil, factor: Factorisation, plan: Plan, tolerance: float, state: State) -> State:
    """Find the eigenpairs around the shift."""
    assert state.vectors is not None
    window, low, high, steps, allowed = _window(plan, state)
    theta, vectors, accurate = block_lanczos(
        pencil, factor, state.start, window, plan.steps, steps, plan.ritz, state.shift, allowed
    )
    rest = state._replace(vectors=None)
    return _accept(pencil, factor.negative, plan, tolerance, theta, vectors, accurate, low, high, state.vectors, rest)


@jit_quickly(static_argnames="plan")
def _window(
    plan: Plan, state: State
) -> tuple[Float[Array, "window n_dof"], Array, Array, Int[Array, ""], Float[Array, ""]]:
    """Return how to search: the known eigenvectors nearest to the shift, the interval in which nothing else is known,
    how many Lanczos steps to take, as the last slice has fewer eigenvalues to find, and how accurately to solve."""
    assert state.vectors is not None
    nearest = jnp.argsort(jnp.abs(state.values - state.shift))
    window = jnp.where((nearest < state.known)[: plan.window, None], state.vectors[nearest[: plan.window]], 0)
    others = jnp.where(jnp.isin(jnp.arange(plan.capacity), nearest[: plan.window]), jnp.nan, state.values)
    low = jnp.nanmax(jnp.where(others < state.shift, others * (1 + 1e-6), -jnp.inf), initial=-jnp.inf)
    high = jnp.nanmin(jnp.where(others > state.shift, others * (1 - 1e-6), jnp.inf), initial=jnp.inf)
    left = jnp.maximum(plan.wanted - state.known, plan.slice_size // 4)
    size = jnp.where(left < plan.slice_size, left * 17 // 16 + 2, plan.slice_size)
    # Fronts are not pivoted: where a part of the domain has an eigenvalue very near to the shift, rounding grows.
    grown = min(_GROWTH * float(jnp.finfo(window.dtype).eps), 0.01)
    allowed = jnp.where(state.moved < _MOVES, grown, jnp.inf).astype(window.dtype)
    return window, low, high, jnp.minimum(steps_for(plan, size), plan.steps), allowed


@jit_quickly(static_argnames=("plan", "tolerance"), donate_argnames="known_vectors")
def _accept(
    pencil: Pencil,
    negative: Int[Array, ""],
    plan: Plan,
    tolerance: float,
    theta: Float[Array, " ritz"],
    vectors: Float[Array, "ritz n_dof"],
    accurate: Bool[Array, ""],
    low: Float[Array, ""],
    high: Float[Array, ""],
    known_vectors: Float[Array, "capacity n_dof"],
    state: State,
) -> State:
    """Take what converged between low and high, and choose the next shift; a little off, where solves are inaccurate.

    What is known outside that interval may have been found again: nothing out there is taken. The state's eigenvectors
    come apart from it, and are overwritten.
    """
    shift, index = state.shift, jnp.arange(plan.capacity)
    near = shift + 1 / theta

    values, residuals = values_and_defects(pencil, vectors)
    first_nonzero = jnp.sort(jnp.concatenate([state.values, values]))[pencil.space.n_null]
    scale = jnp.maximum(jnp.abs(values), first_nonzero)
    rounding = jnp.minimum(indistinct(pencil, values.dtype) / scale, 0.01)
    converged = (residuals <= jnp.maximum(tolerance, rounding) * scale) & (theta != 0)
    # Above the first that did not converge, or farther away than those looked at, some are missing.
    above = near > shift
    limit = jnp.min(jnp.where(above & ~converged, near, jnp.inf))
    reach = shift + 1 / jnp.min(jnp.where(theta != 0, jnp.abs(theta), jnp.inf))
    accepted = accurate & converged & (values > low) & (values < jnp.minimum(jnp.minimum(limit, reach), high))

    order = jnp.argsort(jnp.where(accepted, values, jnp.inf))
    count = jnp.sum(accepted)
    found = jnp.where(jnp.arange(plan.ritz) < count, values[order], jnp.inf)
    all_values = jax.lax.dynamic_update_slice_in_dim(state.values, found, state.known, 0)
    all_vectors = jax.lax.dynamic_update_slice_in_dim(known_vectors, vectors[order], state.known, 0)
    known = state.known + count
    complete = negative == jnp.sum(all_values < shift)
    top = jnp.max(jnp.where(index < known, all_values, -jnp.inf), initial=0)

    # Where some below the shift are missing, go to where the lowest that did not converge seems to be.
    lowest = jnp.min(jnp.where(~converged & (values > low) & (values < shift), values, shift))
    again = jnp.where(lowest < shift, lowest + (shift - lowest) / 4, state.front + (shift - state.front) / 2)
    following = jnp.where(complete, _next_shift(plan, all_values, known, top), again)
    following = jnp.where(accurate, following, state.front + 0.97 * (shift - state.front))
    leftover = jnp.argsort(jnp.where(above & ~accepted, near, jnp.inf))[: plan.block]
    noise = 0.01 * jnp.std(vectors) * jnp.roll(state.noise, state.slices, axis=0)
    start = jnp.where(accurate, vectors[leftover].T + noise, state.start)
    return State(
        all_values,
        all_vectors,
        known,
        following,
        jnp.where(complete, top, state.front),
        jnp.where(complete, shift, state.complete_below),
        start,
        state.noise,
        state.slices,
        jnp.where(accurate, 0, state.moved + 1),
        state.finished,
    )


def _next_shift(plan: Plan, values: Float[Array, " capacity"], known: Int[Array, ""], top: Float[Array, ""]) -> Array:
    """Return where to cut next: within the next slice, or in a gap above the last eigenvalue wanted."""
    ordered = jnp.sort(values)
    index = jnp.arange(plan.capacity)
    # The mean distance of the last few eigenvalues.
    few = jnp.minimum(known, plan.slice_size)
    spacing = (top - ordered[known - few]) / jnp.maximum(few - 1, 1)
    left = plan.wanted - known
    slices = jnp.ceil(left / plan.slice_size)
    ahead = top + spacing * (left / jnp.maximum(slices, 1) / 2 + 1)
    # The widest gap among the next few is safest, and nothing is known above the last.
    gaps = jnp.where(index < known - 1, jnp.roll(ordered, -1) - ordered, spacing)
    there = (index >= plan.wanted - 1) & (index < plan.wanted + 7) & (index < known)
    widest = jnp.argmax(jnp.where(there, gaps, -1))
    certificate = ordered[widest] + gaps[widest] / 2
    return jnp.where(left > 0, ahead, certificate)
