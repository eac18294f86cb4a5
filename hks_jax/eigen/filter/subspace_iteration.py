"""Rounds of subspace iteration: a Chebyshev filter, followed by a Rayleigh–Ritz projection."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from hks_jax.arrays import Scalar
from hks_jax.compilation import jit_quickly
from hks_jax.eigen.filter import subspace
from hks_jax.eigen.filter.coarsening import interpolate
from hks_jax.eigen.filter.polynomial import Band, correction
from hks_jax.eigen.filter.subspace import EVERYWHERE
from hks_jax.eigen.quality import allowed_residuals
from hks_jax.eigen.weyl import weyl
from hks_jax.fem.halo import Slabs
from hks_jax.fem.nodal import NodalPencil, to_rows
from hks_jax.linear.accelerators import row_by_row
from hks_jax.linear.chebyshev import Columns
from hks_jax.linear.loops import for_each
from hks_jax.linear.products import aligned

_GAIN = 40.0
"""The factor by which one round damps unwanted modes. The error of the lumped mass would dominate a larger factor."""
_SPREAD = 1e5
"""The largest value at 0 of a filter polynomial that is at most 1 on the band; with a larger value, rounding
dominates."""
_LEAST_DEGREE = 4
_PASSES = 2
"""The number of filters between two Rayleigh–Ritz projections. With more, low modes would dominate the vectors."""
_SPARE_TOLERANCE = 0.1
"""The relative residual at which a vector beyond the wanted ones is accurate enough. The errors of these vectors enter
the convergence of the wanted ones as squares."""
_MARGIN = 1.1
"""The safety factor of Weyl's law for the eigenvalue of the last vector."""
_SPLIT, _APART = 0.05, 1.5
"""The Neumann series of the inverse mass gets more terms until the relative errors 1 − ψ(λ)/λ of eigenvalues λ near the
last wanted eigenvalue differ by at most ``_SPLIT``, and until ψ(λ) is at least ``_APART`` times the last wanted
eigenvalue for all λ above twice that eigenvalue. In measurements, a smaller ``_SPLIT`` cost more than it saved, because
the first term makes a filter 2.8 times as expensive."""
_MOST_TERMS = 15
"""The maximal number of terms, after the first, of the Neumann series of the inverse mass."""

Number = Int[Array, ""]
Values = Float[Array, " m"]
Rows = Float[Array, "m nodes"]
"""All vectors; each of several devices has a slab of them."""
OwnRows = Float[Array, "own nodes"]
"""The vectors that this device filters, on all nodes of the grid."""


class FilterPlan(NamedTuple):
    """The static settings of subspace iteration."""

    wanted: int  # the number of eigenpairs
    size: int  # the number of vectors, a multiple of `block`
    block: int  # the number of vectors filtered together
    n_null: int  # the number of zero eigenvalues
    tolerance: float  # the relative residual at which a pair counts as converged
    mesh: Mesh | None  # the devices that share the vectors; None for one device


class FilterState(NamedTuple):
    """The state of subspace iteration between two rounds."""

    values: Values  # Ritz values θ, ascending
    vectors: Float[Array, "m nodes"]  # M-orthonormal Ritz vectors; each of several devices has a slab of them
    residuals: Values  # ‖Kx − θMx‖/‖Mx‖
    lumped_values: Values  # xᵀKx / xᵀDx, where D is the lumped mass
    terms: Number  # the number of terms, after the first, of the Neumann series
    rounds: Number  # the number of rounds so far on this grid


class Filtering(NamedTuple):
    """The filter polynomials of a round of subspace iteration."""

    band: Band  # the damped interval
    terms: Number  # the number of terms, after the first, of the Neumann series
    degrees: Int[Array, " blocks"]  # the degree of each block's polynomial
    values: Values  # the value ψ of each vector, at which its polynomial is 1
    factor: Values  # the factor by which each vector's correction is scaled
    allowed: Values  # the residual up to which each vector counts as converged; blocks of such vectors are not filtered


class Block(NamedTuple):
    """Some vectors that are filtered together, with their entries of `Filtering`."""

    vectors: Columns
    values: Float[Array, " b"]
    factor: Float[Array, " b"]
    allowed: Float[Array, " b"]
    degree: Number


