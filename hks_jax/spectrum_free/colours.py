"""Colouring: how far apart sources must be, and to what degree the exponential must be expanded, for a tolerance."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import ive

from hks_jax.domain.static_array import StaticArray
from hks_jax.fem.colouring import axis_colours
from hks_jax.fem.space import GridSpace
from hks_jax.spectrum_free.spectrum_bounds import Bounds

_STEEPEST = 1.2
"""Where the decay of M⁻¹ is still far off: it would be at cosh α = 2."""


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
        error: per time a bound on the error, relative to the smaller of (4πt)^(−d/2) and the largest value a node can
            have.
    """

    spacing: tuple[int, ...]
    degree: int
    mass_degree: int
    columns: int
    top: float
    low: float
    reach: tuple[float, ...]
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
        found = np.unique(number[space.free])
        result[space.free] = np.searchsorted(found, number[space.free])
        return StaticArray(result)

    def n_vectors(self, space: GridSpace) -> int:
        """Count the colours."""
        return int(self.colours(space).value.max()) + 1


def coefficient_sizes(z: float) -> Float[np.ndarray, " n"]:
    """Return the moduli of the Chebyshev coefficients of exp(−z(1 + x)) down to 1e-25: e^(−z) Iₙ(z), doubled."""
    n = np.arange(int(math.sqrt(2 * z * 60) + 60) + 1)
    return np.where(n == 0, 1, 2) * ive(n, z)


def coefficient_tails(z: float) -> Float[np.ndarray, " n+1"]:
    """Return the sums of their moduli from each n on, and 0 at the end."""
    return np.append(np.cumsum(coefficient_sizes(z)[::-1])[::-1], 0)


def reach_bound(distance: Any, reach_time: Any, lumped: bool) -> Any:
    """Bound √(D_x D_y) times the kernel between nodes ``distance`` apart along an axis.

    Davies' method: with the weights exp(αi) along the axis, ‖exp(ψ) exp(−tA) exp(−ψ)‖ ≤ exp(t κ (cosh α − 1)), κ the
    reach, as only the symmetric part of the weighted K counts, in which couplings across the axis are multiplied by
    cosh α. So the kernel is at most exp(−αs + tκ (cosh α − 1)), least at sinh α = s/tκ: the Gauss kernel
    exp(−s²/2tκ) for s ≪ tκ, and what random walks do instead for s ≫ tκ.

    With a consistent mass M⁻¹ itself decays only like (2 − √3)^s, and α must stay below; this is then the bound for a
    constant metric.
    """
    s = np.asarray(distance, float)
    alpha = np.arcsinh(s / reach_time)
    if not lumped:
        alpha = np.minimum(alpha, _STEEPEST)
    bound = np.exp(-alpha * s + reach_time * (np.cosh(alpha) - 1))
    return bound if lumped else 3 / (2 - np.cosh(alpha)) * bound


def kernel_scale(time: float, limits: Bounds, dimension: int) -> float:
    """Return what errors are relative to: the flat kernel's diagonal, or 1/D where time is below the resolution."""
    return min((4 * math.pi * time) ** (-dimension / 2), 1 / float(limits.greatest_mass))


def error_bound(spacing: tuple[int, ...], degree: int, time: float, limits: Bounds, space: GridSpace) -> float:
    """Bound the error at one time, relative to `kernel_scale`.

    Two parts: the expansion's tail, and what other sources of the colour add. The latter is the kernel at their
    distance, and no more than the tail beyond as many terms as there are nodes between, for a polynomial of lower
    degree does not reach there (lumped mass).
    """
    lumped = float(limits.low) == 1
    tails = coefficient_tails(time * float(limits.top) / 2)
    beyond = float(tails[min(degree + 1, tails.size - 1)])
    d = space.dimension
    steps = [_steps(n, s, wraps) for n, s, wraps in zip(space.node_shape, spacing, space.periodic, strict=True)]
    decay = np.stack(
        np.meshgrid(
            *[
                reach_bound(np.arange(k) * s, time * float(kappa), lumped)
                for k, s, kappa in zip(steps, spacing, limits.reach, strict=True)
            ],
            indexing="ij",
        )
    ).min(axis=0)
    decay = decay + beyond
    copies = np.stack(np.meshgrid(*[np.where(np.arange(k) == 0, 1, 2) for k in steps], indexing="ij")).prod(axis=0)
    if lumped:
        away = np.stack(
            np.meshgrid(*[np.arange(k) * s for k, s in zip(steps, spacing, strict=True)], indexing="ij")
        ).max(axis=0)
        within = np.where(away <= degree, tails[np.minimum(away, tails.size - 1)], 0)
        decay = np.minimum(decay, within)
    decay[(0,) * d] = 0
    total = beyond / float(limits.low) + float(np.sum(copies * decay))
    return total / float(limits.least_mass) / kernel_scale(time, limits, d)


