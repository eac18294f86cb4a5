"""Spectral distances and embeddings."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.checks import checked_times
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.nan_outside import nan_is_meant, nan_outside
from hks_jax.signatures.filters import Filter, Heat, Power
from hks_jax.signatures.spectral import source_indices, spectral_squared_distances
from hks_jax.signatures.times import dimension_of, positive_range, require_pairs, volume_of
from hks_jax.signatures.truncation import warn_if_truncated
from hks_jax.traced import is_traced


def diffusion_distance(pairs: Eigenpairs, times: Any, sources: Any) -> Float[Array, "n_times n_sources *shape"]:
    """Compute the diffusion distance d_t(x_s, x)² = Σᵢ exp(−2λᵢt) (φᵢ(x_s) − φᵢ(x))² (Coifman and Lafon 2006).

    Args:
        pairs: from `eigenpairs`.
        times: (n_times,) positive.
        sources: node indices (n_sources, d), or (d,) for one; on a mesh vertex numbers.

    Returns:
        (n_times, n_sources, *shape) in 1/(metric length)^(d/2); NaN outside the mask.
    """
    times = checked_times("times", times, require_pairs(pairs).eigenvalues.dtype)
    warn_if_truncated(pairs, 2 * times)
    return _distance(pairs, Heat(2 * times), sources)


@nan_is_meant
def biharmonic_distance(pairs: Eigenpairs, sources: Any) -> Float[Array, "n_sources *shape"]:
    """Compute the biharmonic distance d(x_s, x)² = Σᵢ (φᵢ(x_s) − φᵢ(x))² / λᵢ² over λᵢ > 0 (Lipman et al. 2010).

    Args:
        pairs: from `eigenpairs`.
        sources: node indices (n_sources, d), or (d,) for one; on a mesh vertex numbers.

    Returns:
        (n_sources, *shape) in (metric length)^(2 − d/2); NaN outside the mask.

    Raises:
        ValueError: sources out of range or outside the mask; a domain of several components; no positive eigenvalue.
    """
    known = pairs.null_space_known or not is_traced(jax.lax.stop_gradient(pairs.eigenvalues))
    if known and pairs.n_null > 1:
        raise ValueError(
            f"pairs: the domain has {pairs.n_null} components, and the biharmonic distance between two of them is "
            "infinite; compute the eigenpairs of one component"
        )
    positive_range(pairs)
    return _distance(pairs, Power(jnp.full(1, -2.0, pairs.eigenvalues.dtype)), sources)[0]


def _distance(pairs: Eigenpairs, filters: Filter, sources: Any) -> Float[Array, "m s *shape"]:
    squared = spectral_squared_distances(pairs, filters, source_indices(pairs, sources))
    # The root has no derivative at distance zero; there the distance is set, with derivative zero.
    root = jnp.sqrt(jnp.where(squared == 0, 1, squared))
    return nan_outside(jnp.where(squared == 0, 0, root), pairs.space.domain)


def shape_dna(pairs: Eigenpairs, normalise: bool = True) -> Float[Array, " k"]:
    """Return the eigenvalues times volume^(2/d), which scaling the metric does not change (Reuter et al. 2006).

    NaN for pairs that are not kept.
    """
    values = pairs.eigenvalues
    if normalise:
        dimension = dimension_of(pairs, "ShapeDNA that is normalised")
        values = values * volume_of(pairs, "ShapeDNA that is normalised") ** (2 / dimension)
    # NaN comes last: as 0·NaN it would reach the volume's derivative.
    return nan_outside(values, pairs.kept)


def global_point_signature(pairs: Eigenpairs) -> Float[Array, "m *shape"]:
    """Return φᵢ(x)/√λᵢ for the positive λᵢ (Rustamov 2007); signs, and bases of multiple eigenvalues, are arbitrary.

    NaN for pairs that are not kept.
    """
    positive_range(pairs)
    n = pairs.n_null  # raises where that is not known
    if not pairs.null_space_known:  # negative ones come first
        n = int((jax.lax.stop_gradient(pairs.eigenvalues) <= 0).sum())
    scaled = pairs.vectors[n:] / jnp.sqrt(jnp.where(pairs.kept, pairs.eigenvalues, 1)[n:, None])
    return pairs.space.extend(nan_outside(scaled, pairs.kept[n:, None]))
