"""Spectral distances and embeddings."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.spectral import source_indices, spectral_columns, spectral_diagonal
from hks_jax.signatures.times import checked_times, positive_range


def diffusion_distance(pairs: Eigenpairs, times: Any, sources: Any) -> Float[Array, "n_times n_sources *shape"]:
    """Compute the diffusion distance d_t(x_s, x)² = Σᵢ exp(−2λᵢt) (φᵢ(x_s) − φᵢ(x))² (Coifman and Lafon 2006).

    Args:
        pairs: from `eigenpairs`.
        times: (n_times,) positive.
        sources: node indices (n_sources, d), or (d,) for one; on a mesh vertex numbers.

    Returns:
        (n_times, n_sources, *shape) in 1/(metric length)^(d/2); NaN outside the mask.
    """
    times = checked_times("times", times, pairs.eigenvalues.dtype)
    return _distance(pairs, jnp.exp(-2 * times[:, None] * pairs.eigenvalues), sources)


def biharmonic_distance(pairs: Eigenpairs, sources: Any) -> Float[Array, "n_sources *shape"]:
    """Compute the biharmonic distance d(x_s, x)² = Σᵢ (φᵢ(x_s) − φᵢ(x))² / λᵢ² over λᵢ > 0 (Lipman et al. 2010).

    Args:
        pairs: from `eigenpairs`.
        sources: node indices (n_sources, d), or (d,) for one; on a mesh vertex numbers.

    Returns:
        (n_sources, *shape) in (metric length)^(2 − d/2); NaN outside the mask.
    """
    positive_range(pairs)
    positive = jnp.arange(pairs.k) >= pairs.n_null
    values = jnp.where(positive, pairs.eigenvalues, 1)
    return _distance(pairs, jnp.where(positive, values**-2, 0)[None], sources)[0]


def _distance(pairs: Eigenpairs, filters: Float[Array, "m k"], sources: Any) -> Float[Array, "m s *shape"]:
    nodes = source_indices(pairs, sources)
    columns = spectral_columns(pairs, filters, nodes)
    here = spectral_diagonal(pairs, filters)
    there = here.reshape(here.shape[0], pairs.space.free.size)[:, nodes]
    squared = here[:, None] + there.reshape(*there.shape, *[1] * (here.ndim - 1)) - 2 * columns
    # The root has no derivative at distance zero; there the distance is set, with derivative zero.
    positive = squared > 0
    root = jnp.sqrt(jnp.where(positive, squared, 1))
    return jnp.where(jnp.isnan(squared), jnp.nan, jnp.where(positive, root, 0))


def shape_dna(pairs: Eigenpairs, normalise: bool = True) -> Float[Array, " k"]:
    """Return the eigenvalues times volume^(2/d), which scaling the metric does not change (Reuter et al. 2006)."""
    if not normalise:
        return pairs.eigenvalues
    return pairs.eigenvalues * pairs.pencil.volume ** (2 / pairs.space.dimension)


def global_point_signature(pairs: Eigenpairs) -> Float[Array, "m *shape"]:
    """Return φᵢ(x)/√λᵢ for the positive λᵢ (Rustamov 2007); signs, and bases of multiple eigenvalues, are arbitrary."""
    positive_range(pairs)
    n = pairs.n_null
    return pairs.space.extend(pairs.vectors[n:] / jnp.sqrt(pairs.eigenvalues[n:, None]))
