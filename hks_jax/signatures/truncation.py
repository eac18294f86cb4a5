"""Truncation and discretisation errors of heat kernel signatures at each time and each node."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.scipy.special import erfc
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import describe_array, nan_is_meant
from hks_jax.compilation import jit_quickly, library_of, numpy_where_known
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.resolution import Resolution
from hks_jax.fem.space import mask_for
from hks_jax.linear.divided_differences import gauss
from hks_jax.linear.loops import for_each
from hks_jax.signatures.filters import Derivative, Heat
from hks_jax.signatures.spectral_functions import spectral_diagonal
from hks_jax.signatures.times import dimension_of, times_of
from hks_jax.traced import is_traced

TAIL_LIMIT = 0.01
BIAS_LIMIT = 0.1
_MANY = 1 << 22
"""The largest total number of nodal values for which NumPy takes less time than one compilation."""


class Truncation(eqx.Module):
    """Estimated errors of heat kernel signatures at given times; derivatives treat the estimates as constants.

    Attributes:
        times: (n,).
        tail: (n,) the share of the heat trace that the k computed pairs lack, by Weyl's law. The share is a mean over
            the domain; the share that is missing at single nodes can be larger (`truncation_map`).
        resolution_bias: (n,) the relative discretisation error at the median node.
        lasting_bias: (n,) the part of `resolution_bias` that does not decrease with t: the error where eigenvectors or
            eigenvalues of the tensors vary between nodes.
        coarse_fraction: (n,) the fraction of nodes where the discretisation error exceeds 10 %.
        smallest_time: the least time at which `tail` is at most 1 %. The worst node may lack ten times as much, and
            most of its signature beside a Dirichlet side (`truncation_map`).
        smallest_resolved: about the least time at which `resolution_bias`, without its lasting part, is at most 10 %.
        order: the part of the discretisation error that decreases with t is proportional to t^(−order).
    """

    times: Float[Array, " n"]
    tail: Float[Array, " n"]
    resolution_bias: Float[Array, " n"]
    lasting_bias: Float[Array, " n"]
    coarse_fraction: Float[Array, " n"]
    smallest_time: Float[Array, ""]
    smallest_resolved: Float[Array, ""]
    order: int = eqx.field(static=True, default=1, kw_only=True)

    def __repr__(self) -> str:
        if is_traced(self) or not isinstance(self.tail, jax.Array | np.ndarray):
            return f"Truncation(times={describe_array(self.times)})"
        names = ("tail", "resolution_bias", "smallest_time")
        worst = (f"{name} ≤ {np.max(np.asarray(getattr(self, name))):.4g}" for name in names)
        return f"Truncation(times={describe_array(self.times)}, {', '.join(worst)})"

    def messages(self) -> list[str]:
        """Return a sentence for each kind of unresolved time. Values must be concrete."""
        times, messages = np.asarray(self.times), []
        smallest = f"t = {times.min():.4g}"
        tail, bias = np.asarray(self.tail), np.asarray(self.resolution_bias)
        if (tail > TAIL_LIMIT).any():
            messages.append(
                f"{int((tail > TAIL_LIMIT).sum())} of {times.size} times are too small for k: on average over the "
                f"domain, an estimated {tail.max():.1%} of the signature at {smallest} lies beyond the computed "
                "eigenpairs (single nodes may lack several times as much, see hks_jax.truncation_map). Use times of "
                f"at least about {float(self.smallest_time):.4g}, or more eigenpairs"
            )
        lasting = np.asarray(self.lasting_bias)
        early = (bias > BIAS_LIMIT) & (lasting <= BIAS_LIMIT)
        if early.any():
            at = np.argmax(np.where(early, bias, 0))
            first = times[at]
            # The bias is x/(1 + x), where x² is about (a/t)^(2·order) + c² (see `_resolution_bias`).
            c, limit = _odds(lasting[at]), _odds(BIAS_LIMIT)
            least = float(self.smallest_resolved) * (1 / max(1 - (c / limit) ** 2, 1e-4)) ** (0.5 / self.order)
            messages.append(
                f"{int(early.sum())} of {times.size} times are too small for the grid: the discretisation biases the "
                f"signature at t = {first:.4g} by about {bias[at]:.1%} at half of the nodes. Use times of at least "
                f"about {least:.4g}, or a finer grid"
            )
        if (lasting > BIAS_LIMIT).any():
            messages.append(
                "the tensors vary too much from node to node, or, between Dirichlet sides, few modes remain: the "
                "discretisation biases the signature at "
                f"{int((lasting > BIAS_LIMIT).sum())} of {times.size} times by about {lasting.max():.1%}, which larger "
                'times do not reduce. Use a finer grid; interpolation="log-euclidean" at least preserves the volume'
            )
        return messages


@nan_is_meant
def truncation(pairs: Eigenpairs, times: Sequence[float] | Real[ArrayLike, " n"]) -> Truncation:
    """Estimate the truncation error of k pairs and the discretisation error of the signature at each time.

    By Weyl's law, k (λ/Λ)^(d/2) eigenvalues are below λ, where Λ is the first eigenvalue beyond the k pairs. The law
    gives the share of the heat trace from eigenvalues above Λ; `truncation_map` estimates this share at each node.

    The discretisation error has a part that decreases with t and a part that does not. For node spacing h, the
    decreasing part of the error is d h²/48t if the metric is constant and diagonal in the grid's axes, and larger
    otherwise; between Dirichlet sides it grows at large t. The lasting part of the error arises where the tensors vary
    between nodes: the elements overestimate eigenvalues, and interpolation changes the volume element. docs/accuracy.md
    compares estimates with errors on random fields: most errors are 1/4 to 1.9 times the estimate, but no estimate is a
    bound. On meshes only the decreasing part of the error is estimated.

    With a potential or an unknown null space, the exponent of Weyl's law is estimated from the mean of the eigenvalues,
    if this gives more than d/2, and the discretisation error is NaN. The error is also NaN for unknown node spacing.

    Raises:
        ValueError: if times are not positive and finite, or the dimension is not known.

    Examples:
        >>> print(hj.truncation(pairs, [0.02, 0.2]).tail < 0.01)  # whether 12 pairs are enough
        [False  True]
    """
    pairs, at = jax.lax.stop_gradient((pairs, times_of(pairs, times)))
    tail, smallest_time, moments = _of_spectrum(pairs, at)
    resolution = pairs.pencil.resolution if pairs.null_space_known else None
    if resolution is None:
        unknown = jnp.full_like(at, jnp.nan)
        return Truncation(at, tail, unknown, unknown, unknown, smallest_time, unknown[0])
    free = mask_for((at, pairs.eigenvalues), pairs.space.free)
    bias, lasting, coarse, resolved = _of_nodes(resolution, free, at, moments, pairs.space.dimension)
    return Truncation(at, tail, bias, lasting, coarse, smallest_time, resolved, order=resolution.order)


def truncated_share(pairs: Eigenpairs, times: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Return `tail` and `smallest_time` of `truncation`, which do not depend on the nodes and take less time."""
    tail, smallest_time, _ = _of_spectrum(*jax.lax.stop_gradient((pairs, times)))
    return tail, smallest_time


