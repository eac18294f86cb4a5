"""Boundary conditions of grids and masks, the problems of doubled domains, and strips around fields."""

from itertools import product
from types import EllipsisType
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_count
from hks_jax.domain.components import active_elements, as_mask, element_nodes, rim_nodes
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_checks import require_grid
from hks_jax.domain.tensor_field import TensorField, require_field
from hks_jax.naming import argument

Sides: TypeAlias = tuple[str, str]
"""The conditions at the low and the high side of one axis."""
BoundarySpec: TypeAlias = str | tuple[str | Sides, ...]

_SIDE_BY_SIDE = ("neumann", "dirichlet", "mean")
_CONDITIONS = (*_SIDE_BY_SIDE, "periodic", "mirror")
_WHOLE_RIM = {"mean": "mean", "dirichlet-rim": "dirichlet"}
"""Names that set one condition on all sides and on the rim of a mask, if `boundary` is the name, and this condition."""


def normalise_boundary(boundary: BoundarySpec, dimension: int) -> tuple[Sides, ...]:
    """Return a pair of conditions (low, high) for each axis; a last pair repeats the condition on the rim of a mask.

    `assemble` describes the argument `boundary`. If `boundary` has no entry for the rim of a mask, the condition on the
    rim is ``"mean"`` if an axis has the mean condition, and natural otherwise.
    """
    if isinstance(boundary, str):
        everywhere = _WHOLE_RIM.get(boundary)
        entries: tuple[str | Sides, ...] = (everywhere or boundary,) * dimension + (everywhere or "neumann",)
    elif not isinstance(boundary, tuple | list) or len(boundary) not in (dimension, dimension + 1):
        raise ValueError(
            f"boundary: got {boundary!r}; expected one name, or a tuple of {dimension} entries, one per axis, "
            f"or of {dimension + 1} entries, the last one for the rim of a mask"
        )
    else:
        entries = tuple(boundary)
    sides = [_pair(entry) for entry in entries]
    if len(sides) == dimension:
        rim = "mean" if any("mean" in pair for pair in sides) else "neumann"
        sides.append((rim, rim))
    elif sides[-1][0] != sides[-1][1] or sides[-1][0] not in _SIDE_BY_SIDE:
        raise ValueError(
            f"boundary: got {entries[-1]!r} for the rim of a mask; "
            f"expected one of {', '.join(map(repr, _SIDE_BY_SIDE))}"
        )
    return tuple(sides)


def _pair(entry: str | Sides) -> Sides:
    pair = (entry, entry) if isinstance(entry, str) else entry
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise ValueError(f"boundary: got {entry!r} for one axis; expected a name or a pair (low, high)")
    low, high = pair
    unknown = [name for name in pair if name not in _CONDITIONS]
    if unknown:
        possible = ", ".join(map(repr, _CONDITIONS))
        alone = ', or "dirichlet-rim" alone, which is for all sides and the rim of a mask'
        raise ValueError(f"boundary: got {unknown[0]!r}; expected one of {possible}{alone}")
    if low != high and not {low, high} <= set(_SIDE_BY_SIDE):
        raise ValueError(f'boundary: got {entry!r} for one axis; "periodic" and "mirror" must be on both sides')
    return low, high


def default_boundary(inside: Bool[np.ndarray, "*shape"]) -> tuple[str, str]:
    """Return the boundary condition that suits a domain, and the reason.

    The suitable condition is ``"mean"`` for a domain whose mask has inner nodes, because the natural condition doubles
    signatures beside the rim of the mask. The command line uses `default_boundary`; the functions of the library use
    ``"neumann"`` by default.

    Args:
        inside: (*shape) the nodes of the domain, such as `Grid.inside`.

    Examples:
        >>> hj.default_boundary(field.grid.inside)
        ('neumann', 'the domain has no mask')
    """
    inside = as_mask("inside", inside)
    if inside.all():
        return "neumann", "the domain has no mask"
    every_axis = (False,) * inside.ndim
    elements = active_elements(inside, every_axis)
    free = element_nodes(elements, every_axis) & ~rim_nodes(elements, every_axis)
    if not free[(slice(1, -1),) * inside.ndim].any():  # the mean needs nodes away from sides and rim
        return "neumann", "the mask is so thin that all voxels are on the rim, but the mean needs inner voxels"
    return (
        "mean",
        f"the domain has a mask; for the natural condition on its rim, pass {argument('boundary', 'neumann')}",
    )


