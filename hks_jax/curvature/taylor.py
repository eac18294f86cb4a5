"""Truncated Taylor series in two variables.

A series is the vector of its coefficients in the order 1, x, y, x², xy, y², …, sorted by total degree. Removing the
last coefficients truncates the series. Operations on several series truncate all series to the shortest one. Nested JAX
derivatives would compute mixed derivatives in every order of the variables, and take several times as long.
"""

from collections.abc import Callable
from functools import lru_cache
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

Series = Float[Array, " _n_terms"]


def expand(fn: Callable[[Array], Array], x: Float[Array, " 2"], degree: int) -> Float[Array, "*components n_terms"]:
    """Return the Taylor series of a function at a point, exact to rounding.

    Derivatives along a line are cheap, because only one variable changes. Derivatives along degree + 1 lines determine
    the series: the k-th derivative along the direction (c, s), divided by k!, is Σⱼ cᵏ⁻ʲ sʲ fₖⱼ, where fₖⱼ is the
    coefficient of xᵏ⁻ʲyʲ. For equidistant angles of the lines, the equations for the coefficients fₖⱼ are
    well-conditioned.
    """
    angles = np.pi * np.arange(degree + 1) / (degree + 1)
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]

    def along(direction: Float[Array, " 2"]) -> tuple[Array, ...]:
        def value(t: Array) -> tuple[Array, ...]:
            return (fn(x + t * direction),)

        derivatives: Callable[[Array], tuple[Array, ...]] = value
        for _ in range(degree):
            derivatives = _with_next(derivatives)
        return derivatives(jnp.zeros((), x.dtype))

    of_line = jax.vmap(along)(jnp.asarray(np.hstack([c, s]), x.dtype))
    series = []
    for k, values in enumerate(of_line):
        j = np.arange(k + 1)
        solve = jnp.asarray(np.linalg.pinv(factorial(k) * c ** (k - j) * s**j), values.dtype)
        series.append(jnp.einsum("jl,l...->...j", solve, values, precision="highest"))
    return jnp.concatenate(series, axis=-1)


def _with_next(derivatives: Callable[[Array], tuple[Array, ...]]) -> Callable[[Array], tuple[Array, ...]]:
    """Return a function of t that returns the given derivatives, 0 to m, and also derivative m + 1."""

    def last(t: Array) -> tuple[Array, tuple[Array, ...]]:
        known = derivatives(t)
        return known[-1], known

    def extended(t: Array) -> tuple[Array, ...]:
        _, following, known = jax.jvp(last, (t,), (jnp.ones_like(t),), has_aux=True)
        return (*known, following)

    return extended


def add(*terms: Series) -> Series:
    """Return the sum of several series."""
    return jnp.sum(jnp.stack([term[: min(a.size for a in terms)] for term in terms]), axis=0)


def product(a: Series, b: Series) -> Series:
    """Return the product of two series."""
    n = min(a.size, b.size)
    return jnp.einsum("i,j,ijk->k", a[:n], b[:n], jnp.asarray(_products(n), a.dtype), precision="highest")


def reciprocal(a: Series) -> Series:
    """Return 1/a by Newton's iteration; a step extends the correct coefficients from degree m to 2m + 1."""
    r = jnp.zeros_like(a).at[0].set(1 / a[0])
    for _ in range(int(_exponents(a.size)[-1].sum()).bit_length()):
        r = 2 * r - product(a, product(r, r))
    return r


def derivative(a: Series, axis: int) -> Series:
    """Return the derivative of a series with respect to one variable; its degree is less by one."""
    exponents = _exponents(a.size)[:, axis]
    kept = np.flatnonzero(exponents)
    return a[kept] * jnp.asarray(exponents[kept], a.dtype)


@lru_cache
def _exponents(n: int) -> Int[np.ndarray, "n 2"]:
    """Return the exponents of both variables for the first n coefficients; xᵏ⁻ʲyʲ has the index k(k + 1)/2 + j."""
    return np.array([(k - j, j) for k in range(n) for j in range(k + 1)][:n])


@lru_cache
def _products(n: int) -> Bool[np.ndarray, "n n n"]:
    """Return an array whose entry [i, j, k] is true if monomial i times monomial j is monomial k."""
    powers = _exponents(n)[:, None] + _exponents(n)
    degree = powers.sum(axis=-1)
    return (degree * (degree + 1) // 2 + powers[..., 1])[..., None] == np.arange(n)
