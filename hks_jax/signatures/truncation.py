"""What a truncated spectrum on a grid of finite spacing resolves: time by time, and node by node."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jax.scipy.special import erfc
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import nan_is_meant
from hks_jax.compilation import numpy_where_known
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.space import mask_for
from hks_jax.linear.loops import for_each
from hks_jax.signatures.filters import Derivative, Heat
from hks_jax.signatures.spectral_functions import spectral_diagonal
from hks_jax.signatures.times import dimension_of, times_of
from hks_jax.traced import is_traced

TAIL_LIMIT = 0.01
BIAS_LIMIT = 0.1


class Truncation(eqx.Module):
    """Error estimates for heat kernel signatures at given times: a diagnostic, constant to derivatives.

    Attributes:
        times: (n,).
        tail: (n,) the part of the heat trace that lies beyond the k pairs, relative, by Weyl's law. A mean over the
            domain: single nodes lack more (`truncation_map`).
        resolution_bias: (n,) the relative error by the spacing of the nodes, at the median node.
        lasting_bias: (n,) the part of it that does not fall as t grows, because the tensors turn or stretch from node
            to node.
        coarse_fraction: (n,) the fraction of nodes where that bias exceeds 10 %.
        smallest_time: the least time that the k pairs resolve to 1 % in that mean. The worst node then lacks up to 6 %,
            beside a Dirichlet side up to 20 %.
        order: the power of 1/t with which the rest of the bias falls.
    """

    times: Float[Array, " n"]
    tail: Float[Array, " n"]
    resolution_bias: Float[Array, " n"]
    lasting_bias: Float[Array, " n"]
    coarse_fraction: Float[Array, " n"]
    smallest_time: Float[Array, ""]
    order: int = eqx.field(static=True, default=1, kw_only=True)

    def messages(self) -> list[str]:
        """Say in sentences which times are under-resolved; empty if none is. Needs concrete values."""
        times, messages = np.asarray(self.times), []
        smallest = f"t = {times.min():.4g}"
        tail, bias = np.asarray(self.tail), np.asarray(self.resolution_bias)
        if (tail > TAIL_LIMIT).any():
            messages.append(
                f"{int((tail > TAIL_LIMIT).sum())} of {times.size} times are too small for k: an estimated "
                f"{tail.max():.1%} of the signature at {smallest}, in the mean over the domain, lies beyond the "
                "computed eigenpairs (single nodes lack several times as much: see hks_jax.truncation_map). Use "
                f"times from about {float(self.smallest_time):.4g}, or more eigenpairs"
            )
        lasting = np.asarray(self.lasting_bias)
        early = (bias > BIAS_LIMIT) & (lasting <= BIAS_LIMIT)
        if early.any():
            at = np.argmax(np.where(early, bias, 0))
            first = times[at]
            # The estimate is x/(1 + x) with x² = (a/t)^(2·order) + c² (see `_resolution_bias`); c does not fall.
            x, c, limit = (each / (1 - each) for each in (min(bias[at], 1 - 1e-15), lasting[at], BIAS_LIMIT))
            least = first * ((x**2 - c**2) / max(limit**2 - c**2, 1e-6)) ** (0.5 / self.order)
            messages.append(
                f"{int(early.sum())} of {times.size} times are too small for the grid: the discretisation biases the "
                f"signature at t = {first:.4g} by about {bias[at]:.1%} at half of the nodes. "
                f"Use times from about {least:.4g}, or a finer grid"
            )
        if (lasting > BIAS_LIMIT).any():
            messages.append(
                f"the tensors turn or stretch too much from node to node: the discretisation biases the signature at "
                f"{int((lasting > BIAS_LIMIT).sum())} of {times.size} times by about {lasting.max():.1%}, which does "
                'not fall as t grows. Use a finer grid; interpolation="log-euclidean" keeps the volume at least'
            )
        return messages


@nan_is_meant
def truncation(pairs: Eigenpairs, times: Sequence[float] | Real[ArrayLike, " n"]) -> Truncation:
    """Estimate what k pairs and the node spacing leave out of the signature at each time.

    Weyl's law N(λ) = k (λ/Λ)^(d/2), whose constant is taken from the spectrum itself (Λ is the first eigenvalue beyond
    the k), gives the part of the heat trace beyond Λ: a mean over the domain. `truncation_map` has single nodes.

    The error by the spacing h has two parts, both of leading order in h. One is that of a constant metric, d h²/48t
    where its axes are the grid's, more where they are not. The other does not fall as t grows: where tensors turn or
    stretch from node to node, elements are too stiff, and the interpolated tensors have another volume. Where k was
    enough for t, the median error on such fields was a third of the estimate to three times it; a quarter at eigenvalue
    ratios of 30 on coarse grids. On meshes only the first part is estimated.

    With a potential, or where nothing is known of the null space, the exponent is the one that the mean of the pairs'
    eigenvalues tells, if it is more than d/2. The error by the spacing is then NaN, as that of matrices from elsewhere.

    Raises:
        ValueError: times that are not positive and finite; pairs in an interval; matrices whose dimension is not known.
    """
    pairs, at = _estimated(pairs, times)
    known = pairs.eigenvalues, pairs.kept, pairs.next_eigenvalue, pairs.spectral_origin
    dimension, resolution = dimension_of(pairs, "an estimate of the truncation"), pairs.pencil.resolution
    by_weyl, errors, order = pairs.null_space_known, None, 1
    if resolution is not None and by_weyl:
        errors, order = (resolution.dispersion, resolution.turning, resolution.swelling), resolution.order
    free = mask_for(known, pairs.space.free)
    return Truncation(at, *_truncation(errors, free, *known, at, dimension, by_weyl, order), order=order)


@numpy_where_known(static_argnums=(7, 8, 9))
def _truncation(
    xp: Any,
    errors: tuple[Any, Any, Any] | None,
    free: Any,
    values: Any,
    kept: Any,
    next_eigenvalue: Any,
    bottom: Any,
    at: Any,
    dimension: int,
    by_weyl: bool,
    order: int,
) -> tuple[Any, ...]:
    """Return what `Truncation` has beside the times; the exponent is Weyl's or that of the spectrum."""
    # Weyl's law counts from the bottom of the spectrum, which a potential moves.
    values, next_eigenvalue = values - bottom, next_eigenvalue - bottom
    complete = xp.isinf(next_eigenvalue)
    following = xp.where(complete, 1, next_eigenvalue)
    count = xp.sum(kept, dtype=at.dtype)
    if by_weyl:
        left, least = beyond_by_weyl(xp, count, dimension, following * at), resolving(TAIL_LIMIT, dimension)
    else:  # between two levels, of which there may be few
        following = (following + xp.max(xp.where(kept, values, 0))) / 2
        mean = xp.sum(xp.where(kept, values, 0)) / (count * following)
        exponent = xp.maximum(_exponent(xp, mean), dimension / 2)
        left = xp.asarray(beyond(*map(jnp.asarray, (count, exponent, following * at))))
        least = xp.interp(exponent, *(xp.asarray(x, at.dtype) for x in (_EXPONENTS, _RESOLVING)))
    exponents = at[:, None] * values[None]
    terms = xp.where(kept[None], xp.exp(-exponents), 0)
    trace = xp.sum(terms, axis=1)
    tail = xp.where(complete, 0, left / (left + trace))
    slope = xp.sum(xp.where(kept[None], exponents * terms, 0), axis=1) / (dimension / 2 * trace)
    smallest = xp.where(complete, 0, least / following)
    if errors is None:
        unknown = xp.full_like(at, xp.nan)
        return tail, unknown, unknown, unknown, smallest
    bias, lasting = _resolution_bias(xp, errors, free, at, 1 - (1 - slope) * (1 - tail), order)
    coarse = xp.sum(bias > BIAS_LIMIT, axis=1, dtype=at.dtype) / xp.sum(free, dtype=at.dtype)
    return tail, median_of_shares(xp, bias, free), median_of_shares(xp, lasting, free), coarse, smallest


