"""How well a grid or a mesh resolves a metric: nodal quantities for estimates of the discretisation error."""

from itertools import combinations
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.compilation import jit_quickly, library_of, numpy_where_known
from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import Interpolation
from hks_jax.fem.space import FunctionSpace, GridSpace, MeshSpace, mask_for


class SampledMetric(eqx.Module):
    """The metric from which a pencil was assembled, for error estimates; derivatives treat it as constant."""

    tensors: Float[Array, "*shape d d"]  # the metric at grid nodes, or on mesh cells in the basis of the cell's edges
    spacing: Float[np.ndarray | Array, " d"] | None  # the spacing of the grid; None on a mesh
    interpolation: Interpolation = eqx.field(static=True, default="linear")
    fick: bool = eqx.field(static=True, default=False)  # whether the operator is Fick's, with D = T⁻¹
    of_space: Float[Array, "n d d"] | None = None  # the metric of space on mesh cells that have another metric


def mean_diffusivity(metric: SampledMetric | None, space: FunctionSpace, dtype: Any) -> Float[Array, ""]:
    """Return the mean of trace(T⁻¹)/d over the domain with the metric T; 1 without a metric or with that of space.

    A plane wave with the wave number ξ has about the eigenvalue of this number times |ξ|².
    """
    if metric is None or (metric.of_space is None and not isinstance(space, GridSpace)):
        return jnp.ones((), dtype)
    tensors = jax.lax.stop_gradient(metric.tensors)
    if metric.of_space is not None:
        return _mean_of_cells(tensors, metric.of_space).astype(dtype)
    return _mean_of_nodes(tensors, mask_for(tensors, space.domain)).astype(dtype)


@numpy_where_known()
def _mean_of_nodes(tensors: Any, domain: Any) -> Any:
    xp = library_of(tensors)
    d = tensors.shape[-1]
    inverse = spd.inverse(xp.where(domain[..., None, None], tensors, xp.eye(d, dtype=tensors.dtype)))
    mean = sum(inverse[..., a, a] for a in range(d)) / d
    return xp.sum(xp.where(domain, mean, 0)) / xp.sum(domain, dtype=tensors.dtype)


# If the edges of a cell are the columns CE of an orthonormal basis E of its plane, the metric T in E has the matrix
# g = CᵀTC in the basis of the edges, and the metric of space has G = CᵀC. So trace(T⁻¹) = trace(Cg⁻¹Cᵀ) = trace(g⁻¹G).
@numpy_where_known()
def _mean_of_cells(tensors: Any, of_space: Any) -> Any:
    """Return the mean of trace(T⁻¹)/d, weighted by the volumes of the cells in space."""
    xp = library_of(tensors)
    trace = (spd.inverse(tensors) * of_space).sum((-2, -1))  # both matrices are symmetric
    return _mean(trace / tensors.shape[-1], xp.sqrt(spd.determinant(of_space)))


class Resolution(eqx.Module):
    """The effect of the spacing on signatures to leading order (see `truncation`); derivatives treat it as constant."""

    mesh_width: Float[Array, "*shape"]  # the distance between neighbouring nodes in the units of the metric
    dispersion: Float[Array, "*shape"]  # the coefficient a (a length²) of the bias (a/t)^order for constant tensors
    of_eigenvalues: Float[Array, "*shape"]  # the part of the bias's coefficient of 1/t that is due to eigenvalues
    turning: Float[Array, "*shape"]  # the relative error of eigenvalues that varying tensors cause
    swelling: Float[Array, ""]  # the relative error of the domain's area or volume
    unevenness: Float[Array, ""]  # the standard deviation over the domain of the relative error of the volume element
    order: int = eqx.field(static=True, default=1, kw_only=True)  # the exponent of a/t: 2 if the leading error cancels