def _of_spectrum(pairs: Eigenpairs, at: Float[Array, " n"]) -> tuple[Any, ...]:
    dimension = dimension_of(pairs, "an estimate of the truncation")
    known = pairs.eigenvalues, pairs.kept, pairs.next_eigenvalue, pairs.spectral_origin
    return _of_eigenvalues(*known, at, dimension, pairs.null_space_known)


@numpy_where_known(static_argnums=(5, 6))
def _of_eigenvalues(
    values: Any, kept: Any, next_eigenvalue: Any, bottom: Any, at: Any, dimension: int, by_weyl: bool
) -> tuple[Any, ...]:
    """Return `tail`, `smallest_time` and, if the spectrum follows Weyl's law, the moments for `_resolution_bias`."""
    xp = library_of(values)
    # Weyl's law counts from the bottom of the spectrum, which a potential shifts.
    values, next_eigenvalue = values - bottom, next_eigenvalue - bottom
    complete = xp.isinf(next_eigenvalue)
    following = xp.where(complete, 1, next_eigenvalue)
    count = xp.sum(kept, dtype=at.dtype)
    last = xp.max(xp.where(kept, values, 0))
    if by_weyl:
        left, least = beyond_by_weyl(count, dimension, following * at), resolving(TAIL_LIMIT, dimension)
    else:
        following = (following + last) / 2  # because there may be few eigenvalues, as in `truncation_map`
        mean = xp.sum(xp.where(kept, values, 0)) / (count * following)
        exponent = xp.maximum(_exponent(mean), dimension / 2)
        left = xp.asarray(beyond(*map(jnp.asarray, (count, exponent, following * at))))
        least = xp.interp(exponent, *(xp.asarray(x, at.dtype) for x in (_EXPONENTS, _RESOLVING)))
    exponents = at[:, None] * values[None]
    terms = xp.where(kept[None], xp.exp(-exponents), 0)
    tail = xp.where(complete, 0, left / (left + xp.sum(terms, axis=1)))
    smallest = xp.where(complete, 0, least / following)
    if not by_weyl:
        return tail, smallest, None
    end = xp.maximum(xp.where(complete, last, next_eigenvalue), xp.finfo(at.dtype).tiny)
    return tail, smallest, _moments(exponents, terms, count, end * at, dimension)


