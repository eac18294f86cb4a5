"""Curvature of a metric, and the Laplace–Beltrami operator applied to a function, at the nodes of a grid."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import nan_is_meant, nan_outside
from hks_jax.checks import real_array
from hks_jax.curvature.jet import (
    Jet,
    at_nodes,
    christoffel,
    domain_nodes,
    function_jet,
    inner,
    metric_jet,
    nodal_jet,
)
from hks_jax.curvature.noise import warn_of_errors
from hks_jax.domain import spd
from hks_jax.domain.components import wraps_per_axis
from hks_jax.domain.tensor_field import TensorField, require_field, require_laplace_beltrami


@nan_is_meant
def scalar_curvature(field: TensorField, periodic: bool | Sequence[bool] = False) -> Float[Array, "*shape"]:
    """Return the scalar curvature R of a metric at the nodes; on a surface R = 2K for the Gaussian curvature K.

    If the field was made from a function, JAX differentiates the function, and R is exact. For nodal tensors, R comes
    from finite differences with the order of convergence, the amplification of noise, the warning and the NaN that
    `gaussian_curvature` states.

    Args:
        field: the metric, d = 2 or 3.
        periodic: as in `gaussian_curvature`.

    Raises:
        ValueError: fewer than 7 nodes along an axis of a nodal field; a bad `periodic`.

    Examples:
        >>> print(hj.scalar_curvature(hj.examples.hyperbolic_field(9))[4, 4].round(3))  # 2K
        -2.0
    """
    require_field(field)
    return _curvature("scalar curvature", scalar, field, wraps_per_axis(periodic, field.grid.dimension))


@nan_is_meant
def gaussian_curvature(field: TensorField, periodic: bool | Sequence[bool] = False) -> Float[Array, "*shape"]:
    """Return the Gaussian curvature K of a two-dimensional metric at the nodes.

    If the field was made from a function, JAX differentiates the function, and K is exact. For nodal tensors, K comes
    from finite differences in rows of 7 nodes, of sixth order in the node distance h. Within three nodes of a side or
    of the rim of a mask, K comes from a polynomial of degree 4 that fits the row in the sense of least squares,
    and is of third order. K is NaN outside the mask and where no row fits into the mask.

    Independent noise of the tensors, of the standard deviation σ relative to the tensors, gives K a noise of about
    2.6 σ/h², where h is the node distance in the metric; on sides and in corners, the noise is at most 3 times larger.
    An `AccuracyWarning` is issued if this noise, estimated from differences of the nodes, exceeds half of the
    median of |K|, and 1/area. Then smooth the tensors (`smooth_tensors`), and compute error bars (`uncertainty`).

    An `AccuracyWarning` is also issued if the grid does not resolve the metric: if the error of the differences,
    estimated by differences of lower order, exceeds a quarter of the median of |K| at over 2 % of the nodes. Near sides
    the estimate may be half of the error.

    Args:
        periodic: whether the axes are periodic, so that node n is node 0; one value for all axes, or one per axis.

    Raises:
        ValueError: a field that is not 2D; fewer than 7 nodes along an axis of a nodal field; a bad `periodic`.

    Examples:
        >>> K = hj.gaussian_curvature(hj.examples.sphere_field(9))
        >>> print(K.min().round(3), K.max().round(3))
        1.0 1.0
    """
    require_field(field)
    if field.grid.dimension != 2:
        raise ValueError(
            f"field: got a grid of shape {field.grid.shape}; expected a metric in two dimensions. Take a "
            "slice: the components of the metric in a coordinate plane, on a two-dimensional grid"
        )
    return _curvature("Gaussian curvature", gaussian, field, wraps_per_axis(periodic, 2))


def _curvature(
    name: str, curvature: Callable[[Jet], Array], field: TensorField, wraps: tuple[bool, ...]
) -> Float[Array, "*shape"]:
    """Return a curvature at the nodes, and warn if noise dominates it, or if the grid does not resolve the metric."""
    values = _at_nodes(curvature, field, wraps, 0)
    warn_of_errors(field, lambda f, lower: [_at_nodes(curvature, f, wraps, lower)], [values], [name], [0.0], wraps)
    return values


@partial(jax.jit, static_argnums=(0, 2))
def _at_nodes(
    curvature: Callable[[Jet], Array], field: TensorField, wraps: tuple[bool, ...], lower: Any
) -> Float[Array, "*shape"]:
    metric, known = metric_jet(field, wraps, lower)
    return nan_outside(curvature(metric), known)


# The coordinate planes. In three dimensions, entry i is the plane perpendicular to axis i.
_PLANES = {2: ((0, 1),), 3: ((1, 2), (2, 0), (0, 1))}


def riemann(metric: Jet) -> Float[Array, "... p p"]:
    """Return the curvature tensor R_abcd of a 2D or 3D metric g; rows are coordinate planes ab, columns are planes cd.

        R_abcd = ½(∂_b∂_c g_ad + ∂_a∂_d g_bc − ∂_a∂_c g_bd − ∂_b∂_d g_ac) + ⟨Γ_bc, Γ_ad⟩ − ⟨Γ_bd, Γ_ac⟩

    The components of the covectors Γ_bc are Christoffel symbols of the first kind (Landau and Lifshitz, The Classical
    Theory of Fields, §92). On a surface the only plane is 12, and the formula is Brioschi's with its determinants
    expanded (Gray, Modern Differential Geometry of Curves and Surfaces, §17.1). In three dimensions the planes are 23,
    31 and 12.
    """
    planes = _PLANES[metric.value.shape[-1]]
    hessian, symbols, inverse = metric.hessian, christoffel(metric), spd.inverse(metric.value)

    def product(i: int, j: int, k: int, m: int) -> Array:
        return inner(inverse, symbols[..., i, j], symbols[..., k, m])

    def component(a: int, b: int, c: int, d: int) -> Array:
        linear = (
            hessian[..., a, d, b, c] + hessian[..., b, c, a, d] - hessian[..., b, d, a, c] - hessian[..., a, c, b, d]
        )
        return linear / 2 + product(b, c, a, d) - product(b, d, a, c)

    numbers = range(len(planes))
    lower = {(i, j): component(*planes[i], *planes[j]) for i in numbers for j in range(i + 1)}
    rows = [jnp.stack([lower[max(i, j), min(i, j)] for j in numbers], axis=-1) for i in numbers]
    return jnp.stack(rows, axis=-2)


def einstein(metric: Jet) -> Float[Array, "... 3 3"]:
    """Return the Einstein tensor (Ric − ½Rg)ⁱʲ of a three-dimensional metric.

    The Einstein tensor is the double dual of the curvature tensor R_abcd: component ij of the Einstein tensor is
    −R_abcd/|g|, where the coordinate planes ab and cd are perpendicular to the axes i and j.
    """
    return -riemann(metric) / spd.determinant(metric.value)[..., None, None]


def scalar(metric: Jet) -> Float[Array, "..."]:
    """Return the scalar curvature R of a metric in two or three dimensions."""
    if metric.value.shape[-1] == 2:
        return 2 * gaussian(metric)
    return -2 * jnp.sum(einstein(metric) * metric.value, axis=(-2, -1))


def gaussian(metric: Jet) -> Float[Array, "..."]:
    """Return the Gaussian curvature R₁₂₁₂/|g| of a metric ((E, F), (F, G))."""
    return riemann(metric)[..., 0, 0] / spd.determinant(metric.value)


def scalar_and_ricci_squared(metric: Jet) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return the scalar curvature R and |Ric|² = RicᵢⱼRicⁱʲ of a three-dimensional metric.

    If G is the Einstein tensor, R = −2 tr G and |Ric|² = |G|² + R²/4.
    """
    mixed = jnp.sum(einstein(metric)[..., :, :, None] * metric.value[..., None, :, :], axis=-2)
    R = -2 * jnp.trace(mixed, axis1=-2, axis2=-1)
    return R, jnp.sum(mixed * jnp.swapaxes(mixed, -1, -2), axis=(-2, -1)) + R**2 / 4


