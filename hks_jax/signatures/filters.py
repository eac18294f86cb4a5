"""Filters f(λ): what a spectral function makes of the eigenvalues, with divided differences free of cancellation."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Filter(eqx.Module):
    """A function f(λ) of the eigenvalue, elementwise; its parameters are array leaves, all of them differentiable.

    Several filters at once are one filter whose leaves have a leading axis, as `jax.vmap` takes it.
    """

    @abstractmethod
    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return f(x)."""

    def divided_difference(self, low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return (f(high) − f(low))/(high − low) for low ≤ high, and f'(low) where they are equal.

        The difference quotient loses digits where low and high are near; the mean of f' over the interval by Gauss
        quadrature, which is the same number, does where they are far apart. The mean is taken where two rules for it
        and the quotient agree as far as each can.
        """
        gap = high - low
        slope = _derivative(self)
        coarse, fine = (_mean(slope, low, gap, n) for n in (6, 12))
        apart = gap > 0
        change, size = self(high) - self(low), jnp.abs(self(high)) + jnp.abs(self(low))
        eps = jnp.finfo(gap.dtype).eps
        smooth = jnp.abs(fine - coarse) * gap <= eps * size
        # Both rules may miss a sharp transition; the quotient does not.
        smooth &= jnp.abs(fine * gap - change) <= jnp.sqrt(eps) * size
        return jnp.where(~apart | smooth, fine, change / jnp.where(apart, gap, 1))


class Heat(Filter):
    """exp(−λt), of heat diffusing for the time t."""

    time: Float[Array, "*m"]

    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return exp(−xt)."""
        return jnp.exp(-self.time * x)

    def divided_difference(self, low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return −t exp(−t·low) (1 − e^(−y))/y, y = t (high − low)."""
        y = self.time * (high - low)
        # For small y the mean of exp(−sy) over 0 ≤ s ≤ 1, whose derivatives by t have no cancellation either.
        small = y < 1
        nodes, weights = _gauss(8)
        near = sum(w * jnp.exp(-s * jnp.where(small, y, 0)) for s, w in zip(nodes, weights, strict=True))
        far = jnp.where(small, 1, y)
        return -self.time * jnp.exp(-self.time * low) * jnp.where(small, near, -jnp.expm1(-far) / far)


class Wave(Filter):
    """exp(−(e − log λ)²/2σ² − c) for λ > 0, of the wave kernel signature at energy e; 0 at λ = 0."""

    energy: Float[Array, "*m"]
    sigma: Float[Array, "*m"]
    offset: Float[Array, "*m"]

    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the bell of log x."""
        positive = x > 0
        logarithm = jnp.log(jnp.where(positive, x, 1))
        bell = jnp.exp(-jnp.square((self.energy - logarithm) / self.sigma) / 2 - self.offset)
        return jnp.where(positive, bell, 0)


class Power(Filter):
    """λ^p for λ > 0; 0 at λ = 0."""

    exponent: Float[Array, "*m"]

    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return x^p."""
        return jnp.where(x > 0, jnp.where(x > 0, x, 1) ** self.exponent, 0)


class Custom(Filter):
    """Any function f(parameters, λ) that JAX differentiates twice.

    Attributes:
        function: maps (parameters, λ) to f, elementwise in λ.
        parameters: any pytree of floating point arrays.
    """

    function: Callable[[Any, Array], Array] = eqx.field(static=True)
    parameters: Any

    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return f(parameters, x)."""
        return self.function(self.parameters, x)


class Derivative(Filter):
    """The derivative of a filter along a direction in its parameters: with Heat(t) and Heat(1), −λ exp(−λt)."""

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


def _derivative(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))[1]


def _gauss(n: int) -> tuple[list[float], list[float]]:
    """Return Gauss–Legendre nodes and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return ((1 + nodes) / 2).tolist(), (weights / 2).tolist()


def _mean(function: Callable[[Array], Array], low: Array, gap: Array, n: int) -> Array:
    """Return the mean over [low, low + gap] by n-point Gauss quadrature."""
    nodes, weights = _gauss(n)
    total = jnp.zeros_like(gap)
    for s, w in zip(nodes, weights, strict=True):
        total = total + w * function(low + s * gap)
    return total