@numpy_where_known(most=_MANY, static_argnums=4)
def _of_nodes(resolution: Resolution, free: Any, at: Any, moments: list[Any], dimension: int) -> tuple[Any, ...]:
    """Return `resolution_bias`, `lasting_bias`, `coarse_fraction` and `smallest_resolved` of `Truncation`."""
    xp = library_of(at)
    nodal: tuple[Any, ...] = (resolution.dispersion, resolution.of_eigenvalues, resolution.turning)
    if xp is np:  # The sizes of a compiled program cannot depend on the mask.
        nodal, free = tuple(x[free] for x in nodal), free[free]
    else:
        nodal, free = tuple(xp.where(free, x, 0).ravel() for x in nodal), free.ravel()
    bias, lasting = _resolution_bias(resolution, nodal, free, at, moments, dimension)
    coarse = xp.sum(bias > BIAS_LIMIT, axis=1, dtype=at.dtype) / xp.sum(free, dtype=at.dtype)
    # At small t, the part x/(1 + x) that decreases has x = |dispersion/t|^order.
    dispersion = xp.abs(nodal[0])
    largest = xp.max(dispersion)
    typical = largest * median_of_shares(dispersion[None] / xp.where(largest > 0, largest, 1), free)[0]
    resolved = typical * _odds(BIAS_LIMIT) ** (-1 / resolution.order)
    medians = (median_of_shares(each, free) for each in (bias, lasting))
    return *medians, coarse, resolved


# The heat trace of a continuous metric is Z(t) = Σ e^(−λt), to which the eigenvalues beyond the pairs contribute as in
# `beyond`. For the exponent a = d/2 of Weyl's law, the moments Σ (λt)ʲ e^(−λt)/Z are a (a + 1) … (a + j − 1) at small
# t. With x = Λt, the integrals Sⱼ of y^(a+j−1) e^(−y) over y > x, times N(Λ) a x^(−a), satisfy the recurrence
# Sⱼ₊₁ = (a + j) Sⱼ + N(Λ) a xʲ e^(−x), by parts.
def _moments(exponents: Any, terms: Any, count: Any, x: Any, dimension: int) -> list[Any]:
    """Return three moments of λt in the heat trace, each relative to its value at small t."""
    xp = library_of(exponents)
    a = dimension / 2
    x = xp.maximum(x, 1e-3)  # prevents overflow
    left = beyond_by_weyl(count, dimension, x)
    trace = xp.sum(terms, axis=1) + left
    moments, scale = [], 1.0
    for j in range(3):
        left = (a + j) * left + count * a * x**j * xp.exp(-x)
        terms, scale = terms * exponents, scale * (a + j)
        moments.append((xp.sum(terms, axis=1) + left) / (scale * trace))
    return moments


