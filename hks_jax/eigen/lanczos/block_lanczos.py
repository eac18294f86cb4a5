"""The eigensolver for sparse factorisable pencils: spectrum slicing by block Lanczos, with a certificate by inertia."""

import math
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.arrays import Scalar
from hks_jax.checks import require_count
from hks_jax.compilation import jit_quickly
from hks_jax.eigen.inertia import dissected, locate
from hks_jax.eigen.lanczos.slicing import (
    Problem,
    SlicingPlan,
    SlicingState,
    Stored,
    cut,
    first_state,
    search,
    unfinished,
)
from hks_jax.eigen.quality import indistinct, measure_pairs
from hks_jax.eigen.solver import Dense, Eigensolver, RawPairs, Report, is_remote, silent
from hks_jax.eigen.weyl import weyl
from hks_jax.fem.pencil import Pencil
from hks_jax.linear.loops import when, while_loop
from hks_jax.linear.symmetric_pencil import SymmetricPencil, tabulated
from hks_jax.traced import is_traced

SLICE = 170
"""The number of eigenvalues per slice. More slices take more factorisations, but less orthogonalisation."""
_DENSE = 3000
"""The largest number of unknowns for which the dense solver takes over if slicing fails."""
_COPIES = 1000
"""The largest number of lowest eigenvalues that are all computed because rounding does not separate them."""


