"""How well a grid or a mesh resolves a metric: the nodal numbers behind estimates of the discretisation error."""

from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import Interpolation
from hks_jax.fem.space import FunctionSpace, GridSpace, MeshSpace, mask_for


class SampledMetric(eqx.Module):
    """The metric that a pencil was assembled from, for estimates; constant to derivatives.

    Attributes:
        tensors: (*shape, d, d) at the nodes of a grid; or (n_cells, d, d) in the cells of a mesh, in their own edges.
        spacing: (d,) of the grid; None on a mesh.
        interpolation: what lies between the nodes.
    """

    tensors: Float[Array, "*shape d d"]
    spacing: Float[np.ndarray | Array, " d"] | None
    interpolation: Interpolation = eqx.field(static=True, default="linear")


class Resolution(eqx.Module):
    """What the spacing does to heat kernel signatures, to leading order; see `truncation`. Constant to derivatives.

    Attributes:
        mesh_width: (*shape) the local distance of neighbouring nodes in the units of the metric.
        dispersion: (*shape) the bias times t, in (metric length)², of tensors that do not vary: it falls as t grows.
        turning: (*shape) the relative error of eigenvalues, whatever their size, because tensors turn or stretch
            between neighbours.
        swelling: the relative error of the domain's area or volume.
    """

    mesh_width: Float[Array, "*shape"]
    dispersion: Float[Array, "*shape"]
    turning: Float[Array, "*shape"]
    swelling: Float[Array, ""]


def resolution_of(metric: SampledMetric, space: FunctionSpace, lumped: bool) -> Resolution:
    """Return what the spacing of a grid, or the edges of a mesh, do to the functions of a space."""
    if isinstance(space, GridSpace):
        # The mask goes in as an array, so that grids that differ only in it share one compilation.
        return _of_grid(metric, mask_for(metric.tensors, space.domain), space.periodic, lumped)
    assert isinstance(space, MeshSpace)
    return _of_mesh(metric.tensors, space.triangulation.cells, space.triangulation.n_vertices, lumped)


# Where tensors hardly vary, a plane wave of wave vector k has the discrete eigenvalue λ(1 + δ) with
# λδ = Σₐ hₐ² g^aa kₐ⁴/12 and, the mass being that of the interpolant, a nodal square larger by Σₐ hₐ²kₐ²/6. In the
# signature k is normal with covariance g/2t: E kₐ² = gₐₐ/2t and E kₐ⁴ = 3gₐₐ²/4t², so that its relative error is
#
#     −t E λδ + E Σₐ hₐ²kₐ²/6 = Σₐ hₐ² (gₐₐ/12 − g^aa gₐₐ²/16)/t.
#
# A lumped mass divides λ and the square by 1 + Σₐ hₐ²kₐ²/6, which adds d/24 Σₐ hₐ²gₐₐ/t, by E λkₐ² = (d + 2)gₐₐ/4t²;
# 1/20 in place of 1/24 is what the next terms make of it at t = 6h².
def dispersion(
    tensors: Float[Array, "*shape d d"], spacing: Float[np.ndarray | Array, " d"], lumped: bool
) -> Float[Array, "*shape"]:
    """Return the error, times t, of the signature that Q1 elements give where tensors do not vary."""
    inverse, d = spd.inverse(tensors), tensors.shape[-1]
    of_mass = 1 / 12 + (d / 20 if lumped else 0)
    total = jnp.zeros(tensors.shape[:-2], tensors.dtype)
    for a in range(d):
        along = tensors[..., a, a]
        total = total + spacing[a] ** 2 * along * (of_mass - inverse[..., a, a] * along / 16)
    return total


# Between neighbours along axis a the flux matrix A = √|T| T⁻¹ varies by δA. An element sees its mean; the exact
# solution u = p·x + w has a corrector w with ∂ₐ(Aₐₐ∂ₐw) = −(∂ₐA eₐ)·p, and its energy, Aₐₐ(∂ₐ²w)² hₐ²/12, is what the
# element lacks: with p of covariance A⁻¹ it is δAeₐ·A⁻¹δAeₐ/12Aₐₐ, in units of what p has along one axis. That is for
# √t above the length on which A varies. Below it the error is of the same size, but no such sum of neighbours.
def turning(
    tensors: Float[Array, "*shape d d"], domain: Bool[np.ndarray | Array, "*shape"], periodic: tuple[bool, ...]
) -> Float[Array, "*shape"]:
    """Return the relative error of eigenvalues because the tensors vary between neighbours that are in the domain."""
    root = jnp.sqrt(spd.determinant(tensors))[..., None, None]
    flux, reciprocal = spd.adjugate(tensors) / root, tensors / root
    total = jnp.zeros(tensors.shape[:-2], tensors.dtype)
    for a, wraps in enumerate(periodic):
        jump = jnp.roll(flux[..., a], -1, a) - flux[..., a]
        half = 0.5 * reciprocal / flux[..., a, a, None, None]
        both = half + jnp.roll(half, -1, a)
        pairs = _neighbours(domain, a, wraps)
        energy = jnp.where(pairs, jnp.einsum("...i,...ij,...j->...", jump, both, jump, precision="highest"), 0)
        count = pairs.astype(energy.dtype) + jnp.roll(pairs, 1, a).astype(energy.dtype)
        total = total + (energy + jnp.roll(energy, 1, a)) / (12 * jnp.maximum(count, 1))
    return total


