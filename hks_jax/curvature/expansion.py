"""The short-time expansion of the heat kernel signature in terms of curvature."""

from collections.abc import Sequence
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.arrays import nan_is_meant, nan_outside
from hks_jax.checks import checked_times
from hks_jax.curvature import taylor
from hks_jax.curvature.geometry import laplacian, scalar, scalar_and_ricci_squared
from hks_jax.curvature.jet import (
    Jet,
    at_nodes,
    domain_nodes,
    function_jet,
    metric_function,
    nodal_jet,
    nodal_series,
    over_nodes,
)
from hks_jax.curvature.noise import warn_of_errors
from hks_jax.domain.components import wraps_per_axis
from hks_jax.domain.tensor_field import TensorField, require_field, require_laplace_beltrami
from hks_jax.traced import is_traced

Coefficients: TypeAlias = list[Array]
Pair: TypeAlias = tuple[taylor.Series, taylor.Series]
HIGHEST_ORDER = {2: 3, 3: 2}
"""The highest implemented order of the expansion in each dimension."""


@nan_is_meant
def hks_expansion(
    field: TensorField, times: Any, order: int | None = None, periodic: bool | Sequence[bool] = False
) -> Float[Array, "n_times *shape"]:
    """Return the short-time expansion of the heat kernel signature at the nodes:

        k_t(x, x) ≈ (1 + u₁t + u₂t² + u₃t³)/(4πt)^(d/2).

    On a surface with the Gaussian curvature K, where ∇² = div grad, the coefficients are (Polterovich 2000)

        u₁ = K/3,   u₂ = (K² + ∇²K)/15,   u₃ = 4K³/315 + 2|∇K|²/105 + K∇²K/30 + ∇⁴K/140.

    In three dimensions, with the Ricci tensor Ric and the scalar curvature R, the coefficients up to u₂ are

        u₁ = R/6,   u₂ = (R² + 2|Ric|² + 4∇²R)/120.

    McKean and Singer (1967) give u₂ = (5R² − 2|Ric|² + 2|Riem|² + 12∇²R)/360; in 3D, the curvature tensor Riem has
    |Riem|² = 4|Ric|² − R². The expansion ignores the boundary, and so holds at distances well above 3√t from it.

    If the field was made from a function, JAX differentiates the function, and the coefficients are exact. For a field
    of nodal tensors, the coefficients come from finite differences, of at least sixth order in the node distance h. On
    a surface, u₁ is of third order near sides and rims (see `gaussian_curvature`), and u₂ and u₃ are NaN within 5 and 6
    nodes of a side or of the rim of a mask. In three dimensions, u₂ is of first order near sides and rims. The result
    is NaN outside the mask, and where a coefficient is NaN.

    The differences amplify noise and rounding in proportion to h⁻²ⁱ in uᵢ. A grid that is finer by the factor 2 has an
    error by rounding in u₃ that is 64 times larger: on the chart [−1, 1]² of the unit sphere in float64, 6e-8 for
    h = 1/40, 3e-6 for h = 1/80 and 1e-4 for h = 1/160. If noise or rounding dominates a coefficient, and changes the
    signature by more than 0.1 %, an `AccuracyWarning` states by how much; another is issued where the grid does not
    resolve the metric, as for `gaussian_curvature`.

    Args:
        field: the metric, d = 2 or 3.
        times: (n_times,) positive times, in length².
        order: the highest power of t in the expansion, at most 3 on a surface and 2 in three dimensions; None means
            this maximum.
        periodic: whether the axes are periodic; one value for all axes, or one per axis.

    Raises:
        ValueError: Fick's operator; times that are not a vector of positive numbers; an order that is not implemented;
            fewer than 7 nodes along an axis of a nodal field (11 and 13 for u₂ and u₃ on a surface); a bad `periodic`.

    Examples:
        >>> expansion = hj.hks_expansion(hj.examples.sphere_field(9), [0.1], order=1)[0, 4, 4]
        >>> print((4 * jnp.pi * 0.1 * expansion).round(3))  # 1 + t/3
        1.033
    """
    require_field(field)
    require_laplace_beltrami(field, "the expansion in curvature")
    dimension = field.grid.dimension
    highest = HIGHEST_ORDER[dimension]
    order = highest if order is None else order
    if order not in range(highest + 1):
        raise ValueError(
            f"order: got {order!r}; expected {', '.join(map(str, range(highest)))} or {highest}, the orders "
            f"that are implemented in {dimension} dimensions"
        )
    t, wraps = checked_times(times, field.tensors.dtype), wraps_per_axis(periodic, dimension)
    coefficients = _coefficients(field, int(order), wraps, 0)
    if not is_traced(t) and t.size:
        # Less than 0.1 % of the signature at the largest time does not count.
        negligible = [1e-3 / float(np.asarray(t).max()) ** i for i in range(1, order + 1)]
        names = [f"coefficient u{i} of the expansion" for i in range(1, order + 1)]
        differences = 10 if order > 1 and dimension == 2 else 6
        again = lambda f, lower: _coefficients(f, int(order), wraps, lower)[1:]  # noqa: E731
        warn_of_errors(field, again, coefficients[1:], names, negligible, wraps, differences)
    return _series(coefficients, t, dimension)


@partial(jax.jit, static_argnums=(1, 2))
def _coefficients(field: TensorField, order: int, wraps: tuple[bool, ...], lower: Any) -> Coefficients:
    if field.function is None:
        coefficients, known = _nodal(field, order, wraps, lower)
    else:
        coefficients, known = _exact(field, order, wraps)
    return [nan_outside(u, known) for u in coefficients]


