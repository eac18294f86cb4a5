"""The matrix-free eigensolver for grids: Chebyshev-filtered subspace iteration, from coarse grids to the fine one."""

import math
import time
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, Bool, Float

from hks_jax.checks import require_count
from hks_jax.eigen.adjoints.complement import Adjoint
from hks_jax.eigen.filter.coarsening import coarsen
from hks_jax.eigen.filter.filtered_adjoint import FilteredAdjoint
from hks_jax.eigen.filter.polynomial import upper_end
from hks_jax.eigen.filter.subspace import EVERYWHERE
from hks_jax.eigen.filter.subspace_iteration import FilterPlan, FilterState, GridFilter
from hks_jax.eigen.quality import indistinct
from hks_jax.eigen.solver import Eigensolver, RawPairs, Report, Status, silent
from hks_jax.fem.halo import checked_mesh
from hks_jax.fem.nodal import NodalPencil, nodal_pencil
from hks_jax.fem.pencil import Pencil, from_lower_bound
from hks_jax.fem.space import GridSpace
from hks_jax.fem.stencil import StencilOperator
from hks_jax.linear import accelerators
from hks_jax.linear.loops import while_loop
from hks_jax.traced import is_traced

_FIRST_ROUNDS, _COARSE_ROUNDS = 3, 1
"""The numbers of rounds on the coarsest grid, which starts from random functions, and on each intermediate grid."""
_ROOM = 12
"""The least number of degrees of freedom per vector on a coarse grid."""
_SPARE = 0.35
"""The number of additional vectors as a fraction of k. With more vectors, the rounds are fewer but more expensive."""
_LEAST_NODES = 6
"""The least number of nodes along each axis at which a grid is coarsened."""
_LARGE = 1 << 21
"""The total number of entries of the vectors above which every block reports progress, not only every round."""

Pairs = tuple[Float[Array, " k"], Float[Array, "m n_dof"]]


