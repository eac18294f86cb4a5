"""Default times, from eigenpairs and the influence of the boundary."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.arrays import nan_is_meant
from hks_jax.checks import require_count, require_number
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.rim import half_free
from hks_jax.signatures.times import RESOLVED, dimension_of, positive_range
from hks_jax.signatures.truncation import truncated_share

SHORTEST = 2.0
"""The least ratio of the last to the first default time: nearer times give nearly equal signatures."""


@nan_is_meant
def default_times(pairs: Eigenpairs, n: int = 16, decay: float = 1e-4) -> Float[Array, " n"]:
    """Return n log-spaced times, from the eigenvalues (Sun, Ovsjanikov and Guibas 2009, section 5) and the boundary.

    At the first of the n times, 4 ln10/λ_last, the mode of λ_last has decayed to the fraction 1e-4. The last time is
    the time at which half of the nodes are free of the boundary (`boundary_influence` below 0.1), but at least twice
    the first time: if fewer nodes are free there, more eigenpairs give smaller times. Without a boundary, or if its
    influence is not known, the last time is 4 ln10/λ₁.

    Args:
        n: the number of times.
        decay: the fraction to which all modes except the constant have decayed at the last time, at the latest; smaller
            fractions give larger times.

    Examples:
        >>> times = hj.default_times(pairs, 3)
        >>> print((times[0] * pairs.eigenvalues[-1]).round(2))  # 4 ln 10
        9.21
    """
    require_count("n", n)
    require_number("decay", decay, 1)
    last = positive_range(pairs)[1]
    return _spaced(pairs, 4 * math.log(10.0) / last, -math.log(decay), n)


@nan_is_meant
def resolved_span(pairs: Eigenpairs, n: int) -> Float[Array, " n"]:
    """Return n log-spaced times as `default_times`, from the first time that the eigenpairs resolve.

    At the first time, at most 1 % of the signature is truncated. At the last time, √t is at most a third of the length
    of an interval with the same first positive eigenvalue, but t is at least twice the first time.
    """
    last = positive_range(pairs)[1]
    first = RESOLVED[dimension_of(pairs, "default times")] / last
    return _spaced(pairs, jnp.maximum(first, truncated_share(pairs, first[None])[1]), (math.pi / 3) ** 2, n)


def _spaced(pairs: Eigenpairs, first: Array, product: float, n: int) -> Float[Array, " n"]:
    """Return times from `first` to the end that the boundary, or the given product λ₁t, permits."""
    end = jnp.maximum(first, product / positive_range(pairs)[0])
    free = half_free(pairs, first, end).astype(first.dtype)
    return jnp.geomspace(first, jnp.maximum(jnp.minimum(end, free), SHORTEST * first), n)
