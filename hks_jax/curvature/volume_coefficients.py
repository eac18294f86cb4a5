"""Riemann curvature of a metric, and the coefficients of the heat kernel's expansion in three dimensions."""

from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.curvature.jet import (
    Jet,
    at_nodes,
    christoffel,
    domain_nodes,
    function_jet,
    inner,
    metric_function,
    metric_jet,
    nodal_jet,
)
from hks_jax.curvature.laplace_beltrami import laplacian
from hks_jax.domain import spd
from hks_jax.domain.tensor_field import TensorField

# The coordinate planes; in three dimensions each at the place of the axis that is not in it.
_PLANES = {2: ((0, 1),), 3: ((1, 2), (2, 0), (0, 1))}


def riemann(metric: Jet) -> Float[Array, "... p p"]:
    """Return the curvature tensor R_abcd of a metric in 2 or 3 dimensions, ab and cd running over the p planes,

        R_abcd = ½(∂_b∂_c g_ad + ∂_a∂_d g_bc − ∂_a∂_c g_bd − ∂_b∂_d g_ac) + ⟨Γ_bc, Γ_ad⟩ − ⟨Γ_bd, Γ_ac⟩

    in Christoffel symbols of the first kind (Landau and Lifshitz, The Classical Theory of Fields, §92). The planes are
    12 on a surface, and 23, 31, 12 in three dimensions.
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

    lower = {(i, j): component(*planes[i], *planes[j]) for i in range(len(planes)) for j in range(i + 1)}
    return _symmetric(lower, len(planes))


def einstein(metric: Jet) -> Float[Array, "... 3 3"]:
    """Return the Einstein tensor (Ric − ½Rg)ⁱʲ of a three-dimensional metric.

    It is the double dual of the curvature tensor, −R_abcd/|g| at the place ij of the planes ab and cd, and so in three
    dimensions all of the curvature.
    """
    return -riemann(metric) / spd.determinant(metric.value)[..., None, None]


def scalar(metric: Jet) -> Float[Array, "..."]:
    """Return the scalar curvature R of a metric in two or three dimensions."""
    if metric.value.shape[-1] == 2:
        return 2 * riemann(metric)[..., 0, 0] / spd.determinant(metric.value)
    return -2 * jnp.sum(einstein(metric) * metric.value, axis=(-2, -1))


def scalar_and_ricci_squared(metric: Jet) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return R and |Ric|² = RicᵢⱼRicⁱʲ of a three-dimensional metric.

    With the Einstein tensor G, R = −2 tr G and |Ric|² = |G|² + R²/4.
    """
    mixed = jnp.sum(einstein(metric)[..., :, :, None] * metric.value[..., None, :, :], axis=-2)
    R = -2 * jnp.trace(mixed, axis1=-2, axis2=-1)
    return R, jnp.sum(mixed * jnp.swapaxes(mixed, -1, -2), axis=(-2, -1)) + R**2 / 4


def _symmetric(lower: dict[tuple[int, int], Array], n: int) -> Float[Array, "... n n"]:
    rows = [[lower[max(i, j), min(i, j)] for j in range(n)] for i in range(n)]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


Coefficients: TypeAlias = list[Array]


def volume_coefficients(
    field: TensorField, order: int, wraps: tuple[bool, ...]
) -> tuple[Coefficients, Bool[np.ndarray, "*shape"]]:
    """Return 1, u₁ and u₂ up to the order, each (*shape), and the nodes where they are known.

    u₁ = R/6 and u₂ = (R² + 2|Ric|² + 4∇²R)/120 (see `hks_expansion`).
    """
    return (_nodal if field.function is None else _exact)(field, order, wraps)


def _exact(field: TensorField, order: int, wraps: tuple[bool, ...]) -> tuple[Coefficients, Bool[np.ndarray, "*shape"]]:
    metric, inside = metric_function(field), domain_nodes(field.grid, wraps)

    def curvature(x: Array) -> Array:
        return scalar(function_jet(metric, x))

    def coefficients(x: Array) -> Coefficients:
        g = function_jet(metric, x)
        return _coefficients(g, function_jet(curvature, x) if order == 2 else None)[: order + 1]

    return at_nodes(coefficients, field.grid, inside), inside


def _nodal(field: TensorField, order: int, wraps: tuple[bool, ...]) -> tuple[Coefficients, Bool[np.ndarray, "*shape"]]:
    g, known = metric_jet(field, wraps)
    R = None
    if order == 2:
        R, known = nodal_jet(scalar(g), field.grid, known, wraps)
    return _coefficients(g, R)[: order + 1], known


def _coefficients(metric: Jet, curvature: Jet | None) -> Coefficients:
    """Return 1 and u₁, and with the jet of R also u₂."""
    R, ricci_squared = scalar_and_ricci_squared(metric)
    coefficients = [jnp.ones_like(R), R / 6]
    if curvature is not None:
        coefficients.append((R**2 + 2 * ricci_squared + 4 * laplacian(metric, curvature)) / 120)
    return coefficients
