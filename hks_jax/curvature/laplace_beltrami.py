"""The Laplace–Beltrami operator applied to a function."""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from hks_jax.arrays import nan_is_meant, nan_outside
from hks_jax.checks import real_array
from hks_jax.curvature.jet import (
    Jet,
    at_nodes,
    christoffel,
    domain_nodes,
    function_jet,
    metric_jet,
    nodal_jet,
    wraps_per_axis,
)
from hks_jax.domain import spd
from hks_jax.domain.tensor_field import TensorField


@nan_is_meant
def laplace_beltrami(
    field: TensorField,
    f: Float[Array, "*shape"] | Callable[[Array], Array],
    periodic: bool | Sequence[bool] = False,
) -> Float[Array, "*shape"]:
    """Return ∇²f = div grad f = (1/√g) ∂ₐ(√g gᵃᵇ ∂ᵦf) at the nodes: the geometers' −Δf, negative where f peaks.

    Derivatives are exact of whatever is given as a function, the metric or `f`, and differences of sixth order of
    what is given at the nodes (see `gaussian_curvature`).

    Args:
        field: the metric, d = 2 or 3.
        f: nodal values (*shape), or a function from coordinates (d,) to a number, differentiable by JAX.
        periodic: whether the axes are periodic, one for all or one per axis.

    Returns:
        (*shape), in units of f/length²; NaN outside the mask, and where no difference stencil fits in it.

    Raises:
        ValueError: values of another shape; fewer than 8 nodes on an axis where differences are needed; bad `periodic`.
    """
    if callable(f):
        f = f if isinstance(f, jtu.Partial) else jtu.Partial(f)
    else:
        f = real_array("f", f)
        if f.shape != field.grid.shape:
            raise ValueError(f"f: got shape {f.shape}; expected the grid's shape {field.grid.shape}, or a function")
    return _laplace_beltrami(field, f, wraps_per_axis(periodic, field.grid.dimension))


@partial(jax.jit, static_argnums=2)
def _laplace_beltrami(field: TensorField, f: Array | jtu.Partial, wraps: tuple[bool, ...]) -> Float[Array, "*shape"]:
    inside = domain_nodes(field.grid, wraps)
    metric, known = metric_jet(field, wraps)
    if callable(f):

        def number(x: Array) -> Array:
            return real_array("f", f(x)).astype(x.dtype)

        scalar = at_nodes(lambda x: function_jet(number, x), field.grid, inside)
    else:
        scalar, of_f = nodal_jet(jnp.where(inside, f, 0), field.grid, inside, wraps)
        known = known & of_f
    return nan_outside(laplacian(metric, scalar), known)


def laplacian(metric: Jet, scalar: Jet) -> Float[Array, "..."]:
    """Return gᵃᵇ(∂ₐ∂ᵦf − Γᶜₐᵦ ∂_c f) from the jets of the metric (to first order) and of f."""
    inverse = spd.inverse(metric.value)
    raised = jnp.sum(inverse * scalar.gradient[..., None, :], axis=-1)
    connection = jnp.sum(christoffel(metric) * raised[..., :, None, None], axis=-3)
    return jnp.sum(inverse * (scalar.hessian - connection), axis=(-2, -1))
