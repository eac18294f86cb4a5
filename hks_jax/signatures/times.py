"""Properties of eigenpairs that signatures need, and the default times and energies of Sun et al. and Aubry et al."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.checks import checked_times
from hks_jax.compilation import numpy_where_known
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.traced import is_traced


def require_pairs(pairs: Eigenpairs) -> Eigenpairs:
    """Return the pairs; raise TypeError or ValueError unless they are eigenpairs of one domain."""
    if not isinstance(pairs, Eigenpairs):
        raise TypeError(f"pairs: got {type(pairs).__name__}; expected the result of `eigenpairs`")
    if pairs.eigenvalues.ndim != 1:
        raise ValueError(
            f"pairs: got a batch with eigenvalues of shape {pairs.eigenvalues.shape}; expected (k,). Use jax.vmap"
        )
    return pairs


def times_of(pairs: Eigenpairs, times: Any) -> Float[Array, " n"]:
    """Return times as an array with the dtype of the pairs; raise TypeError or ValueError if they are invalid."""
    return checked_times(times, require_pairs(pairs).eigenvalues.dtype)


def dimension_of(pairs: Eigenpairs, purpose: str) -> int:
    """Return the dimension of the manifold; raise ValueError if it is not known."""
    return _stated(pairs.space.dimension, "dimension", "manifold", purpose)


def volume_of(pairs: Eigenpairs, purpose: str) -> Float[Array, ""]:
    """Return the area or volume of the domain; raise ValueError if it is not known."""
    return _stated(pairs.pencil.volume, "volume", "domain", purpose)


def _stated(value: Any, name: str, of: str, purpose: str) -> Any:
    if value is None:
        raise ValueError(
            f"pairs: got matrices without the {name} of the {of}, which {purpose} needs. Use `sparse_pencil(K, M, "
            f"{name}=…)`"
        )
    return value


def positive_range(pairs: Eigenpairs) -> tuple[Array, Array]:
    """Return the first positive and the last eigenvalue.

    A multiple eigenvalue is returned as the mean over its multiplet, which is differentiable.

    Raises:
        ValueError: if no eigenvalue can be positive.
    """
    if _n_positive(require_pairs(pairs)) < 1:
        raise ValueError(
            f"pairs: got {pairs.k} eigenvalues, none positive (each Neumann component has a zero). Compute more "
            "eigenpairs"
        )
    return _ends(pairs.eigenvalues, pairs.kept, pairs.multiplet_tolerance)


@numpy_where_known()
def _ends(xp: Any, values: Any, kept: Any, tolerance: Any) -> tuple[Any, Any]:
    def mean_of_copies(value: Any) -> Any:
        copies = kept & (xp.abs(values - value) <= tolerance * value)
        return xp.sum(xp.where(copies, values, 0)) / xp.sum(copies, dtype=values.dtype)

    return mean_of_copies(values[xp.argmax(values > 0)]), mean_of_copies(values[xp.sum(kept) - 1])


def _n_positive(pairs: Eigenpairs) -> int:
    """Return the number of kept eigenvalues that are positive, or an upper bound for traced values."""
    values, kept = jax.lax.stop_gradient((pairs.eigenvalues, pairs.kept))
    if not is_traced((values, kept)):
        return int((kept & (values > 0)).sum())
    return pairs.k - pairs.n_null if pairs.null_space_known else pairs.k


def default_times(pairs: Eigenpairs, n: int = 16, decay: float = 1e-4) -> Float[Array, " n"]:
    """Return n times, log-spaced from 4 ln10/λ_last to 4 ln10/λ₁ (Sun, Ovsjanikov and Guibas 2009, section 5).

    At the first time the last mode has decayed by the factor 1e-4. At the last, which is not before the first, all
    modes except the constant have decayed by `decay`. The command line uses 0.085, at
    which √t is half the length of an interval with the same λ₁.

    Examples:
        >>> times = hj.default_times(pairs, 3)
        >>> print((times[0] * pairs.eigenvalues[-1]).round(2), (times[-1] * pairs.eigenvalues[1]).round(2))  # 4 ln 10
        9.21 9.21
    """
    if n < 1:
        raise ValueError(f"n: got {n}; expected at least 1")
    if not 0 < decay < 1:
        raise ValueError(f"decay: got {decay}; expected a number between 0 and 1")
    first, last = positive_range(pairs)
    end = jnp.minimum(last, first * (math.log(1e-4) / math.log(decay)))
    return 4 * jnp.log(10.0).astype(first.dtype) / jnp.geomspace(last, end, n)


def default_energies(pairs: Eigenpairs, n: int = 100) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Return n energies and the width σ of the wave kernel signature (Aubry, Schlickewei and Cremers 2011).

    Here σ = 7 (log λ_last − log λ₁)/n. The energies run from log λ₁ + 2σ to log λ_last − 2σ.

    Examples:
        >>> energies, sigma = hj.default_energies(pairs)
        >>> print(jnp.isclose(energies[0], jnp.log(pairs.eigenvalues[1]) + 2 * sigma))
        True
    """
    if n < 29:
        raise ValueError(f"n: got {n}; expected at least 29, so that the range of energies exceeds 4σ")
    if _n_positive(pairs) < 2:
        raise ValueError(
            f"pairs: got {_n_positive(pairs)} positive eigenvalue(s); expected at least two, from more eigenpairs"
        )
    first, last = (jnp.log(value) for value in positive_range(pairs))
    sigma = 7 * (last - first) / n
    return jnp.linspace(first + 2 * sigma, last - 2 * sigma, n), sigma