# If all eigenvalues grow by the factor 1 + δ, the heat trace Z(t) becomes Z((1 + δ)t). The relative change of Z is
# −δ Σ λt e^(−λt)/Z, which is proportional to δ and to the first moment m₁ of `_moments`. The moment is 1 at small t and
# 0 at times at which only the constant function contributes; if no constant function contributes, it grows like t. If
# δ is proportional to λ, the relative change of Z is proportional to the second moment m₂.
#
# If the volume grows by the factor 1 + v, the metric grows by the factor (1 + v)^(2/d). The signature is divided by
# 1 + v and the eigenvalues by (1 + v)^(2/d), with a relative error of size v(1 − m₁).
#
# An uneven error v of the volume element is a sum of waves exp(iξ·x). By Duhamel's formula (in
# hks_jax/inverse/conformal.py for the plane), a flat metric that is multiplied by 1 + 2v/d has an HKS with the
# relative change cv, where
#
#     c = (2/d)(d − 1) a(t|ξ|²),    a(x) = ∫₀¹ (1 + x (1 − s)²) exp(−x s (1 − s)) ds − 1 ≤ a(5.54) = 0.32.
def _resolution_bias(
    resolution: Resolution, nodal: tuple[Any, ...], free: Any, times: Any, moments: list[Any], d: int
) -> tuple[Any, Any]:
    """Return the estimated relative discretisation error (times, nodes), and its part that does not decrease with t.

    The arrays of ``nodal`` are the dispersion, the part of the eigenvalues and the turning (nodes,), 0 at fixed nodes.
    """
    xp = library_of(times)
    first, second, third = (each[:, None] for each in moments)
    order, t = resolution.order, times[:, None]
    dispersion, of_eigenvalues, turning = (x[None] for x in nodal)
    uneven = _LARGEST_CHANGE * (2 / d) * (d - 1) * xp.maximum(first, 1) * resolution.unevenness
    # Moments below 1 are those of the computed eigenvalues, which may be much too large on a coarse grid.
    decreasing = xp.maximum(first if order == 1 else third, 1) * (dispersion / t) ** order
    of_spacing = xp.hypot(decreasing, xp.abs(second - first) * of_eigenvalues / t)
    # Between Dirichlet sides few eigenvalues remain at large t, where their relative errors, times t, grow.
    grows = second > 2
    lasting = first * turning + xp.abs(1 - first) * resolution.swelling + uneven + xp.where(grows, of_spacing, 0)
    lasting = xp.where(free[None], lasting, 0)
    both = xp.hypot(xp.where(grows, 0, of_spacing), lasting)
    # The signature of the discretised domain stays bounded as t tends to 0, so its relative error tends to 1.
    return both / (1 + both), lasting / (1 + lasting)


_LARGEST_CHANGE = 0.32


def _odds(share: Any) -> Any:
    """Return x for the share x/(1 + x)."""
    return share / (1 - share)


def median_of_shares(x: Any, free: Any) -> Any:
    """Return the median over the free nodes of each row of x (n, nodes), whose entries are in [0, 1], and 0 elsewhere.

    The accuracy is 1e-12. The median of a row with a NaN is NaN. In JAX, bisection is ten times as fast as sorting.
    """
    xp = library_of(x)
    if xp is np:
        known = x[:, free.ravel()]
        middle = (known.shape[1] - 1) // 2
        return np.where(np.isnan(known).any(axis=1), np.nan, np.partition(known, middle, axis=1)[:, middle])
    twice_half = 2 * free.size - xp.sum(free)

    def halve(_: Any, ends: tuple[Any, Any]) -> tuple[Any, Any]:
        low, high = ends
        middle = (low + high) / 2
        enough = 2 * xp.sum(x <= middle[:, None], axis=1) >= twice_half
        return xp.where(enough, low, middle), xp.where(enough, middle, high)

    _, median = for_each(40, halve, (xp.zeros(len(x), x.dtype), xp.ones(len(x), x.dtype)))
    return xp.where(xp.any(xp.isnan(x), axis=1), xp.nan, median)


def resolved_times(pairs: Eigenpairs, times: Any, factor: int = 1) -> Float[Array, " n"]:
    """Return times as `times_of` does; warn if the pairs or the node spacing do not resolve some of the times.

    The factor is 2 if the caller computes exp(−2λt). No warning is issued if values are traced, or if the
    dimension of the manifold is not known.
    """
    times = times_of(pairs, times)
    known, at = jax.lax.stop_gradient((pairs, times))
    if not is_traced((known.eigenvalues, known.pencil, at)) and pairs.space.dimension is not None:
        estimate = truncation(known, factor * at)
        of_caller = dataclasses.replace(
            estimate,
            times=at,
            smallest_time=estimate.smallest_time / factor,
            smallest_resolved=estimate.smallest_resolved / factor,
        )
        for message in of_caller.messages():
            warn_of_accuracy(message)
    return times


