"""Spectral distances and embeddings, and the geodesic distance by Varadhan's formula."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import nan_is_meant, nan_outside
from hks_jax.eigen.eigenpairs import Eigenpairs, require_pairs
from hks_jax.fem.space import FunctionSpace, VectorSpace
from hks_jax.signatures.filters import Filter, Heat, Power
from hks_jax.signatures.spectral_functions import (
    source_indices,
    spectral_columns,
    spectral_diagonal,
    spectral_squared_distances,
)
from hks_jax.signatures.times import dimension_of, positive_range, volume_of
from hks_jax.signatures.truncation import TAIL_LIMIT, resolved_times, share_of_inverse_squares, truncated_share
from hks_jax.traced import is_traced


def diffusion_distance(pairs: Eigenpairs, times: Any, sources: Any) -> Float[Array, "n_times n_sources *shape"]:
    """Compute the diffusion distance d_t(x_s, x)² = Σᵢ exp(−2λᵢt) (φᵢ(x_s) − φᵢ(x))² (Coifman and Lafon 2006).

    The unit is 1/(metric length)^(d/2). The result is NaN outside the mask.

    Args:
        times: (n_times,) positive.
        sources: node indices (n_sources, d), or (d,) for one source; vertex numbers on a mesh.

    Examples:
        >>> k = hj.heat_kernel(pairs, [0.4], [(0, 0), (8, 8)])[0]
        >>> d = hj.diffusion_distance(pairs, [0.2], (0, 0))[0, 0, 8, 8]
        >>> print(jnp.isclose(d**2, k[0, 0, 0] - 2 * k[0, 8, 8] + k[1, 8, 8]))
        True
    """
    return _distance(pairs, Heat(2 * resolved_times(pairs, times, 2)), sources)


@nan_is_meant
def biharmonic_distance(pairs: Eigenpairs, sources: Any) -> Float[Array, "n_sources *shape"]:
    """Compute the biharmonic distance d(x_s, x)² = Σᵢ (φᵢ(x_s) − φᵢ(x))² / λᵢ² over λᵢ > 0 (Lipman et al. 2010).

    The unit is (metric length)^(2 − d/2). The result is NaN outside the mask.

    The sum is over the computed pairs, so the result is too small. With 24 pairs on a square of 24 × 24 nodes, the
    median node lacks 1 % of its distance, and nodes beside the source lack 20 to 80 %. In 3D the terms decay slowly:
    with 100 pairs on a cube of 8 × 8 × 8 nodes, the median node lacks 6 %.

    Args:
        sources: node indices (n_sources, d), or (d,) for one source; vertex numbers on a mesh.

    Raises:
        ValueError: if a source is outside the domain, if the domain is not connected, or if no eigenvalue is positive.

    Warns:
        AccuracyWarning: if the mean over the domain of the squared distance lacks more than 1 %, by Weyl's law. No
            warning is issued if values are traced, or if the dimension of the manifold is not known.

    Examples:
        >>> d = hj.biharmonic_distance(hj.eigenpairs(field, k=25), [(0, 0), (8, 8)])
        >>> print(d[0, 0, 0], jnp.isclose(d[0, 8, 8], d[1, 0, 0]))  # to itself; there and back
        0.0 True
    """
    require_pairs(pairs)
    known = pairs.null_space_known or not is_traced(jax.lax.stop_gradient(pairs.eigenvalues))
    count = pairs.n_null if known else 0
    if isinstance(pairs.space, VectorSpace):
        raise ValueError("pairs: got eigenpairs of vector-valued functions; the biharmonic distance needs scalar ones")
    if count and (components := max(count, pairs.space.n_components)) > 1:  # some may have Dirichlet nodes
        raise ValueError(
            f"pairs: got eigenpairs of {components} components, between which the biharmonic distance is infinite; "
            "expected one component. Compute the eigenpairs of each component separately"
        )
    positive_range(pairs)
    _warn_of_truncation(jax.lax.stop_gradient(pairs))
    return _distance(pairs, Power(jnp.full(1, -2.0, pairs.eigenvalues.dtype)), sources)[0]


# The mean of (φᵢ(x) − φᵢ(y))² over x and y is 2/volume for each i, so the mean of the squared distance is proportional
# to the sum of all 1/λᵢ².
def _warn_of_truncation(pairs: Eigenpairs) -> None:
    if is_traced((pairs.eigenvalues, pairs.kept, pairs.next_eigenvalue)) or pairs.space.dimension is None:
        return
    if (left := share_of_inverse_squares(pairs)) > TAIL_LIMIT:
        warn_of_accuracy(
            f"pairs: got {int(np.asarray(pairs.kept).sum())}; on average over the domain, an estimated {left:.1%} of "
            "the squared biharmonic distance lies beyond them (several times as much near a source). Use more "
            "eigenpairs"
        )


def _distance(pairs: Eigenpairs, filters: Filter, sources: Any) -> Float[Array, "m s *shape"]:
    squared = spectral_squared_distances(pairs, filters, source_indices(pairs, sources))
    # The square root is not differentiable at zero. Zero distances are set to the constant 0 with derivative 0.
    root = jnp.sqrt(jnp.where(squared == 0, 1, squared))
    return nan_outside(jnp.where(squared == 0, 0, root), pairs.space.domain)


def shape_dna(pairs: Eigenpairs, normalise: bool = True) -> Float[Array, " k"]:
    """Return the scale-invariant λᵢ·volume^(2/d) (Reuter et al. 2006), or NaN where ``pairs.kept`` is false.

    Examples:
        >>> nine = hj.eigenpairs(hj.TensorField(field.grid, 9 * field.tensors), k=12)
        >>> np.allclose(hj.shape_dna(nine), hj.shape_dna(pairs), atol=1e-2)
        True
    """
    values = require_pairs(pairs).eigenvalues
    if normalise:
        dimension = dimension_of(pairs, "normalised ShapeDNA")
        values = values * volume_of(pairs, "normalised ShapeDNA") ** (2 / dimension)
    # NaN is inserted last because the product 0·NaN would otherwise enter the derivative of the volume.
    return nan_outside(values, pairs.kept)


def global_point_signature(pairs: Eigenpairs) -> Float[Array, "m *shape"]:
    """Return φᵢ(x)/√λᵢ for the positive λᵢ (Rustamov 2007), or NaN where ``pairs.kept`` is false.

    The signs of the φᵢ and the bases of multiple eigenvalues' eigenspaces are arbitrary.

    Examples:
        >>> u = hj.global_point_signature(pairs)[0].ravel()
        >>> print((u @ (pairs.pencil.stiffness @ u)).round(3))  # ∫ |∇φ|²/λ
        1.0
    """
    positive_range(pairs)
    n = pairs.n_null  # raises an error if the null space is not known
    if not pairs.null_space_known:  # negative eigenvalues come first
        n = int((jax.lax.stop_gradient(pairs.eigenvalues) <= 0).sum())
    scaled = pairs.at_nodes[n:] / jnp.sqrt(jnp.where(pairs.kept, pairs.eigenvalues, 1)[n:, None])
    return pairs.space.extend(nan_outside(scaled, pairs.kept[n:, None]))


MARGIN = 10.0
"""The least accepted ratio of a kernel to its truncation error, at which the kernel's logarithm has an error of 0.1."""
GRID_LIMIT = 0.1
"""The largest accepted relative error of a squared distance due to the grid spacing."""


