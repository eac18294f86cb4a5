"""Filters, which are functions f(λ) of the eigenvalue, and their divided differences, which derivatives need."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hks_jax.compilation import jit_quickly
from hks_jax.linear.divided_differences import divided_difference, gauss


class Filter(eqx.Module):
    """An elementwise function f(λ) of the eigenvalue, whose parameters are differentiable array leaves.

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
    """Return (1 − e^(−y))/y, the mean of exp(−sy) over s from 0 to 1, for y ≥ 0."""
    return jnp.where(y > 0, -jnp.expm1(-y) / jnp.where(y > 0, y, 1), 1)


@_mean_decay.defjvp
def _mean_decay_jvp(
    primals: tuple[Float[Array, "*n"]], tangents: tuple[Float[Array, "*n"]]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    def free_of_cancellation(y: Array) -> Array:
        """Return (1 − e^(−y))/y; where y is small, by quadrature of the mean of exp(−sy)."""
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
        """Return (f(high) − f(low))/(high − low) as −t exp(−t·low) (1 − e^(−y))/y, where y is t (high − low)."""
        return -self.time * jnp.exp(-self.time * low) * _mean_decay(self.time * (high - low))


class Wave(Filter):
    """The filter exp(−(e − log λ)²/2σ² − c) of the wave kernel signature, with an offset c; it is 0 at λ = 0."""

    energy: Float[Array, "*m"]
    sigma: Float[Array, "*m"]
    offset: Float[Array, "*m"]

    @jax.jit
    def __call__(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return f(x), a Gaussian function of log x with the mean ``energy`` and the standard deviation ``sigma``."""
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
    """A user's function f(parameters, λ), which acts elementwise on λ and which JAX can differentiate twice."""

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
        """Return the directional derivative of the divided difference of the filter f."""
        if type(self.filter).divided_difference is Filter.divided_difference:
            return super().divided_difference(low, high)
        return jax.jvp(lambda f: f.divided_difference(low, high), (self.filter,), (self.direction,))[1]


def weights_of(one: Filter, values: Float[Array, " k"], kept: Bool[Array, " k"]) -> Float[Array, " k"]:
    """Return f(λᵢ), or zero for eigenpairs i that ``kept`` excludes."""
    return jnp.where(kept, one(values), 0)


@jit_quickly(static_argnames="fixed")
def mixing(
    filters: Filter, values: Float[Array, " k"], kept: Bool[Array, " k"], fixed: bool
) -> tuple[Float[Array, "m k"], Float[Array, "m k k"], Float[Array, "m k k"], Bool[Array, "m k"]]:
    """Return f(λᵢ), the divided differences of f and λf, and marks of pairs that matter, for each filter f.

    Pair i does not matter if λᵢ > 0, and f(λᵢ) and λᵢ f'(λᵢ) are negligible relative to the largest such value. The
    marks serve to omit entries (i, j) with i and j beyond the last pair that matters; all others are computed.
    """
    rows, columns = values[:, None], values[None]
    low, high, gap = jnp.minimum(rows, columns), jnp.maximum(rows, columns), rows - columns

    def of_one(one: Filter) -> tuple[Array, Array, Array, Array]:
        f = weights_of(one, values, kept)
        quotient = (f[:, None] - f[None]) / jnp.where(gap == 0, 1, gap)
        of_f = jnp.where(kept[:, None] & kept[None], one.divided_difference(low, high), quotient)
        # Between null vectors ``of_f`` has no effect if no perturbation acts on them, and f' may not exist at zero.
        of_f = jnp.where((high == 0) & (fixed | ~jnp.isfinite(of_f)), 0, of_f)
        # The sum f(low) + high · ``of_f`` has the same value, but its terms cancel, because f usually decreases.
        of_lambda_f = jnp.where(gap >= 0, f[:, None], f[None]) + low * of_f
        size = jnp.maximum(jnp.abs(f), jnp.abs(values * jnp.diagonal(of_f)))
        # For two negligible pairs i and j, the divided difference is at most f' at one of them if f is monotone, and at
        # most ε divided by the relative gap of λᵢ and λⱼ if f is not. NaN counts as not negligible.
        negligible = (values > 0) & (size <= jnp.finfo(f.dtype).eps * jnp.max(jnp.where(values > 0, size, 0)))
        return f, of_f, of_lambda_f, ~negligible

    return jax.lax.map(of_one, filters)