@partial(jax.jit, static_argnums=2)
def _series(coefficients: Coefficients, times: Float[Array, " n_times"], d: int) -> Float[Array, "n_times *shape"]:
    t = jnp.expand_dims(times, tuple(range(1, d + 1))).astype(coefficients[0].dtype)
    series = jnp.zeros_like(t)
    for u in reversed(coefficients):
        series = series * t + u[None]
    return series / (4 * jnp.pi * t) ** (d / 2)


def _of_surface(K: Array, laplacian_K: Any = 0, gradient_squared: Any = 0, bilaplacian_K: Any = 0) -> Coefficients:
    """Return the coefficients 1, u₁, u₂, u₃ on a surface; each is valid only if its formula's invariants are given."""
    return [
        jnp.ones_like(K),
        K / 3,
        (K**2 + laplacian_K) / 15,
        4 * K**3 / 315 + 2 * gradient_squared / 105 + K * laplacian_K / 30 + bilaplacian_K / 140,
    ]


def _of_volume(metric: Jet, curvature: Jet | None) -> Coefficients:
    """Return the coefficients 1 and u₁ in three dimensions, and u₂ if the jet of the scalar curvature is given."""
    R, ricci_squared = scalar_and_ricci_squared(metric)
    coefficients = [jnp.ones_like(R), R / 6]
    if curvature is not None:
        coefficients.append((R**2 + 2 * ricci_squared + 4 * laplacian(metric, curvature)) / 120)
    return coefficients


def _exact(field: TensorField, order: int, wraps: tuple[bool, ...]) -> tuple[Coefficients, Bool[np.ndarray, "*shape"]]:
    """Compute the expansion's coefficients from the metric's function; also return the nodes of the domain."""
    metric, inside = metric_function(field), domain_nodes(field.grid, wraps)

    def of_surface(x: Array) -> Coefficients:
        g = taylor.expand(metric, x, degree=2 * max(order, 1))
        return _of_series(g[0, 0], g[0, 1], g[1, 1], order)

    def of_volume(x: Array) -> Coefficients:
        R = function_jet(lambda y: scalar(function_jet(metric, y)), x) if order == 2 else None
        return _of_volume(function_jet(metric, x), R)

    at = of_surface if field.grid.dimension == 2 else of_volume
    return at_nodes(lambda x: at(x)[: order + 1], field.grid, inside), inside


def _of_series(E: taylor.Series, F: taylor.Series, G: taylor.Series, order: int) -> Coefficients:
    """Return the coefficients on a surface with the metric ((E, F), (F, G)); those up to `order` are valid."""
    return _of_surface(*(series[0] for series in _invariant_series(E, F, G, order)))


def _invariant_series(E: taylor.Series, F: taylor.Series, G: taylor.Series, order: int) -> tuple[taylor.Series, ...]:
    """Return Taylor series of the curvature invariants that `_of_surface` needs, for the metric ((E, F), (F, G))."""
    add, times, d = taylor.add, taylor.product, taylor.derivative
    determinant = add(times(E, G), -times(F, F))
    over = taylor.reciprocal(determinant)

    def raised(p: Pair) -> Pair:  # |g| times the vector of the covector p, by the adjugate of g
        return add(times(G, p[0]), -times(F, p[1])), add(times(E, p[1]), -times(F, p[0]))

    def inner(p: Pair, q: Pair) -> taylor.Series:
        v = raised(p)
        return times(over, add(times(v[0], q[0]), times(v[1], q[1])))

    def gradient(f: taylor.Series) -> Pair:
        return d(f, 0), d(f, 1)

    def laplacian(f: taylor.Series) -> taylor.Series:
        # For the vector v = |g| ∇f, ∇²f = (1/√|g|) ∂ₐ(vᵃ/√|g|) is expanded so that no square roots remain.
        v, slope = raised(gradient(f)), gradient(determinant)
        along = times(over, add(times(v[0], slope[0]), times(v[1], slope[1])))
        return times(over, add(d(v[0], 0), d(v[1], 1), -along / 2))

    (E1, E2), (F1, F2), (G1, G2) = map(gradient, (E, F, G))
    linear = add(d(F1, 1), -d(E2, 1) / 2, -d(G1, 0) / 2)
    mixed, pure = (E2 / 2, G1 / 2), ((E1 / 2, F1 - E2 / 2), (F2 - G1 / 2, G2 / 2))
    K = times(over, add(linear, inner(mixed, mixed), -inner(*pure)))
    if order < 2:
        return (K,)
    invariants = K, laplacian(K), inner(gradient(K), gradient(K))
    return invariants if order < 3 else (*invariants, laplacian(invariants[1]))


def _nodal(
    field: TensorField, order: int, wraps: tuple[bool, ...], lower: Any
) -> tuple[Coefficients, Bool[np.ndarray, "*shape"]]:
    """Compute the expansion's coefficients by finite differences; also return the nodes where all are known."""
    tensors, inside = field.domain_tensors, domain_nodes(field.grid, wraps)
    if field.grid.dimension == 3:
        g, known = nodal_jet(tensors, field.grid, inside, wraps, lower)
        R = None
        if order == 2:
            R, known = nodal_jet(scalar(g), field.grid, known, wraps, lower)
        return _of_volume(g, R)[: order + 1], known
    components = tensors[..., (0, 0, 1), (0, 1, 1)]
    coefficients, known = [jnp.ones(field.grid.shape, tensors.dtype)], inside
    for i in range(1, order + 1):
        # Each coefficient has the shortest rows that suffice, because longer ones reach further into the domain.
        series, of_series = nodal_series(components, field.grid, inside, wraps, 2 * i, lower)
        coefficients.append(over_nodes(partial(_highest, order=i), series, 2))
        known = known & of_series
    return coefficients, known


def _highest(metric: Float[Array, "3 n_terms"], order: int) -> Array:
    return _of_series(metric[0], metric[1], metric[2], order)[order]