def varadhan_distance(
    pairs: Eigenpairs, times: Any, sources: Any, normalised: bool = True
) -> Float[Array, "n_times n_sources *shape"]:
    """Estimate the geodesic distance by Varadhan's formula: d(x_s, x)² is the limit of −4t log k_t(x_s, x) as t → 0.

    See Varadhan 1967 and Zobel, Reininghaus and Hotz, section 2. At a time t > 0 the kernel in n dimensions is
    (4πt)^(−n/2) exp(−d²/4t) (u₀ + O(t)), where the function u₀ is 1 on a flat domain away from its boundary. Division
    by the diagonal, k_t(x_s, x)/√(k_t(x_s, x_s) k_t(x, x)), removes the power of t. The normalised kernel estimates d²
    with the error −4t log u₀ + O(t²). The kernel without normalisation adds 2nt log 4πt to the error of d².

    Small times need fine grids and many pairs: with linear elements of node spacing h, d² has the relative error
    h²d²/48t², and exp(−d²/4t) must exceed the truncation and rounding errors. The result is NaN where the estimated
    relative error of the kernel or the grid's relative error of d² exceeds 0.1, outside the mask, and at Dirichlet
    nodes. Larger times resolve larger distances, but with larger errors.

    Args:
        pairs: the result of `eigenpairs`; more pairs resolve larger distances. Geodesics stay in the domain: they go
            around holes and across periodic sides. Under ``"mirror"`` and ``"mean"`` straight sides have no effect if
            the metric is flat.
        times: (n_times,) positive, in (metric length)²; a time near d·h suits distances d on a grid of node spacing h.
        sources: node indices (n_sources, d), or (d,) for one source; vertex numbers (n_sources,) on a mesh.
        normalised: whether to divide by the diagonal. The unnormalised result depends on the unit of length, and is NaN
            where the kernel exceeds 1.

    Raises:
        ValueError: if times are invalid or if a source is out of range, outside the mask or at a Dirichlet node.

    Warns:
        AccuracyWarning: if distances are NaN, with the cause, or if times are too small for k or for the grid.

    Examples:
        >>> flat = hj.TensorField(field.grid, np.tile(np.eye(2), (9, 9, 1, 1)))
        >>> mirrored = hj.eigenpairs(flat, k=25, boundary="mirror")
        >>> print(hj.varadhan_distance(mirrored, [0.1], (4, 4))[0, 0, 6, 4:7].round(2))  # 1/4, √5/8, √2/4
        [0.25 0.28 0.35]
    """
    times = resolved_times(pairs, times)
    nodes, space = source_indices(pairs, sources), pairs.space
    if not space.free.ravel()[nodes].all():
        raise ValueError("sources: got a node on a Dirichlet boundary, where the kernel is 0; expected inner nodes")

    # Values outside the mask are 0, because NaN would enter the derivatives as the product 0·NaN.
    kernel = jnp.where(space.domain, spectral_columns(pairs, Heat(times), nodes), 0)
    diagonal = jnp.where(space.domain, spectral_diagonal(pairs, Heat(times)), 0)
    scale = _broadcast(diagonal.reshape(times.size, -1)[:, nodes], space) * diagonal[:, None]
    relative = kernel / jnp.sqrt(jnp.where(scale > 0, scale, 1))

    by_pairs, by_grid = _least_kernels(pairs, times, nodes)
    _warn_of_distance(pairs, times, nodes, relative, by_pairs, by_grid)
    defined = relative > jnp.maximum(by_pairs, by_grid)
    if normalised:
        # At distance zero, rounding may change the kernel, and √ has no derivative, so the distance is set to zero.
        numbers = np.arange(space.domain.size).reshape(1, *space.node_shape)
        zero = (relative >= 1) | (numbers == _broadcast(nodes, space))[None]
    else:
        relative, zero = kernel, kernel == 1
        defined &= kernel <= 1
    ratio = jnp.where(defined & ~zero, relative, jnp.exp(-1.0))
    distance = jnp.sqrt(-4 * _broadcast(times[:, None], space) * jnp.log(ratio))
    return nan_outside(jnp.where(zero, 0, distance), defined)


