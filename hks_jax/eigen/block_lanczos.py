"""The eigensolver for grids: spectrum slicing by block Lanczos, with a certificate that no eigenvalue was missed."""

import math
from collections.abc import Callable
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.compilation import jit_quickly
from hks_jax.eigen import grid_complement
from hks_jax.eigen.dissection import dissect
from hks_jax.eigen.multifrontal import Factorisation
from hks_jax.eigen.slicing import Plan, State, crowded, cut, first_state, make_room, search, unfinished
from hks_jax.eigen.solver import Eigensolver, RawPairs
from hks_jax.fem.operators import StencilOperator
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import GridSpace
from hks_jax.traced import is_traced

_SLICE = 170
"""Eigenvalues per slice: fewer cost more factorisations, more cost more orthogonalisation."""


class BlockLanczos(Eigensolver):
    """Spectrum slicing: shift-invert block Lanczos on nested-dissection factorisations, all in JAX.

    For grids, 2D above all (in 3D the factors fill in). The same code runs on CPUs and accelerators, and is traceable
    whole. Called plainly it can be interrupted, and reports progress, between two slices.

    Attributes:
        tolerance: relative residual that counts as converged.
        block: vectors per Lanczos block. Multiplicities may be larger.
        slice_size: eigenvalues per slice; None chooses.
        derivative_tolerance: to what the linear solves for derivatives reduce their error, in the energy norm; not
            below what the eigenvectors' dtype allows.
        progress: called with short texts after each slice; None is silent.
    """

    name: ClassVar[str] = "block-lanczos"
    tolerance: float = eqx.field(default=1e-8, static=True)
    block: int = eqx.field(default=8, static=True)
    slice_size: int | None = eqx.field(default=None, static=True)
    derivative_tolerance: float = eqx.field(default=1e-12, static=True)
    progress: Callable[[str], None] | None = eqx.field(default=None, static=True)

    def __check_init__(self) -> None:
        """Check the settings."""
        if self.block < 1 or (self.slice_size is not None and self.slice_size < 1):
            raise ValueError(f"block, slice_size: got {self.block}, {self.slice_size}; expected at least 1")
        if not 0 < self.derivative_tolerance < 1:
            raise ValueError(f"derivative_tolerance: got {self.derivative_tolerance}; expected between 0 and 1")

    def lowest(self, pencil: Pencil, k: int) -> RawPairs:
        """Return the k lowest eigenpairs."""
        if not isinstance(pencil.stiffness, StencilOperator):
            raise ValueError("solver: block-lanczos needs a grid; use 'shift-invert' for a mesh")
        plan = self.plan(k, pencil.space.n_dof)
        state = (_slice_traced if is_traced(pencil) else self._slice)(pencil, plan, self.tolerance)
        assert state.vectors is not None
        return (*_lowest(state.values, state.vectors, k), state.complete_below)

    def prepare_complement(self, pencil: Pencil, values: Float[Array, " p"], k: int) -> Factorisation:
        """Factorise K − σM for each group of neighbouring eigenvalues."""
        return grid_complement.prepare(pencil, values, k, self.derivative_tolerance)

    def solve_complement(
        self,
        prepared: Factorisation,
        pencil: Pencil,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = (I − MΦΦᵀ) rhsᵢ with ΦᵀMxᵢ = 0; see `hks_jax.eigen.grid_complement`."""
        return grid_complement.solve(prepared, pencil, values, vectors, rhs, self.derivative_tolerance)

    def max_pairs(self, n_dof: int) -> int:
        """Return how many pairs leave room for a Lanczos basis."""
        return max((n_dof - 16 * self.block) // 4, 0)

    def plan(self, k: int, n_dof: int) -> Plan:
        """Return the sizes of the computation."""
        slices = max(round(k / (self.slice_size or _SLICE)), 1)
        size = math.ceil(1.06 * k / slices) + 2
        return Plan(k, self.block, size, max_slices=3 * slices + 12)

    def _slice(self, pencil: Pencil, plan: Plan, tolerance: float) -> State:
        dissection = jax.device_put(dissect(_grid(pencil)))
        state = _first_state(pencil, plan)
        while _unfinished(plan, state):
            factor, here, state = cut(pencil, dissection, plan, state)
            if here:
                state = _make_room(plan, state) if _crowded(plan, state) else state
                state = search(pencil, factor, plan, tolerance, state)
            self._report(f"{state.known} of {plan.wanted} eigenpairs, all below {float(state.complete_below):.6g}")
        return state

    def _report(self, text: str) -> None:
        if self.progress is not None:
            self.progress(text)


_first_state = jit_quickly(static_argnames="plan")(first_state)
_make_room = jit_quickly(static_argnames="plan")(make_room)
_unfinished = jit_quickly(static_argnames="plan")(unfinished)
_crowded = jit_quickly(static_argnames="plan")(crowded)


def _slice_traced(pencil: Pencil, plan: Plan, tolerance: float) -> State:
    dissection = dissect(_grid(pencil))

    def body(state: State) -> State:
        factor, here, state = cut(pencil, dissection, plan, state)
        state = jax.lax.cond(here & crowded(plan, state), partial(make_room, plan), lambda state: state, state)
        return jax.lax.cond(here, partial(search, pencil, factor, plan, tolerance), lambda state: state, state)

    return jax.lax.while_loop(partial(unfinished, plan), body, first_state(pencil, plan))


@jit_quickly(static_argnames="k")
def _lowest(
    values: Float[Array, " capacity"], vectors: Float[Array, "capacity n_dof"], k: int
) -> tuple[Float[Array, " k"], Float[Array, "k n_dof"]]:
    """Return the lowest known pairs; NaN where there are fewer than k."""
    order = jnp.argsort(values)[:k]
    values, vectors = values[order], vectors[order]
    found = jnp.isfinite(values)
    return jnp.where(found, values, jnp.nan), jnp.where(found[:, None], vectors, jnp.nan)


def _grid(pencil: Pencil) -> GridSpace:
    assert isinstance(pencil.space, GridSpace)
    return pencil.space
