"""Several scalars over t, a row each; and the map of the boundary's influence."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Real
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from hks_jax.domain.grid import Grid
from hks_jax.plot.figure import SMALL, finished, new_figure, panel_size, require_plane
from hks_jax.plot.images import panel_titles, scalar_image


def time_rows(
    rows: Mapping[str, Real[ArrayLike, "n_times nx ny"]],
    times: Sequence[float] | Real[ArrayLike, " n_times"],
    grid: Grid,
    *,
    unit: str = "",
    shared: str = "none",
    cmap: str | Colormap | Mapping[str, str] = "viridis",
    quantiles: tuple[float, float] = (0.0, 1.0),
    suptitle: str = "",
) -> Figure:
    """Return a figure with a row of images for each scalar and a column for each time, such as the HKS beside scalars.

    Args:
        rows: the scalars by name, each (n_times, *shape), NaN where there is nothing to draw.
        times: (n_times,).
        grid: the 2D grid of the values.
        unit: the unit of t.
        shared: which images share the colours of one range: ``"none"``, or those of each ``"row"``.
        cmap: a colour map, or one for each row by name.
        quantiles: as for `scalar_image`.
        suptitle: the figure's title.

    Raises:
        ValueError: no rows or times; values that are not one image per time; another `shared`.
    """
    require_plane("grid", grid)
    if shared not in ("none", "row"):
        raise ValueError(f'shared: got {shared!r}; expected "none" or "row"')
    if not rows:
        raise ValueError("rows: got none; expected one scalar or more")
    for name, values in rows.items():
        t, titles = panel_titles(values, times, grid, None, unit, f"rows: {name}")
    width, height = panel_size(grid, 1.9)
    figure = new_figure(t.size * (width + 0.65) + 0.6, len(rows) * (height + 0.2) + 0.5 + 0.3 * bool(suptitle))
    panels = figure.subplots(len(rows), t.size, squeeze=False)
    for line, (name, values) in zip(panels, rows.items(), strict=True):
        images = np.asarray(values, dtype=np.float64)
        low = high = None
        if shared == "row":
            inside = images[:, grid.inside]
            low, high = (float(q) for q in np.nanquantile(inside, quantiles))
        colours = cmap[name] if isinstance(cmap, Mapping) else cmap
        for ax, image in zip(line, images, strict=True):
            scalar_image(ax, image, grid, cmap=colours, vmin=low, vmax=high, quantiles=quantiles)
            ax.set(xticks=[], yticks=[])
        line[0].set_ylabel(name, fontsize=SMALL)
    for ax, title in zip(panels[0], titles, strict=True):
        ax.set_title(title, fontsize="medium")
    return finished(figure, suptitle)


def influence_map(
    ax: Axes,
    influence: Real[ArrayLike, "nx ny"],
    grid: Grid,
    *,
    levels: Sequence[float] = (0.01, 0.1),
    cmap: str | Colormap = "cividis",
    label: str = "boundary's influence",
    **kwargs: Any,
) -> AxesImage:
    """Draw what part of the HKS the boundary decides at one time, with lines at a few levels.

    Args:
        ax: the axes to draw on.
        influence: (*shape), one time of `hks_jax.boundary_influence`.
        grid: the 2D grid of the values.
        levels: ascending, between 0 and 1.
        cmap: colour map, from 0 to 1.
        label: the colour bar's label.
        **kwargs: passed to `scalar_image`.

    Returns:
        The image.

    Raises:
        ValueError: a 3D grid, or values that are not of its shape.
    """
    image = scalar_image(ax, influence, grid, cmap=cmap, vmin=0.0, vmax=1.0, label=label, **kwargs)
    values = np.ma.masked_invalid(np.where(grid.inside, np.asarray(influence, dtype=np.float64), np.nan))
    reached = [level for level in levels if values.min() < level < values.max()]
    if reached:
        lines = ax.contour(*grid.axes, values.T, levels=reached, colors="white", linewidths=1.0)
        ax.clabel(lines, fmt=lambda level: f"{100 * level:g} %", fontsize="x-small")
    return image
