"""Divided differences of functions of eigenvalues, without cancellation."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Function = Callable[[Array], Array]


def divided_difference(f: Function, low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return f[a, b] = (f(b) − f(a))/(b − a) for a ≤ b, and f'(a) where a = b.

    The divided difference is also the mean of f' over [a, b]. The difference quotient is inaccurate for close a and b;
    Gauss quadrature of the mean of f' is inaccurate for distant a and b. `_mean_or_quotient` chooses one formula.
    """
    gap = high - low
    slope = _derivative(f)
    rules = (zip(*gauss(n), strict=True) for n in (6, 12))
    coarse, fine = (sum((w * slope(low + s * gap) for s, w in rule), jnp.zeros_like(gap)) for rule in rules)
    at_low, at_high = f(low), f(high)
    return _mean_or_quotient(coarse, fine, gap, at_high - at_low, jnp.abs(at_high) + jnp.abs(at_low))


# Hermite and Genocchi: f[a, b, c] is the integral of f'' over the triangle of the convex combinations of a, b and c,
#
#     f[a, b, c] = ∫₀¹ s ∫₀¹ f''(a + s (b − a) + s u (c − b)) du ds,
#
# computed by Gauss quadrature in both variables. The equivalent quotient (f[b, c] − f[a, b])/(c − a) is inaccurate for
# close a, b, c.
def second_divided_difference(
    f: Function,
    low: Float[Array, "*n"],
    middle: Float[Array, "*n"],
    high: Float[Array, "*n"],
    below: Float[Array, "*n"],
    above: Float[Array, "*n"],
    scale: Float[Array, ""],
) -> Float[Array, "*n"]:
    """Return f[a, b, c] for a ≤ b ≤ c, and f''(a)/2 where a = b = c, given f[a, b] and f[b, c].

    The argument ``scale`` is the largest magnitude of all first divided differences of f. The error of
    (c − a) f[a, b, c] is about ε·``scale``, even where f' is much smaller than ``scale``, as for f = tanh.
    """
    curvature = _derivative(_derivative(f))

    def triangle(n: int) -> Array:
        # Evaluating all points at once shortens compilation.
        nodes, weights = (np.asarray(numbers) for numbers in gauss(n))
        s = jnp.asarray(np.repeat(nodes, n), low.dtype).reshape(-1, *(1,) * low.ndim)
        u = jnp.asarray(np.tile(nodes, n), low.dtype).reshape(s.shape)
        values = curvature(low[None] + s * (middle - low)[None] + s * u * (high - middle)[None])
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
    """Return the mean ``fine`` if it agrees with ``coarse`` and the quotient to within errors, otherwise the quotient.

    Gauss quadrature gives both means. The quotient is ``change``/``gap``; ``change`` is a difference of two numbers of
    magnitude ``size``.
    """
    eps = jnp.finfo(gap.dtype).eps
    apart = gap > 0
    smooth = jnp.abs(fine - coarse) * gap <= eps * size
    # Both quadrature rules may miss a sharp transition of the function, which the quotient includes.
    smooth &= jnp.abs(fine * gap - change) <= jnp.sqrt(eps) * size
    return jnp.where(~apart | smooth, fine, change / jnp.where(apart, gap, 1))


def gauss(n: int) -> tuple[list[float], list[float]]:
    """Return n Gauss–Legendre nodes and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return ((1 + nodes) / 2).tolist(), (weights / 2).tolist()


def _derivative(function: Function) -> Function:
    return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))[1]
