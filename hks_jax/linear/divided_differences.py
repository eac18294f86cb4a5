"""Divided differences of functions of one variable, accurate where arguments are apart, close, and equal."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Function = Callable[[Array], Array]


def divided_difference(f: Function, low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return f[a, b] = (f(b) − f(a))/(b − a) for a ≤ b, and f'(a) where they are equal.

    The difference quotient loses digits where a and b are near; the mean of f' over the interval by Gauss quadrature,
    which is the same number, does where they are far apart. `_mean_or_quotient` chooses.
    """
    gap = high - low
    slope = _derivative(f)
    coarse, fine = (_mean(slope, low, gap, n) for n in (6, 12))
    at_low, at_high = f(low), f(high)
    return _mean_or_quotient(coarse, fine, gap, at_high - at_low, jnp.abs(at_high) + jnp.abs(at_low))


# Hermite and Genocchi: f[a, b, c] is the integral of f'' over the triangle of the convex combinations of a, b and c,
#
#     f[a, b, c] = ∫₀¹ s ∫₀¹ f''(a + s (b − a) + s u (c − b)) du ds,
#
# by Gauss quadrature for both. It is also (f[b, c] − f[a, b])/(c − a), which loses digits where all three are near.
def second_divided_difference(
    f: Function,
    low: Float[Array, "*n"],
    middle: Float[Array, "*n"],
    high: Float[Array, "*n"],
    below: Float[Array, "*n"],
    above: Float[Array, "*n"],
    scale: Float[Array, ""],
) -> Float[Array, "*n"]:
    """Return f[a, b, c] for a ≤ b ≤ c, and f''(a)/2 where they are equal.

    Args:
        f: elementwise.
        low: a.
        middle: b.
        high: c.
        below: f[a, b].
        above: f[b, c].
        scale: the largest magnitude of f' or [f], to whose rounding the result is accurate: where f' is much smaller
            it may still have errors of that size, 1 − tanh² for example.
    """
    curvature = _derivative(_derivative(f))

    def triangle(n: int) -> Array:
        # All points at once: one by one, they would take the compiler long.
        nodes, weights = (np.asarray(numbers) for numbers in gauss(n))
        s = jnp.asarray(np.repeat(nodes, n), low.dtype).reshape(-1, *(1,) * low.ndim)
        u = jnp.asarray(np.tile(nodes, n), low.dtype).reshape(s.shape)
        values = curvature(low + s * (middle - low) + s * u * (high - middle))
        weight = jnp.asarray(np.outer(weights * nodes, weights).ravel(), low.dtype)
        return jnp.tensordot(weight, values, 1, precision="highest")

    return _mean_or_quotient(triangle(5), triangle(8), high - low, above - below, scale)


def _mean_or_quotient(
    coarse: Float[Array, "*n"],
    fine: Float[Array, "*n"],
    gap: Float[Array, "*n"],
    change: Float[Array, "*n"],
    size: Float[Array, "..."],
) -> Float[Array, "*n"]:
    """Return the mean where two quadrature rules for it and the quotient agree as far as each can; else the quotient.

    Args:
        coarse: the mean, by a quadrature rule.
        fine: the mean, by a more accurate one.
        gap: the denominator of the quotient, not negative.
        change: the numerator of the quotient.
        size: the magnitude of what the numerator is a difference of.
    """
    eps = jnp.finfo(gap.dtype).eps
    apart = gap > 0
    smooth = jnp.abs(fine - coarse) * gap <= eps * size
    # Both rules may miss a sharp transition; the quotient does not.
    smooth &= jnp.abs(fine * gap - change) <= jnp.sqrt(eps) * size
    return jnp.where(~apart | smooth, fine, change / jnp.where(apart, gap, 1))


def gauss(n: int) -> tuple[list[float], list[float]]:
    """Return n Gauss–Legendre nodes and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return ((1 + nodes) / 2).tolist(), (weights / 2).tolist()


def _derivative(function: Function) -> Function:
    return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))[1]


def _mean(function: Function, low: Array, gap: Array, n: int) -> Array:
    """Return the mean over [low, low + gap] by n-point Gauss quadrature."""
    nodes, weights = gauss(n)
    total = jnp.zeros_like(gap)
    for s, w in zip(nodes, weights, strict=True):
        total = total + w * function(low + s * gap)
    return total
