"""Images of scalars on grids."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Real
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.image import AxesImage

from hks_jax.domain.grid import Grid
from hks_jax.plot.figure import cell_extent, colour_bar, frame, require_plane
from hks_jax.plot.orientation import Orientation

FADED = 2.0
"""The number of standard deviations from which on values are no longer faded as noise."""


def scalar_image(
    ax: Axes,
    values: Real[ArrayLike, "nx ny"],
    grid: Grid,
    *,
    cmap: str | Colormap | None = None,
    vmin: float | None = None,
    vmax: float | None = None,
    centre: float | None = None,
    quantiles: tuple[float, float] = (0.0, 1.0),
    least_range: float = 1e-6,
    colorbar: bool = True,
    label: str = "",
    orientation: Orientation | None = None,
    z: Real[ArrayLike, "nx ny"] | None = None,
    **kwargs: Any,
) -> AxesImage:
    """Draw node values as an image: array axis 0 horizontal, one cell per node, transparent outside the mask.

    Args:
        ax: the axes to draw on.
        values: (*shape,), NaN where there is nothing to draw.
        grid: the 2D grid of the values.
        cmap: colour map; None: viridis, or a diverging one, red above and blue below, where there is a centre.
        vmin: value of the first colour; None: from `quantiles`.
        vmax: value of the last colour; None: from `quantiles`.
        centre: value of the middle colour where vmin and vmax do not say, such as 1 for 4πt·HKS, which it is where the
            metric is flat: the colours reach as far above it as below. Of values that are never negative they reach
            down to 0 at most; if then most values would have one of the last colours, there is no centre.
        quantiles: the values' quantiles that take the first and the last colour where vmin and vmax do not
            say. The colour bar has arrows where values lie beyond.
        least_range: the least difference between the last colour's value and the first's, relative to the larger.
            A constant then looks constant, whatever its rounding or discretisation errors are.
        colorbar: whether to add a colour bar.
        label: the colour bar's label.
        orientation: how the grid lies in space. The picture is then turned, has coordinates of space, and letters at
            its edges.
        z: (*shape,), how many standard deviations of noise the values are from what would be nothing
            (`hks_jax.Uncertainty.z`): below `FADED` of them they fade into grey, which they are at 0.
        **kwargs: passed to `Axes.imshow`.

    Raises:
        ValueError: a 3D grid, or values that are not of its shape or have nothing finite inside its mask.
    """
    require_plane("grid", grid)
    array = masked("values", values, grid)
    opacity = None if z is None else (1 - np.abs(masked("z", z, grid)) / FADED).clip(0, 1).filled(0)
    if orientation is not None:
        array = orientation.array(array)
        opacity = None if opacity is None else orientation.array(opacity)
        grid = orientation.grid(grid)
    low, high, own = colours_of(array.compressed(), quantiles, least_range, centre, vmin, vmax)
    image = ax.imshow(
        array.T,
        origin="lower",
        extent=cell_extent(grid),
        cmap=cmap or own,
        vmin=low,
        vmax=high,
        **{"interpolation": "nearest", **kwargs},
    )
    if opacity is not None:
        grey = np.dstack([np.full((*opacity.T.shape, 3), 0.8), opacity.T])
        ax.imshow(grey, origin="lower", extent=cell_extent(grid), interpolation="nearest")
    frame(ax, grid)
    if orientation is not None:
        orientation.letter(ax)
    if colorbar:
        colour_bar(ax, image, label)
    return image


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
    """Draw the share of the HKS that the boundary decides at one time, with lines at a few levels.

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
    values = masked("influence", influence, grid)
    image = scalar_image(ax, values, grid, cmap=cmap, vmin=0.0, vmax=1.0, label=label, **kwargs)
    reached = [level for level in levels if values.min() < level < values.max()]
    if reached:
        lines = ax.contour(*grid.axes, values.T, levels=reached, colors="white", linewidths=1.0)
        ax.clabel(lines, fmt=lambda level: f"{100 * level:g} %", fontsize="x-small")
    return image


def masked(name: str, values: Any, grid: Grid) -> np.ma.MaskedArray:
    """Return values on the grid, masked where they are not finite or outside its mask; raise if that is everywhere."""
    if isinstance(values, np.ma.MaskedArray):
        return values
    array = np.asarray(values, dtype=np.float64)
    if array.shape != grid.shape:
        raise ValueError(f"{name}: got shape {array.shape}; expected the grid's shape {grid.shape}")
    masked = np.ma.array(array, mask=~(np.isfinite(array) & grid.inside))
    if masked.count() == 0:
        raise ValueError(f"{name}: no finite value inside the grid's mask; nothing to draw")
    return masked


class Colours(NamedTuple):
    """The values of the first and the last colour, and the colour map unless another is asked for."""

    low: float
    high: float
    cmap: str = "viridis"


def colours_of(
    values: np.ndarray,
    quantiles: tuple[float, float] = (0.0, 1.0),
    least_range: float = 1e-6,
    centre: float | None = None,
    vmin: float | None = None,
    vmax: float | None = None,
) -> Colours:
    """Return the colours of values; see `scalar_image`."""
    low, high = (float(q) for q in np.quantile(values, quantiles))
    cmap = "viridis"
    if centre is not None:
        reach = max(high - centre, centre - low, 0.0)
        if values.min() >= 0 < centre < reach:  # no colours for what is negative
            reach = centre if np.median(values) <= 1.5 * centre else 0.0
        if reach or low == high:
            low, high, cmap = centre - reach, centre + reach, "RdBu_r"
    lacking = least_range * (max(abs(low), abs(high)) or 1.0) - (high - low)
    low, high = low - max(lacking, 0) / 2, high + max(lacking, 0) / 2
    return Colours(low if vmin is None else vmin, high if vmax is None else vmax, cmap)


def shared_colours(images: Sequence[np.ma.MaskedArray], kwargs: dict[str, Any]) -> dict[str, Any]:
    """Return arguments of `scalar_image` by which all of these have the same colours for the same values."""
    values = np.concatenate([image.compressed() for image in images])
    names = ("quantiles", "least_range", "centre", "vmin", "vmax")
    low, high, own = colours_of(values, **{name: kwargs[name] for name in names if name in kwargs})
    return {**kwargs, "vmin": low, "vmax": high, "cmap": kwargs.get("cmap") or own}