class GridFilter(eqx.Module):
    """Subspace iteration on one grid. All grids of one shape share the compiled functions."""

    pencil: NodalPencil  # K and M
    high: Scalar  # an upper bound of the spectrum of D⁻¹K, where D is the lumped mass
    plan: FilterPlan = eqx.field(static=True)

    @property
    def slabs(self) -> Slabs | None:
        """The parts of the grid on which several devices store vectors between two rounds; None on one device."""
        return self.pencil.cut(self.plan.mesh)

    @jit_quickly()
    def excess(self, rounding: Scalar, state: FilterState) -> Values:
        """Return the residuals as multiples of the largest residuals that count as converged."""
        return state.residuals / self._allowed(rounding, state.values)

    def _allowed(self, rounding: Scalar, values: Values) -> Values:
        scale = jnp.maximum(values, values[self.plan.n_null])
        allowed = allowed_residuals(scale, rounding, self.plan.tolerance)
        return jnp.where(self._spare, jnp.maximum(allowed, _SPARE_TOLERANCE * scale), allowed)

    @property
    def _spare(self) -> Bool[np.ndarray, " m"]:
        return np.arange(self.plan.size) >= self.plan.wanted

    def from_random(self, volume: Scalar) -> FilterState:
        """Return the state after filtering random functions."""
        return self._begin(self._random(volume))

    @jit_quickly()
    def _random(self, volume: Scalar) -> Rows:
        plan, shape, dtype = self.plan, self.pencil.shape, self.high.dtype
        low = jnp.minimum(1.3 * weyl(plan.size, volume, len(shape)).astype(dtype), self.high / 3)

        def run(grid: GridFilter, low: Scalar) -> Rows:
            pencil, band = grid.pencil, Band(low, grid.high)
            degree = jnp.ceil(band.degree_for(jnp.zeros_like(low), _SPREAD)).astype(int)

            def damped(key: Array) -> Float[Array, "b nodes"]:
                x = jnp.where(pencil.free[..., None], jax.random.normal(key, (*shape, plan.block), dtype), 0)
                image = pencil.stiffness @ x
                return to_rows(x + correction(pencil, band, image, jnp.full(plan.block, low), degree, x))

            numbers = subspace.own_blocks(grid.slabs, plan.size // plan.block)
            keys = jax.random.split(jax.random.key(0), plan.size // plan.block)[numbers]
            own = jax.lax.map(damped, keys).reshape(-1, pencil.free.size)
            return subspace.to_slabs(grid.slabs, plan.block, own)

        return subspace.shared(self.slabs, run, EVERYWHERE, _layout(self.slabs).vectors)(self, low)

    def from_rows(self, rows: Rows) -> FilterState:
        """Return the state in the span of functions on the whole grid."""
        return self._begin(self._dealt(rows))

    @jit_quickly()
    def _dealt(self, rows: Rows) -> Rows:
        plan, layout = self.plan, _layout(self.slabs)

        def run(grid: GridFilter, rows: Rows) -> Rows:
            numbers = subspace.own_blocks(grid.slabs, plan.size // plan.block)
            own = rows.reshape(-1, plan.block, rows.shape[1])[numbers].reshape(-1, rows.shape[1])
            return subspace.to_slabs(grid.slabs, plan.block, own)

        return subspace.shared(self.slabs, run, (EVERYWHERE, EVERYWHERE), layout.vectors)(self, rows)

    def from_coarse(self, coarse: "GridFilter", state: FilterState) -> FilterState:
        """Return the state interpolated from the next coarser grid."""
        return self._begin(self._interpolated(coarse, state.vectors))

    @jit_quickly()
    def _interpolated(self, coarse: "GridFilter", vectors: Float[Array, "m coarse_nodes"]) -> Rows:
        slabs, shape, block = coarse.slabs, coarse.pencil.shape, self.plan.block

        def run(grid: GridFilter, vectors: Float[Array, "m coarse_nodes"]) -> Rows:
            rows = subspace.to_own_rows(slabs, block, vectors)

            def of_block(number: Array) -> Float[Array, "b nodes"]:
                return to_rows(interpolate(grid.pencil, subspace.block_of(rows, number, block, shape)))

            own = jax.lax.map(of_block, jnp.arange(len(rows) // block)).reshape(len(rows), -1)
            return subspace.to_slabs(grid.slabs, block, own)

        layout = _layout(self.slabs).vectors
        return subspace.shared(self.slabs, run, (EVERYWHERE, layout), layout)(self, vectors)

    def improve_told(
        self, rounding: Scalar, state: FilterState, done: Callable[[int, int], Any] | None = None
    ) -> FilterState:
        """Filter the blocks of vectors that have not converged, `_PASSES` times, then apply Rayleigh–Ritz.

        Outside `jit` and on one device, the round can be interrupted between two blocks. After each block, ``done``
        receives the numbers of products with K in this round, so far and in total. `improve` is the compiled version.
        """
        slabs, plan, layout = self.slabs, self.plan, _layout(self.slabs)

        def run(grid: GridFilter, rounding: Scalar, state: FilterState) -> tuple[Rows, Number]:
            numbers = subspace.own_blocks(slabs, plan.size // plan.block)
            chosen = grid.choose(rounding, state)

            def step(turn: Array, rows: OwnRows) -> OwnRows:
                own = turn % numbers.size
                rows = grid.filter_block(chosen, numbers[own], own, rows)
                if done is not None:
                    jax.block_until_ready(rows)
                    products = jnp.tile(chosen.degrees, _PASSES)
                    done(int(products[: turn + 1].sum()), int(products.sum()))
                return rows

            own_rows = subspace.to_own_rows(slabs, plan.block, state.vectors)
            filtered = for_each(_PASSES * numbers.size, step, own_rows)
            return subspace.to_slabs(slabs, plan.block, filtered), chosen.terms

        ends = layout.vectors, EVERYWHERE
        vectors, terms = subspace.shared(slabs, run, (EVERYWHERE, EVERYWHERE, layout), ends)(self, rounding, state)
        return self.ritz(vectors, terms, state.rounds + 1)

    improve = jax.jit(improve_told, donate_argnames="state")

    @jit_quickly()
    def choose(self, rounding: Scalar, state: FilterState) -> Filtering:
        """Return the polynomials of a round: the band that they damp, the degree for each block, and further data."""
        plan = self.plan
        terms, filtered_values, factor = _lumping(plan, state)
        high = (1 + terms).astype(self.high.dtype) * self.high
        # Weyl's law limits the lower end of the band, because the vectors that are not wanted may be inaccurate.
        edge = _MARGIN * filtered_values[plan.wanted - 1] * (plan.size / plan.wanted) ** (2 / len(self.pencil.shape))
        low = jnp.minimum(jnp.minimum(jnp.max(filtered_values), edge), high / 2)
        band = Band(low, high)
        # For vectors beyond the wanted ones, the degree of the last wanted vector suffices.
        goal = jnp.where(self._spare, filtered_values[plan.wanted - 1], filtered_values)
        most = band.degree_for(jnp.zeros_like(low), _SPREAD)
        degrees = jnp.ceil(jnp.clip(band.degree_for(goal, _GAIN), _LEAST_DEGREE, jnp.maximum(most, _LEAST_DEGREE)))
        degrees = jnp.max(degrees.reshape(-1, plan.block), axis=1).astype(int)
        return Filtering(band, terms, degrees, filtered_values, factor, self._allowed(rounding, state.values))

    def filter_block(self, chosen: Filtering, number: Number, own: Number, vectors: OwnRows) -> OwnRows:
        """Filter the block of vectors with index ``number`` among all blocks and ``own`` among this device's blocks."""
        block = self._block(chosen, number, own, vectors)
        return self._plus(_change(self.pencil, chosen.band, chosen.terms, block), own, vectors)

    @jit_quickly()
    def _block(self, chosen: Filtering, number: Number, own: Number, vectors: OwnRows) -> Block:
        block = self.plan.block
        values, factor, allowed = (
            jax.lax.dynamic_slice_in_dim(of_all, number * block, block)
            for of_all in (chosen.values, chosen.factor, chosen.allowed)
        )
        x = subspace.block_of(vectors, own, block, self.pencil.shape)
        return Block(x, values, factor, allowed, chosen.degrees[number])

    @jit_quickly(donate_argnames="vectors")
    def _plus(self, change: Columns, own: Number, vectors: OwnRows) -> OwnRows:
        block = self.plan.block
        rows = row_by_row(jax.lax.dynamic_slice_in_dim(vectors, own * block, block)) + row_by_row(to_rows(change))
        return jax.lax.dynamic_update_slice_in_dim(vectors, rows, own * block, axis=0)

    @jit_quickly(donate_argnames="vectors")
    def ritz(self, vectors: Rows, terms: Number, rounds: Number) -> FilterState:
        """Return the state with the Ritz vectors of the subspace that the given vectors span."""
        slabs, block, layout = self.slabs, self.plan.block, _layout(self.slabs)

        def run(grid: GridFilter, vectors: Rows, terms: Number, rounds: Number) -> FilterState:
            own = grid.pencil.own(slabs)
            values, vectors = subspace.rayleigh_ritz(own, slabs, block, vectors)
            residuals, lumped_values = subspace.measured(own, slabs, block, values, vectors)
            return FilterState(values, vectors, residuals, lumped_values, terms, rounds)

        given = EVERYWHERE, layout.vectors, EVERYWHERE, EVERYWHERE
        return subspace.shared(slabs, run, given, layout)(self, vectors, terms, rounds)

    def _begin(self, vectors: Rows) -> FilterState:
        zero = jnp.zeros((), int)
        return self.ritz(vectors, zero, zero)


# The program is the same for every number of vectors, such as those of both problems of "mean".
@jax.jit
def _change(pencil: NodalPencil, band: Band, terms: Number, block: Block) -> Columns:
    """Return what the filter adds to the vectors of a block."""
    x, zeta, scale, allowed, degree = block

    def total(terms: Columns) -> Float[Array, " b"]:
        return jnp.sum(terms, tuple(range(terms.ndim - 1)))

    image, moved = pencil.products()(x)
    residual = image - aligned(total(x * image) / total(x * moved), x) * moved
    left = ~(total(residual**2) <= allowed**2 * total(moved**2))

    def filtered(image: Columns, residual: Columns) -> Columns:
        # If the quotient ζ of x is in the damped band, the residual is large, and the polynomial is applied to x.
        inside = aligned(zeta > band.low, x)
        of_residual = jnp.where(inside, image, residual).astype(jnp.float32)
        whole = jnp.where(inside, x, 0).astype(jnp.float32)
        z = correction(pencil, band, of_residual, zeta, degree, whole, terms)
        return jnp.where(inside, 1, aligned(jnp.clip(scale, 0, 1), x)) * z.astype(x.dtype)

    return jax.lax.cond(jnp.any(left), filtered, lambda *_: jnp.zeros_like(x), image, residual)


def _lumping(plan: FilterPlan, state: FilterState) -> tuple[Number, Values, Values]:
    """Return the fields ``terms``, ``values`` and ``factor`` of `Filtering`."""
    values, wanted = state.values, state.values[plan.wanted - 1]
    # The lumped mass decreases the eigenvalue of each mode by a relative amount, 1 − β. Rounding may violate 0 ≤ β ≤ 1.
    missing = jnp.clip(1 - jnp.where(values > 0, state.lumped_values / jnp.where(values > 0, values, 1), 1), 0, 1)
    powers = jnp.arange(1, _MOST_TERMS + 2, dtype=values.dtype)[:, None]
    lost = missing[None] ** powers
    near = (values >= wanted / 2) & (values <= 2 * wanted)
    spread = jnp.max(jnp.where(near, lost, 0), axis=1) - jnp.min(jnp.where(near, lost, jnp.inf), axis=1)
    beyond = jnp.min(jnp.where((values > 2 * wanted)[None], (1 - lost) * values[None], jnp.inf), axis=1)
    enough = (spread <= _SPLIT) & (beyond >= _APART * wanted)
    # The number of terms never decreases, because modes that more terms have damped would grow again with fewer terms.
    terms = jnp.maximum(state.terms, jnp.where(jnp.any(enough), jnp.argmax(enough), _MOST_TERMS))
    return terms, (1 - lost[terms]) * values, 1 - (terms + 1).astype(values.dtype) * lost[terms]


def _layout(slabs: Slabs | None) -> FilterState:
    vectors = EVERYWHERE if slabs is None else PartitionSpec(None, slabs.name)
    return FilterState(EVERYWHERE, vectors, EVERYWHERE, EVERYWHERE, EVERYWHERE, EVERYWHERE)  # type: ignore[arg-type]