def _broadcast(values: Any, space: FunctionSpace) -> Any:
    """Append an axis of length one for each axis of the nodes to values that belong to sources or times."""
    return values.reshape(*values.shape, *[1] * len(space.node_shape))


# By the Cauchy–Schwarz inequality the error of the normalised kernel is about as large as the relative error of the
# kernel's diagonal, which is about the truncated share of the heat trace plus the mean residual with weights exp(−λᵢt).
#
# On an axis with the node spacing h, linear elements give a wave of frequency ξ the eigenvalue λ = ξ² (1 + ξ²h²/12) and
# the mass m = 1 − ξ²h²/6. In the kernel ∫ exp(iξd − tλ)/m dξ at the distance d, the means of powers of ξ are ⟨ξ²⟩ = (2t
# − d²)/4t² and ⟨ξ⁴⟩ = (d⁴ − 12td² + 12t²)/16t⁴. To first order in h² the estimate of d² has the error d²h² (d² −
# 4t)/48t², or −d²h² (d² − 12t)/48t² with a lumped mass. Where d² is several times t, and the error matters, the
# relative error is about d²h²/48t², or (h²/12t) log(1/k) if d² is 4t log(1/k) with the normalised kernel k.
def _least_kernels(
    pairs: Eigenpairs, times: Float[Array, " m"], nodes: Int[np.ndarray, " s"]
) -> tuple[Float[Array, "m 1 *ones"], Float[Array, "m s *shape"]]:
    """Return the least values of the normalised kernel that the eigenpairs resolve, and that the grid resolves."""
    pairs, times = jax.lax.stop_gradient((pairs, times))
    space, resolution = pairs.space, pairs.pencil.resolution
    if resolution is None:
        raise ValueError("pairs: got eigenpairs of unknown node spacing; expected a grid or linear elements")
    weights = jnp.where(pairs.kept[None], jnp.exp(-times[:, None] * pairs.eigenvalues[None]), 0)
    residuals = jnp.sum(weights * jnp.where(pairs.kept, pairs.residuals, 0)[None], axis=1) / jnp.sum(weights, axis=1)
    error = MARGIN * truncated_share(pairs, times)[0] + residuals + 100 * jnp.finfo(times.dtype).eps
    at_nodes = jnp.where(space.free, jnp.square(resolution.mesh_width), 0)
    # The spacing along a geodesic is replaced by the larger of the mean spacing and the spacing at the geodesic's ends.
    along = jnp.maximum(
        jnp.maximum(at_nodes[None], _broadcast(at_nodes.ravel()[nodes], space)), jnp.sum(at_nodes) / space.n_dof
    )
    by_grid = jnp.exp(-12 * GRID_LIMIT * _broadcast(times[:, None], space) / along[None])
    return _broadcast(error[:, None], space), by_grid


