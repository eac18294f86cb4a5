"""Quantities and their first and second derivatives: of functions by JAX, of nodal values by finite differences."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.curvature.stencils import NODES, differentiate
from hks_jax.domain import spd
from hks_jax.domain.components import active_elements, element_nodes
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField

_BATCH = 4096


class Jet(NamedTuple):
    """A jet: the value, gradient and Hessian of a quantity at one or many points; the derivatives' axes come last."""

    value: Float[Array, "..."]
    gradient: Float[Array, "... d"]
    hessian: Float[Array, "... d d"]


def function_jet(fn: Callable[[Array], Any], x: Float[Array, " d"]) -> Jet:
    """Return the jet of a function at a point."""

    # The value and the gradient are auxiliary outputs; otherwise each level of nested jets would trace `fn` 7 times.
    def value(y: Array) -> tuple[Any, Any]:
        f = fn(y)
        return f, f

    def gradient(y: Array) -> tuple[Any, tuple[Any, Any]]:
        df, f = jax.jacfwd(value, has_aux=True)(y)
        return df, (f, df)

    hessian, (f, df) = jax.jacfwd(gradient, has_aux=True)(x)
    return Jet(f, df, hessian)


def nodal_jet(
    values: Float[Array, "*shape_and_components"],
    grid: Grid,
    inside: Bool[np.ndarray, "*shape"],
    wraps: tuple[bool, ...],
    lower: Any = 0,
) -> tuple[Jet, Bool[np.ndarray, "*shape"]]:
    """Compute the jets of nodal values by finite differences; also return the nodes where all derivatives are known.

    The order of the differences is lower if `lower` is positive; see `stencils`.
    """
    _require_nodes(grid, wraps, 2)
    d = grid.dimension

    def along(values: Array, inside: np.ndarray, axis: int, orders: range) -> tuple[list[Array], np.ndarray]:
        return differentiate(values, inside, axis, orders, 2, grid.spacing[axis], wraps[axis], lower)

    lines = [along(values, inside, a, range(1, 3)) for a in range(d)]
    mixed = {(a, b): along(lines[a][0][0], lines[a][1], b, range(1, 2)) for a in range(d) for b in range(a + 1, d)}
    known = np.logical_and.reduce([valid for _, valid in [*lines, *mixed.values()]])

    def second(a: int, b: int) -> Array:
        return lines[a][0][1] if a == b else mixed[min(a, b), max(a, b)][0][0]

    return Jet(
        values,
        jnp.stack([derivatives[0] for derivatives, _ in lines], axis=-1),
        jnp.stack([jnp.stack([second(a, b) for b in range(d)], axis=-1) for a in range(d)], axis=-2),
    ), known


def nodal_series(
    values: Float[Array, "nx ny *components"],
    grid: Grid,
    inside: Bool[np.ndarray, "nx ny"],
    wraps: tuple[bool, ...],
    degree: int,
    lower: Any = 0,
) -> tuple[Float[Array, "nx ny *components n_terms"], Bool[np.ndarray, "nx ny"]]:
    """Compute Taylor series of nodal values on a 2D grid by finite differences; also return the nodes with a series.

    The coefficients have the order of `taylor`; `lower` is that of `nodal_jet`.
    """
    _require_nodes(grid, wraps, degree)

    def along(values: Array, inside: np.ndarray, axis: int) -> tuple[Array, np.ndarray]:
        orders = range(1, degree + 1)
        found, known = differentiate(values, inside, axis, orders, degree, grid.spacing[axis], wraps[axis], lower)
        return jnp.stack([values, *found], axis=-1), known

    of_x, known = along(values, inside, 0)
    of_xy, known = along(of_x, known, 1)
    terms = [
        of_xy[..., k - j, j] / (math.factorial(k - j) * math.factorial(j))
        for k in range(degree + 1)
        for j in range(k + 1)
    ]
    return jnp.stack(terms, axis=-1), known


def _require_nodes(grid: Grid, wraps: tuple[bool, ...], highest: int) -> None:
    least = tuple(NODES[2 if wrap else highest] for wrap in wraps)
    if any(n < needed for n, needed in zip(grid.shape, least, strict=True)):
        raise ValueError(
            f"grid: got shape {grid.shape}; expected at least {least} nodes, for differences of nodal values up to the "
            f"order {highest}. Use a finer grid, or a metric from TensorField.from_function"
        )


def christoffel(metric: Jet) -> Float[Array, "... d d d"]:
    """Return the Christoffel symbols of the first kind, Γ_cab = (∂ₐg_cb + ∂ᵦg_ca − ∂_c g_ab)/2 at [..., c, a, b]."""
    slope = metric.gradient
    return (slope + jnp.swapaxes(slope, -1, -2) - jnp.moveaxis(slope, -1, -3)) / 2


def inner(inverse: Float[Array, "... d d"], p: Float[Array, "... d"], q: Float[Array, "... d"]) -> Float[Array, "..."]:
    """Return ⟨p, q⟩ = gᵃᵇ pₐ qᵦ of two covectors."""
    # XLA fuses sums of products with other operations, but would call a library for each of many tiny matrix products.
    return jnp.sum(inverse * p[..., :, None] * q[..., None, :], axis=(-2, -1))


def metric_function(field: TensorField) -> Callable[[Array], Array]:
    """Return the field's function, symmetrised, in the dtype of its argument; NaN where it is not positive definite."""
    function = field.function
    assert function is not None
    return lambda x: spd.positive_or_nan(spd.symmetrise(jnp.asarray(function(x), x.dtype)))


def metric_jet(field: TensorField, wraps: tuple[bool, ...], lower: Any = 0) -> tuple[Jet, Bool[np.ndarray, "*shape"]]:
    """Return a metric and its derivatives at the nodes, and the nodes where the derivatives are known."""
    inside = domain_nodes(field.grid, wraps)
    if field.function is None:
        return nodal_jet(field.domain_tensors, field.grid, inside, wraps, lower)
    function = metric_function(field)
    return at_nodes(lambda x: function_jet(function, x), field.grid, inside), inside


def domain_nodes(grid: Grid, wraps: tuple[bool, ...]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes of the domain's elements; results are NaN at all other nodes."""
    return element_nodes(active_elements(grid.inside, wraps), wraps)


def at_nodes(fn: Callable[[Array], Any], grid: Grid, inside: Bool[np.ndarray, "*shape"]) -> Any:
    """Evaluate a function of position at every node; each array in the result has the shape (*shape, …).

    Nodes outside the domain get the function's value at a node inside. The function may be NaN outside, and NaN would
    enter the gradients even if a mask removed it from the values.
    """
    nodes = np.where(inside[..., None], grid.nodes, grid.nodes[inside][0])
    return over_nodes(fn, jnp.asarray(nodes, jnp.result_type(float)), grid.dimension)


def over_nodes(fn: Callable[[Array], Any], values: Float[Array, "*shape_and_more"], dimension: int) -> Any:
    """Apply a function to the values of every node of a grid; each array in the result has the shape (*shape, …)."""
    shape = values.shape[:dimension]
    # High derivatives have many intermediates per node; batches limit their memory and keep them in the cache.
    size = math.prod(shape)
    n_batches = -(-size // _BATCH)
    flat = values.reshape(size, *values.shape[dimension:])
    batches = jnp.resize(flat, (n_batches, -(-size // n_batches), *flat.shape[1:]))
    found = jax.lax.map(jax.vmap(fn), batches)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:size].reshape(*shape, *a.shape[2:]), found)
