"""The matrix-free eigensolver for grids: Chebyshev-filtered subspace iteration, from coarse grids to the fine one."""

import math
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Float

from hks_jax.checks import require_count, require_number
from hks_jax.eigen.complement.adjoint import Adjoint
from hks_jax.eigen.complement.filtered import FilteredAdjoint
from hks_jax.eigen.filter.coarsening import GridLevel, coarsen, finest_level
from hks_jax.eigen.filter.damping import upper_end
from hks_jax.eigen.filter.pace import Pace
from hks_jax.eigen.filter.rounds import (
    FilterState,
    Plan,
    excess,
    from_coarse,
    from_random,
    improve,
    unconverged,
)
from hks_jax.eigen.filter.sharing import replicate
from hks_jax.eigen.filter.steps import improve_in_steps
from hks_jax.eigen.quality import indistinct
from hks_jax.eigen.solver import Eigensolver, RawPairs, Report, Status, silent
from hks_jax.fem.halo import checked_mesh
from hks_jax.fem.operators import StencilOperator
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import GridSpace
from hks_jax.traced import is_traced

_FIRST_ROUNDS, _COARSE_ROUNDS = 4, 2
"""Rounds on the coarsest grid, from random functions, and on those between."""
_ROOM = 12
"""Degrees of freedom per vector that a coarse grid must have."""
_LEAST_NODES = 6
"""Nodes along each axis below which a grid is not coarsened."""
_LARGE = 1 << 21
"""Numbers in all vectors from which on a round takes so long that its blocks are told one by one."""


