"""Filters, which are functions f(λ) of the eigenvalue, and their divided differences without cancellation."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Function = Callable[[Array], Array]


def divided_difference(f: Function, low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return f[a, b] = (f(b) − f(a))/(b − a) for a ≤ b, and f'(a) where they are equal.

    This is also the mean of f' over the interval. The difference quotient is inaccurate where a and b are close, and
    Gauss quadrature of the mean where they are far apart. `_mean_or_quotient` chooses between them.
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
# by Gauss quadrature in both variables. The equal quotient (f[b, c] − f[a, b])/(c − a) is inaccurate for close a, b, c.
def second_divided_difference(
    f: Function,
    low: Float[Array, "*n"],
    middle: Float[Array, "*n"],
    high: Float[Array, "*n"],
    below: Float[Array, "*n"],
    above: Float[Array, "*n"],
    scale: Float[Array, ""],
) -> Float[Array, "*n"]:
    """Return f[a, b, c] for a ≤ b ≤ c, and f''(a)/2 where they are equal, given f[a, b] and f[b, c].

    The scale is the largest magnitude of f' or [f]. The error of the result is about the rounding error of the scale,
    also where f' is much smaller, as for f' = 1 − tanh².
    """
    curvature = _derivative(_derivative(f))

    def triangle(n: int) -> Array:
        # Evaluating all points at once shortens compilation.
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
    """Return the mean if two quadrature rules and the quotient agree to within their errors, otherwise the quotient.

    The quotient is the change divided by the gap. The change is the difference of two terms of the given size.
    """
    eps = jnp.finfo(gap.dtype).eps
    apart = gap > 0
    smooth = jnp.abs(fine - coarse) * gap <= eps * size
    # Both rules may miss a sharp transition, which the quotient includes.
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


class Filter(eqx.Module):
    """An elementwise function f(λ) of the eigenvalue. Its parameters are differentiable array leaves.

    Several filters are stored as one filter whose leaves have a leading axis, for `jax.vmap`.
    """

    @abstractmethod
    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return f(x)."""

    def divided_difference(self, low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return (f(high) − f(low))/(high − low) for low ≤ high, and f'(low) where they are equal."""
        return divided_difference(self, low, high)


@jax.custom_jvp
def _mean_decay(y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the mean of exp(−sy) over 0 ≤ s ≤ 1, y ≥ 0."""
    return jnp.where(y > 0, -jnp.expm1(-y) / jnp.where(y > 0, y, 1), 1)


@_mean_decay.defjvp
def _mean_decay_jvp(
    primals: tuple[Float[Array, "*n"]], tangents: tuple[Float[Array, "*n"]]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    def free_of_cancellation(y: Array) -> Array:
        """Return the mean of exp(−sy), with derivatives by quadrature where y is small."""
        small = y < 1
        nodes, weights = gauss(8)
        near = sum(w * jnp.exp(-s * jnp.where(small, y, 0)) for s, w in zip(nodes, weights, strict=True))
        far = jnp.where(small, 1, y)
        return jnp.where(small, near, -jnp.expm1(-far) / far)

    return _mean_decay(*primals), jax.jvp(free_of_cancellation, primals, tangents)[1]


class Heat(Filter):
    """The filter exp(−λt) of heat diffusion for the time t."""

    time: Float[Array, "*m"]

    @jax.jit
    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return exp(−xt)."""
        return jnp.exp(-self.time * x)

    def divided_difference(self, low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return −t exp(−t·low) (1 − e^(−y))/y, y = t (high − low)."""
        return -self.time * jnp.exp(-self.time * low) * _mean_decay(self.time * (high - low))


class Wave(Filter):
    """The filter exp(−(e − log λ)²/2σ² − c) of the wave kernel signature at energy e; it is 0 at λ = 0."""

    energy: Float[Array, "*m"]
    sigma: Float[Array, "*m"]
    offset: Float[Array, "*m"]

    @jax.jit
    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the Gaussian function of log x."""
        positive = x > 0
        logarithm = jnp.log(jnp.where(positive, x, 1))
        bell = jnp.exp(-jnp.square((self.energy - logarithm) / self.sigma) / 2 - self.offset)
        return jnp.where(positive, bell, 0)


class Power(Filter):
    """The filter λ^p for λ > 0, which is 0 at λ = 0."""

    exponent: Float[Array, "*m"]

    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return x^p."""
        return jnp.where(x > 0, jnp.where(x > 0, x, 1) ** self.exponent, 0)


class Custom(Filter):
    """Any function f(parameters, λ) that JAX differentiates twice, elementwise in λ."""

    function: Callable[[Any, Array], Array] = eqx.field(static=True)
    parameters: Any

    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return f(parameters, x)."""
        return jnp.broadcast_to(jnp.asarray(self.function(self.parameters, x), x.dtype), x.shape)


class Derivative(Filter):
    """The derivative of a filter in a direction of its parameters: −λ exp(−λt) for Heat(t) in the direction Heat(1)."""

    filter: Filter
    direction: Filter

    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the directional derivative of f(x)."""
        return jax.jvp(lambda f: f(x), (self.filter,), (self.direction,))[1]

    def divided_difference(self, low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the directional derivative of the divided difference."""
        if type(self.filter).divided_difference is Filter.divided_difference:
            return super().divided_difference(low, high)
        return jax.jvp(lambda f: f.divided_difference(low, high), (self.filter,), (self.direction,))[1]
