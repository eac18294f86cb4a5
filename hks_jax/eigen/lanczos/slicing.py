"""Spectrum slicing: the lowest eigenpairs of a pencil, slice by slice, with a certificate that no pair is missed.

Each slice factorises K − σM at a shift σ slightly above the known eigenvalues. The inertia gives the number of
eigenvalues below σ. Block Lanczos finds the eigenvectors below σ that are not known yet, and about as many above σ. The
Lanczos basis is kept orthogonal to the known eigenvectors close to σ. Converged pairs become known. A last
factorisation, at a shift above the wanted eigenvalues, is the certificate: its inertia equals the number of known
eigenvalues below the shift. Small slices keep orthogonalisation cheap for any number of wanted pairs.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.arrays import Scalar
from hks_jax.compilation import jit_quickly
from hks_jax.eigen.lanczos.krylov_basis import Block, orthonormal
from hks_jax.eigen.lanczos.recurrence import RitzPairs, ShiftedSolve, block_lanczos
from hks_jax.eigen.quality import allowed_residuals, indistinct, measure_pairs
from hks_jax.linear import lapack
from hks_jax.linear.dissection import Dissection
from hks_jax.linear.loops import by_column_ranges, when
from hks_jax.linear.multifrontal import Factorisation, Trial, factorise, try_out
from hks_jax.linear.products import gram, matmul, products_with_columns
from hks_jax.linear.symmetric_pencil import SymmetricPencil
from hks_jax.traced import is_traced

_ERROR = 0.1
"""The largest accepted error of solves, relative to the allowed residual of the lowest missing eigenvalue."""
_EXCUSE = 30
"""The factor by which residuals may exceed the usual level of rounding if nothing converges otherwise."""
_MOVES = 3
"""The maximal number of consecutive moves of a shift whose inertia is uncertain; then the shift is used anyway."""
_TURNS = 12
"""The maximal number of inverse iterations in a search."""
_COPY = 1e-6
"""The relative distance within which all computed copies of a multiple eigenvalue lie."""
_NODES = 1 << 16
"""The number of degrees of freedom for which the stored eigenvectors are reordered at once."""

Stored = Float[Array, "capacity n_dof"]
Interval = tuple[Scalar, Scalar]
Order = Int[Array, " ritz"]
"""The order in which Ritz vectors are stored; accepted vectors come first."""


class Problem(NamedTuple):
    """A pencil, and estimates of its spectrum. No eigenvalue is negative."""

    pencil: SymmetricPencil  # K and M
    first: Float[Array, ""]  # the first shift
    spacing: Float[Array, ""]  # the expected mean gap of eigenvalues
    lowest: Float[Array, ""]  # the expected lowest nonzero eigenvalue
    unit: Float[Array, ""]  # the least number by which residuals are divided in relative residuals


class SlicingPlan(NamedTuple):
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


# A slice begins with the factorisation of K − σM at a shift σ. Its negative pivots give the number ``below`` of
# eigenvalues below σ, unless a trial solve shows that the inertia is uncertain. Let ``missing`` be the number of
# eigenvalues below σ that are not known, and m the slice size. The first line that applies decides (`_consider`):
#
#     inertia at σ                                        next
#     --------------------------------------------------  -------------------------------------------------------------
#     certain, missing = 0, all wanted pairs are known    finished: the inertia is the certificate
#     certain, missing > m, and a lower σ separates them  a lower σ (`far` remembers this one)
#     certain, missing > 2 blocks, and a lower σ did not  copies of one eigenvalue (`multiple`): if enough are known,
#                                                         σ just below them; otherwise a search by inverse iteration
#     certain, but solves are too inaccurate (once)       σ beside
#     uncertain (three times)                             σ beside
#     otherwise                                           a search by block Lanczos, with refined solves if inaccurate
#
# A search accepts converged pairs, unless an unknown pair may lie between them and σ. The next shift is then
# (`_accept`):
#
#     pairs below σ     accepted   next
#     ----------------  ---------  ------------------------------------------------------------------------------------
#     none is missing   some       σ in the next slice or, if all wanted pairs are known, in the widest gap above them
#     none is missing   none       σ beyond the gap, at the Ritz values above it
#     some are missing  some       σ towards the lowest Ritz value that did not converge, with refined solves
#     some are missing  none       `stuck`: as before, or below the spectrum; known pairs above `reached` are discarded
#                                  (`make_room`), and larger rounding errors are accepted
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
def first_state(problem: Problem, plan: SlicingPlan) -> tuple[SlicingState, Stored]:
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
def unfinished(plan: SlicingPlan, state: SlicingState) -> Bool[Array, ""]:
    """Return whether another slice is needed and allowed."""
    return ~state.finished & (state.slices < plan.max_slices)


def crowded(plan: SlicingPlan, state: SlicingState) -> Bool[Array, ""]:
    """Return whether to discard some known pairs, because the storage is full or the search is stuck."""
    return state.stuck | (state.known > plan.capacity - plan.ritz)


@jit_quickly(static_argnames="plan", donate_argnames="vectors")
def make_room(plan: SlicingPlan, state: SlicingState, vectors: Stored) -> tuple[SlicingState, Stored]:
    """Discard the highest known pairs to make room for a search; if stuck, discard all pairs above ``reached``."""
    order = jnp.argsort(state.values)
    count = jnp.where(state.stuck, jnp.sum(state.values <= state.reached), state.known)
    count = jnp.minimum(count, plan.capacity - plan.ritz)
    kept = jnp.arange(plan.capacity) < count
    values = jnp.where(kept, state.values[order], jnp.inf)
    vectors = by_column_ranges(lambda part: jnp.where(kept[:, None], part[order], 0), _NODES, vectors)
    return state._replace(values=values, known=count), vectors


def cut(
    problem: Problem, dissection: Dissection, plan: SlicingPlan, state: SlicingState, vectors: Stored
) -> tuple[Factorisation, Bool[Array, ""], tuple[SlicingState, Stored]]:
    """Factorise K − σM at the next shift σ; also return whether to search around σ, and the state with free storage."""
    factor = factorise(dissection, problem.pencil.shifted(state.shift))
    trial = try_out(factor, problem.pencil, state.shift, state.noise)
    searchable, full, following = _consider(problem, factor.negative, trial, plan, state)
    return factor, searchable, when(full, lambda both: make_room(plan, *both), (following, vectors))


@jit_quickly(static_argnames="plan")
def _consider(
    problem: Problem, below: Int[Array, ""], trial: Trial, plan: SlicingPlan, state: SlicingState
) -> tuple[Bool[Array, ""], Bool[Array, ""], SlicingState]:
    """Decide whether to search at the current shift, and whether to free storage first; also return the new state."""
    known = jnp.sum(state.values < state.shift)
    missing = below - known
    complete = trial.sound & (missing == 0)
    last = jnp.sort(state.values)[plan.wanted - 1]
    # The search ends if all wanted pairs are known, or all but copies of the last one, or if no further pairs exist.
    all_wanted = (known >= plan.wanted) | (last * (1 - 2 * _COPY) < state.shift)
    finished = complete & (all_wanted | (below == problem.pencil.size))
    # If lowering the shift leaves equally many eigenvalues missing, the missing ones are copies of a multiple
    # eigenvalue. The search for these copies is at the lowered shift, repeatedly if necessary.
    too_many = trial.sound & (missing > plan.slice_size) & (below != state.below)
    multiple = trial.sound & (missing > 2 * plan.block) & (below == state.far_below)
    # If an eigenvalue has more copies than pairs are wanted, some suffice, and the certificate ends just below it.
    cut = multiple & jnp.isfinite(last)
    reached = jnp.where(state.reached > 0, state.reached, problem.lowest)
    needed = _allowed(problem, plan, state, reached, jnp.min(state.values))
    accurate = state.stuck | (trial.error <= _ERROR * needed)
    # Moving the shift takes less time than refining all solves, so solves are refined only if a move does not help.
    moves = ~(finished | too_many) & jnp.where(trial.sound, ~accurate & (state.moved < 1), state.moved < _MOVES)

    # If too many eigenvalues are missing, the new shift divides the range between the known ones and the old shift.
    start = jnp.maximum(state.reached, state.complete_below)
    share = jnp.maximum(plan.slice_size / (2.5 * jnp.maximum(missing, 1).astype(state.shift.dtype)), 1 / 4)
    nearer = start + share * (state.shift - start)
    # Inertia may be uncertain if the shift is an eigenvalue of a part of the domain; a move by 0.7 mean gaps avoids
    # this eigenvalue. The shift moves up if all eigenvalues below it are known, and otherwise down.
    down = state.shift - 0.7 * (state.shift - state.reached) / jnp.maximum(missing, 1).astype(state.shift.dtype)
    up = state.shift + 0.7 * _spacing(problem, plan, state)
    beside = jnp.where(jnp.where(trial.sound, missing <= 0, state.known >= plan.wanted), up, down)
    state = state._replace(
        slices=state.slices + 1,
        finished=finished,
        complete_below=jnp.where(complete, jnp.maximum(state.shift, state.complete_below), state.complete_below),
        shift=jnp.where(too_many, nearer, jnp.where(cut, last * (1 - _COPY), jnp.where(moves, beside, state.shift))),
        below=jnp.where(trial.sound, below, -1),
        multiple=multiple,
        far=jnp.where(too_many, state.shift, state.far),
        far_below=jnp.where(too_many, below, state.far_below),
        moved=jnp.where(moves, state.moved + 1, 0),
        passes=jnp.where(accurate, state.passes, 2),
    )
    searchable = ~(finished | too_many | cut | moves)
    return searchable, searchable & crowded(plan, state), state


def _allowed(problem: Problem, plan: SlicingPlan, state: SlicingState, values: Array, lowest: Scalar) -> Array:
    """Return the largest residuals ‖Kφ − λMφ‖/‖Mφ‖ at which eigenvalues count as converged.

    The tolerance is relative to the eigenvalue, if the spectrum begins at zero. If it begins at some ``lowest``
    eigenvalue, the tolerance is relative to the distance from this one, but at least to the mean gap.
    """
    # If the last search found no pair, as on a very elongated domain, larger rounding errors are accepted.
    rounding = jnp.where(state.stuck, _EXCUSE, 1).astype(values.dtype) * indistinct(problem.pencil, values.dtype)
    begins = (problem.unit > 0) & jnp.isfinite(lowest)
    last = jnp.maximum(state.shift, jnp.max(jnp.where(jnp.isfinite(state.values), state.values, -jnp.inf)))
    gap = (last - lowest) / jnp.maximum(jnp.maximum(state.below, state.known), 1).astype(values.dtype)
    unit = jnp.where(begins & (gap > 0), jnp.minimum(gap, problem.unit), problem.unit)
    return allowed_residuals(jnp.maximum(values - jnp.where(begins, lowest, 0), unit), rounding, plan.tolerance)


def search(
    problem: Problem, factor: Factorisation, plan: SlicingPlan, both: tuple[SlicingState, Stored]
) -> tuple[SlicingState, Stored]:
    """Find the eigenpairs around the shift."""
    state, vectors = both
    shifted = ShiftedSolve(factor, state.shift, state.passes)
    one_multiplet = not is_traced(state.multiple) and bool(state.multiple)
    if not one_multiplet:
        # The search stays orthogonal to a window of known eigenvectors. If one slice suffices, the window is empty.
        # With several slices, zero vectors fill the first window, because an empty window would be compiled separately.
        nothing = plan.wanted <= plan.slice_size and not is_traced(state.known) and int(state.known) == 0
        known, interval, steps = _window(problem, plan, state, vectors, 0 if nothing else plan.window)
        ritz = block_lanczos(problem.pencil, shifted, state.start, known, plan.steps, steps, plan.ritz)
        (order, following), new = _accept(problem, plan, ritz, interval, state), ritz[1]
        one_multiplet = not is_traced(following.stuck) and bool(following.stuck and state.below > 0)
    if one_multiplet:
        order, new, following = _nearest(problem, shifted, plan, state, vectors)
    # New vectors are stored in a separate call, so that only two arrays of vectors are in memory at a time.
    return following, _stored(vectors, new, order, state.known)


# Block Lanczos finds at most as many pairs of a multiple eigenvalue as a block has columns, and breaks down if it takes
# more steps than there are distinct eigenvalues. Inverse iteration with m vectors finds m pairs near the shift. If the
# multiplicity of an eigenvalue exceeds m, any m vectors of its eigenspace suffice.
def _nearest(
    problem: Problem, shifted: ShiftedSolve, plan: SlicingPlan, state: SlicingState, vectors: Stored
) -> tuple[Order, Float[Array, "ritz n_dof"], SlicingState]:
    """Search by inverse iteration, orthogonal to all known eigenvectors; see `_accept`. Values must be concrete."""
    missing = int(state.below - jnp.sum(state.values < state.shift))
    count = min(missing + plan.block, plan.ritz, problem.pencil.size - int(state.known))
    x = jax.random.normal(jax.random.key(int(state.slices)), (problem.pencil.size, count), state.shift.dtype)
    worst = jnp.full((), jnp.inf)
    for turn in range(_TURNS):
        values, x, residuals = _inverse_iteration(problem.pencil, shifted, vectors, state.known, x)
        before, worst = worst, jnp.max(residuals[:missing])
        if turn > 2 and not worst < before / 2:
            break
    ritz = jnp.pad(1 / (values - state.shift), (0, plan.ritz - count)), jnp.pad(x.T, ((0, plan.ritz - count), (0, 0)))
    everywhere = jnp.asarray(-jnp.inf, values.dtype), jnp.asarray(jnp.inf, values.dtype)
    order, following = _accept(problem, plan, ritz, everywhere, state)
    return order, ritz[1], following


@jit_quickly()
def _inverse_iteration(
    pencil: SymmetricPencil, shifted: ShiftedSolve, vectors: Stored, known: Int[Array, ""], x: Block
) -> tuple[Float[Array, " b"], Block, Float[Array, " b"]]:
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    x = shifted.factor.solve(mass(x))
    for _ in range(2):
        parts = jnp.where(jnp.arange(len(vectors))[:, None] < known, products_with_columns(vectors, mass(x)), 0)
        x, _, _ = orthonormal(mass, x - matmul(parts.T, vectors).T)
    values, mix = lapack.eigh(gram(x, stiffness(x)))
    x = matmul(x, mix)
    image = mass(x)
    return values, x, jnp.linalg.norm(stiffness(x) - values[None] * image, axis=0) / jnp.linalg.norm(image, axis=0)


@jit_quickly(static_argnames=("plan", "rows"))
def _window(
    problem: Problem, plan: SlicingPlan, state: SlicingState, vectors: Stored, rows: int
) -> tuple[Float[Array, "rows n_dof"], Interval, Int[Array, ""]]:
    """Return the known eigenvectors, the interval and the number of Lanczos blocks for a search around the shift.

    The search stays orthogonal to the known eigenvectors nearest to the shift, which are padded with zeros. The
    interval around the shift contains the eigenvalues of no other known eigenvectors.
    """
    nearest = jnp.argsort(jnp.abs(state.values - state.shift))[:rows]
    vectors = jnp.where((nearest < state.known)[:, None], vectors[nearest], 0)
    others = jnp.where(jnp.isin(jnp.arange(plan.capacity), nearest), jnp.nan, state.values)
    low = jnp.nanmax(jnp.where(others < state.shift, others * (1 + 1e-6), -jnp.inf), initial=-jnp.inf)
    high = jnp.nanmin(jnp.where(others > state.shift, others * (1 - 1e-6), jnp.inf), initial=jnp.inf)
    left = jnp.maximum(plan.wanted - state.known, plan.slice_size // 4)
    # The last slice is smaller, but contains some unwanted eigenvalues, because the certificate needs a gap.
    size = jnp.where(left < plan.slice_size, left * 17 // 16 + 2 + 2 * plan.block, plan.slice_size)
    return vectors, (low, high), jnp.minimum(plan.steps_for(size), plan.steps)


@jit_quickly(donate_argnames="known_vectors")
def _stored(known_vectors: Stored, vectors: Float[Array, "ritz n_dof"], order: Order, known: Int[Array, ""]) -> Stored:
    return jax.lax.dynamic_update_slice_in_dim(known_vectors, vectors[order], known, 0)


@jit_quickly(static_argnames="plan")
def _accept(
    problem: Problem, plan: SlicingPlan, ritz: RitzPairs, interval: Interval, state: SlicingState
) -> tuple[Order, SlicingState]:
    """Accept the converged Ritz pairs in the interval, and choose the next shift.

    Ritz pairs outside the interval may repeat known pairs, and are not accepted.
    """
    (theta, vectors), (low, high) = ritz, interval
    shift, index, dtype = state.shift, jnp.arange(plan.capacity), vectors.dtype
    near = shift + 1 / theta

    values, residuals, _ = measure_pairs(problem.pencil, vectors)
    first_nonzero = jnp.sort(jnp.concatenate([state.values, values]))[plan.nulls]
    lowest_of_all = jnp.minimum(jnp.min(state.values), jnp.min(jnp.where(theta != 0, values, jnp.inf)))
    allowed = partial(_allowed, problem, plan, state, lowest=lowest_of_all)
    converged = (residuals <= allowed(jnp.maximum(jnp.abs(values), first_nonzero))) & (theta != 0)
    # Pairs may be missing above the first pair that did not converge, and beyond the examined pairs.
    above = near > shift
    limit = jnp.min(jnp.where(above & ~converged, near, jnp.inf))
    reach = shift + 1 / jnp.min(jnp.where(theta != 0, jnp.abs(theta), jnp.inf))
    end = jnp.minimum(jnp.minimum(limit, reach), high)
    accepted = converged & (values > low) & (values < end)
    complete = state.below == jnp.sum(state.values < shift) + jnp.sum(accepted & (values < shift))
    # Later searches stay orthogonal to the known vectors. If known vectors had components along missing eigenvectors,
    # whose eigenvalues may be much smaller, the missing pairs could not converge. So if pairs are missing, accept only
    # vectors that are accurate enough for the missing pairs.
    accepted &= complete | (residuals <= allowed(jnp.maximum(state.reached, first_nonzero)))

    order = jnp.argsort(jnp.where(accepted, values, jnp.inf))
    count = jnp.sum(accepted)
    new = jnp.where(jnp.arange(plan.ritz) < count, values[order], jnp.inf)
    all_values = jax.lax.dynamic_update_slice_in_dim(state.values, new, state.known, 0)
    known = state.known + count
    # All eigenvalues between the shift and `end` are known.
    gapless = jnp.max(jnp.where((index < known) & (all_values < end), all_values, -jnp.inf), initial=0)

    # If eigenvalues below the shift are missing, move towards the lowest Ritz value that did not converge. If all Ritz
    # values below the shift converged, copies of some multiple eigenvalue are missing; move towards `complete_below`.
    # If not even the lowest pairs converge, move below the spectrum, where K − σM is definite and its factorisation
    # most accurate.
    lowest = jnp.min(jnp.where(~converged & (values > low) & (values < shift), values, shift))
    seen, stuck = lowest < shift, ~complete & (count == 0)
    again = jnp.where(seen, lowest + (shift - lowest) / 4, (state.complete_below + shift) / 2)
    again = jnp.where(stuck & (state.reached <= 0), -jnp.abs(shift) / jnp.maximum(state.below, 1).astype(dtype), again)
    leftover = jnp.argsort(jnp.where(above & ~accepted, near, jnp.inf))[: plan.block]
    # If no pair converged, and none is missing below the shift, a wide gap follows; move to the next Ritz values.
    beyond = jnp.sort(jnp.where(above, near, jnp.inf))[min(plan.slice_size // 4, plan.ritz - 1)]
    onward = jnp.where((count == 0) & jnp.isfinite(beyond), shift + 1.1 * (beyond - shift), -jnp.inf)
    noise = 0.01 * jnp.std(vectors) * jnp.roll(state.noise, state.slices, axis=0)
    state = state._replace(
        values=all_values,
        known=known,
        reached=jnp.where(
            complete, jnp.maximum(gapless, state.reached), jnp.where(seen, state.reached, state.complete_below)
        ),
        complete_below=jnp.where(complete, jnp.maximum(shift, state.complete_below), state.complete_below),
        start=vectors[leftover].T + noise,
        moved=jnp.zeros((), int),
        passes=jnp.where(complete | stuck, 1, 2).astype(int),
        stuck=stuck,
    )
    following = jnp.maximum(_next_shift(problem, plan, state), onward)
    middle = (jnp.maximum(state.reached, state.complete_below) + state.far) / 2
    following = jnp.where(state.far_below - known > plan.slice_size, jnp.minimum(following, middle), following)
    return order, state._replace(shift=jnp.where(complete, following, again))


def _spacing(problem: Problem, plan: SlicingPlan, state: SlicingState) -> Scalar:
    """Return the mean gap of the last known eigenvalues; if few are known, at least the ``spacing`` of the problem."""
    few = jnp.minimum(state.known, plan.slice_size)
    ordered = jnp.sort(state.values)
    last = ordered[jnp.maximum(state.known - 1, 0)]
    mean = (last - ordered[state.known - few]) / jnp.maximum(few - 1, 1).astype(last.dtype)
    return jnp.where(few < plan.block, jnp.fmax(mean, problem.spacing), mean)


def _next_shift(problem: Problem, plan: SlicingPlan, state: SlicingState) -> Scalar:
    """Return the next shift: within the next slice, or in a gap above the last wanted eigenvalue."""
    ordered, known = jnp.sort(state.values), state.known
    index = jnp.arange(plan.capacity)
    spacing = _spacing(problem, plan, state)
    left = (plan.wanted - jnp.sum(ordered <= state.reached)).astype(ordered.dtype)
    slices = jnp.ceil(left / plan.slice_size)
    ahead = jnp.maximum(state.reached, state.complete_below) + spacing * (left / jnp.maximum(slices, 1) / 2 + 1)
    # The middle of the widest gap is the safest shift; the gap above the last known eigenvalue is estimated.
    gaps = jnp.where(index < known - 1, jnp.roll(ordered, -1) - ordered, spacing)
    last_few = (index >= plan.wanted - 1) & (index < plan.wanted + 7) & (index < known)
    widest = jnp.argmax(jnp.where(last_few, gaps, -1))
    certificate = ordered[widest] + gaps[widest] / 2
    return jnp.where(left > 0, ahead, certificate)