class ChebyshevFilter(Eigensolver[Pencil]):
    """Chebyshev-filtered subspace iteration on stencils, without a factorisation; the vectors take most of the memory.

    The solver is for grids, mainly in 3D, where factorisations have much fill-in, and for accelerators. Filters run in
    single precision without loss of accuracy, because they act on residuals that are computed in the precision of the
    matrices. All pairs are computed simultaneously, so that multiple eigenvalues are complete; but no certificate shows
    that no eigenvalue was missed. The solver works under `jit`. Outside `jit`, it can be interrupted and reports
    progress between two rounds.

    Attributes:
        tolerance: the relative residual at which a pair counts as converged.
        block: the number of vectors filtered together, to which the size of the workspace is proportional. None means
            16 on CPUs, and 32 on accelerators, which then launch fewer kernels.
        max_rounds: the maximal number of rounds on the finest grid.
        mesh: the devices, as a `jax.sharding.Mesh` with one axis. Each device filters some of the vectors, and stores
            all vectors on a part of the grid (docs/devices.md). None means one device.
        keep_spare: whether the pairs keep the additional vectors, a third of k, which ``start`` of `eigenpairs` needs.

    Examples:
        >>> flat = hj.TensorField(hj.Grid((17, 17), 1 / 16), np.tile(np.eye(2), (17, 17, 1, 1)))
        >>> pairs = hj.eigenpairs(flat, k=4, solver=hj.ChebyshevFilter(block=8))
        >>> print((pairs.eigenvalues / jnp.pi**2).round(1))
        [0. 1. 1. 2.]
    """

    name: ClassVar[str] = "chebyshev-filter"
    starts: ClassVar[bool] = True
    tolerance: float = eqx.field(default=1e-8, static=True)
    block: int | None = eqx.field(default=None, static=True)
    max_rounds: int = eqx.field(default=60, static=True)
    adjoint: Adjoint = eqx.field(default=FilteredAdjoint(), static=True, kw_only=True)
    mesh: Mesh | None = eqx.field(default=None, static=True)
    keep_spare: bool = eqx.field(default=False, static=True)

    def __check_init__(self) -> None:
        require_count("block", self._together)
        require_count("max_rounds", self.max_rounds)
        if self.mesh is not None:
            checked_mesh(self.mesh)

    def require(self, pencil: Pencil) -> None:
        """Raise ValueError unless the pencil is that of a grid, with a known lower bound of the spectrum."""
        if not isinstance(pencil.stiffness, StencilOperator):
            raise ValueError("solver: got 'chebyshev-filter', which needs a grid; pass 'shift-invert' for others")
        if not pencil.bounded:
            raise ValueError(
                "solver: got 'chebyshev-filter', which needs a positive semidefinite stiffness with a known null "
                'space; the null space is unknown. Use "block-lanczos" or "dense", or give `sparse_pencil` the null '
                "vectors"
            )

    def lowest(
        self, pencil: Pencil, k: int, report: Report = silent, start: Float[Array, "given n_dof"] | None = None
    ) -> RawPairs:
        """Return the k lowest eigenpairs; the bound is NaN, because the method has no certificate.

        The iteration starts from the vectors ``start`` if they are enough, otherwise on coarser grids.
        """
        moved, origin = from_lower_bound(pencil)
        assert isinstance(moved, Pencil)
        assert isinstance(moved.space, GridSpace)
        plan = self.plan(k, pencil)
        compute = _compiled if is_traced(moved) else _iterate
        start = None if start is None or len(start) < plan.size else start[: plan.size]
        rounds = 0 if plan.n_null >= k else self.max_rounds  # the caller knows null vectors
        values, vectors = compute(moved, plan, rounds, report, start, plan.size if self.keep_spare else k)
        values = values if pencil.null_space is not None else values + origin
        return values, vectors, jnp.asarray(jnp.nan, values.dtype)

    def guards(self, k: int, n_dof: int) -> int:
        """Return the number of guard pairs that keep linear solves well conditioned: half of the additional vectors."""
        return max(8, int(_SPARE * k) // 2)

    def max_pairs(self, n_dof: int) -> int:
        """Return the largest k for which the filter still damps most of the spectrum."""
        return max(n_dof // 8 - self._together, 0)

    @property
    def _together(self) -> int:
        return (32 if accelerators.at_hand() else 16) if self.block is None else self.block

    def plan(self, k: int, pencil: Pencil) -> FilterPlan:
        """Return the number of vectors, and the other static settings of the subspace iteration, for k eigenpairs."""
        mesh, block = None if self.mesh is None else checked_mesh(self.mesh), self._together
        multiple = block if mesh is None else block * mesh.size
        size = math.ceil((k + max(8, _SPARE * k)) / multiple) * multiple
        zeros = 1 if pencil.null_space is None else min(pencil.n_null, size - 1)
        return FilterPlan(k, size, block, zeros, self.tolerance, mesh)


def _iterate(
    pencil: Pencil,
    plan: FilterPlan,
    max_rounds: int,
    report: Report,
    start: Float[Array, "m n_dof"] | None,
    returned: int,
) -> Pairs:
    nested = _nested(pencil, plan) if start is None else [nodal_pencil(pencil)]
    grids = [_replicated(plan.mesh, GridFilter(nodal, upper_end(nodal), plan)) for nodal in nested]
    rounding, grid = indistinct(pencil, grids[0].high.dtype), grids.pop()
    if start is None:
        assert pencil.volume is not None
        state = grid.from_random(pencil.volume)
    else:
        state = grid.from_rows(pencil.space.extend(start, outside=0.0).reshape(plan.size, -1))
    rounds = _FIRST_ROUNDS
    while grids:
        for _ in range(rounds):
            # The programs of `improve_told` serve the grid's beginning too, and one of them both problems of "mean".
            state = grid.improve_told(rounding, state) if plan.mesh is None else grid.improve(rounding, state)
        if not is_traced(state):
            report(f"grid {' × '.join(map(str, grid.pencil.shape))}")
        coarse, grid, rounds = grid, grids.pop(), _COARSE_ROUNDS
        state = grid.from_coarse(coarse, state)
    state = _converge(grid, rounding, state, max_rounds, report)
    values, vectors = _wanted(grid, state, returned=returned)
    del state  # its vectors, while `restrict` makes further ones
    space = pencil.space
    if space.n_dof < vectors.shape[1]:
        vectors = space.restrict(vectors.reshape(-1, *space.node_shape))
    return values, vectors


# Outside `jit`, each operation on its own would copy all vectors.
@partial(jax.jit, static_argnames="returned")
def _wanted(grid: GridFilter, state: FilterState, returned: int) -> Pairs:
    """Return the wanted eigenvalues, and the returned vectors on all nodes of the grid."""
    slabs, vectors = grid.slabs, state.vectors[:returned]
    if slabs is not None:
        vectors = slabs.join(vectors.reshape(returned, *slabs.padded_shape), axis=1).reshape(returned, -1)
    return state.values[: grid.plan.wanted], vectors


_compiled = jax.jit(_iterate, static_argnames=("plan", "max_rounds", "report", "returned"))


def _converge(grid: GridFilter, rounding: Array, state: FilterState, max_rounds: int, report: Report) -> FilterState:
    """Iterate on the finest grid until the pairs converge. Report each round and, for large problems, each block."""
    wanted = grid.plan.wanted

    def excess(state: FilterState) -> Float[Array, " wanted"]:
        return grid.excess(rounding, state)[:wanted]

    def going_on(state: FilterState) -> Bool[Array, ""]:
        return jnp.any(excess(state) > 1) & (state.rounds < max_rounds)  # NaN ends the iteration

    if report is silent or is_traced(state):
        return while_loop(going_on, partial(grid.improve, rounding), state)
    pace = Pace(float(jnp.max(excess(state))))
    in_steps = grid.plan.mesh is None and state.vectors.size >= _LARGE
    while going_on(state):
        beyond = np.asarray(excess(state))
        text = (
            f"round {int(state.rounds) + 1}: {int((beyond <= 1).sum())} of {wanted} pairs, residuals up to "
            f"{float(beyond.max()) * grid.plan.tolerance:.0e} (wanted {grid.plan.tolerance:.0e})"
        )
        report(Status(text, pace.seconds_left()))

        def tell(done: int, of: int, text: str = text) -> None:
            report(Status(f"{text}: {done / of:.0%} of the products", pace.seconds_left(done, of)))

        state = grid.improve_told(rounding, state, tell) if in_steps else grid.improve(rounding, state)
        pace.round_done(float(jnp.max(excess(state))))
    return state


class Pace:
    """An estimate of the remaining time of a subspace iteration, from the convergence and cost of earlier rounds.

    The estimate assumes that each round reduces the largest residual by the same factor, and that the time of a round
    is proportional to its number of matrix–vector products. No estimate exists before the end of the first round.
    """

    def __init__(self, excess: float) -> None:
        """Start the clock. ``excess`` is the largest residual, in units of the residual that counts as converged."""
        self._excess, self._factor = excess, math.nan
        self._seconds, self._last_work, self._work = math.nan, 1, 1
        self._begin = time.perf_counter()

    def round_done(self, excess: float) -> None:
        """Record the residual after a round."""
        now = time.perf_counter()
        self._factor, self._excess = self._excess / excess if excess > 0 else math.inf, excess
        self._last_work, self._seconds, self._begin = self._work, now - self._begin, now

    def seconds_left(self, done: int = 0, work: int | None = None) -> float | None:
        """Return the remaining seconds after ``done`` of the current round's ``work`` products; None if unknown."""
        self._work = work or self._last_work
        if not self._factor > 1 or not self._excess > 1:
            return None
        rounds = math.ceil(math.log(self._excess) / math.log(self._factor))
        # Later rounds filter fewer pairs. So the number of products in the current round, if known, is a better
        # estimate for later rounds than the number in the previous round.
        return (rounds - done / self._work) * self._seconds * self._work / self._last_work


def _nested(pencil: Pencil, plan: FilterPlan) -> list[NodalPencil]:
    """Return the pencils of all grids, from the finest to the coarsest, on which no component of the domain is lost.

    All vectors would be zero on a component without a node on a coarse grid, and filters would keep them zero there.
    """
    grids, labels = [nodal_pencil(pencil)], np.where(pencil.space.free, pencil.space.labels, 0)
    in_each = np.bincount(labels.ravel())[1:]  # the numbers of free nodes
    while True:
        labels, finer = labels[(slice(None, None, 2),) * labels.ndim], in_each
        in_each = np.bincount(labels.ravel(), minlength=finer.size + 1)[1:]
        lost = (finer > 0) & (in_each == 0)
        if lost.any() or min(grids[-1].shape) < _LEAST_NODES or in_each.sum() < _ROOM * plan.size:
            return grids
        grids.append(coarsen(grids[-1]))


def _replicated(mesh: Mesh | None, grid: GridFilter) -> GridFilter:
    return grid if mesh is None else jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, EVERYWHERE))(grid)