# By Weyl's law N(λ) = N(Λ) ((λ − b)/(Λ − b))^a, with the bottom b of the spectrum and a = d/2, which is less than 2.
# With u = s^(2−a) for s = (Λ − b)/(λ − b), the eigenvalues above Λ contribute
#
#     ∫_Λ^∞ λ^(−2) dN = N(Λ) a/(2 − a) ∫_c^1 (Λ − b + b u^(1/(2−a)))^(−2) du,
#
# where c is 0 for infinitely many eigenvalues. The n eigenvalues of a grid end at s = (N(Λ)/n)^(1/a).
def share_of_inverse_squares(pairs: Eigenpairs) -> float:
    """Return the share of Σ λᵢ^(−2) over all positive eigenvalues that the k pairs lack, by Weyl's law.

    Values must be concrete, and the dimension known.
    """
    a = dimension_of(pairs, "an estimate of the truncation") / 2
    following, bottom = float(pairs.next_eigenvalue), float(pairs.spectral_origin)
    if math.isinf(following):
        return 0.0
    kept = np.asarray(pairs.eigenvalues, np.float64)[np.asarray(pairs.kept)]
    first = (kept.size / pairs.n_unknowns) ** ((2 - a) / a)
    nodes, weights = np.array(gauss(_NODES))
    u = first + (1 - first) * nodes
    integral = (1 - first) * np.sum(weights / (following - bottom + bottom * u ** (1 / (2 - a))) ** 2)
    left = kept.size * a / (2 - a) * integral
    return float(left / (left + np.sum(kept[kept > 0] ** -2.0)))


_NODES = 8
"""The number of quadrature points of `share_of_inverse_squares`."""
_EXPONENTS = np.geomspace(0.5, 8, 33)
"""Exponents from ½ (a thin strip, whose lowest modes vary along one axis) to 8 (a 3D corner of Dirichlet sides)."""
_RESOLVING = scipy.special.gammainccinv(_EXPONENTS, TAIL_LIMIT)
"""The least Λt at which at most `TAIL_LIMIT` of the heat trace lies beyond Λ, for each of `_EXPONENTS`."""
_POINTS, _WEIGHTS = np.polynomial.laguerre.laggauss(24)
"""The points and weights of Gauss–Laguerre quadrature, for integrals of f(u) e^(−u) from 0 to ∞."""