@nan_is_meant
def laplace_beltrami(
    field: TensorField,
    f: Float[Array | np.ndarray, "*shape"] | Callable[[Array], Array],
    periodic: bool | Sequence[bool] = False,
) -> Float[Array, "*shape"]:
    """Return ∇²f = div grad f = (1/√|g|) ∂ₐ(√|g| gᵃᵇ ∂ᵦf) at the nodes; ∇²f is negative at a peak of f.

    If the metric or `f` is a function, its derivatives are exact. Derivatives of nodal values are finite differences,
    of the order and NaN under the conditions that `gaussian_curvature` states. No warning tells of their noise.

    Args:
        field: the metric, d = 2 or 3.
        f: nodal values (*shape), or a function from coordinates (d,) to a number, differentiable by JAX.
        periodic: as in `gaussian_curvature`.

    Raises:
        ValueError: Fick's operator; values of another shape; fewer than 7 nodes along an axis of nodal values; a bad
            `periodic`.

    Examples:
        >>> print(hj.laplace_beltrami(field, lambda x: (x + 0.3) @ (x + 0.3))[4, 4].round(3))  # of r²
        4.0
    """
    require_field(field)
    require_laplace_beltrami(field, "∇²")
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
    """Return gᵃᵇ(∂ₐ∂ᵦf − Γᶜₐᵦ ∂_c f) from the jet of the metric, without its second derivatives, and the jet of f."""
    inverse = spd.inverse(metric.value)
    raised = jnp.sum(inverse * scalar.gradient[..., None, :], axis=-1)
    connection = jnp.sum(christoffel(metric) * raised[..., :, None, None], axis=-3)
    return jnp.sum(inverse * (scalar.hessian - connection), axis=(-2, -1))
