"""Boundary conditions per axis and side; the mirror as a set of mixed problems; reflected strips."""

from itertools import product
from types import EllipsisType
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField

Side: TypeAlias = str
Sides: TypeAlias = tuple[Side, Side]
"""The conditions at the low and the high side of one axis."""
BoundarySpec: TypeAlias = str | tuple[str | Sides, ...]

_CONDITIONS = ("neumann", "dirichlet", "periodic", "mirror")


def normalise_boundary(boundary: BoundarySpec, dimension: int) -> tuple[Sides, ...]:
    """Return the (low, high) conditions of every axis.

    Args:
        boundary: ``"neumann"``, ``"dirichlet"``, ``"periodic"`` or ``"mirror"``; or a tuple with one entry per
            axis, each one of these names or a pair (low, high) of ``"neumann"`` and ``"dirichlet"``.
        dimension: the number of axes.
    """
    entries = (boundary,) * dimension if isinstance(boundary, str) else boundary
    if not isinstance(entries, tuple | list) or len(entries) != dimension:
        raise ValueError(f"boundary: got {boundary!r}; expected one name, or a tuple of {dimension}, one per axis")
    sides = []
    for entry in entries:
        pair = (entry, entry) if isinstance(entry, str) else entry
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValueError(f"boundary: got {entry!r} for one axis; expected a name or a pair (low, high)")
        low, high = pair
        unknown = [name for name in pair if name not in _CONDITIONS]
        if unknown:
            raise ValueError(f"boundary: got {unknown[0]!r}; expected one of {', '.join(map(repr, _CONDITIONS))}")
        if low != high and not {low, high} <= {"neumann", "dirichlet"}:
            raise ValueError(
                f'boundary: got {entry!r} for one axis; "periodic" and "mirror" bind both sides of an axis'
            )
        sides.append((low, high))
    return tuple(sides)


def mirror_problems(boundary: tuple[Sides, ...]) -> list[tuple[Sides, ...]]:
    """Return the mixed problems whose spectra together are that of the domain doubled along its mirror axes.

    Functions on the doubled, periodic axis are even or odd about both mirrors: even ones have no normal derivative
    there, odd ones vanish. So each mirror axis stands for a Neumann and a Dirichlet problem, and m mirror axes
    for 2^m of them.
    """
    choices = [
        [("neumann", "neumann"), ("dirichlet", "dirichlet")] if sides == ("mirror", "mirror") else [sides]
        for sides in boundary
    ]
    return list(product(*choices))


def reflect(field: TensorField, width: int) -> TensorField:
    """Extend a field by a strip of its mirror image on every side, as the paper does before it crops.

    A reflection is an isometry only if the off-diagonal components across the mirror change their sign; in the strip
    beyond a side of axis a, Tₐᵦ (b ≠ a) is negated.

    Args:
        field: the field on a grid of shape (n₁, …).
        width: the strip's width in nodes, 1 … n − 1.

    Returns:
        The field on the grid of shape (n₁ + 2·width, …); the mask, if any, is reflected too.
    """
    grid, d = field.grid, field.grid.dimension
    if not 1 <= width <= min(grid.shape) - 1:
        raise ValueError(f"width: got {width}; expected 1 … {min(grid.shape) - 1} nodes for shape {grid.shape}")
    pad = [(width, width)] * d
    tensors = jnp.pad(field.tensors, [*pad, (0, 0), (0, 0)], mode="reflect")
    for axis in range(d):
        index = np.arange(-width, grid.shape[axis] + width)
        beyond = (index < 0) | (index > grid.shape[axis] - 1)
        sign = np.where(beyond, -1.0, 1.0).reshape([-1 if a == axis else 1 for a in range(d)] + [1, 1])
        flips = np.zeros((d, d), dtype=bool)
        flips[axis, :] = flips[:, axis] = True
        flips[axis, axis] = False
        tensors = tensors * jnp.where(flips, sign, 1.0).astype(tensors.dtype)
    mask = None if grid.mask is None else np.pad(grid.mask, pad, mode="reflect")
    origin = [o - width * h for o, h in zip(grid.origin, grid.spacing, strict=True)]
    shape = [n + 2 * width for n in grid.shape]
    return TensorField(Grid(shape, grid.spacing, origin, mask, components="all"), tensors, field.interpolation)


def crop(
    values: Float[Array | np.ndarray, "*leading_and_enlarged"], grid: Grid
) -> Float[Array | np.ndarray, "*leading_and_shape"]:
    """Cut the trailing axes of ``values`` centrally down to the shape of ``grid``: the inverse of `reflect`."""
    d = grid.dimension
    excess = [big - n for big, n in zip(np.shape(values)[-d:], grid.shape, strict=True)]
    if min(excess) < 0 or any(e % 2 for e in excess):
        raise ValueError(
            f"values: got trailing shape {np.shape(values)[-d:]}; expected {grid.shape} plus an even number of nodes "
            "per axis, as `reflect` makes it"
        )
    centre = [slice(e // 2, e // 2 + n) for e, n in zip(excess, grid.shape, strict=True)]
    index: tuple[EllipsisType | slice, ...] = (..., *centre)
    return values[index]
