"""Spectral distances and embeddings, and the geodesic distance by Varadhan's formula."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import nan_is_meant, nan_outside
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.space import FunctionSpace
from hks_jax.signatures.filters import Filter, Heat, Power
from hks_jax.signatures.spectral_functions import (
    source_indices,
    spectral_columns,
    spectral_diagonal,
    spectral_squared_distances,
)
from hks_jax.signatures.times import dimension_of, positive_range, times_of, volume_of
from hks_jax.signatures.truncation import resolved_times, truncation
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
    return _distance(pairs, Heat(resolved_times(pairs, 2 * times_of(pairs, times))), sources)


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
    scaled = pairs.at_nodes[n:] / jnp.sqrt(jnp.where(pairs.kept, pairs.eigenvalues, 1)[n:, None])
    return pairs.space.extend(nan_outside(scaled, pairs.kept[n:, None]))


MARGIN = 10.0
"""How many times what lies beyond k a kernel must be: its logarithm is then off by at most about 0.1."""
GRID_LIMIT = 0.1
"""The largest relative error of a squared distance that the spacing may cause."""


def varadhan_distance(
    pairs: Eigenpairs, times: Any, sources: Any, normalised: bool = True
) -> Float[Array, "n_times n_sources *shape"]:
    """Estimate the geodesic distance by Varadhan's formula: d(x_s, x)² is the limit of −4t log k_t(x_s, x) as t → 0.

    Varadhan 1967; Zobel, Reininghaus and Hotz, section 2. At a positive t the kernel is (4πt)^(−n/2) exp(−d²/4t)
    (u₀ + O(t)) in n dimensions. Divided by its diagonal, k_t(x_s, x)/√(k_t(x_s, x_s) k_t(x, x)), it has no power of t
    before it: the error of d² is −4t log u₀ + O(t²), none on a flat domain away from its sides. The formula as it
    stands errs by 2nt log 4πt besides.

    Small times need fine grids and many pairs: linear elements with neighbours at the distance h err by d²h²/48t² of
    d², and exp(−d²/4t) must stand out from the part beyond k and from rounding. Where the kernel's estimated error
    exceeds a tenth of it, or the grid's error of d² a tenth, the result is NaN. Larger times reach further, at the cost
    of an error that grows with t.

    Args:
        pairs: from `eigenpairs`; more of them reach further. Distances are those within the domain: around holes of its
            mask, across periodic sides. Under ``"mirror"`` and ``"mean"`` straight sides have no effect.
        times: (n_times,) positive, in (metric length)²; about d·h for distances d.
        sources: node indices (n_sources, d), or (d,) for one; on a mesh vertex numbers (n_sources,).
        normalised: whether to divide by the diagonal. False is the formula as it stands, which depends on the unit of
            length and has no root, NaN, where k_t > 1.

    Returns:
        (n_times, n_sources, *shape) in metric length; if normalised, 0 at the source. NaN outside the mask, at
        Dirichlet nodes, and where times, pairs and grid do not resolve the distance.

    Raises:
        ValueError: bad times; sources out of range, outside the mask or at Dirichlet nodes.

    Warns:
        AccuracyWarning: how many distances are NaN, and what limits them; and as `hks`, times too small for k or
            for the grid.
    """
    times = resolved_times(pairs, times)
    nodes, space = source_indices(pairs, sources), pairs.space
    if not space.free.ravel()[nodes].all():
        raise ValueError("sources: got a node on a Dirichlet boundary, where the heat kernel is zero; choose others")

    # Zero, not NaN, outside the mask: as 0·NaN it would reach the derivatives.
    kernel = jnp.where(space.domain, spectral_columns(pairs, Heat(times), nodes), 0)
    diagonal = jnp.where(space.domain, spectral_diagonal(pairs, Heat(times)), 0)
    scale = _broadcast(diagonal.reshape(times.size, -1)[:, nodes], space) * diagonal[:, None]
    relative = kernel / jnp.sqrt(jnp.where(scale > 0, scale, 1))

    by_pairs, by_grid = _least_kernels(pairs, times, nodes)
    _warn_of_distance(pairs, times, relative, by_pairs, by_grid)
    defined = relative > jnp.maximum(by_pairs, by_grid)
    if normalised:
        # At distance zero the root has no derivative, and rounding may leave the kernel just off 1: there it is set.
        numbers = np.arange(space.domain.size).reshape(1, *space.node_shape)
        zero = (relative >= 1) | (numbers == _broadcast(nodes, space))[None]
    else:
        relative, zero = kernel, kernel == 1
        defined &= kernel <= 1
    ratio = jnp.where(defined & ~zero, relative, jnp.exp(-1.0))
    distance = jnp.sqrt(-4 * _broadcast(times[:, None], space) * jnp.log(ratio))
    return nan_outside(jnp.where(zero, 0, distance), defined)


def _broadcast(values: Any, space: FunctionSpace) -> Any:
    """Give values, one for each source or time, an axis of length one for each of the nodes'."""
    return values.reshape(*values.shape, *[1] * len(space.node_shape))


