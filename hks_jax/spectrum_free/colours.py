"""Colouring: how far apart sources must be, and to what degree the exponential must be expanded, for a tolerance."""

import math
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.arrays import StaticArray
from hks_jax.fem.space import GridSpace, axis_colours
from hks_jax.linear.chebyshev import coefficient_tails, least_degree
from hks_jax.spectrum_free.spectrum_bounds import Bounds

_STEEPEST = 0.9
"""How much of the steepest decay of M⁻¹ is made use of: near all of it the bound has a large factor before it."""


@dataclass(frozen=True)
class Colouring:
    """How `hks_spectrum_free` probes: static, made by `colouring` from a field and times.

    Sources of one colour are ``spacing`` nodes apart along each axis (one or so more here and there, so that a
    periodic axis comes out even), and the exponential is expanded to ``degree``.

    Attributes:
        spacing: nodes between sources, per axis; n nodes or more stand for one source on the whole axis.
        degree: of the Chebyshev expansion in M⁻¹K.
        mass_degree: of the polynomial that stands for M⁻¹; 1 with a lumped mass, which is inverted exactly.
        columns: how many colours are worked on at once.
        top: the bound on the eigenvalues that the expansion is for.
        low: the bound from below on those of D⁻¹M, D the row sums.
        reach: per axis what `Bounds.reach` was, times the longest time.
        across: per axis what `Bounds.across` was.
        error: per time what the error stays below, relative to the smaller of (4πt)^(−d/2) and the largest value a
            node can have, rounding included. With a lumped mass a bound (but for a probability of 10⁻⁶ that `top` is
            too small). With a consistent mass it is proven to first order in the polynomial for M⁻¹, as t → 0 and for a
            constant metric; for varying ones it was never exceeded, and fifty times too large or more.
    """

    spacing: tuple[int, ...]
    degree: int
    mass_degree: int
    columns: int
    top: float
    low: float
    reach: tuple[float, ...]
    across: tuple[float, ...]
    error: tuple[float, ...]

    def colours(self, space: GridSpace) -> StaticArray:
        """Number the colours of the free nodes, int (*shape); −1 at the others."""
        axes = [
            axis_colours(n, s, wraps)
            for n, s, wraps in zip(space.node_shape, self.spacing, space.periodic, strict=True)
        ]
        counts = [int(axis.max()) + 1 for axis in axes]
        number = np.asarray(np.ravel_multi_index(np.meshgrid(*axes, indexing="ij"), counts))
        result = np.full(space.node_shape, -1, np.int32)
        used = np.unique(number[space.free])
        result[space.free] = np.searchsorted(used, number[space.free])
        return StaticArray(result)

    def n_vectors(self, space: GridSpace) -> int:
        """Count the colours."""
        return int(self.colours(space).value.max()) + 1


def reach_bound(distance: Any, reach_time: Any, low: float, across: float) -> Any:
    """Bound √(D_x D_y) times the kernel between nodes ``distance`` apart along an axis.

    Davies' method: with the weights exp(αi) along the axis, ‖exp(ψ) exp(−tA) exp(−ψ)‖ ≤ exp(t κ (cosh α − 1)), κ the
    reach, as only the symmetric part of the weighted K counts, in which couplings across the axis are multiplied by
    cosh α. So the kernel is at most exp(−αs + tκ (cosh α − 1)), least at sinh α = s/tκ: the Gauss kernel
    exp(−s²/2tκ) for s ≪ tκ, and what random walks do instead for s ≫ tκ.

    A consistent mass has an inverse that is not local. The symmetric part of the weighted M is M + (cosh α − 1) C, C
    its couplings across the axis, and −C ⪯ βM: it is at least low (1 − β (cosh α − 1)) D, and the inverse decays like
    exp(−αs) over that. This factor times the one above is a bound as t → 0, and for a constant metric; in between it
    is not proven for metrics that vary from node to node.
    """
    s = np.asarray(distance, float)
    alpha = np.arcsinh(s / reach_time)
    if across == 0:
        return np.exp(-alpha * s + reach_time * (np.cosh(alpha) - 1))
    alpha = np.minimum(alpha, _STEEPEST * math.acosh(1 + 1 / across))
    growth = np.cosh(alpha) - 1
    return np.exp(-alpha * s + reach_time * growth) / (low * (1 - across * growth))


def _unit(time: float, limits: Bounds, dimension: int) -> float:
    """Return the unit of errors, times the least entry of D.

    The unit is the flat kernel's diagonal, or the largest 1/D where time is below the resolution.
    """
    return limits.least_mass * min((4 * math.pi * time) ** (-dimension / 2), 1 / limits.greatest_mass)