# Eigenvalues larger by the factor 1 + δ make the heat trace Z(t) that of the time (1 + δ)t: an error proportional to
# s = −(2/d) d log Z/d log t, which is 1 at small t (Weyl) and 0 where the constant is left. A volume larger by the
# factor 1 + v is that of the metric times (1 + v)^(2/d), which divides the signature by 1 + v and eigenvalues by
# (1 + v)^(2/d): an error of v(1 − s). Where k pairs are too few for t, what lies beyond them counts with s = 1.
def _resolution_bias(
    xp: Any, errors: tuple[Any, Any, Any], free: Any, times: Any, slope: Any, order: int
) -> tuple[Any, Any]:
    """Return the estimated relative error (n, nodes) by the spacing, and its part that does not fall with t.

    Both are 0 at nodes that are not free.
    """
    dispersion, turning = (xp.where(free, x, 0).ravel() for x in errors[:2])
    lasting = slope[:, None] * turning[None] + (xp.abs(1 - slope) * errors[2])[:, None]
    lasting = xp.where(free.ravel()[None], lasting, 0)
    both = xp.hypot((dispersion[None] / times[:, None]) ** order, lasting)
    # Discrete signatures stay bounded as t falls, so that their relative error tends to 1.
    return both / (1 + both), lasting / (1 + lasting)


