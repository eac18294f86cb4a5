"""The determinant of a Laplacian, as its zeta function defines it."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.filters import gauss
from hks_jax.signatures.times import dimension_of, positive_range, require_pairs, volume_of
from hks_jax.signatures.truncation import truncation
from hks_jax.traced import is_traced

_FIRST = 18.0
"""The least λ_last·T: the eigenvalues beyond the last then contribute less than 1e-9 each."""
_TIMES, _PER_DOUBLING = 12, 2
"""How many times T are tried, and in how many of them T doubles."""
_DOUBTFUL = 0.01
"""The error from which on a warning says so."""
_SMALL, _TERMS, _NODES = 2.0, 20, 32
"""Up to this argument E₁ is a series, with this many terms; beyond, an integral by as many points: 1e-14 for both."""


class LogDeterminant(NamedTuple):
    """The logarithm of a zeta-regularised determinant.

    Attributes:
        value: log det′ Δ.
        error: an estimate of its error: that of the elements, and of the terms of the heat trace without a coefficient.
            Constant to derivatives.
        time: T, before which the heat trace is taken from its coefficients, and after which from the eigenvalues;
            likewise constant.
    """

    value: Float[Array, ""]
    error: Float[Array, ""]
    time: Float[Array, ""]


def heat_coefficients(
    pairs: Eigenpairs,
    euler_characteristic: float,
    boundary_length: Any = 0.0,
    corners: Sequence[float] = (),
    condition: Literal["neumann", "dirichlet"] = "neumann",
) -> Float[Array, " 3"]:
    """Return a₀, a₁, a₂ of the heat trace Σ exp(−λᵢt) ~ a₀/t + a₁/√t + a₂ of a surface (Kac 1966; McKean, Singer 1967).

    a₀ = V/4π; a₁ = ±L/8√π, + under Neumann conditions; a₂ = χ/6 + Σ (π − θ)²/24πθ over the corners.

    Args:
        pairs: from `eigenpairs`, of the area V in 2D; under "mirror" and "mean" of the doubled domain.
        euler_characteristic: χ: 2 of a sphere, 0 of a torus, 1 of a disc or a square.
        boundary_length: L, in the units of the metric.
        corners: the inner angles θ of the boundary's corners, in radians: four times π/2 of a square.
        condition: that on all of the boundary.

    Raises:
        ValueError: pairs that are not of a surface, or whose area is not known; angles outside of (0, 2π].
    """
    if dimension_of(require_pairs(pairs), "the heat trace") != 2:
        raise ValueError("pairs: got a 3D domain; give `log_determinant` its coefficients a₀, a₁, a₂, a₃ yourself")
    angles = np.asarray(corners, float)
    if not ((angles > 0) & (angles <= 2 * math.pi)).all():
        raise ValueError(f"corners: got {corners}; expected inner angles in radians, above 0 and at most 2π")
    area = volume_of(pairs, "the heat trace")
    length = jnp.asarray(boundary_length, area.dtype) * (1 if condition == "neumann" else -1)
    constant = euler_characteristic / 6 + float(((math.pi - angles) ** 2 / (24 * math.pi * angles)).sum())
    known = area / (4 * math.pi), length / (8 * math.sqrt(math.pi)), jnp.asarray(constant, area.dtype)
    return jnp.stack(known)


# With Z the heat trace, n₀ the number of zero eigenvalues and T > 0,
#
#     Γ(s) ζ(s) = ∫₀^∞ t^(s−1) (Z(t) − n₀) dt,    Z(t) ~ Σⱼ aⱼ t^pⱼ,    pⱼ = (j − d)/2.
#
# Up to T the terms of Z are integrated one by one and continued analytically, and beyond it the exponentials are. With
# 1/Γ(s) = s + γs² + … the value at zero is
#
#     −log det′ = ζ′(0) = (a_d − n₀) (log T + γ) + Σ_{j≠d} aⱼ T^pⱼ/pⱼ + Σ E₁(λᵢT).
#
# What is missing is ∫₀^T (Z − Σⱼ aⱼ t^pⱼ) dt/t, which begins with the first power left out: from values at T, 2T, 4T, …
# it is extrapolated away as Richardson does, power by power.
def log_determinant(
    pairs: Eigenpairs, coefficients: Any, *, extrapolate: Sequence[float] = (), time: Any = None
) -> LogDeterminant:
    """Compute log det′ Δ = −ζ′(0), ζ(s) = Σ λᵢ^(−s) over the positive eigenvalues.

    Eigenvalues alone do not tell it: what is beyond the last comes from the heat trace's expansion at small times.
    Differentiable, through the eigenvalues and the coefficients. The eigenvalues' own errors limit the result: of
    linear elements with spacing h the error is about a₀h²/16T² in 2D, so that many pairs, and small T, need fine grids.

    Args:
        pairs: the lowest, from `eigenpairs`.
        coefficients: a₀, a₁, …, at least as far as a_d, of Σ exp(−λᵢt) ~ Σⱼ aⱼ t^((j−d)/2): `heat_coefficients`.
        extrapolate: the next powers of t in the expansion, whose coefficients are not known: (1, 2) on a closed curved
            surface, (0.5, 1) with a curved boundary. On flat tori and polygons there are none.
        time: T, in (metric length)²; None takes the one whose estimated error is least.

    Returns:
        The value, and an estimate of its error.

    Raises:
        ValueError: fewer than d + 1 coefficients; powers that are not positive; pairs in an interval, negative
            eigenvalues, or none that is positive; a dimension that is not known.

    Warns:
        AccuracyWarning: an estimated error above 0.01.
    """
    d, dtype = dimension_of(require_pairs(pairs), "the determinant"), pairs.eigenvalues.dtype
    a = jnp.asarray(coefficients, dtype)
    if a.ndim != 1 or a.size <= d:
        raise ValueError(f"coefficients: got shape {a.shape}; expected at least {d + 1}, a₀ to a_{d}")
    powers = np.asarray(extrapolate, float)
    if not (powers > 0).all() or len(set(powers)) != powers.size:
        raise ValueError(f"extrapolate: got {extrapolate}; expected different positive powers of t")
    if not pairs.lowest:
        raise ValueError("pairs: these lie in an interval; the determinant is that of the lowest eigenpairs")
    if not is_traced(pairs.eigenvalues) and (pairs.eigenvalues < 0).any():
        raise ValueError(f"pairs: got the eigenvalue {float(pairs.eigenvalues[0]):.4g}; expected none below zero")
    _, last = jax.lax.stop_gradient(positive_range(pairs))
    steps = 2.0 ** (np.arange(_TIMES) / _PER_DOUBLING)
    times = _FIRST / last * jnp.asarray(steps, dtype) if time is None else jnp.asarray(time, dtype)[None]
    # At (m,) times, and at each √2, 2, … times as late, the odd ones for the error.
    count = powers.size + 1
    doublings = 2.0 ** (np.arange(2 * count + 1) / 2)
    values = _at(pairs, a, d, times[:, None] * jnp.asarray(doublings, dtype)[None])
    # Weights that keep constants and take the powers away; 0 stands for the constants.
    weights = np.linalg.solve(2.0 ** np.outer(np.append(0, powers), np.arange(count)), np.eye(count)[0])
    levels = [values[:, i : i + 2 * count : 2] @ jnp.asarray(weights, dtype) for i in range(3)]
    rest = jnp.maximum(jnp.abs(levels[0] - levels[1]), jnp.abs(levels[0] - levels[2]))
    # The trace of linear elements errs by d h²/16t, three times as much as the signature at a node.
    bias = 3 * truncation(pairs, times).resolution_bias * jnp.abs(a[0]) * times ** (-d / 2) / (d / 2 + 1)
    errors = jax.lax.stop_gradient(rest + jnp.where(jnp.isfinite(bias), bias, 0))
    best = jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.inf))
    result = LogDeterminant(levels[0][best], errors[best], times[best])
    if not is_traced(result) and not float(result.error) <= _DOUBTFUL:
        warn_of_accuracy(
            f"pairs: log det′ = {float(result.value):.4g} may be off by {float(result.error):.2g}. Use a finer grid or "
            "more pairs; name the powers of t that the coefficients leave out by `extrapolate`, or give more of them"
        )
    return result


@partial(jax.jit, static_argnums=2)
def _at(pairs: Eigenpairs, a: Float[Array, " m"], d: int, times: Float[Array, "*n"]) -> Float[Array, "*n"]:
    positive = pairs.kept & (pairs.eigenvalues > 0)
    known = jnp.where(positive, pairs.eigenvalues, 1)
    at = times[..., None]
    tails = jnp.sum(jnp.where(positive, exponential_integral(known * at), 0), axis=-1)
    null = jnp.sum(pairs.kept & (pairs.eigenvalues == 0), dtype=a.dtype)
    powers = (np.arange(a.size) - d) / 2
    terms = sum(a[j] * times**p / p for j, p in enumerate(powers) if p != 0)
    return -((a[d] - null) * (jnp.log(times) + np.euler_gamma) + terms + tails)


@jax.custom_jvp
def exponential_integral(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return E₁(x) = ∫₁^∞ exp(−xu) du/u for x > 0; that of JAX takes many times as long to compile and to compute."""
    near, far = jnp.minimum(x, _SMALL), jnp.maximum(x, _SMALL)
    series, term = -np.euler_gamma - jnp.log(near), -jnp.ones_like(x)
    for k in range(1, _TERMS + 1):
        term = term * -near / k
        series += term / k
    # With u = 1/v, from 0 to 1.
    integral = sum(w / v * jnp.exp(-far / v) for v, w in zip(*gauss(_NODES), strict=True))
    return jnp.where(x < _SMALL, series, integral)


@exponential_integral.defjvp
def _exponential_integral_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (change,) = primals, tangents
    return exponential_integral(x), -jnp.exp(-x) / x * change