class BlockLanczos(Eigensolver[SymmetricPencil]):
    """Spectrum slicing: shift-invert block Lanczos with nested-dissection factorisations, all in JAX.

    The solver is for grids and meshes, mainly in 2D; in 3D, the factors have much fill-in. The same code runs on CPUs
    and accelerators, and works under `jit`. Outside `jit`, the solver can be interrupted, reports progress between two
    slices, and finds eigenvalues of any multiplicity, if necessary (up to 3000 unknowns) by the dense solver.

    Attributes:
        tolerance: the relative residual at which a pair counts as converged.
        block: the number of vectors per Lanczos block, which multiplicities of eigenvalues may exceed.
        slice_size: the number of eigenvalues per slice; None means an automatic choice.

    Examples:
        >>> K = 2 * np.eye(59) - np.eye(59, k=1) - np.eye(59, k=-1)  # a string of 59 beads
        >>> values = hj.eigsh(K, k=3, solver=hj.BlockLanczos()).eigenvalues
        >>> print((values / (jnp.pi / 60) ** 2).round(1))
        [1. 4. 9.]
    """

    name: ClassVar[str] = "block-lanczos"
    tolerance: float = eqx.field(default=1e-8, static=True)
    block: int = eqx.field(default=8, static=True)
    slice_size: int | None = eqx.field(default=None, static=True)

    def __check_init__(self) -> None:
        require_count("block", self.block)
        if self.slice_size is not None:
            require_count("slice_size", self.slice_size)

    def lowest(self, pencil: SymmetricPencil, k: int, report: Report = silent) -> RawPairs:
        """Return the k lowest eigenpairs, and the bound below which inertia certifies that none is missing."""
        # Weyl's law predicts the beginning and density of some spectra; for the others, inertia is needed.
        if isinstance(pencil, Pencil) and pencil.measured and pencil.null_space is not None:
            plan = self.plan(k, min(pencil.n_null, k))
            return self._by_slices(expected(pencil, plan), plan, report)
        half = max(self.plan(k).slice_size // 2, 1)
        origin, first, below = locate(pencil, half, self.block)
        reach, number = first - origin, k
        if not is_traced(below) and 2 * half < below <= _COPIES:
            # The lowest eigenvalue has an unexpectedly high multiplicity. Compute all pairs that `locate` counted.
            number = max(k, int(below))
            if number > self.max_pairs(pencil.size):
                return Dense().lowest(pencil, k)
        plan, spacing = self.plan(number), reach / jnp.maximum(below, 1).astype(reach.dtype)
        values, vectors, bound = self._by_slices(_moved(pencil, origin, reach, spacing), plan, report)
        if not is_traced(values) and is_remote(values, indistinct(pencil, values.dtype)):
            spread = values[-1] - values[0]
            origin = origin + values[0] - spread
            moved = _moved(pencil, origin, 2 * spread, spread / number)
            values, vectors, bound = self._by_slices(moved, plan, report)
        return values[:k] + origin, vectors[:k], bound + origin

    def _by_slices(self, problem: Problem, plan: SlicingPlan, report: Report) -> RawPairs:
        k, dissection = plan.wanted, dissected(problem.pencil)
        if not is_traced(problem):
            problem = problem._replace(pencil=tabulated(problem.pencil))

        def step(both: tuple[SlicingState, Stored]) -> tuple[SlicingState, Stored]:
            factor, searchable, both = cut(problem, dissection, plan, *both)
            both = when(searchable, partial(search, problem, factor, plan), both)
            if report is not silent and not is_traced(both):  # a report makes the host wait for the device
                known, bound = min(int(both[0].known), k), float(both[0].complete_below)
                report(f"{known} of {k} eigenpairs, and all eigenvalues below {bound:.6g}")
            return both

        state, stored = while_loop(lambda both: unfinished(plan, both[0]), step, first_state(problem, plan))
        values, vectors, bound = _ordered(problem.pencil, state.values, stored, state.complete_below, k)
        if is_traced(bound) or (state.finished and not math.isnan(bound)) or problem.pencil.size > _DENSE:
            return values, vectors, bound
        report("slicing missed pairs: computing all pairs with the dense solver")
        return Dense().lowest(problem.pencil, k)

    def max_pairs(self, n_dof: int) -> int:
        """Return the largest k that leaves room for a Lanczos basis."""
        return max((n_dof - 16 * self.block) // 4, 0)

    def plan(self, k: int, nulls: int = 0) -> SlicingPlan:
        """Return the slice size and other static settings for k eigenvalues; the first ``nulls`` are zero."""
        slices = max(round(k / (self.slice_size or SLICE)), 1)
        size = math.ceil(1.06 * k / slices) + 2
        # The search divides residuals by an estimate of the mean gap, the result by the mean gap of the pairs found.
        return SlicingPlan(k, self.block, size, 3 * slices + 12, self.tolerance / 4, nulls)


@jit_quickly(static_argnames="plan")
def expected(pencil: Pencil, plan: SlicingPlan) -> Problem:
    """Return the pencil with estimates of its spectrum from Weyl's law."""
    assert pencil.volume is not None
    n, dtype = pencil.space.dimension, pencil.stiffness.dtype
    first, several, lowest = (
        weyl(j, pencil.volume, n).astype(dtype) for j in (min(plan.wanted, plan.slice_size) / 2 + 1, plan.slice_size, 1)
    )
    return Problem(pencil, first, several / plan.slice_size, lowest, jnp.zeros((), dtype))


@jit_quickly()
def _moved(pencil: SymmetricPencil, origin: Scalar, first: Scalar, spacing: Scalar) -> Problem:
    """Return the pencil of K − σ₀M and M for an origin σ₀ below the spectrum, with the beginning of its spectrum."""
    moved, source = pencil.moved_by(origin)
    spacing = spacing.astype(origin.dtype)
    return Problem(SymmetricPencil(moved, pencil.mass, source=source), first, spacing, spacing, spacing)


@jit_quickly(static_argnames="k")
def _ordered(
    pencil: SymmetricPencil, values: Float[Array, " capacity"], vectors: Stored, bound: Float[Array, ""], k: int
) -> RawPairs:
    """Return the k lowest pairs (NaN if missing) and the certified bound (NaN if an eigenvector was found twice)."""
    order = jnp.argsort(values)[:k]
    values, vectors = values[order], vectors[order]
    found = jnp.isfinite(values)
    if values.dtype == jnp.float32:
        bound = jnp.where(jnp.any(measure_pairs(pencil, vectors, values)[2] & found), jnp.nan, bound)
    return jnp.where(found, values, jnp.nan), jnp.where(found[:, None], vectors, jnp.nan), bound