def mass_error(mass_degree: int, time: float, limits: Bounds, dimension: int) -> float:
    """Bound the error of taking P for M⁻¹, relative to `kernel_scale`, to first order in ε = max |1 − μ p(μ)|.

    With w = M^(−½)e_x, S = M^(−½)KM^(−½) and P = M^(−½)(1 − E)M^(−½), ‖E‖ ≤ ε, Duhamel's formula and an integration by
    parts where the solution is not smooth yet bound the error by 4.5 ε ‖w‖ ‖exp(−St/4)w‖, that is, by
    4.5 ε √((M⁻¹)ₓₓ HKS(t/2, x)). The entry of M⁻¹ is 3^(d/2)/D for a constant metric.
    """
    low = float(limits.low)
    if low == 1:
        return 0.0
    epsilon = 1 / math.cosh(mass_degree * math.acosh((1 + low) / (1 - low)))
    peak = 6 ** (dimension / 2) / (float(limits.least_mass) * kernel_scale(time, limits, dimension))
    return 4.5 * epsilon * math.sqrt(peak)


def _steps(n: int, spacing: int, wraps: bool) -> int:
    """Count the distances, zero among them, at which other sources are on an axis."""
    if wraps:
        return max(n // spacing, 1) // 2 + 1
    return -(-n // min(spacing, n))


def least_mass_degree(times: Float[np.ndarray, " m"], limits: Bounds, dimension: int, tolerance: float) -> int:
    """Return how many steps invert the mass to the tolerance at all times; 1 if it is lumped."""
    degree = 1
    while max(mass_error(degree, float(time), limits, dimension) for time in times) > tolerance:
        degree += 1
    return degree


def choose(
    times: Float[np.ndarray, " m"],
    limits: Bounds,
    space: GridSpace,
    tolerance: float,
    mass_degree: int,
    columns: int,
) -> Colouring:
    """Choose the least spacing and degree whose bound is below the tolerance at all times."""
    d, lumped = space.dimension, float(limits.low) == 1
    degree, spacing = 1, np.ones(d, int)
    of_mass = [mass_error(mass_degree, float(time), limits, d) for time in times]
    tolerance -= max(of_mass)
    for time in times:
        allowed = tolerance * kernel_scale(time, limits, d) * float(limits.least_mass) / 2
        tails = coefficient_tails(time * float(limits.top) / 2)
        # It counts once at every source that the expansion reaches: the node itself and its neighbours of one colour.
        here = int(np.argmax(tails <= 0.1 / 3**d * allowed * float(limits.low))) - 1
        degree = max(degree, here)
    for time in times:
        allowed = tolerance * kernel_scale(time, limits, d) * float(limits.least_mass) / 2
        while True:
            trial = tuple(
                _least_spacing(n, time * float(kappa), allowed, lumped)
                for n, kappa in zip(space.node_shape, limits.reach, strict=True)
            )
            if error_bound(trial, degree, time, limits, space) <= tolerance or all(
                s >= n for s, n in zip(trial, space.node_shape, strict=True)
            ):
                break
            allowed /= 2
        spacing = np.maximum(spacing, trial)
    chosen = tuple(int(min(s, n)) for s, n in zip(spacing, space.node_shape, strict=True))
    if lumped:
        # Or else no wider than the expansion reaches: then nothing comes from other sources.
        shortest = max(_least_degree(float(time), limits, space, tolerance) for time in times)
        apart = tuple(min(shortest + 1, n) for n in space.node_shape)
        if math.prod(apart) <= math.prod(chosen):
            chosen, degree = apart, shortest
    errors = tuple(
        error_bound(chosen, degree, float(time), limits, space) + more
        for time, more in zip(times, of_mass, strict=True)
    )
    return Colouring(
        chosen,
        degree,
        mass_degree,
        columns,
        float(limits.top),
        float(limits.low),
        tuple(float(kappa) * float(times.max()) for kappa in limits.reach),
        errors,
    )


def _least_degree(time: float, limits: Bounds, space: GridSpace, tolerance: float) -> int:
    allowed = tolerance * kernel_scale(time, limits, space.dimension) * float(limits.least_mass)
    tails = coefficient_tails(time * float(limits.top) / 2)
    return max(int(np.argmax(tails <= allowed)) - 1, 1)


def _least_spacing(n: int, reach_time: float, allowed: float, lumped: bool) -> int:
    distances = np.arange(1, n)
    near = np.flatnonzero(reach_bound(distances, reach_time, lumped) <= allowed)
    return int(distances[near[0]]) if near.size else n
