"""The settings of the colouring method: from a tolerance follow the sources' spacing and the polynomial's degree."""

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
"""The share of the steepest decay rate of M⁻¹ in `reach_bound`; a share near 1 gives the bound a large factor."""


@dataclass(frozen=True)
class Colouring:
    """The static settings of colouring in `hks_spectrum_free`, which `colouring` computes from a field and times.

    Point sources of one colour are ``spacing`` nodes apart along each axis, and processed together as one vector. On a
    periodic axis some sources are slightly farther apart, so that the distances add up to the length of the axis.

    Attributes:
        spacing: the distance between a colour's sources on each axis, in nodes; n or more for one source on n nodes.
        degree: the degree of the Chebyshev expansion in M⁻¹K.
        mass_degree: the degree of the polynomial approximation of M⁻¹; 1 for a lumped mass, which is inverted exactly.
        columns: the number of colours that are processed at once.
        top: the upper bound on the eigenvalues of M⁻¹K for which the expansion is made.
        low: the lower bound on the eigenvalues of D⁻¹M, where the diagonal matrix D holds the row sums of M.
        reach: `Bounds.reach` for each axis, times the longest time.
        across: `Bounds.across` for each axis.
        shape: the shape of the grid; on a longer axis, sources of one colour would interfere.
        longest: the longest time, up to which the degree suffices on [0, `top`].
        error: for each time, a bound on the signature's error, including rounding errors, relative to the smaller of
            (4πt)^(−d/2) and the largest possible value at a node. For a lumped mass the bound holds unless `top` is too
            small, which has the probability 10⁻⁶. For a consistent mass the bound is proven to first order in the error
            of the polynomial for M⁻¹, for t → 0 and for a constant metric. For varying metrics, measured errors were
            1.6 times smaller than the bound, or more.
    """

    spacing: tuple[int, ...]
    degree: int
    mass_degree: int
    columns: int
    top: float
    low: float
    reach: tuple[float, ...]
    across: tuple[float, ...]
    shape: tuple[int, ...]
    longest: float
    error: tuple[float, ...]

    def colours(self, space: GridSpace) -> StaticArray:
        """Return the colours of the free nodes as integers (*shape), with −1 at the other nodes."""
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
        """Return the number of colours."""
        return int(self.colours(space).value.max()) + 1


def reach_bound(distance: Any, reach_time: Any, low: float, across: float) -> Any:
    """Return a bound on √(D_x D_y) times the heat kernel of two nodes x, y at a given distance along an axis.

    The diagonal matrix D holds the row sums of M. Davies' method weights node i along the axis by exp(ψ) with ψ = αi.
    For A = D^(−½)KD^(−½) and the reach κ of `Bounds`, ‖exp(ψ) exp(−tA) exp(−ψ)‖ ≤ exp(t κ (cosh α − 1)): only the
    symmetric part of exp(ψ) K exp(−ψ) matters, in which couplings across the axis are multiplied by cosh α. At the
    distance s, the heat kernel is therefore at most exp(−αs + tκ (cosh α − 1)), which is least for sinh α = s/tκ. The
    least bound is close to the Gaussian kernel exp(−s²/2tκ) for s ≪ tκ, and to the decay of a random walk for s ≫ tκ.

    A consistent mass M has a nonlocal inverse. The symmetric part of exp(ψ) M exp(−ψ) is M + (cosh α − 1) C, where C
    holds the couplings of M across the axis and −C ⪯ βM, and so at least low (1 − β (cosh α − 1)) D. Entries of M⁻¹
    between nodes at the distance s are therefore at most exp(−αs) divided by low (1 − β (cosh α − 1)) D. The product of
    the bounds on exp(−tA) and M⁻¹ is a bound on the heat kernel for t → 0 and for a constant metric. For varying
    metrics at other times t, it is not a proven bound.
    """
    s = np.asarray(distance, float)
    alpha = np.arcsinh(s / reach_time)
    if across == 0:
        return np.exp(-alpha * s + reach_time * (np.cosh(alpha) - 1))
    alpha = np.minimum(alpha, _STEEPEST * math.acosh(1 + 1 / across))
    growth = np.cosh(alpha) - 1
    return np.exp(-alpha * s + reach_time * growth) / (low * (1 - across * growth))


def _unit(time: float, limits: Bounds, dimension: int) -> float:
    """Return the unit of errors, the smaller of (4πt)^(−d/2) and 1/(M's greatest row sum), times M's least row sum."""
    return limits.least_mass * min((4 * math.pi * time) ** (-dimension / 2), 1 / limits.greatest_mass)