def median_of_shares(xp: Any, x: Any, free: Any) -> Any:
    """Return the medians (n) over the free nodes of numbers (n, nodes) between 0 and 1, which are 0 at the others.

    To 1e-12; NaN where one is. By bisection: sorting takes JAX ten times as long.
    """
    twice_half = 2 * free.size - xp.sum(free)

    def halve(_: Any, ends: tuple[Any, Any]) -> tuple[Any, Any]:
        low, high = ends
        middle = (low + high) / 2
        enough = 2 * xp.sum(x <= middle[:, None], axis=1) >= twice_half
        return xp.where(enough, low, middle), xp.where(enough, middle, high)

    _, median = for_each(40, halve, (xp.zeros(len(x), x.dtype), xp.ones(len(x), x.dtype)))
    return xp.where(xp.any(xp.isnan(x), axis=1), xp.nan, median)


def _estimated(pairs: Eigenpairs, times: Any) -> tuple[Eigenpairs, Float[Array, " n"]]:
    """Return pairs and times, constant to derivatives; raise ValueError for pairs of which nothing is estimated."""
    at = times_of(pairs, times)
    if not pairs.lowest:
        raise ValueError("pairs: these lie in an interval; the error is estimated of the lowest eigenpairs")
    return jax.lax.stop_gradient((pairs, at))


def resolved_times(pairs: Eigenpairs, times: Any) -> Float[Array, " n"]:
    """Return times as `times_of` does; warn (AccuracyWarning) of those that k or the spacing does not resolve.

    Nothing is said where values are traced, of pairs in an interval, whose sums are meant to be those of a band, nor
    where the dimension of the manifold is not known.
    """
    times = times_of(pairs, times)
    known, at = jax.lax.stop_gradient((pairs, times))
    if not is_traced((known.eigenvalues, known.pencil, at)) and pairs.lowest and pairs.space.dimension is not None:
        for message in truncation(known, at).messages():
            warn_of_accuracy(message)
    return times


_EXPONENTS = np.geomspace(0.5, 8, 33)
"""Between a strip, which is a line to all eigenfunctions that were computed, and a corner of Dirichlet sides in 3D."""
_RESOLVING = scipy.special.gammainccinv(_EXPONENTS, TAIL_LIMIT)
"""The Λt from which on no more than that share of the heat trace lies beyond Λ, for each of these exponents."""
_POINTS, _WEIGHTS = np.polynomial.laguerre.laggauss(24)
"""Gauss and Laguerre's quadrature, of f(u) e^(−u) from 0 to ∞."""