def resolution_of(metric: SampledMetric, space: FunctionSpace, lumped: bool, cancelling: bool) -> Resolution:
    """Return the resolution of the functions of a space, from the spacing of a grid or the edges of a mesh."""
    if isinstance(space, GridSpace):
        domain = mask_for(metric.tensors, space.domain)
        return Resolution(*_of_grid(metric, domain, space.periodic, lumped, cancelling), order=1 + cancelling)
    assert isinstance(space, MeshSpace)
    return _of_mesh(metric.tensors, space.triangulation.cells, space.triangulation.n_vertices, lumped)


# In a nearly constant metric g, a plane wave with the wave vector k has the discrete eigenvalue λ(1 + δ) in place of λ,
# where λδ = Σₐ hₐ² g^aa kₐ⁴/12 for the spacing hₐ along axis a. With the consistent mass, the squared nodal values of
# the wave are too large by the factor 1 + Σₐ hₐ²kₐ²/6. In the signature, the wave vector k is normally distributed with
# covariance g/2t: E kₐ² = gₐₐ/2t and E kₐ⁴ = 3gₐₐ²/4t². The relative error of the signature is
#
#     −t E λδ + E Σₐ hₐ²kₐ²/6 = Σₐ hₐ² (gₐₐ/12 − g^aa gₐₐ²/16)/t.
#
# A lumped mass divides the eigenvalue λ and the squared nodal values of a plane wave by 1 + Σₐ hₐ²kₐ²/6. Since
# E λkₐ² = (d + 2)gₐₐ/4t² in d dimensions, a lumped mass adds d/24 Σₐ hₐ²gₐₐ/t to the relative error of the signature.
# The code has 1/20 in place of 1/24, to include terms of higher order in h²/t at t = 6h².
#
# The part −t E λδ is due to eigenvalues. `truncation` weights this part and the rest by moments of λt, because few
# eigenvalues contribute at large t: beside Dirichlet sides the relative error of the lowest eigenvalue, times t, is
# also the error of the signature.
#
# If the leading error cancels (hks_jax/fem/elements.py) and the metric is diagonal, the error of the eigenvalue is
# λδ = −Σₐ hₐ⁴ g^aa kₐ⁶/240, and the squared nodal values have the factor 1 + (Σₐ hₐ²kₐ²)²/576. Since E kₐ⁶ = 15gₐₐ³/8t³
# for the wave vector k, the relative error of the signature is
#
#     Σₐ hₐ⁴gₐₐ²/128t² + Σₐᵦ hₐ²hᵦ² (gₐₐgᵦᵦ + 2gₐᵦ²)/2304t².
#
# For a metric that is not diagonal, the error is half to twice as large as the formula for a diagonal metric. The error
# of single eigenvalues is of second order: −Σ_{a<b} g^ab kₐkᵦ (hₐ²kₐ² + hᵦ²kᵦ²)/6 cancels only in the mean over the
# heat kernel. Since E kₐ³kᵦ = 3gₐₐgₐᵦ/4t², the sum of its terms' sizes, times t, is Σ_{a<b}
# |g^ab gₐᵦ| (hₐ²gₐₐ + hᵦ²gᵦᵦ)/8t.
def _dispersion(tensors: Any, spacing: Any, lumped: bool, cancelling: bool) -> tuple[Any, Any]:
    """Return the coefficients `Resolution.dispersion` and `Resolution.of_eigenvalues`."""
    xp = library_of(tensors)
    inverse, d = spd.inverse(tensors), tensors.shape[-1]
    if cancelling:
        scaled = tensors * spacing[:, None] * spacing
        along = xp.stack([scaled[..., a, a] for a in range(d)], axis=-1)
        mixed = along.sum(-1) ** 2 + 2 * (scaled**2).sum((-2, -1))
        oblique = xp.zeros(tensors.shape[:-2], tensors.dtype)
        for a, b in combinations(range(d), 2):
            size = xp.abs(inverse[..., a, b] * tensors[..., a, b])
            oblique = oblique + size * (along[..., a] + along[..., b]) / 8
        return xp.sqrt((along**2).sum(-1) / 128 + mixed / 2304), oblique
    of_mass = 1 / 12 + (d / 20 if lumped else 0)
    total = of_eigenvalues = xp.zeros(tensors.shape[:-2], tensors.dtype)
    for a in range(d):
        along = tensors[..., a, a]
        of_stiffness = inverse[..., a, a] * along / 16
        total = total + spacing[a] ** 2 * along * (of_mass - of_stiffness)
        of_eigenvalues = of_eigenvalues + spacing[a] ** 2 * along * of_stiffness
    return total, (total if lumped else of_eigenvalues)


