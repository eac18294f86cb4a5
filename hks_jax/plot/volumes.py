"""Scalars on volumes as three orthogonal slices through a node, at one time or at several."""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Real
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from hks_jax.domain.components import as_mask
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_checks import require_grid
from hks_jax.plot.figure import SMALL, colour_bar_in, finished, lines_in, new_figure
from hks_jax.plot.images import masked, panel_colours, scalar_image
from hks_jax.plot.orientation import Orientation
from hks_jax.plot.panels import BESIDE, LINE, checked_times, panel_titles

AXES = "xyz"
PLANES = ((0, 1), (0, 2), (1, 2))
"""The horizontal and vertical axes of the three slices."""
_COLUMN, _COLUMNS = 2.3, 6
"""The width of a column of slices in inches, and the maximum number of columns."""
_LEAST_HEIGHT = 0.8
"""The least height of a slice in inches, which leaves room for the labels of its vertical axis."""


def middle_node(inside: Bool[np.ndarray, "*shape"]) -> tuple[int, ...]:
    """Return the inside node that is nearest to the mean of all inside nodes.

    Raises:
        ValueError: if no node is inside.

    Examples:
        >>> hj.plot.middle_node(np.ones((5, 5, 5), bool))
        (2, 2, 2)
    """
    nodes = np.argwhere(inside)
    if not len(nodes):
        raise ValueError("inside: got no node inside; expected at least one")
    extent = np.maximum(np.ptp(nodes, axis=0), 1)
    distance = np.sum(((nodes - nodes.mean(axis=0)) / extent) ** 2, axis=1)
    return tuple(nodes[np.argmin(distance)].tolist())


def orthogonal_slices(
    axes: Sequence[Axes] | np.ndarray,
    values: Real[ArrayLike, "nx ny nz"],
    grid: Grid,
    *,
    node: Sequence[int] | None = None,
    cross: bool = True,
    orientation: Orientation | None = None,
    z: Real[ArrayLike, "nx ny nz"] | None = None,
    hatched: Bool[ArrayLike, "nx ny nz"] | None = None,
    **kwargs: Any,
) -> AxesImage:
    """Draw the slices xy, xz and yz of a volume through a node in the same colours, and return the last image.

    Args:
        axes: three Matplotlib axes for the planes xy, xz and yz, in this order.
        values: (*shape,), with NaN at nodes without a value.
        grid: the 3D grid of the values, whose spacing determines the aspect ratio of the slices.
        node: the indices (i, j, k) of the node. If the given node has no value, the nearest node with a value is used.
            The default node is the middle of all nodes with a value (`middle_node`).
        cross: whether thin lines show the positions of the other two slices.
        orientation: the grid's orientation in space, by which slices are turned and their sides are labelled (L, R, …).
        z: (*shape,); values within the noise fade as in `scalar_image`.
        hatched: (*shape,) the nodes that are hatched.
        **kwargs: arguments of `scalar_image` for the whole volume, such as cmap, vmin, vmax, centre, quantiles.

    Raises:
        ValueError: if there are not three axes, if the grid is not 3D, or if values have another shape or are all NaN.

    Examples:
        >>> axes, grid = hj.plot.new_figure(6, 2).subplots(1, 3), hj.Grid((5, 5, 5))
        >>> hj.plot.orthogonal_slices(axes, grid.nodes[..., 0], grid).get_clim()  # of all three
        (0.0, 4.0)
    """
    if len(axes) != 3:
        raise ValueError(f"axes: got {len(axes)} axes; expected 3, for the planes xy, xz and yz")
    require_volume(grid)
    masks: dict[str, Any] = {
        "z": None if z is None else masked("z", z, grid),
        "hatched": None if hatched is None else as_mask("hatched", hatched),
    }
    if orientation is not None:
        masks = {name: None if mask is None else orientation.array(mask) for name, mask in masks.items()}
    array, grid, chosen = _turned(masked("values", values, grid), grid, node, orientation)
    (style,) = panel_colours([array], **kwargs)
    for ax, (first, second) in zip(axes, PLANES, strict=True):
        normal = 3 - first - second
        plane = (np.take(of, (first, second)).tolist() for of in (grid.shape, grid.spacing, grid.origin))
        slab = np.take(array, chosen[normal], axis=normal)
        cut: dict[str, Any] = {
            n: None if mask is None else mask.take(chosen[normal], axis=normal) for n, mask in masks.items()
        }
        image = scalar_image(ax, slab, Grid(*plane), colorbar=False, **cut, **style)
        if orientation is not None:
            orientation.letter(ax, (first, second))
        if cross:
            lines: dict[str, Any] = {"color": "0.5", "linewidth": 0.6, "linestyle": (0, (4, 3))}
            ax.axvline(grid.axes[first][chosen[first]], **lines)
            ax.axhline(grid.axes[second][chosen[second]], **lines)
    return image