# What truncation, inexact eigenvectors and rounding leave in the normalised kernel is, by Cauchy and Schwarz, about
# what they leave in the diagonal: the tail's share, and the mean of the residuals, weighted as in the trace.
#
# Linear elements have the eigenvalue ξ² (1 + ξ²h²/12) and the mass 1 − ξ²h²/6 at the frequency ξ along an axis. In the
# kernel ∫ exp(iξd − tλ)/m dξ the means of powers of ξ are ⟨ξ²⟩ = (2t − d²)/4t² and ⟨ξ⁴⟩ = (d⁴ − 12td² + 12t²)/16t⁴: of
# first order in h² the squared distance errs by d²h² (d² − 4t)/48t². Lumped, it is −d²h² (d² − 12t)/48t².
# Where it matters, d² is several t, and it is d²h²/48t² of d²: with d² = 4t log 1/k, h²/12t · log 1/k.
def _least_kernels(
    pairs: Eigenpairs, times: Float[Array, " m"], nodes: Int[np.ndarray, " s"]
) -> tuple[Float[Array, "m 1 *ones"], Float[Array, "m s *shape"]]:
    """Return the least normalised kernel that the pairs resolve, and the least that the grid resolves."""
    pairs, times = jax.lax.stop_gradient((pairs, times))
    space, resolution = pairs.space, pairs.pencil.resolution
    if resolution is None:
        raise ValueError(
            "pairs: the distance needs the spacing of nodes, which is known of grids and linear elements alone"
        )
    weights = jnp.where(pairs.kept[None], jnp.exp(-times[:, None] * pairs.eigenvalues[None]), 0)
    residuals = jnp.sum(weights * jnp.where(pairs.kept, pairs.residuals, 0)[None], axis=1) / jnp.sum(weights, axis=1)
    error = MARGIN * truncation(pairs, times).tail + residuals + 100 * jnp.finfo(times.dtype).eps
    at_nodes = jnp.where(space.free, jnp.square(resolution.mesh_width), 0)
    # The spacing along the way is not known: that at its ends, or the domain's mean if that is larger.
    along = jnp.maximum(
        jnp.maximum(at_nodes[None], _broadcast(at_nodes.ravel()[nodes], space)), jnp.sum(at_nodes) / space.n_dof
    )
    by_grid = jnp.exp(-12 * GRID_LIMIT * _broadcast(times[:, None], space) / along[None])
    return _broadcast(error[:, None], space), by_grid


def _warn_of_distance(
    pairs: Eigenpairs, times: Float[Array, " m"], relative: Array, by_pairs: Array, by_grid: Array
) -> None:
    """Warn (AccuracyWarning) of nodes that are too far, where values are concrete."""
    relative, by_pairs, by_grid = jax.lax.stop_gradient((relative, by_pairs, by_grid))
    if is_traced((relative, by_pairs, by_grid)):
        return
    free = pairs.space.free
    too_small = ~np.asarray(relative > by_pairs)[..., free]
    far = too_small | ~np.asarray(relative > by_grid)[..., free]
    if far.any():
        worst = int(np.argmax(far.mean(axis=(1, 2))))
        remedy = "more eigenpairs (in float64)" if 2 * too_small.sum() >= far.sum() else "a finer grid"
        warn_of_accuracy(
            f"times: {far.mean():.1%} of the distances are NaN, {far[worst].mean():.1%} at t = "
            f"{float(times[worst]):.4g}: so far from a source the heat kernel is not resolved. Use larger times, or "
            f"{remedy}"
        )