# Between neighbours along axis a, the flux matrix A = √|T| T⁻¹ changes by δA, and an element uses the mean of A. The
# exact solution p·x + w with the gradient p has a corrector w with ∂ₐ(Aₐₐ∂ₐw) = −(∂ₐA eₐ)·p, where eₐ is the unit
# vector of axis a. An element lacks the energy of the corrector w, Aₐₐ(∂ₐ²w)² hₐ²/12. For gradients p with the
# covariance A⁻¹, the missing energy is δAeₐ·A⁻¹δAeₐ/12Aₐₐ, relative to the energy of p along one axis. The estimate
# holds for √t above the length on which the metric varies; for smaller t only its order of magnitude is right.
# Fick's operator has the flux matrix A = D = T⁻¹.
def _turning(tensors: Any, domain: Any, periodic: tuple[bool, ...], fick: bool) -> Any:
    """Return the relative error (*shape) of eigenvalues due to the variation of tensors between neighbours."""
    xp = library_of(tensors)
    determinant = spd.determinant(tensors)[..., None, None]
    root = determinant if fick else xp.sqrt(determinant)
    flux, reciprocal = spd.adjugate(tensors) / root, tensors * (root / determinant)
    total = xp.zeros(tensors.shape[:-2], tensors.dtype)
    for a, wraps in enumerate(periodic):
        jump = xp.roll(flux[..., a], -1, a) - flux[..., a]
        half = 0.5 * reciprocal / flux[..., a, a, None, None]
        both = half + xp.roll(half, -1, a)
        pairs = _neighbours(domain, a, wraps)
        energy = xp.where(pairs, (jump[..., :, None] * both * jump[..., None, :]).sum((-2, -1)), 0)
        count = pairs.astype(energy.dtype) + xp.roll(pairs, 1, a).astype(energy.dtype)
        total = total + (energy + xp.roll(energy, 1, a)) / (12 * xp.maximum(count, 1))
    return total


# At distance ξ from one of two nodes with the spacing h, linear interpolation has the error ξ(h − ξ)/2 times the second
# derivative of the interpolated quantity. The mean of ξ(h − ξ)/2 between the nodes is h²/12. The relative error of the
# density √|T| is half the trace of T⁻¹ times the error of T. The relative error of the volume element is therefore
# Σₐ hₐ² tr(T⁻¹∂ₐ²T)/24 if T is interpolated, and Σₐ hₐ² ∂ₐ²log|T|/24 if log T is interpolated.
def _swelling(tensors: Any, domain: Any, periodic: tuple[bool, ...], interpolation: Interpolation) -> tuple[Any, Any]:
    """Return the size of the mean of the volume element's relative error, and its standard deviation."""
    xp = library_of(tensors)
    determinant, inverse = spd.determinant(tensors), spd.inverse(tensors)
    density = xp.sqrt(determinant)
    total, inner = xp.zeros((), tensors.dtype), domain
    of_nodes = xp.zeros(domain.shape, tensors.dtype)
    for a, wraps in enumerate(periodic):
        if interpolation == "linear":
            second = xp.roll(tensors, 1, a) + xp.roll(tensors, -1, a) - 2 * tensors
            error = (inverse * second).sum((-2, -1)) / 24  # both matrices are symmetric
        else:
            logarithm = xp.log(determinant)
            error = (xp.roll(logarithm, 1, a) + xp.roll(logarithm, -1, a) - 2 * logarithm) / 24
        pairs = _neighbours(domain, a, wraps)
        between = pairs & xp.roll(pairs, 1, a)
        total, inner = total + _mean(error, xp.where(between, density, 0)), inner & between
        of_nodes = of_nodes + error
    weight = xp.where(inner, density, 0)
    variance = _mean((of_nodes - _mean(of_nodes, weight)) ** 2, weight)
    return xp.abs(total), xp.sqrt(variance)


