"""The Chebyshev expansion of exp(−tλ) on an interval 0 ≤ λ ≤ top: its coefficients, and to which degree it is needed.

They are e^(−z) Iₙ(z) (twice that for n > 0, with alternating signs), z = t·top/2.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import ive


@partial(jax.jit, static_argnames="degree")
def heat_coefficients(
    times: Float[Array, " m"], top: Float[Array, ""] | float, degree: int
) -> Float[Array, "m {degree}+1"]:
    """Return the coefficients by the cosine transform of samples, whose derivatives JAX knows."""
    samples = degree + 32 + 4 * math.isqrt(degree)  # aliasing brings in coefficients from 2·samples − degree on
    angles = (np.arange(samples) + 0.5) * (np.pi / samples)
    weights = np.cos(np.outer(angles, np.arange(degree + 1))) * (2 / samples)
    weights[:, 0] /= 2
    values = jnp.exp(-times[:, None] * top * jnp.asarray((1 + np.cos(angles)) / 2, times.dtype))
    return jnp.matmul(values, jnp.asarray(weights, times.dtype), precision="highest")


def coefficient_sizes(z: float) -> Float[np.ndarray, " n"]:
    """Return the moduli of the coefficients down to 1e-25."""
    n = np.arange(int(math.sqrt(2 * z * 60) + 60) + 1)
    return np.where(n == 0, 1, 2) * ive(n, z)


def coefficient_tails(z: float) -> Float[np.ndarray, " n_and_1"]:
    """Return the sums of their moduli from each n on, and 0 at the end."""
    return np.append(np.cumsum(coefficient_sizes(z)[::-1])[::-1], 0)


def least_degree(z: float, error: float) -> int:
    """Return the least degree, at least 1, beyond which the coefficients add up to no more than the error."""
    return max(int(np.argmax(coefficient_tails(z) <= error)) - 1, 1)