def sides_of(grid: Grid, boundary: BoundarySpec) -> tuple[Sides, ...]:
    """Return `normalise_boundary`, and warn of conditions where the grid's domain has no boundary.

    Warns:
        AccuracyWarning: the mask does not reach the side of a condition, or there is no mask for the rim's condition.
    """
    *axes, (rim, _) = sides = normalise_boundary(boundary, grid.dimension)
    if grid.inside.all() and rim == "dirichlet" and not any("dirichlet" in pair for pair in axes):
        where = "acts nowhere: there is no mask, and so no rim. Leave this condition out"
        warn_of_accuracy(f'boundary: got {boundary!r}, but "dirichlet" {where}')
    reached = [[bool(np.take(grid.inside, index, axis).any()) for index in (0, -1)] for axis in range(grid.dimension)]
    mirrored = any(any(here) for here, pair in zip(reached, axes, strict=True) if "mirror" in pair)
    found = {}
    for name, here, pair in zip("xyz", reached, axes, strict=False):
        if "periodic" in pair:  # acts on both sides or on none
            here = [all(here)] * 2
        elif "mirror" in pair:  # needs one side; the caller refuses mirrors that act nowhere
            here = [any(here) or not mirrored] * 2
        for side, condition, acts in zip(("low", "high"), pair, here, strict=True):
            if not acts and condition not in ("neumann", rim):
                found[f"the {side} side of {name}"] = condition
    if found:
        distinct = dict.fromkeys(found.values())
        names = " and ".join(f'"{name}"' for name in distinct) + (" has" if len(distinct) == 1 else " have")
        where = "any side of the grid" if len(found) == 2 * grid.dimension else ", ".join(found)
        natural = 'has the natural condition, unless you pass "dirichlet-rim" or "mean"'
        warn_of_accuracy(
            f"boundary: {names} no effect at {where}, which the mask does not reach; the rim of the mask "
            + (natural if rim == "neumann" else f'has "{rim}"')
        )
    return sides


def doubled_problems(boundary: tuple[Sides, ...]) -> list[tuple[Sides, ...]]:
    """Return the problems whose spectra together are the spectrum of a domain doubled by ``"mirror"`` or ``"mean"``.

    On an axis doubled by ``"mirror"``, functions are sums of an even and an odd function about the mirrors at both
    sides. Even functions satisfy the Neumann condition at a mirror, and odd functions vanish. A mirrored axis therefore
    gives a Neumann and a Dirichlet problem, and m mirrored axes give 2^m problems. On two copies of a domain glued
    along the rim by ``"mean"``, functions are sums of an even (Neumann) and an odd (Dirichlet) function. The first
    problem in the list has the functions that are even under all reflections.
    """
    choices = [
        [("neumann", "neumann"), ("dirichlet", "dirichlet")] if sides == ("mirror", "mirror") else [sides]
        for sides in boundary
    ]
    mixed = list(product(*choices))
    if not any("mean" in sides for sides in boundary):
        return mixed
    halves = [{"mean": condition} for condition in ("neumann", "dirichlet")]
    return [tuple((half.get(a, a), half.get(b, b)) for a, b in problem) for half in halves for problem in mixed]


def reflect(field: TensorField, width: int) -> TensorField:
    """Extend a field by a mirrored strip on every side, as Zobel, Reininghaus and Hotz do; `crop` removes the strips.

    A reflection is an isometry only if the off-diagonal components of the tensors across the mirror change sign. In the
    strip beyond a side of axis a, the tensor components Tₐᵦ with b ≠ a are negated. `reflect` also reflects a mask.

    Args:
        field: the field on a grid of shape (n₁, …).
        width: the strip's width in nodes, 1 … n − 1.

    Examples:
        >>> wide = hj.reflect(field, 2)
        >>> np.allclose(wide.tensors[1, 6], field.tensors[1, 4] * jnp.array([[1.0, -1.0], [-1.0, 1.0]]))
        True
    """
    require_field(field)
    require_count("width", width)
    grid, d = field.grid, field.grid.dimension
    if not 1 <= width <= min(grid.shape) - 1:
        raise ValueError(f"width: got {width}; expected 1 … {min(grid.shape) - 1} nodes for shape {grid.shape}")
    pad = [(width, width)] * d
    tensors = jnp.pad(field.tensors, [*pad, (0, 0), (0, 0)], mode="reflect")
    inside = [np.pad(np.ones(n), width, constant_values=-1) for n in grid.shape]
    sign = np.stack(np.meshgrid(*inside, indexing="ij"), axis=-1)
    tensors = tensors * jnp.asarray(sign[..., :, None] * sign[..., None, :], tensors.dtype)
    mask = None if grid.mask is None else np.pad(grid.mask, pad, mode="reflect")
    origin = [o - width * h for o, h in zip(grid.origin, grid.spacing, strict=True)]
    shape = [n + 2 * width for n in grid.shape]
    return field.with_tensors(tensors, Grid(shape, grid.spacing, origin, mask, components="all"))


def crop(
    values: Float[Array | np.ndarray, "*leading_and_enlarged"], grid: Grid
) -> Float[Array | np.ndarray, "*leading_and_shape"]:
    """Return the centre of the trailing axes of ``values``, in the shape of ``grid``: the inverse of `reflect`.

    Examples:
        >>> wide = hj.reflect(field, 2)
        >>> np.allclose(hj.crop(wide.tensors[..., 0, 1], field.grid), field.tensors[..., 0, 1])
        True
    """
    require_grid(grid)
    values, d = values if hasattr(values, "shape") else np.asarray(values), grid.dimension
    if values.ndim < d:
        raise ValueError(f"values: got shape {values.shape}; expected at least {d} axes")
    excess = [big - n for big, n in zip(np.shape(values)[-d:], grid.shape, strict=True)]
    if min(excess) < 0 or any(e % 2 for e in excess):
        raise ValueError(
            f"values: got trailing shape {np.shape(values)[-d:]}; expected {grid.shape} plus an even number of nodes "
            "per axis, as `reflect` adds"
        )
    centre = [slice(e // 2, e // 2 + n) for e, n in zip(excess, grid.shape, strict=True)]
    index: tuple[EllipsisType | slice, ...] = (..., *centre)
    return values[index]