# Interpolation along axis a errs by −ξ(h − ξ)/2 times the second derivative, in the mean by −h²/12 times it, and the
# density √|T| by half the trace of T⁻¹ times that: tr T⁻¹∂ₐ²T for T interpolated, ∂ₐ²log|T| for its logarithm.
def swelling(
    tensors: Float[Array, "*shape d d"],
    domain: Bool[np.ndarray | Array, "*shape"],
    periodic: tuple[bool, ...],
    interpolation: Interpolation,
) -> Float[Array, ""]:
    """Return the relative error of the domain's volume because of the interpolation between the nodes."""
    determinant, inverse = spd.determinant(tensors), spd.inverse(tensors)
    density, total = jnp.sqrt(determinant), jnp.zeros((), tensors.dtype)
    for a, wraps in enumerate(periodic):
        if interpolation == "linear":
            second = jnp.roll(tensors, 1, a) + jnp.roll(tensors, -1, a) - 2 * tensors
            error = jnp.einsum("...ij,...ji->...", inverse, second, precision="highest")
        else:
            logarithm = jnp.log(determinant)
            error = jnp.roll(logarithm, 1, a) + jnp.roll(logarithm, -1, a) - 2 * logarithm
        pairs = _neighbours(domain, a, wraps)
        weight = jnp.where(pairs & jnp.roll(pairs, 1, a), density, 0)
        total = total + jnp.sum(weight * error) / 24 / jnp.maximum(jnp.sum(weight), jnp.finfo(tensors.dtype).tiny)
    return jnp.abs(total)


def _neighbours(domain: Bool[np.ndarray | Array, "*shape"], axis: int, wraps: bool) -> Bool[Array, "*shape"]:
    """Tell which nodes are in the domain with the next one along the axis."""
    pairs = jnp.logical_and(domain, jnp.roll(domain, -1, axis))
    if wraps:
        return pairs
    n = domain.shape[axis]
    return pairs & (jnp.arange(n) < n - 1).reshape([-1 if a == axis else 1 for a in range(domain.ndim)])


@jit_quickly(static_argnames=("periodic", "lumped"))
def _of_grid(
    metric: SampledMetric, domain: Bool[np.ndarray | Array, "*shape"], periodic: tuple[bool, ...], lumped: bool
) -> Resolution:
    assert metric.spacing is not None
    tensors = spd.positive_or_nan(spd.identity_unless(domain, metric.tensors))
    along = [metric.spacing[a] ** 2 * tensors[..., a, a] for a in range(tensors.shape[-1])]
    return Resolution(
        jnp.sqrt(jnp.max(jnp.stack(along), axis=0)),
        dispersion(tensors, metric.spacing, lumped),
        turning(tensors, domain, periodic),
        swelling(tensors, domain, periodic, metric.interpolation),
    )


_BIAS = (0.03, 0.22)
"""c in the relative bias c·h²/t of P1 elements with consistent and lumped mass, h the longest edge.

The medians over the nodes of squares, spheres, boxes and balls, cut regularly or jittered, were 0.008 … 0.028 and
0.03 … 0.14.
"""


@jit_quickly(static_argnames=("n_vertices", "lumped"))
def _of_mesh(
    metric: Float[Array, "n d d"], cells: Int[np.ndarray | Array, "n corners"], n_vertices: int, lumped: bool
) -> Resolution:
    """A vertex is as coarse as the longest edge of its cells: the metric as it is, without turning between them."""
    d = metric.shape[-1]
    corners = np.concatenate([np.zeros((1, d)), np.eye(d)])
    edges = jnp.asarray([b - a for a, b in combinations(corners, 2)], metric.dtype)
    squared = jnp.einsum("ea,nab,eb->ne", edges, metric, edges, precision="highest")
    longest = jnp.repeat(jnp.max(squared, axis=1), d + 1)
    at_vertices = jnp.maximum(jax.ops.segment_max(longest, cells.ravel(), n_vertices), 0)
    bias = _BIAS[lumped] * at_vertices
    return Resolution(jnp.sqrt(at_vertices), bias, jnp.zeros_like(bias), jnp.zeros((), bias.dtype))