def error_bound(spacing: tuple[int, ...], degree: int, time: float, limits: Bounds, space: GridSpace) -> float:
    """Return a bound on the error of the signature at one time, relative to the unit that `_unit` defines.

    At each node, the bound adds the tail of the Chebyshev expansion and the heat kernel between the node and each other
    source of its colour. For a lumped mass, the heat kernel between two nodes is at most the expansion's tail from the
    degree that equals their distance in nodes, because polynomials of lower degree do not couple the two nodes.
    """
    low, d = limits.low, space.dimension
    tails = coefficient_tails(time * limits.top / 2)
    beyond = float(tails[min(degree + 1, tails.size - 1)])
    # The distances in nodes, along each axis, between sources of one colour. All distances but 0 occur twice.
    of_axes = zip(space.node_shape, spacing, space.periodic, strict=True)
    steps = [np.arange(max(n // s, 1) // 2 + 1 if wraps else -(-n // s)) for n, s, wraps in of_axes]
    distances = [s * along for s, along in zip(spacing, steps, strict=True)]
    bounds = [
        reach_bound(along, reach_time, low, across)
        for along, reach_time, across in zip(distances, time * limits.reach, limits.across, strict=True)
    ]
    decay = reduce(np.minimum.outer, bounds) + beyond
    if low == 1:
        away = reduce(np.maximum.outer, distances)
        decay = np.minimum(decay, np.where(away <= degree, tails[np.minimum(away, tails.size - 1)], 0))
    decay[(0,) * d] = 0
    copies = reduce(np.multiply.outer, [np.where(along == 0, 1, 2) for along in steps])
    return float(beyond / low + np.sum(copies * decay)) / _unit(time, limits, d)


def mass_error(mass_degree: int, time: float, limits: Bounds, dimension: int) -> float:
    """Return a bound, to first order in ε, on the relative error due to the approximation P = p(D⁻¹M)D⁻¹ of M⁻¹.

    The polynomial p has the error ε = max |1 − μ p(μ)| over the eigenvalues μ of D⁻¹M. In P = M^(−½)(1 − E)M^(−½), the
    norm of the matrix E is at most ε. For a node x, with w = M^(−½)e_x and S = M^(−½)KM^(−½), Duhamel's formula and, at
    small times, integration by parts bound the error of the signature by 4.5 ε ‖w‖ ‖exp(−St/4)w‖ = 4.5 ε √((M⁻¹)ₓₓ
    HKS(t/2, x)). Since low is the least eigenvalue of D⁻¹M or less, (M⁻¹)ₓₓ and HKS(t/2, x) are at most 1/(low D). The
    returned bound is relative to the unit that `_unit` defines.
    """
    low = limits.low
    if low == 1:
        return 0.0
    epsilon = 1 / math.cosh(mass_degree * math.acosh((1 + low) / (1 - low)))
    return 4.5 * epsilon / (low * _unit(time, limits, dimension))


def rounding_error(time: float, limits: Bounds, dimension: int, eps: float) -> float:
    """Return an estimate of the rounding error of the signature, relative to the unit that `_unit` defines.

    The vectors of the Chebyshev recurrence have entries of up to 1/(low D), like M⁻¹, and their rounding gives the term
    1/low of the estimate. The rounding of the row sums D of M, and of the tensors in them, gives the term 4. Measured
    rounding errors did not grow with the degree of the expansion, and were 0.02 to 0.7 times the estimate in float32.
    """
    return eps * (4 + 1 / limits.low) / _unit(time, limits, dimension)


def choose(
    times: Float[np.ndarray, " m"],
    limits: Bounds,
    space: GridSpace,
    tolerance: float,
    mass_degree: int,
    columns: int,
    eps: float,
) -> Colouring:
    """Return the least spacing and degree whose error bound is below the tolerance at all times."""
    d, shape, low = space.dimension, space.node_shape, limits.low
    others = [mass_error(mass_degree, time, limits, d) + rounding_error(time, limits, d, eps) for time in times]
    tolerance -= max(others)

    def least(time: float, share: float) -> int:
        return least_degree(time * limits.top / 2, share * tolerance * _unit(time, limits, d))

    # The expansion's tail counts 3ᵈ times: for the node itself, and for the nearest sources of the same colour.
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
        # With a lumped mass, a spacing above the degree of the expansion excludes all contributions of other sources.
        shortest = max(least(time, 1.0) for time in times)
        apart = tuple(min(shortest + 1, n) for n in shape)
        if math.prod(apart) <= math.prod(spacing):
            spacing, degree = apart, shortest
    errors = [error_bound(spacing, degree, time, limits, space) for time in times]
    longest = float(times.max())
    reach, across, error = (tuple(x.tolist()) for x in (longest * limits.reach, limits.across, np.add(errors, others)))
    top = float(limits.top)
    return Colouring(spacing, degree, mass_degree, columns, top, float(low), reach, across, shape, longest, error)


def _least_spacing(n: int, reach_time: float, allowed: float, low: float, across: float) -> int:
    distances = np.arange(1, n)
    near = np.flatnonzero(reach_bound(distances, reach_time, low, across) <= allowed)
    return int(distances[near[0]]) if near.size else n