def error_bound(spacing: tuple[int, ...], degree: int, time: float, limits: Bounds, space: GridSpace) -> float:
    """Bound the error at one time, relative to the unit of errors.

    Two parts: the expansion's tail, and what other sources of the colour add. The latter is the kernel at their
    distance, and no more than the tail beyond as many terms as there are nodes between, for a polynomial of lower
    degree does not reach there (lumped mass).
    """
    low, d = limits.low, space.dimension
    tails = coefficient_tails(time * limits.top / 2)
    beyond = float(tails[min(degree + 1, tails.size - 1)])
    # The sources of one colour, by how many spacings they are away along each axis; all but the first are there twice.
    steps = [np.arange(_steps(*of_axis)) for of_axis in zip(space.node_shape, spacing, space.periodic, strict=True)]
    distances = [s * along for s, along in zip(spacing, steps, strict=True)]
    of_axes = zip(distances, time * limits.reach, limits.across, strict=True)
    bounds = [reach_bound(along, reach_time, low, across) for along, reach_time, across in of_axes]
    decay = reduce(np.minimum.outer, bounds) + beyond
    if low == 1:
        away = reduce(np.maximum.outer, distances)
        decay = np.minimum(decay, np.where(away <= degree, tails[np.minimum(away, tails.size - 1)], 0))
    decay[(0,) * d] = 0
    copies = reduce(np.multiply.outer, [np.where(along == 0, 1, 2) for along in steps])
    return float(beyond / low + np.sum(copies * decay)) / _unit(time, limits, d)


def mass_error(mass_degree: int, time: float, limits: Bounds, dimension: int) -> float:
    """Bound the error of taking P for M⁻¹, relative to the unit of errors, to first order in ε = max |1 − μ p(μ)|.

    With w = M^(−½)e_x, S = M^(−½)KM^(−½) and P = M^(−½)(1 − E)M^(−½), ‖E‖ ≤ ε, Duhamel's formula and an integration by
    parts where the solution is not smooth yet bound the error by 4.5 ε ‖w‖ ‖exp(−St/4)w‖, that is, by
    4.5 ε √((M⁻¹)ₓₓ HKS(t/2, x)). Neither of these is more than 1/(low D).
    """
    low = limits.low
    if low == 1:
        return 0.0
    epsilon = 1 / math.cosh(mass_degree * math.acosh((1 + low) / (1 - low)))
    return 4.5 * epsilon / (low * _unit(time, limits, dimension))


def rounding_error(time: float, limits: Bounds, dimension: int, eps: float) -> float:
    """Return what rounding leaves of the signature, relative to the unit of errors.

    The vectors of the recurrence are as large as M⁻¹ at their source, up to 1/(low D), and D itself is rounded; what
    rounding leaves of them does not grow with the degree as far as measured, and was 0.05 to 0.7 of this in float32.
    """
    return eps * (1 + 1 / limits.low) / _unit(time, limits, dimension)


def _steps(n: int, spacing: int, wraps: bool) -> int:
    """Count the distances, zero among them, at which other sources are on an axis."""
    if wraps:
        return max(n // spacing, 1) // 2 + 1
    return -(-n // min(spacing, n))


def least_mass_degree(times: Float[np.ndarray, " m"], limits: Bounds, dimension: int, tolerance: float) -> int:
    """Return how many steps invert the mass to the tolerance at all times; 1 if it is lumped."""
    degree = 1
    while max(mass_error(degree, time, limits, dimension) for time in times) > tolerance:
        degree += 1
    return degree


def choose(
    times: Float[np.ndarray, " m"],
    limits: Bounds,
    space: GridSpace,
    tolerance: float,
    mass_degree: int,
    columns: int,
    eps: float,
) -> Colouring:
    """Choose the least spacing and degree whose bound is below the tolerance at all times."""
    d, shape, low = space.dimension, space.node_shape, limits.low
    others = [mass_error(mass_degree, time, limits, d) + rounding_error(time, limits, d, eps) for time in times]
    tolerance -= max(others)

    def least(time: float, share: float) -> int:
        return least_degree(time * limits.top / 2, share * tolerance * _unit(time, limits, d))

    # It counts once at every source that the expansion reaches: the node itself and its neighbours of one colour.
    degree = max(1, *(least(time, 0.05 * low / 3**d) for time in times))
    spacing = (1,) * d
    for time in times:
        allowed = tolerance * _unit(time, limits, d) / 2
        while True:
            of_axes = zip(shape, time * limits.reach, limits.across, strict=True)
            trial = tuple(_least_spacing(n, reach_time, allowed, low, across) for n, reach_time, across in of_axes)
            if trial == shape or error_bound(trial, degree, time, limits, space) <= tolerance:
                break
            allowed /= 2
        spacing = tuple(map(max, spacing, trial))
    if low == 1:
        # Or else no wider than the expansion reaches: then nothing comes from other sources.
        shortest = max(least(time, 1.0) for time in times)
        apart = tuple(min(shortest + 1, n) for n in shape)
        if math.prod(apart) <= math.prod(spacing):
            spacing, degree = apart, shortest
    errors = [error_bound(spacing, degree, time, limits, space) for time in times]
    reach, across, error = (
        tuple(x.tolist()) for x in (times.max() * limits.reach, limits.across, np.add(errors, others))
    )
    return Colouring(spacing, degree, mass_degree, columns, float(limits.top), float(low), reach, across, error)


def _least_spacing(n: int, reach_time: float, allowed: float, low: float, across: float) -> int:
    distances = np.arange(1, n)
    near = np.flatnonzero(reach_bound(distances, reach_time, low, across) <= allowed)
    return int(distances[near[0]]) if near.size else n
