"""Significance of numbers with estimated standard deviations: normal scores, and the false discovery rate."""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.special import betainc, ndtr, ndtri
from jax.scipy.stats import norm, t
from jaxtyping import Array, Bool, Float


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def normal_score(x: Float[Array, "..."], freedom: float) -> Float[Array, "..."]:
    """Map numbers with Student's distribution monotonically to numbers with the standard normal distribution.

    Both numbers have the same probability of being exceeded. Because this probability is at least the smallest normal
    number of the dtype, the result is at most 37 in float64 and 13 in float32, unless the freedom is infinite.
    """
    if math.isinf(freedom):
        return x
    tail = betainc(0.5 * freedom, 0.5 * jnp.ones_like(x), freedom / (freedom + x**2)) / 2
    return -jnp.sign(x) * ndtri(jnp.maximum(tail, jnp.finfo(x.dtype).tiny))


# The probabilities F(x) and Φ(z) are equal, so dz/dx is the ratio of the densities at x and z.
@normal_score.defjvp
def _normal_score_jvp(
    freedom: float, primals: tuple[Float[Array, "..."]], tangents: tuple[Float[Array, "..."]]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    (x,), (change,) = primals, tangents
    z = normal_score(x, freedom)
    slope = 1.0 if math.isinf(freedom) else jnp.exp(t.logpdf(x, freedom) - norm.logpdf(z))
    return z, slope * change


# Benjamini and Hochberg (1995): of the m probabilities p in ascending order, find the last one with pᵢ ≤ rate·i/m, and
# declare it and all smaller ones. The rate holds for independent numbers, and for normal numbers with positive
# correlation in one-sided tests (Benjamini and Yekutieli 2001). The noise of maps has positive correlation. The
# correction of Benjamini and Yekutieli for any correlation divides the rate by Σ 1/i, 7 for 500 nodes; in simulations
# of smooth noise it was not needed.
def discoveries(z: Float[Array, "maps n"], rate: float) -> Bool[Array, "maps n"]:
    """Return for each map the numbers that differ from 0 at a false discovery rate; NaN is not counted."""
    p = jnp.where(jnp.isnan(z), jnp.inf, 2 * ndtr(-jnp.abs(z)))
    count = jnp.isfinite(p).sum(axis=1, keepdims=True, dtype=p.dtype)
    ascending, index = jnp.sort(p, axis=1), jnp.arange(1, p.shape[1] + 1, dtype=p.dtype)
    low = ascending <= rate * index[None] / jnp.maximum(count, 1)
    return p <= jnp.where(low, ascending, -1).max(axis=1, keepdims=True, initial=-1)