# If N(λ) = N(Λ) (λ/Λ)^a, what lies beyond Λ is
#
#     ∫_Λ^∞ e^(−λt) dN = N(Λ) a (Λt)^(−a) ∫_Λt^∞ e^(−y) y^(a−1) dy = N(Λ) (a/x) e^(−x) ∫_0^∞ (1 + u/x)^(a−1) e^(−u) du
#
# with x = Λt and y = x + u. The incomplete gamma function, which is the integral in the middle, takes JAX ten times as
# long to compile, and thirty times as long to compute.
def beyond(count: Float[Array, "..."], exponent: Float[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return ∫ e^(−λt) dN over λ > Λ, with N(λ) = count · (λ/Λ)^exponent and x = Λt.

    To 1e-3 from x = 0.1 on, to 1e-7 from x = 1 on, for exponents from ½ to 8; x below 1e-3 counts as that.
    """
    x = jnp.maximum(x, 1e-3)  # nothing overflows
    count, exponent = (jnp.expand_dims(each, tuple(range(x.ndim - each.ndim))) for each in (count, exponent))

    def add(total: Array, node: tuple[Array, ...]) -> tuple[Array, None]:
        point, weight = node
        return total + weight * jnp.exp((exponent - 1) * jnp.log1p(point / x)), None

    nodes = tuple(jnp.asarray(each, x.dtype) for each in (_POINTS, _WEIGHTS))
    integral, _ = jax.lax.scan(add, jnp.zeros(jnp.broadcast_shapes(x.shape, exponent.shape), x.dtype), nodes)
    return count * exponent / x * jnp.exp(-x) * integral


# For a = 1 the integral is 1, for a = 3/2, by parts, 1 + (√π/2) erfc(√x) e^x/√x.
def beyond_by_weyl(xp: Any, count: Any, dimension: int, x: Any) -> Any:
    """Return `beyond` of x (...) for Weyl's exponent d/2, d = 2 or 3."""
    if dimension == 2:
        return count * xp.exp(-x) / x
    complement = erfc if xp is jnp else scipy.special.erfc
    return 1.5 * count * (xp.exp(-x) + math.sqrt(math.pi) / 2 * complement(xp.sqrt(x)) / xp.sqrt(x)) / x


def resolving(share: float, dimension: int) -> float:
    """Return the Λt from which on no more than this share of the heat trace lies beyond Λ, by Weyl's law."""
    return float(scipy.special.gammainccinv(dimension / 2, share))


def _exponent(xp: Any, mean: Any) -> Any:
    """Return the exponent of a counting function from the mean of λ/Λ below Λ."""
    return xp.clip(mean / xp.maximum(1 - mean, 1e-3), float(_EXPONENTS[0]), float(_EXPONENTS[-1]))


@nan_is_meant
def truncation_map(
    pairs: Eigenpairs, times: Sequence[float] | Real[ArrayLike, " n_times"]
) -> Float[Array, "n_times *shape"]:
    """Estimate, node by node, what part of the heat kernel signature lies beyond the k pairs.

    `truncation` estimates the mean over the domain; beside a Dirichlet side, in its corners, or where the tensors vary
    from node to node, a single node can lack several times as much. Here Weyl's law is local: the function
    N(λ, x) = Σ φᵢ(x)² over λᵢ < λ is taken for N(Λ, x) (λ/Λ)^a(x), Λ the first eigenvalue beyond the k. The constant
    N(Λ, x) and the exponent a(x) come from the pairs, the latter from the mean of λ at the node, which is Λ a/(a + 1):
    about d/2 inside and at natural sides, d/2 + 1 at a Dirichlet side.

    An estimate, not a bound. On small grids the largest true share of a node was 0.25 to 2 times the largest estimate
    where the mean was above 0.1 %, and up to 3 times at a mean of 1e-6.

    Args:
        pairs: from `eigenpairs`.
        times: (n_times,) positive, in (metric length)².

    Returns:
        (n_times, *shape), 0 … 1, relative to the signature of all pairs; NaN outside the mask, 0 at Dirichlet nodes and
        where all pairs were computed. Constant to derivatives.

    Raises:
        ValueError: times that are not positive and finite; pairs in an interval.
    """
    return _map(*_estimated(pairs, times))


@jax.jit
def _map(pairs: Eigenpairs, at: Float[Array, " n"]) -> Float[Array, "n *shape"]:
    dtype, bottom = at.dtype, pairs.spectral_origin
    moved = pairs.eigenvalues - bottom, pairs.next_eigenvalue - bottom
    pairs = eqx.tree_at(lambda p: (p.eigenvalues, p.next_eigenvalue), pairs, moved)
    complete, axes = jnp.isinf(pairs.next_eigenvalue), (1,) * len(pairs.space.node_shape)
    following = jnp.where(complete, 1, pairs.next_eigenvalue)
    at_zero = jnp.zeros(1, dtype)
    count = spectral_diagonal(pairs, Heat(at_zero))[0]
    # The derivative of exp(−λt) by t at 0 is −λ.
    moment = -spectral_diagonal(pairs, Derivative(Heat(at_zero), Heat(jnp.ones(1, dtype))))[0]
    mean = moment / jnp.where(count > 0, count * following, 1)
    left = beyond(count, _exponent(jnp, mean), following * at.reshape(-1, *axes))
    kept = spectral_diagonal(pairs, Heat(at))
    share = left / jnp.where(count > 0, left + kept, 1)
    return jnp.where(complete & ~jnp.isnan(share), 0, share)
