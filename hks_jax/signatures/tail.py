"""What lies beyond the last eigenpair: the share of a signature that a truncated sum leaves out, by Weyl's law."""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real
from scipy.special import gammainccinv

from hks_jax.checks import checked_times
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.nan_outside import nan_is_meant
from hks_jax.signatures.filters import Derivative, Heat
from hks_jax.signatures.spectral import spectral_diagonal
from hks_jax.signatures.times import require_pairs

_LEAST_EXPONENT, _GREATEST_EXPONENT = 0.5, 8.0
"""Between a strip, which is a line to all eigenfunctions that were computed, and a corner of Dirichlet sides in 3D."""
_POINTS, _WEIGHTS = np.polynomial.laguerre.laggauss(24)
"""Gauss and Laguerre's quadrature, of f(u) e^(−u) from 0 to ∞."""


# If N(λ) = N(Λ) (λ/Λ)^a, what lies beyond Λ is
#
#     ∫_Λ^∞ e^(−λt) dN = N(Λ) a (Λt)^(−a) ∫_Λt^∞ e^(−y) y^(a−1) dy = N(Λ) (a/x) e^(−x) ∫_0^∞ (1 + u/x)^(a−1) e^(−u) du
#
# with x = Λt and y = x + u. The incomplete gamma function, which is the integral in the middle, takes JAX ten times as
# long to compile, and thirty times as long to compute.
def beyond(count: Float[Array, "..."], exponent: Float[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return ∫ e^(−λt) dN over λ > Λ, with N(λ) = count · (λ/Λ)^exponent and x = Λt.

    To 1e-3 from x = 0.1 on, to 1e-7 from x = 1 on, for exponents from ½ to 8; x below 1e-3 counts as that.
    """
    x = jnp.maximum(x, 1e-3)  # nothing overflows
    count, exponent = (jnp.expand_dims(each, tuple(range(x.ndim - each.ndim))) for each in (count, exponent))

    def add(total: Array, node: tuple[Array, ...]) -> tuple[Array, None]:
        point, weight = node
        return total + weight * jnp.exp((exponent - 1) * jnp.log1p(point / x)), None

    nodes = tuple(jnp.asarray(each, x.dtype) for each in (_POINTS, _WEIGHTS))
    integral, _ = jax.lax.scan(add, jnp.zeros(jnp.broadcast_shapes(x.shape, exponent.shape), x.dtype), nodes)
    return count * exponent / x * jnp.exp(-x) * integral


# For a = 1 the integral is 1, for a = 3/2, by parts, 1 + (√π/2) erfc(√x) e^x/√x.
def beyond_by_weyl(count: Float[Array, ""], dimension: int, x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return `beyond` for Weyl's exponent d/2, d = 2 or 3."""
    if dimension == 2:
        return count * jnp.exp(-x) / x
    return 1.5 * count * (jnp.exp(-x) + math.sqrt(math.pi) / 2 * erfc(jnp.sqrt(x)) / jnp.sqrt(x)) / x


def resolving(share: float, dimension: int) -> float:
    """Return the Λt from which on no more than this share of the heat trace lies beyond Λ, by Weyl's law."""
    return float(gammainccinv(dimension / 2, share))


@nan_is_meant
def truncation_map(
    pairs: Eigenpairs, times: Sequence[float] | Real[ArrayLike, " n_times"]
) -> Float[Array, "n_times *shape"]:
    """Estimate, node by node, what part of the heat kernel signature lies beyond the k pairs.

    `truncation` estimates the mean over the domain; beside a Dirichlet side, in its corners, or where the tensors vary
    from node to node, a single node can lack several times as much. Here Weyl's law is local: the function
    N(λ, x) = Σ φᵢ(x)² over λᵢ < λ is taken for N(Λ, x) (λ/Λ)^a(x), Λ the first eigenvalue beyond the k. The constant
    N(Λ, x) and the exponent a(x) come from the pairs, the latter from the mean of λ at the node, which is Λ a/(a + 1):
    about d/2 inside and at natural sides, d/2 + 1 at a Dirichlet side.

    An estimate, not a bound. Against all pairs of small grids (2D and 3D, flat, smooth and rough tensors, every
    boundary, from 28 pairs to a third of all) the largest share of a node was 0.25 to 2 times the largest estimate
    where the mean was above 0.1 %, and up to 3 times at a mean of 1e-6. Where the mean was 1 % the largest share was
    1.1 to 6 times that without Dirichlet sides, and 3 to 20 times beside them.

    Args:
        pairs: from `eigenpairs`.
        times: (n_times,) positive, in (metric length)².

    Returns:
        (n_times, *shape), 0 … 1, relative to what all pairs would give; NaN outside the mask, 0 at Dirichlet nodes and
        where all pairs were computed. Constant to derivatives.

    Raises:
        ValueError: times that are not positive and finite; pairs in an interval.
    """
    dtype = require_pairs(pairs).eigenvalues.dtype
    if not pairs.lowest:
        raise ValueError("pairs: these lie in an interval; the error is estimated of the lowest eigenpairs")
    return _map(*jax.lax.stop_gradient((pairs, checked_times("times", times, dtype))))


@jax.jit
def _map(pairs: Eigenpairs, at: Float[Array, " n"]) -> Float[Array, "n *shape"]:
    dtype, bottom = at.dtype, pairs.spectral_origin
    moved = pairs.eigenvalues - bottom, pairs.next_eigenvalue - bottom
    pairs = eqx.tree_at(lambda p: (p.eigenvalues, p.next_eigenvalue), pairs, moved)
    complete, axes = jnp.isinf(pairs.next_eigenvalue), (1,) * len(pairs.space.node_shape)
    following = jnp.where(complete, 1, pairs.next_eigenvalue)
    at_zero = jnp.zeros(1, dtype)
    count = spectral_diagonal(pairs, Heat(at_zero))[0]
    # The derivative of exp(−λt) by t at 0 is −λ.
    moment = -spectral_diagonal(pairs, Derivative(Heat(at_zero), Heat(jnp.ones(1, dtype))))[0]
    mean = moment / jnp.where(count > 0, count * following, 1)
    exponent = jnp.clip(mean / jnp.maximum(1 - mean, 1e-3), _LEAST_EXPONENT, _GREATEST_EXPONENT)
    left = beyond(count, exponent, following * at.reshape(-1, *axes))
    kept = spectral_diagonal(pairs, Heat(at))
    share = left / jnp.where(count > 0, left + kept, 1)
    return jnp.where(complete & ~jnp.isnan(share), 0, share)
