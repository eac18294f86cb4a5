"""Rounds of filtering: what a subspace gains from Chebyshev polynomials, and Rayleigh–Ritz after each."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from hks_jax.eigen.filter.coarsening import GridLevel, interpolate
from hks_jax.eigen.filter.damping import Band, correction, degree_for
from hks_jax.eigen.filter.sharing import EVERYWHERE, own_blocks, shared, to_own_rows, to_slabs
from hks_jax.eigen.filter.subspace import block_of, local_level, measure, rayleigh_ritz
from hks_jax.eigen.quality import allowed_defects
from hks_jax.eigen.weyl import weyl
from hks_jax.fem.columns import stencil, stencil_product, to_columns, to_rows
from hks_jax.fem.halo import Slabs
from hks_jax.linear.accelerators import row_by_row

_GAIN = 40.0
"""How far one round damps what is not wanted: much more, and the lumped mass in the filter is what limits it."""
_SPREAD = 1e5
"""How much more than a mode at the edge of the band the lowest may grow: beyond it, rounding does."""
_LEAST_DEGREE = 4
_MARGIN = 1.1
"""What may be missing from the last vector's eigenvalue by Weyl's law."""
_SPLIT, _APART = 0.02, 1.5
"""How far the lumped mass may shift modes of like eigenvalues apart, and how far above the wanted ones it must leave
those of more than twice their eigenvalues, before the filter needs a better inverse."""
_MOST_TERMS = 15
"""Further terms of its Neumann series, at most."""


class Plan(NamedTuple):
    """The sizes of a computation; static.

    Attributes:
        wanted: how many eigenpairs.
        size: how many vectors, whole blocks.
        block: vectors filtered together.
        n_null: zero eigenvalues.
        tolerance: relative residual that counts as converged.
        single_precision: whether filters run in float32.
        mesh: the devices that vectors are shared among; None for one.
    """

    wanted: int
    size: int
    block: int
    n_null: int
    tolerance: float
    single_precision: bool
    mesh: Mesh | None

    def slabs(self, shape: tuple[int, ...], periodic: tuple[bool, ...]) -> Slabs | None:
        """Return how a grid of this shape is cut between rounds."""
        return None if self.mesh is None else Slabs(self.mesh, shape, periodic)


class FilterState(NamedTuple):
    """What is known between two rounds.

    Attributes:
        values: (m,) Ritz values θ, ascending.
        vectors: (m, nodes) M-orthonormal Ritz vectors; on several devices, padded nodes, each device's slab.
        defects: (m,) ‖Kx − θMx‖/‖Mx‖.
        lumped_values: (m,) xᵀKx / xᵀDx with the lumped mass D.
        terms: further terms of the mass's inverse that were needed so far.
        rounds: rounds so far on this grid.
    """

    values: Float[Array, " m"]
    vectors: Float[Array, "m nodes"]
    defects: Float[Array, " m"]
    lumped_values: Float[Array, " m"]
    terms: Int[Array, ""]
    rounds: Int[Array, ""]


class Filtering(NamedTuple):
    """The polynomials of a round.

    Attributes:
        band: what they damp.
        terms: further terms of the mass's inverse.
        degrees: by block; 0 where all has converged.
        values: (m,) ψ of each vector, at which its polynomial is scaled.
        factor: (m,) by which corrections are multiplied.
    """

    band: Band
    terms: Int[Array, ""]
    degrees: Int[Array, " blocks"]
    values: Float[Array, " m"]
    factor: Float[Array, " m"]


def unconverged(plan: Plan, rounding: Float[Array, ""], state: FilterState) -> Int[Array, ""]:
    """Return how many of the wanted pairs have not converged."""
    return jnp.sum(~_converged(plan, rounding, state)[: plan.wanted])


@partial(jax.jit, static_argnames="plan")
def excess(plan: Plan, rounding: Float[Array, ""], state: FilterState) -> Float[Array, ""]:
    """Return the largest defect of the wanted pairs, as a multiple of what counts as converged."""
    return jnp.max((state.defects / _allowed(plan, rounding, state))[: plan.wanted])


def _converged(plan: Plan, rounding: Float[Array, ""], state: FilterState) -> Bool[Array, " m"]:
    return state.defects <= _allowed(plan, rounding, state)


def _allowed(plan: Plan, rounding: Float[Array, ""], state: FilterState) -> Float[Array, " m"]:
    return allowed_defects(jnp.maximum(state.values, state.values[plan.n_null]), rounding, plan.tolerance)


@partial(jax.jit, static_argnames=("periodic", "plan"))
def from_random(
    level: GridLevel, periodic: tuple[bool, ...], plan: Plan, high: Float[Array, ""], volume: Float[Array, ""]
) -> FilterState:
    """Return the state after filtering random functions."""
    low = jnp.minimum(1.3 * weyl(plan.size, volume, len(level.shape)).astype(high.dtype), high / 3)
    slabs = plan.slabs(level.shape, periodic)

    def run(level: GridLevel, low: Float[Array, ""], high: Float[Array, ""]) -> FilterState:
        band = Band(low, high)
        degree = jnp.ceil(degree_for(band, jnp.zeros_like(low), _SPREAD)).astype(int)

        def damped(key: Array) -> Float[Array, "b nodes"]:
            x = jnp.where(level.free[..., None], jax.random.normal(key, (*level.shape, plan.block), high.dtype), 0)
            image = stencil_product(level.stiffness, x, periodic)
            return to_rows(x + correction(level, periodic, band, image, jnp.full(plan.block, low), degree, x))

        numbers = own_blocks(slabs, plan.size // plan.block)
        keys = jax.random.split(jax.random.key(0), plan.size // plan.block)[numbers]
        rows = jax.lax.map(damped, keys).reshape(-1, level.lumped.size)
        return ritz(level, periodic, plan, to_slabs(slabs, plan.block, rows), jnp.zeros((), int), jnp.zeros((), int))

    return shared(slabs, run, EVERYWHERE, _layout(slabs))(level, low, high)


@partial(jax.jit, static_argnames=("periodic", "plan", "coarse_shape"))
def from_coarse(
    level: GridLevel, periodic: tuple[bool, ...], plan: Plan, coarse_shape: tuple[int, ...], coarse: FilterState
) -> FilterState:
    """Return the state that interpolation from the next coarser grid gives."""
    slabs, coarse_slabs = plan.slabs(level.shape, periodic), plan.slabs(coarse_shape, periodic)

    def run(level: GridLevel, coarse: Float[Array, "m coarse_nodes"]) -> FilterState:
        rows = to_own_rows(coarse_slabs, plan.block, coarse)

        def of_block(number: Array) -> Float[Array, "b nodes"]:
            return to_rows(interpolate(block_of(rows, number, plan.block, coarse_shape), level, periodic))

        fine = jax.lax.map(of_block, jnp.arange(rows.shape[0] // plan.block)).reshape(rows.shape[0], -1)
        return ritz(level, periodic, plan, to_slabs(slabs, plan.block, fine), jnp.zeros((), int), jnp.zeros((), int))

    layout = _layout(slabs)
    return shared(slabs, run, (EVERYWHERE, layout.vectors), layout)(level, coarse.vectors)


@partial(jax.jit, static_argnames=("periodic", "plan"), donate_argnames="state")
def improve(
    level: GridLevel,
    periodic: tuple[bool, ...],
    plan: Plan,
    high: Float[Array, ""],
    rounding: Float[Array, ""] | None,
    state: FilterState,
) -> FilterState:
    """Filter the blocks in which something has not converged (without ``rounding``, all), and Rayleigh–Ritz."""
    slabs = plan.slabs(level.shape, periodic)
    layout = _layout(slabs)
    run = partial(_improve, periodic, plan, slabs)
    return shared(slabs, run, (EVERYWHERE, EVERYWHERE, EVERYWHERE, layout), layout)(level, high, rounding, state)


def _improve(
    periodic: tuple[bool, ...],
    plan: Plan,
    slabs: Slabs | None,
    level: GridLevel,
    high: Float[Array, ""],
    rounding: Float[Array, ""] | None,
    state: FilterState,
) -> FilterState:
    numbers = own_blocks(slabs, plan.size // plan.block)
    chosen = plan_round(plan, level, high, rounding, state)
    step = partial(filter_block, level, periodic, plan, chosen, state.values)
    rows = to_own_rows(slabs, plan.block, state.vectors)
    filtered = jax.lax.fori_loop(0, numbers.size, lambda own, rows: step(numbers[own], own, rows), rows)
    vectors = to_slabs(slabs, plan.block, filtered)
    return ritz(level, periodic, plan, vectors, chosen.terms, state.rounds + 1)


@partial(jax.jit, static_argnames="plan")
def plan_round(
    plan: Plan, level: GridLevel, high: Float[Array, ""], rounding: Float[Array, ""] | None, state: FilterState
) -> Filtering:
    """Return the polynomials of a round: the band that they damp, and their degrees."""
    spare = jnp.arange(plan.size) >= plan.wanted
    terms, filtered_values, factor = _lumping(plan, state)
    high = (1 + terms).astype(high.dtype) * high
    # Where the vectors beyond the wanted ones are no eigenvectors yet, the band begins where Weyl's law has the last.
    edge = _MARGIN * filtered_values[plan.wanted - 1] * (plan.size / plan.wanted) ** (2 / len(level.shape))
    low = jnp.minimum(jnp.minimum(jnp.max(filtered_values), edge), high / 2)
    band = Band(low, high)
    left = spare | (True if rounding is None else ~_converged(plan, rounding, state))
    # The spare vectors need no more than the last wanted one.
    goal = jnp.where(spare, filtered_values[plan.wanted - 1], filtered_values)
    most = degree_for(band, jnp.zeros_like(low), _SPREAD)
    degrees = jnp.ceil(jnp.clip(degree_for(band, goal, _GAIN), _LEAST_DEGREE, jnp.maximum(most, _LEAST_DEGREE)))
    degrees = jnp.max(jnp.where(left, degrees, 0).reshape(-1, plan.block), axis=1).astype(int)
    return Filtering(band, terms, degrees, filtered_values, factor)


def filter_block(
    level: GridLevel,
    periodic: tuple[bool, ...],
    plan: Plan,
    chosen: Filtering,
    values: Float[Array, " m"],
    number: Int[Array, ""],
    own: Int[Array, ""],
    vectors: Float[Array, "own nodes"],
) -> Float[Array, "own nodes"]:
    """Return the rows with a block filtered: the one of this number among all, the `own`th among these rows."""
    stiffness, mass = stencil(level.stiffness, periodic), stencil(level.mass, periodic)
    dtype = jnp.float32 if plan.single_precision else values.dtype
    band, degree = chosen.band, chosen.degrees[number]

    def filtered(rows: Float[Array, "b nodes"]) -> Float[Array, "b nodes"]:
        x = to_columns(rows, level.shape)
        theta, zeta, scale = (
            jax.lax.dynamic_slice_in_dim(v, number * plan.block, plan.block)
            for v in (values, chosen.values, chosen.factor)
        )
        # What is in the band itself has no residual worth the name: it is damped as it is.
        inside = zeta > band.low
        moved = jnp.where(inside, 0, theta * mass(x))
        residual = stiffness(x) - moved
        whole = jnp.where(inside, x, 0).astype(dtype)
        z = correction(level, periodic, band, residual.astype(dtype), zeta, degree, whole, chosen.terms)
        z = jnp.where(inside, 1, jnp.clip(scale, 0, 1)) * z.astype(x.dtype)
        return rows + row_by_row(to_rows(z))

    # The condition has nothing but the block: what goes through one is copied.
    rows = row_by_row(jax.lax.dynamic_slice_in_dim(vectors, own * plan.block, plan.block))
    rows = jax.lax.cond(degree > 0, filtered, lambda unchanged: unchanged, rows)
    return jax.lax.dynamic_update_slice_in_dim(vectors, rows, own * plan.block, axis=0)


def _lumping(plan: Plan, state: FilterState) -> tuple[Int[Array, ""], Float[Array, " m"], Float[Array, " m"]]:
    """Return how many further terms the inverse of the mass needs, and with them ψ and the scale of each vector."""
    values, wanted = state.values, state.values[plan.wanted - 1]
    # 1 − β of the modes: what the lumped mass takes from their eigenvalues.
    missing = 1 - jnp.where(values > 0, state.lumped_values / jnp.where(values > 0, values, 1), 1)
    powers = jnp.arange(1, _MOST_TERMS + 2, dtype=values.dtype)[:, None]
    lost = missing**powers
    near = (values >= wanted / 2) & (values <= 2 * wanted)
    spread = jnp.max(jnp.where(near, lost, 0), axis=1) - jnp.min(jnp.where(near, lost, jnp.inf), axis=1)
    beyond = jnp.min(jnp.where(values > 2 * wanted, (1 - lost) * values, jnp.inf), axis=1)
    enough = (spread <= _SPLIT) & (beyond >= _APART * wanted)
    # Never fewer than before: what they keep away would come back.
    terms = jnp.maximum(state.terms, jnp.where(jnp.any(enough), jnp.argmax(enough), _MOST_TERMS))
    return terms, (1 - lost[terms]) * values, 1 - (terms + 1).astype(values.dtype) * lost[terms]


def ritz(
    level: GridLevel,
    periodic: tuple[bool, ...],
    plan: Plan,
    vectors: Float[Array, "m nodes"],
    terms: Int[Array, ""],
    rounds: Int[Array, ""],
) -> FilterState:
    """Return the state whose vectors are the Ritz vectors of the rows."""
    slabs = plan.slabs(level.shape, periodic)
    level = local_level(level, slabs)
    values, vectors = rayleigh_ritz(level, periodic, plan.block, vectors, slabs)
    measured = measure(level, periodic, plan.block, values, vectors, slabs)
    return FilterState(values, vectors, measured.defects, measured.lumped_values, terms, rounds)


def _layout(slabs: Slabs | None) -> FilterState:
    """Return how a state is laid out: the vectors in slabs, the rest on every device."""
    vectors = EVERYWHERE if slabs is None else PartitionSpec(None, slabs.name)
    return FilterState(EVERYWHERE, vectors, EVERYWHERE, EVERYWHERE, EVERYWHERE, EVERYWHERE)  # type: ignore[arg-type]
