"""Scalar curvature of a metric, and Gaussian curvature in two dimensions."""

from collections.abc import Sequence
from functools import partial

import jax
from jaxtyping import Array, Float

from hks_jax.curvature.jet import Jet, metric_jet, wraps_per_axis
from hks_jax.curvature.volume_coefficients import riemann, scalar
from hks_jax.domain import spd
from hks_jax.domain.tensor_field import TensorField
from hks_jax.nan_outside import nan_is_meant, nan_outside


@nan_is_meant
def scalar_curvature(field: TensorField, periodic: bool | Sequence[bool] = False) -> Float[Array, "*shape"]:
    """Return the scalar curvature R of a metric at the nodes; on a surface it is 2K, K the Gaussian curvature.

    Exact, by JAX derivatives, when the field came from a function. Else by differences of sixth order of the
    nodal tensors (see `gaussian_curvature`).

    Args:
        field: the metric, d = 2 or 3.
        periodic: whether the axes are periodic (a node n that is node 0), one for all or one per axis.

    Returns:
        (*shape), in 1/length²; NaN outside the mask, and where no difference stencil fits in it.

    Raises:
        ValueError: fewer than 8 nodes on an axis of a nodal field; bad `periodic`.
    """
    return _scalar_curvature(field, wraps_per_axis(periodic, field.grid.dimension))


@partial(jax.jit, static_argnums=1)
def _scalar_curvature(field: TensorField, wraps: tuple[bool, ...]) -> Float[Array, "*shape"]:
    metric, known = metric_jet(field, wraps)
    return nan_outside(scalar(metric), known)


@nan_is_meant
def gaussian_curvature(field: TensorField, periodic: bool | Sequence[bool] = False) -> Float[Array, "*shape"]:
    """Return the Gaussian curvature K of a two-dimensional metric at the nodes.

    Exact, by JAX derivatives, when the field came from a function. Else by differences of sixth order of the
    nodal tensors, centred where the grid and the mask allow it and one-sided at their edges.

    Args:
        field: the metric, d = 2.
        periodic: whether the axes are periodic (a node n that is node 0), one for all or one per axis.

    Returns:
        (*shape), in 1/length²; NaN outside the mask, and where no stencil of 7 nodes (8 for a second derivative
        next to an edge) along a grid line fits in it.

    Raises:
        ValueError: a field that is not two-dimensional; fewer than 8 nodes on an axis of a nodal field; bad
            `periodic`.
    """
    require_surface(field)
    return _gaussian_curvature(field, wraps_per_axis(periodic, 2))


@partial(jax.jit, static_argnums=1)
def _gaussian_curvature(field: TensorField, wraps: tuple[bool, ...]) -> Float[Array, "*shape"]:
    metric, known = metric_jet(field, wraps)
    return nan_outside(brioschi(metric), known)


def brioschi(metric: Jet) -> Float[Array, "..."]:
    """Return the Gaussian curvature from the jet of a metric ((E, F), (F, G)).

    This is Brioschi's formula (Gray, Modern Differential Geometry of Curves and Surfaces, §17.1) with its two
    determinants expanded, in Christoffel symbols of the first kind; the right-hand side is R₁₂₁₂:

        K (EG − F²) = ∂₁∂₂F − ½ ∂₂∂₂E − ½ ∂₁∂₁G + ⟨Γ₁₂, Γ₁₂⟩ − ⟨Γ₁₁, Γ₂₂⟩.
    """
    return riemann(metric)[..., 0, 0] / spd.determinant(metric.value)


def require_surface(field: TensorField) -> None:
    """Raise ValueError unless the field is two-dimensional."""
    if field.grid.dimension != 2:
        raise ValueError(
            f"field: got a grid of shape {field.grid.shape}; Gaussian curvature belongs to metrics in two "
            "dimensions. Take a slice: the metric's components in a coordinate plane, on its two-dimensional grid"
        )