class ChebyshevFilter(Eigensolver[Pencil]):
    """Chebyshev-filtered subspace iteration on stencils: no factorisation, memory for the vectors and little more.

    For grids, above all in 3D, where factorisations fill in, and on accelerators. Filters run in single precision
    without loss: they act on residuals, which are computed in the matrices' own. Multiple eigenvalues are found whole,
    since all are sought at once, but there is no certificate that none was missed. Traceable whole; called plainly it
    can be interrupted, and reports progress, between two rounds.

    Attributes:
        tolerance: relative residual that counts as converged.
        block: vectors filtered together; with it grows the memory beyond that for all vectors.
        spare: how many vectors to iterate beyond k, as a part of k: more converge faster, and cost more.
        max_rounds: rounds on the finest grid before giving up.
        single_precision: whether filters run in float32.
        mesh: devices to share the work among, a `jax.sharding.Mesh` with one axis: each filters some of the vectors,
            and holds all of them on a part of the grid (docs/devices.md). None: one device.
    """

    name: ClassVar[str] = "chebyshev-filter"
    indefinite: ClassVar[bool] = False
    tolerance: float = eqx.field(default=1e-8, static=True)
    block: int = eqx.field(default=32, static=True)
    spare: float = eqx.field(default=0.35, static=True)
    max_rounds: int = eqx.field(default=60, static=True)
    single_precision: bool = eqx.field(default=True, static=True)
    adjoint: Adjoint = eqx.field(default=FilteredAdjoint(), static=True, kw_only=True)
    mesh: Mesh | None = eqx.field(default=None, static=True)

    def __check_init__(self) -> None:
        """Check the settings."""
        require_number("tolerance", self.tolerance, 1)
        require_count("block", self.block)
        require_number("spare", self.spare)
        require_count("max_rounds", self.max_rounds)
        if self.mesh is not None:
            checked_mesh(self.mesh)

    def lowest(self, pencil: Pencil, k: int, report: Report = silent) -> RawPairs:
        """Return the k lowest eigenpairs; the bound is NaN: there is no certificate."""
        if not isinstance(pencil.stiffness, StencilOperator):
            raise ValueError("solver: chebyshev-filter needs a grid; use 'shift-invert' for a mesh")
        assert isinstance(pencil.space, GridSpace)
        plan = self.plan(k, pencil.space)
        if is_traced(pencil):
            values, vectors = _lowest_traced(pencil, plan, self.max_rounds)
        else:
            values, vectors = _lowest(pencil, plan, self.max_rounds, report)
        return values, vectors, jnp.asarray(jnp.nan, values.dtype)

    def guards(self, k: int, n_dof: int) -> int:
        """Return as many as are iterated anyway, so that what is left to linear solves is far away."""
        return max(8, int(self.spare * k) // 2)

    def max_pairs(self, n_dof: int) -> int:
        """Return how many pairs leave most of the spectrum to be damped."""
        return max(n_dof // 8 - self.block, 0)

    def plan(self, k: int, space: GridSpace) -> Plan:
        """Return the sizes of the computation."""
        mesh = None if self.mesh is None else checked_mesh(self.mesh)
        together = self.block if mesh is None else self.block * mesh.size
        size = math.ceil((k + max(8, self.spare * k)) / together) * together
        return Plan(k, size, self.block, space.n_null, self.tolerance, self.single_precision, mesh)


def _lowest(
    pencil: Pencil, plan: Plan, max_rounds: int, report: Report | None
) -> tuple[Float[Array, " k"], Float[Array, "k n_dof"]]:
    """Return the pairs; without ``report``, in one computation that can be traced."""
    space = pencil.space
    assert isinstance(space, GridSpace)
    levels = _levels(pencil, plan)
    state = None
    for number in reversed(range(len(levels))):
        level = levels[number]
        level, high = replicate(plan.mesh, (level, upper_end(level, space.periodic)))
        if state is None:
            rounds, state = _FIRST_ROUNDS, from_random(level, space.periodic, plan, high, pencil.volume)
        else:
            rounds, state = _COARSE_ROUNDS, from_coarse(level, space.periodic, plan, levels[number + 1].shape, state)
        if number:
            for _ in range(rounds):
                state = improve(level, space.periodic, plan, high, None, state)
            if report:
                report(f"grid {' × '.join(map(str, level.shape))}")
    assert state is not None
    rounding = indistinct(pencil, high.dtype)
    if report:
        state = _converge(level, space.periodic, plan, high, rounding, state, max_rounds, report)
    else:
        state = jax.lax.while_loop(
            lambda state: (unconverged(plan, rounding, state) > 0) & (state.rounds < max_rounds),
            lambda state: improve(level, space.periodic, plan, high, rounding, state),
            state,
        )
    slabs, vectors = plan.slabs(level.shape, space.periodic), state.vectors[: plan.wanted]
    vectors = vectors.reshape(plan.wanted, *(level.shape if slabs is None else slabs.padded_shape))
    vectors = vectors if slabs is None else slabs.join(vectors, axis=1)
    return state.values[: plan.wanted], space.restrict(vectors)


def _converge(
    level: GridLevel,
    periodic: tuple[bool, ...],
    plan: Plan,
    high: Float[Array, ""],
    rounding: Float[Array, ""],
    state: FilterState,
    max_rounds: int,
    report: Report,
) -> FilterState:
    """Return the state after rounds on the finest grid, each told, and of large problems the blocks of each."""
    in_steps = report is not silent and plan.mesh is None and state.vectors.size >= _LARGE
    pace = Pace(float(excess(plan, rounding, state)))
    while (left := int(unconverged(plan, rounding, state))) and state.rounds < max_rounds:
        text = f"{plan.wanted - left} of {plan.wanted} pairs, round {int(state.rounds) + 1}"
        report(Status(text, pace.seconds_left()))
        work = 1
        if in_steps:

            def tell(done: int, of: int, text: str = text) -> None:
                nonlocal work
                work = of
                report(Status(f"{text}, {done / of:.0%} of it filtered", pace.seconds_left(done, of)))

            state = improve_in_steps(level, periodic, plan, high, rounding, state, tell)
        else:
            state = improve(level, periodic, plan, high, rounding, state)
        pace.round_done(float(excess(plan, rounding, state)), work)
    return state


@partial(jax.jit, static_argnames=("plan", "max_rounds"))
def _lowest_traced(pencil: Pencil, plan: Plan, max_rounds: int) -> tuple[Float[Array, " k"], Float[Array, "k n_dof"]]:
    return _lowest(pencil, plan, max_rounds, None)


def _levels(pencil: Pencil, plan: Plan) -> list[GridLevel]:
    """Return the grids from fine to coarse."""
    space = pencil.space
    assert isinstance(space, GridSpace)
    levels, free = [finest_level(pencil)], space.free
    while True:
        free = free[(slice(None, None, 2),) * free.ndim]
        if min(levels[-1].shape) < _LEAST_NODES or free.sum() < _ROOM * plan.size:
            return levels
        levels.append(coarsen(levels[-1], space.periodic))