# Let N(λ) = N(Λ) (λ/Λ)^a be the number of eigenvalues below λ. The eigenvalues above Λ contribute to the heat trace
#
#     ∫_Λ^∞ e^(−λt) dN = N(Λ) a (Λt)^(−a) ∫_Λt^∞ e^(−y) y^(a−1) dy = N(Λ) (a/x) e^(−x) ∫_0^∞ (1 + u/x)^(a−1) e^(−u) du
#
# with x = Λt, y = λt and u = y − x. The code computes the integral over u by quadrature. JAX's incomplete gamma
# function, which is the integral over y, takes ten times as long to compile and thirty times as long to run.
def beyond(count: Float[Array, "..."], exponent: Float[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the heat trace ∫ e^(−λt) dN of eigenvalues λ > Λ, where N(λ) is count · (λ/Λ)^exponent and x is Λt.

    The accuracy for exponents from ½ to 8 is 1e-3 for x ≥ 0.1 and 1e-7 for x ≥ 1. An x below 1e-3 is replaced by 1e-3.
    """
    x = jnp.maximum(x, 1e-3)  # prevents overflow
    count, exponent = (jnp.expand_dims(each, tuple(range(x.ndim - each.ndim))) for each in (count, exponent))

    def add(total: Array, node: tuple[Array, ...]) -> tuple[Array, None]:
        point, weight = node
        return total + weight * jnp.exp((exponent - 1) * jnp.log1p(point / x)), None

    nodes = tuple(jnp.asarray(each, x.dtype) for each in (_POINTS, _WEIGHTS))
    integral, _ = jax.lax.scan(add, jnp.zeros(jnp.broadcast_shapes(x.shape, exponent.shape), x.dtype), nodes)
    return count * exponent / x * jnp.exp(-x) * integral


# The integral over u in `beyond` is 1 for a = 1 and, by parts, 1 + (√π/2) erfc(√x) e^x/√x for a = 3/2.
def beyond_by_weyl(count: Any, dimension: int, x: Any) -> Any:
    """Return `beyond` for Weyl's exponent d/2, where d is 2 or 3."""
    xp = library_of(x)
    if dimension == 2:
        return count * xp.exp(-x) / x
    complement = erfc if xp is jnp else scipy.special.erfc
    return 1.5 * count * (xp.exp(-x) + math.sqrt(math.pi) / 2 * complement(xp.sqrt(x)) / xp.sqrt(x)) / x


def resolving(share: float, dimension: int) -> float:
    """Return the least Λt at which at most this share of the heat trace lies beyond Λ, by Weyl's law."""
    return float(scipy.special.gammainccinv(dimension / 2, share))


def _exponent(mean: Any) -> Any:
    """Return the exponent a of the law N(λ) = N(Λ) (λ/Λ)^a, given the mean a/(a + 1) of λ/Λ over the λ below Λ."""
    xp = library_of(mean)
    return xp.clip(mean / xp.maximum(1 - mean, 1e-3), float(_EXPONENTS[0]), float(_EXPONENTS[-1]))


@nan_is_meant
def truncation_map(
    pairs: Eigenpairs, times: Sequence[float] | Real[ArrayLike, " n_times"]
) -> Float[Array, "n_times *shape"]:
    """Estimate the share of the heat kernel signature that the k computed pairs lack at each node.

    `truncation` estimates the mean of this share over the domain. The share can be several times the mean at single
    nodes: beside a Dirichlet side, in its corners, or where tensors vary between nodes. Weyl's law is applied to each
    node x: the sum N(λ, x) of φᵢ(x)² over the eigenvalues below λ is approximated by N(Λ, x) (λ/Λ)^a, where Λ is midway
    between the last of the k eigenvalues and the next. The pairs determine N(Λ, x) and the exponent a at each node,
    because the mean of the eigenvalues with the weights φᵢ(x)² is Λ a/(a + 1). The exponent a is about d/2 inside the
    domain and at Neumann sides, and d/2 + 1 at a Dirichlet side. Since Weyl's law holds for large eigenvalues, a is at
    least d/2, also in a thin strip, whose lowest eigenfunctions vary along one axis only.

    The result is an estimate, not a bound. On 320 random fields on small grids (smooth, turning, jumping, rough, and
    anisotropic up to 1e4), the largest true share over the nodes was 0.3 to 2.3 times the largest estimate in 98 % of
    the comparisons with a mean share above 0.1 %, and 0.07 to 10 times in all of them. For mean shares of 1e-6 to 0.1 %
    it was 0.2 to 4 times the largest estimate in 98 % of the comparisons. The result is NaN
    outside the mask, 0 at Dirichlet nodes or if no pairs are left out, and constant in derivatives.

    Args:
        times: (n_times,) positive, in (metric length)².

    Raises:
        ValueError: if times are not positive and finite.

    Examples:
        >>> print(hj.truncation_map(pairs, [0.2]).max() < 1e-5)  # 12 pairs are enough
        True
    """
    return _map(*jax.lax.stop_gradient((pairs, times_of(pairs, times))))


@jit_quickly()
def _map(pairs: Eigenpairs, at: Float[Array, " n"]) -> Float[Array, "n *shape"]:
    dtype, bottom = at.dtype, pairs.spectral_origin
    pairs = pairs.with_problems(
        dataclasses.replace(each, eigenvalues=each.eigenvalues - bottom, next_eigenvalue=each.next_eigenvalue - bottom)
        for each in pairs.problems
    )
    complete, axes = jnp.isinf(pairs.next_eigenvalue), (1,) * len(pairs.space.node_shape)
    # Λ lies midway between the last and the next eigenvalue, because there may be few or multiple eigenvalues.
    last = jnp.max(jnp.where(pairs.kept, pairs.eigenvalues, 0))
    following = jnp.where(complete, 1, (pairs.next_eigenvalue + last) / 2)
    at_zero = jnp.zeros(1, dtype)
    count = spectral_diagonal(pairs, Heat(at_zero))[0]
    # The derivative of exp(−λt) with respect to t at 0 is −λ.
    moment = -spectral_diagonal(pairs, Derivative(Heat(at_zero), Heat(jnp.ones(1, dtype))))[0]
    mean = moment / jnp.where(count > 0, count * following, 1)
    exponent = jnp.maximum(_exponent(mean), (pairs.space.dimension or 1) / 2)
    left = beyond(count, exponent, following * at.reshape(-1, *axes))
    kept = spectral_diagonal(pairs, Heat(at))
    share = left / jnp.where(count > 0, left + kept, 1)
    return jnp.where(complete & ~jnp.isnan(share), 0, share)