def _mean(x: Any, weight: Any) -> Any:
    """Return the weighted mean, or 0 if all weights are 0."""
    xp = library_of(x)
    return xp.sum(weight * x) / xp.maximum(xp.sum(weight), xp.finfo(x.dtype).tiny)


def _neighbours(domain: Any, axis: int, wraps: bool) -> Any:
    """Return a mask (*shape) of the nodes that are in the domain and have a next node in the domain along the axis."""
    xp = library_of(domain)
    pairs = xp.logical_and(domain, xp.roll(domain, -1, axis))
    if wraps:
        return pairs
    n = domain.shape[axis]
    return pairs & (xp.arange(n) < n - 1).reshape([-1 if a == axis else 1 for a in range(domain.ndim)])


@numpy_where_known(most=1 << 21, static_argnums=(2, 3, 4))
def _of_grid(
    metric: SampledMetric, domain: Any, periodic: tuple[bool, ...], lumped: bool, cancelling: bool
) -> tuple[Any, ...]:
    xp = library_of(domain)
    d, dtype, spacing = metric.tensors.shape[-1], metric.tensors.dtype, metric.spacing
    assert spacing is not None
    tensors = xp.where(domain[..., None, None], metric.tensors, xp.eye(d, dtype=dtype))
    along = [spacing[a] ** 2 * tensors[..., a, a] for a in range(d)]
    turning = _turning(tensors, domain, periodic, metric.fick)
    measured = spd.inverse(tensors) if metric.fick else tensors
    swelling, unevenness = _swelling(measured, domain, periodic, metric.interpolation)
    if metric.fick:
        # Fick's volume element is exact. An error of √|D| is one of the eigenvalues to the power d/2, and so of the
        # signature, proportional to λ^(d/2) at small times.
        turning, swelling, unevenness = turning + swelling, xp.zeros_like(swelling), xp.zeros_like(unevenness)
    width = xp.sqrt(xp.max(xp.stack(along), axis=0))
    return width, *_dispersion(tensors, spacing, lumped, cancelling), turning, swelling, unevenness


_BIAS = (0.03, 0.22)
"""The constant c in the relative bias c·h²/t of P1 elements, for consistent and lumped mass; h is the longest edge.

On regular and perturbed meshes of squares, spheres, boxes and balls, the median of the constant c over the nodes was
0.008 … 0.028 with a consistent mass and 0.03 … 0.14 with a lumped mass."""


@jit_quickly(static_argnames=("n_vertices", "lumped"))
def _of_mesh(
    metric: Float[Array, "n d d"], cells: Int[np.ndarray | Array, "n corners"], n_vertices: int, lumped: bool
) -> Resolution:
    """Return the resolution of P1 elements, where the mesh width at a vertex is the longest edge of its cells."""
    d = metric.shape[-1]
    corners = np.concatenate([np.zeros((1, d)), np.eye(d)])
    edges = jnp.asarray([b - a for a, b in combinations(corners, 2)], metric.dtype)
    squared = jnp.einsum("ea,nab,eb->ne", edges, metric, edges, precision="highest")
    longest = jnp.repeat(jnp.max(squared, axis=1), d + 1)
    at_vertices = jnp.maximum(jax.ops.segment_max(longest, cells.ravel(), n_vertices), 0)
    bias = _BIAS[lumped] * at_vertices
    nothing = jnp.zeros((), bias.dtype)
    return Resolution(jnp.sqrt(at_vertices), bias, bias, jnp.zeros_like(bias), nothing, nothing)
