"""Fields that forms read, given at the nodes, on the elements, or as functions of position."""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.checks import real_array
from hks_jax.fem.space import FunctionSpace, MeshSpace, mask_for
from hks_jax.traced import is_traced

Place = Literal["everywhere", "nodes", "elements", "points"]


class Field(eqx.Module):
    """A field on the elements of a domain."""

    values: Float[Array, "..."]  # one value (…), or values (*node_shape, …), (*elements, …) or (*elements, q, …)
    at: Place = eqx.field(static=True)  # where the values are given; "points" are quadrature points

    def at_points(
        self, corners: Callable[[Array], Array], shape_values: Float[np.ndarray, "q n"], elements: tuple[int, ...]
    ) -> Float[Array, "E q ..."]:
        """Return the field at the quadrature points of all elements.

        Nodal values are interpolated by the shape functions; `corners` gathers the nodal values of each element.
        """
        values, n, q, axes = self.values, int(np.prod(elements)), len(shape_values), len(elements)
        if self.at == "nodes":
            h = jnp.asarray(shape_values, values.dtype)
            return jnp.einsum("qn,En...->Eq...", h, corners(values), precision="highest")
        if self.at == "points":
            return values.reshape(n, *values.shape[axes:])
        rest = values.shape[axes:] if self.at == "elements" else values.shape
        one = values.reshape(n, 1, *rest) if self.at == "elements" else values
        return jnp.broadcast_to(one, (n, q, *rest))


def checked_field(
    name: str,
    given: Any,
    space: FunctionSpace,
    positions: Callable[[], Float[Array, "*elements q m"]],
    dtype: Any,
    *,
    scalar: bool = False,
    positive: bool = False,
    of_cells: bool = False,
) -> Field:
    """Return the `Field` of a number, an array over nodes or elements, or a function of position.

    An array that fits both has nodal values, unless it is known to be of the cells of a mesh.

    Values outside the domain are ignored. If a field must be positive, traced values that are not positive become NaN.
    Functions are evaluated at the quadrature points; `positions` is called only for functions.

    Raises:
        ValueError: another shape; values that are NaN, infinite or not positive (the message has their number).
    """
    values, at, inside = _placed(name, given, space, positions, of_cells)
    # If a field has several numbers at each place, a place with one wrong number counts as wrong.
    rest = values.ndim - (0 if inside is None else inside.ndim)
    if scalar and rest:
        raise ValueError(f"{name}: got shape {values.shape}; expected one number at each place: {_expected(space)}")
    trailing = tuple(range(values.ndim - rest, values.ndim))
    if not is_traced(values):
        numbers, counted = np.asarray(values), np.ones((), bool) if inside is None else inside
        wrong, what, remedy = counted & ~np.isfinite(numbers).all(axis=trailing), "NaN or infinite", "Replace"
        if positive and not wrong.any():
            wrong, what, remedy = counted & ~(numbers > 0), "not positive", "Raise"
        if wrong.any():
            first = tuple(int(i) for i in np.argwhere(wrong)[0])
            where = f"{at[:-1]} {first if len(first) > 1 else first[0]}" if first else "each place"
            if at == "points":
                where = f"x = {np.asarray(positions())[first].round(6).tolist()}"
            number = "" if trailing else f"{numbers[first]:.6g} "
            raise ValueError(
                f"{name}: {int(wrong.sum())} of {int(counted.sum())} values are {what} (the first is {number}at "
                f"{where}). {remedy} them, or exclude these places by a mask"
            )
    values = values.astype(dtype)
    if positive:
        values = jnp.where(values > 0, values, jnp.nan)
    if inside is not None and not inside.all():
        within = mask_for(values, inside)
        values = jnp.where(within.reshape(*inside.shape, *(1,) * rest), values, 1)
    return Field(values, at)


def _placed(
    name: str,
    given: Any,
    space: FunctionSpace,
    positions: Callable[[], Float[Array, "*elements q m"]],
    of_cells: bool,
) -> tuple[Array, Place, Bool[np.ndarray, "..."] | None]:
    nodes, elements = space.node_shape, space.elements
    if callable(given):
        x = positions()
        values = jax.vmap(lambda at: real_array(name, given(at)))(x.reshape(-1, x.shape[-1]))
        inside = np.broadcast_to(elements[..., None], x.shape[:-1])
        return values.reshape(*x.shape[:-1], *values.shape[1:]), "points", inside
    values = real_array(name, given)
    if isinstance(space, MeshSpace) and space.degree == 2 and not of_cells:
        triangulation = space.triangulation
        if values.shape[:1] == (triangulation.n_vertices,):
            values = jnp.concatenate([values, jnp.mean(values[triangulation.edges], axis=1)])
    if values.ndim == 0:
        return values, "everywhere", None
    if values.shape[: len(nodes)] == nodes and not of_cells:
        return values, "nodes", space.domain
    if values.shape[: elements.ndim] == elements.shape:
        return values, "elements", elements
    raise ValueError(f"{name}: got shape {values.shape}; expected {_expected(space)}")


def _expected(space: FunctionSpace) -> str:
    return (
        f"{space.node_shape}, one per node, {space.elements.shape}, one per element, a number, or a function of "
        "position"
    )
