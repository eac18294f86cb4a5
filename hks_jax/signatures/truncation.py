"""What a truncated spectrum on a grid of finite spacing can resolve, time by time."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.operators import DiagonalOperator
from hks_jax.signatures.filters import Heat
from hks_jax.signatures.spectral import spectral_trace
from hks_jax.signatures.times import checked_times, require_pairs
from hks_jax.traced import is_traced

TAIL_LIMIT = 0.01
BIAS_LIMIT = 0.1

_BIAS = {"consistent": 0.06, "lumped": 0.44}
"""c in the relative bias c·h²/t of Q1 elements, the upper end of what is measured."""


class Truncation(eqx.Module):
    """Error estimates for heat kernel signatures at given times: a diagnostic, constant to derivatives.

    Attributes:
        times: (n,).
        tail: (n,) the part of the heat trace that lies beyond the k pairs, relative, by Weyl's law.
        resolution_bias: (n,) the relative bias c·h²/t at the median node, h its distance to its neighbours.
        coarse_fraction: (n,) the fraction of nodes where that bias exceeds 10 %.
        smallest_time: the least time that the k pairs resolve to 1 %.
    """

    times: Float[Array, " n"]
    tail: Float[Array, " n"]
    resolution_bias: Float[Array, " n"]
    coarse_fraction: Float[Array, " n"]
    smallest_time: Float[Array, ""]

    def messages(self) -> list[str]:
        """Say in sentences which times are under-resolved; empty if none is. Needs concrete values."""
        times, found = np.asarray(self.times), []
        smallest = f"t = {times.min():.4g}"
        tail, bias = np.asarray(self.tail), np.asarray(self.resolution_bias)
        if (tail > TAIL_LIMIT).any():
            found.append(
                f"{int((tail > TAIL_LIMIT).sum())} of {times.size} times are too small for k: an estimated "
                f"{tail.max():.1%} of the signature at {smallest} lies beyond the computed eigenpairs. Use times from "
                f"about {float(self.smallest_time):.4g}, or more eigenpairs"
            )
        if (bias > BIAS_LIMIT).any():
            found.append(
                f"{int((bias > BIAS_LIMIT).sum())} of {times.size} times are too small for the grid: the "
                f"discretisation biases the signature at {smallest} by about {bias.max():.1%} at half of the nodes. "
                f"Use times from about {times.min() * bias.max() / BIAS_LIMIT:.4g}, or a finer grid"
            )
        return found


def truncation(pairs: Eigenpairs, times: Float[Array, " n"]) -> Truncation:
    """Estimate what k pairs and the node spacing leave out of the signature at each time.

    With Weyl's law N(λ) = k (λ/Λ)^(d/2), whose constant is taken from the spectrum itself (Λ is the first eigenvalue
    beyond the k), the trace beyond Λ is k Γ(d/2 + 1) (Λt)^(−d/2) Q(d/2, Λt), Q the regularised upper incomplete gamma
    function.
    """
    dtype = require_pairs(pairs).eigenvalues.dtype
    pairs, times = jax.lax.stop_gradient((pairs, checked_times("times", times, dtype)))
    half_d, complete = pairs.space.dimension / 2, jnp.isinf(pairs.next_eigenvalue)
    following = jnp.where(complete, 1, pairs.next_eigenvalue)
    x = following * times
    beyond = jnp.sum(pairs.kept) * math.gamma(half_d + 1) * x**-half_d * gammaincc(half_d, x)
    kept = spectral_trace(pairs, Heat(times))
    tail = jnp.where(complete, 0, beyond / (beyond + kept))
    lumped = isinstance(pairs.pencil.parts[0].mass, DiagonalOperator)
    bias = _BIAS["lumped" if lumped else "consistent"] * jnp.square(pairs.pencil.mesh_width) / times[:, None]
    coarse = jnp.mean(bias > BIAS_LIMIT, axis=1)
    # Q(d/2, x) falls to 1 % at x = 4.6 (d = 2) and 5.7 (d = 3).
    smallest = jnp.where(complete, 0, (4.6 if pairs.space.dimension == 2 else 5.7) / following)
    return Truncation(times, tail, jnp.median(bias, axis=1), coarse, smallest)


def warn_if_truncated(pairs: Eigenpairs, times: Float[Array, " n"]) -> None:
    """Warn (AccuracyWarning) of times that k or the spacing does not resolve, where values are concrete."""
    pairs, times = jax.lax.stop_gradient((pairs, times))
    if is_traced((pairs.eigenvalues, pairs.pencil, times)):
        return
    for message in truncation(pairs, times).messages():
        warn_of_accuracy(message)