def volume_panels(
    values: Real[ArrayLike, "n_times nx ny nz"],
    times: Sequence[float] | Real[ArrayLike, " n_times"],
    grid: Grid,
    *,
    node: Sequence[int] | None = None,
    titles: Sequence[str] | None = None,
    unit: str = "",
    length_unit: str = "",
    shared_range: bool = False,
    limits: Sequence[tuple[float, float]] | None = None,
    beside: Mapping[str, Real[ArrayLike, "nx ny nz"]] | None = None,
    path: str | os.PathLike[str] | None = None,
    label: str = "",
    suptitle: str = "",
    orientation: Orientation | None = None,
    z: Real[ArrayLike, "n_times nx ny nz"] | None = None,
    hatched: Bool[ArrayLike, "n_times nx ny nz"] | None = None,
    **kwargs: Any,
) -> Figure:
    """Return a figure with a column of three orthogonal slices of the HKS and a colour bar for each time.

    Args:
        values: (n_times, *shape) the result of `hks_jax.hks`.
        times: (n_times,).
        grid: the 3D grid of the values.
        node: the same as for `orthogonal_slices`.
        titles: a title for each time, by default “t = …”.
        unit: the unit of t, which titles show after the value of t.
        length_unit: the unit of the coordinates.
        shared_range: whether all times use the colours of one range. The three slices always do.
        limits: the values of the first and the last colour for each time.
        beside: other scalars (*shape,) by title, drawn in grey after the last time.
        path: the file in which to save the figure, if given.
        label: the colour bars' label.
        suptitle: the figure's title.
        orientation: the same as for `orthogonal_slices`.
        z: (n_times, *shape); values within the noise fade as in `hks_panels`.
        hatched: (n_times, *shape) the nodes that are hatched.
        **kwargs: arguments of `scalar_image` for all volumes, such as cmap, centre and quantiles.

    Raises:
        ValueError: if shapes disagree, if no time is given, or as in `orthogonal_slices`.

    Examples:
        >>> grid = hj.Grid((5, 5, 5))
        >>> fig = hj.plot.volume_panels(np.stack([grid.nodes[..., 0]] * 2), [0.2, 0.5], grid)
        >>> len(fig.axes)
        8
    """
    require_volume(grid)
    t = checked_times(times, grid.shape, values=values, z=z, hatched=hatched)
    titles = panel_titles(t, titles, unit)
    volumes = [masked("values", each, grid) for each in np.ma.asarray(values)]
    colours = panel_colours(volumes, limits, shared_range, **kwargs)
    others = [masked(f"beside: {title}", each, grid) for title, each in (beside or {}).items()]
    volumes, colours = [*volumes, *others], [*colours, *panel_colours(others, **BESIDE)]
    titles, n = [*titles, *(beside or {})], len(volumes)
    noise, lines = ([None] * n if each is None else [*np.asarray(each), *[None] * len(others)] for each in (z, hatched))
    _, shown, chosen = _turned(volumes[0], grid, node, orientation)

    rows = math.ceil(n / _COLUMNS)
    columns = math.ceil(n / rows)
    sizes = np.multiply(shown.shape, shown.spacing)
    heights = [float(np.clip(_COLUMN * sizes[up] / max(sizes[:2]), _LEAST_HEIGHT, 3 * _COLUMN)) for _, up in PLANES]
    coordinates = [f"{name} ({length_unit})" if length_unit else name for name in AXES]
    fig = new_figure(
        columns * (_COLUMN + 0.2) + 0.6,
        rows * (sum(heights) + 1.15 + 0.15 * bool(label) + LINE * max(map(lines_in, titles)))
        + LINE * lines_in(suptitle),
    )
    blocks = np.atleast_1d(np.asarray(fig.subfigures(rows, 1), dtype=object))
    for row, block in enumerate(blocks):
        panels = block.subplots(4, columns, squeeze=False, height_ratios=[*heights, 0.09])
        for column in range(columns):
            index = row * columns + column
            if index >= n:
                for ax in panels[:, column]:
                    ax.remove()
                continue
            style: dict[str, Any] = {
                "node": node,
                "orientation": orientation,
                "z": noise[index],
                "hatched": lines[index],
            }
            image = orthogonal_slices(panels[:3, column], volumes[index], grid, **style, **colours[index])
            panels[0, column].set_title(titles[index], fontsize="medium")
            for ax, (first, second) in zip(panels[:3, column], PLANES, strict=True):
                normal = 3 - first - second
                place = f"{AXES[normal]} = {shown.axes[normal][chosen[normal]]:.4g} {length_unit}".rstrip()
                ax.set_xlabel(coordinates[first], fontsize=SMALL, labelpad=1)
                ax.set_ylabel(f"{place}\n{coordinates[second]}" if column == 0 else "", fontsize=SMALL)
                ax.tick_params(labelleft=column == 0)
            quantity = label if index < t.size else ""
            colour_bar_in(panels[3, column], image, quantity, values=volumes[index], orientation="horizontal")
    return finished(fig, suptitle, path)


def require_volume(grid: Grid) -> None:
    """Raise ValueError unless the grid is three-dimensional."""
    require_grid(grid)
    if grid.dimension != 3:
        raise ValueError(f"grid: got shape {grid.shape}; expected three dimensions. Use hks_panels for two dimensions")


def _turned(
    array: np.ma.MaskedArray, grid: Grid, node: Sequence[int] | None, orientation: Orientation | None
) -> tuple[np.ma.MaskedArray, Grid, tuple[int, ...]]:
    """Return the values, the grid and the nearest node with a value along the axes of the image."""
    if node is not None:
        if np.shape(node) != (3,):
            raise ValueError(f"node: got {node!r}; expected three indices")
        nodes = np.argwhere(~np.ma.getmaskarray(array))
        node = nodes[np.argmin(np.sum((nodes - np.asarray(node)) ** 2, axis=1))].tolist()
    if orientation is not None:
        node = None if node is None else orientation.node(node, grid.shape)
        array, grid = orientation.array(array), orientation.grid(grid)
    # The array is turned before the middle node is chosen, so that the choice does not depend on the storage order.
    return array, grid, middle_node(~np.ma.getmaskarray(array)) if node is None else tuple(node)