def _warn_of_distance(
    pairs: Eigenpairs,
    times: Float[Array, " m"],
    nodes: Int[np.ndarray, " s"],
    relative: Array,
    by_pairs: Array,
    by_grid: Array,
) -> None:
    times, relative, by_pairs, by_grid = jax.lax.stop_gradient((times, relative, by_pairs, by_grid))
    if is_traced((times, relative, by_pairs, by_grid)):
        return
    free, labels = pairs.space.free, pairs.space.labels
    connected = labels[free] == labels.ravel()[nodes][:, None]
    if apart := int((~connected).sum()):
        warn_of_accuracy(
            f"sources: {apart / connected.size:.1%} of the distances are NaN, because source and node are in different "
            "components of the domain, between which the distance is infinite"
        )
    too_small = ~np.asarray(relative > by_pairs)[..., free][:, connected]
    far = too_small | ~np.asarray(relative > by_grid)[..., free][:, connected]
    if far.any():
        worst = int(np.argmax(far.mean(axis=1)))
        remedy = "more eigenpairs (in float64)" if 2 * too_small.sum() >= far.sum() else "a finer grid"
        warn_of_accuracy(
            f"times: {far.mean():.1%} of the distances are NaN ({far[worst].mean():.1%} at t = "
            f"{float(times[worst]):.4g}), because the heat kernel is not resolved between nodes so far apart. Use "
            f"larger times or {remedy}"
        )
