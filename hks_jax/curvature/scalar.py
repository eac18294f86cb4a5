"""Scalar curvature of a metric in two or three dimensions."""

from collections.abc import Sequence
from functools import partial

import jax
from jaxtyping import Array, Float

from hks_jax.curvature.jet import metric_jet, wraps_per_axis
from hks_jax.curvature.riemann import scalar
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
