"""Degenerate points, marked."""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from scipy.spatial import cKDTree

from hks_jax.domain.degenerate import degenerate_points as find_degenerate_points
from hks_jax.domain.tensor_field import TensorField
from hks_jax.plot.figure import cell_extent, frame, legend_below


def degenerate_points(
    ax: Axes,
    field: TensorField,
    *,
    merge: int = 2,
    size: float = 0.022,
    cmap: str = "PuOr",
    legend: bool = True,
    **kwargs: Any,
) -> PolyCollection:
    """Mark the degenerate points of a 2D field over whatever `ax` shows, shape and colour by their index.

    Trisectors (index −½) are triangles, wedges (½) discs, points of other indices polygons of |2·index| + 2 sides.
    Marks have sizes in coordinates, and shrink where they would overlap.

    Args:
        ax: the axes to draw on.
        field: the field.
        merge: as for `hks_jax.degenerate_points`, which finds the points.
        size: radius of a mark, relative to the longer side of the grid.
        cmap: a diverging colour map; its middle belongs to index 0.
        legend: whether to say which mark is which index, and how many there are.
        **kwargs: passed to `matplotlib.collections.PolyCollection`.

    Raises:
        ValueError: a 3D field; merge less than 1; a size that is not positive.
    """
    if not size > 0:
        raise ValueError(f"size: got {size}; expected a positive number, relative to the longer side")
    positions, indices = find_degenerate_points(field, merge)
    x0, x1, y0, y1 = cell_extent(field.grid)
    radii = np.full(len(indices), size * max(x1 - x0, y1 - y0))
    if len(indices) > 1:
        nearest = cKDTree(positions).query(positions, k=2)[0][:, 1]
        radii = np.minimum(radii, 0.48 * nearest)
    limit = max(1.5, np.abs(indices).max(initial=0))
    colours = {index: colormaps[cmap](0.5 - 0.5 * index / limit) for index in np.unique(indices)}
    marks = [r * _outline(index) + x for x, index, r in zip(positions, indices, radii, strict=True)]
    collection = PolyCollection(
        marks,
        **{
            "facecolors": [colours[i] for i in indices],
            "edgecolors": "black",
            "linewidths": 0.8,
            "zorder": 3,
            "path_effects": [withStroke(linewidth=2.5, foreground="white")],
            **kwargs,
        },
    )
    frame(ax, field.grid)
    ax.add_collection(collection, autolim=False)
    if legend and len(indices):
        _add_legend(ax, indices, colours)
    return collection


def _add_legend(ax: Axes, indices: np.ndarray, colours: dict[float, Any]) -> None:
    """Say which mark is which index."""
    handles = [
        Line2D(
            [],
            [],
            linestyle="",
            color=colour,
            markeredgecolor="black",
            marker="o" if index == 0.5 else (_corners(index), 0, 0),
            label=f"{_half_text(index)}  ({np.sum(indices == index)})",
        )
        for index, colour in colours.items()
    ]
    legend_below(ax, handles, "index (how many)")


def _outline(index: float) -> np.ndarray:
    """Return a polygon of radius 1: a disc for ½, else as many corners as `_corners` says."""
    corners = 32 if index == 0.5 else _corners(index)
    angle = np.pi / 2 + 2 * np.pi * np.arange(corners) / corners
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _corners(index: float) -> int:
    return round(abs(2 * index)) + 2


def _half_text(index: float) -> str:
    """Write a multiple of ½."""
    sign, twice = "−" if index < 0 else "", round(abs(2 * index))
    return f"{sign}{twice // 2}" if twice % 2 == 0 else f"{sign}{twice}/2" if twice > 1 else f"{sign}½"
