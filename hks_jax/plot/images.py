"""Images of scalars on grids."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Real
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.image import AxesImage

from hks_jax.checks import require_number, require_real
from hks_jax.domain.components import as_mask
from hks_jax.domain.grid import Grid
from hks_jax.plot.figure import cell_extent, colour_bar, frame, require_plane
from hks_jax.plot.orientation import Orientation

HATCH = "0.25"
"""The colour of hatching."""
FADED = 2.0
"""The distance |z| from the null value above which values are not faded as noise."""
UNFADED = math.erfc(FADED / math.sqrt(2))
"""The share of nodes that noise alone leaves without any grey."""
FADED_NOTE = (
    "grey: noise explains the difference from constant tensors;\n"
    f"noise alone leaves {100 * UNFADED:.0f} % of the nodes without grey"
)
"""The legend of pictures with faded values."""
FAR = 1.5
"""If nine tenths of nonnegative values exceed 1.5 times the centre, the colour range is not centred."""
DIVERGING = "RdBu_r"
"""The colour map about a centre, with red above and blue below."""
RULES = ("quantiles", "least_range", "centre", "vmin", "vmax")
"""The arguments of `scalar_image` that determine the values of the first and the last colour."""


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
    hatched: Bool[ArrayLike, "nx ny"] | None = None,
    **kwargs: Any,
) -> AxesImage:
    """Draw nodal values as an image with array axis 0 horizontal and one cell per node, transparent outside the mask.

    Args:
        ax: the axes to draw on.
        values: (*shape,), with NaN at nodes without a value.
        grid: the 2D grid of the values.
        cmap: the colour map, by default viridis or, with a centre, a diverging map with red above and blue below.
        vmin: the value of the first colour, by default from `quantiles`.
        vmax: the value of the last colour, by default from `quantiles`.
        centre: the value of the middle colour unless vmin and vmax are given, such as 1, the value of 4πt·HKS for a
            flat metric. The colour range is symmetric about the centre, but does not extend below 0 if no value is
            negative. The argument `centre` is ignored if no value is negative and nine tenths of the values exceed 1.5
            times the centre.
        quantiles: the quantiles of the values that get the first and the last colour, unless vmin and vmax are given.
            The colour bar has arrows if other values lie beyond its ends.
        least_range: the least difference between the values of the first and the last colour, relative to the larger
            value. A larger `least_range` hides rounding or discretisation errors of nearly constant values.
        colorbar: whether to add a colour bar.
        label: the colour bar's label.
        orientation: the grid's orientation in space, by which the image is turned and its sides are labelled (L, R, …).
        z: (*shape,) the distance of the values from a null value as a normal number (`hks_jax.Uncertainty.z`). Values
            with |z| < 2 fade to grey; noise alone leaves 4.6 % of the nodes without grey.
        hatched: (*shape,) the nodes that are hatched, such as those where `hks_jax.boundary_influence` exceeds 0.1.
        **kwargs: arguments of `Axes.imshow`.

    Raises:
        ValueError: if the grid is 3D, or if the values have another shape or none of them is finite inside the mask.

    Examples:
        >>> ax = hj.plot.new_figure(3, 3).add_subplot()
        >>> hj.plot.scalar_image(ax, field.grid.nodes[..., 0], field.grid).get_clim()
        (0.0, 1.0)
    """
    require_plane("grid", grid)
    array = masked("values", values, grid)
    lines = None if hatched is None else as_mask("hatched", hatched) & ~np.ma.getmaskarray(array)
    opacity = None if z is None else (1 - np.abs(masked("z", z, grid)) / FADED).clip(0, 1).filled(0)
    if orientation is not None:
        array = orientation.array(array)
        opacity = None if opacity is None else orientation.array(opacity)
        lines = None if lines is None else orientation.array(lines)
        grid = orientation.grid(grid)
    ((low, high, own),) = colours_of([array.compressed()], quantiles, least_range, centre, vmin, vmax)
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
    if lines is not None and lines.any():
        _hatch(ax, lines, grid)
    frame(ax, grid)
    if orientation is not None:
        orientation.letter(ax)
    if colorbar:
        colour_bar(ax, image, label)
    return image


def _hatch(ax: Axes, nodes: Bool[np.ndarray, "nx ny"], grid: Grid) -> None:
    """Hatch the cells of nodes; a margin of cells that are not hatched closes the outline half a cell beyond them."""
    axes = [np.concatenate([[a[0] - h], a, [a[-1] + h]]) for a, h in zip(grid.axes, grid.spacing, strict=True)]
    area = ax.contourf(*axes, np.pad(nodes, 1).T.astype(float), levels=[0.5, 2.0], colors="none", hatches=["////"])
    area.set(edgecolor=HATCH, linewidth=0.0)


def influence_map(
    ax: Axes,
    influence: Real[ArrayLike, "nx ny"],
    grid: Grid,
    *,
    levels: Sequence[float] = (0.01, 0.1),
    **kwargs: Any,
) -> AxesImage:
    """Draw the share of the HKS that is due to the boundary at one time, with contour lines.

    Args:
        ax: the axes to draw on.
        influence: (*shape) the result of `hks_jax.boundary_influence` at one time.
        grid: the 2D grid of the values.
        levels: the levels of the contour lines, ascending between 0 and 1.
        **kwargs: arguments of `scalar_image`.

    Raises:
        ValueError: if the grid is 3D, or if the values have another shape.

    Examples:
        >>> influence = np.exp(-(field.grid.nodes[..., 0] ** 2) / 0.2)
        >>> hj.plot.influence_map(hj.plot.new_figure(3, 3).add_subplot(), influence, field.grid).get_clim()
        (0.0, 1.0)
    """
    values = masked("influence", influence, grid)
    style = {"cmap": "cividis", "vmin": 0.0, "vmax": 1.0, "label": "boundary's influence", **kwargs}
    image = scalar_image(ax, values, grid, **style)
    if (orientation := style.get("orientation")) is not None:
        values, grid = orientation.array(values), orientation.grid(grid)
    if reached := [level for level in levels if values.min() < level < values.max()]:
        lines = ax.contour(*grid.axes, values.T, levels=reached, colors="white", linewidths=1.0)
        ax.clabel(lines, fmt=lambda level: f"{100 * level:g} %", fontsize="x-small")
    return image


def masked(name: str, values: Any, grid: Grid) -> np.ma.MaskedArray:
    """Return values with a mask where they are not finite or lie outside the grid's mask; raise if all are masked."""
    require_real(name, np.ma.getdata(values))
    array = np.ma.masked_invalid(np.ma.asarray(values, dtype=np.float64))
    if array.shape != grid.shape:
        raise ValueError(f"{name}: got shape {array.shape}; expected the grid's shape {grid.shape}")
    masked = np.ma.array(array, mask=np.ma.getmaskarray(array) | ~grid.inside)
    if masked.count() == 0:
        raise ValueError(f"{name}: got no finite value inside the grid's mask; expected at least one")
    return masked


class Colours(NamedTuple):
    """The values of the first and the last colour, and the default colour map."""

    low: float
    high: float
    cmap: str = "viridis"


def colours_of(
    images: Sequence[np.ndarray],
    quantiles: tuple[float, float] = (0.0, 1.0),
    least_range: float = 1e-6,
    centre: float | None = None,
    vmin: float | None = None,
    vmax: float | None = None,
) -> list[Colours]:
    """Return the colours of each image by the rules of `scalar_image`, with one colour map for all images."""
    for name, value in (("centre", centre), ("vmin", vmin), ("vmax", vmax)):
        if value is not None:
            require_number(name, value, above=-np.inf)
    require_number("least_range", least_range, inclusive=True)
    if np.shape(quantiles) != (2,) or not 0 <= quantiles[0] < quantiles[1] <= 1:
        raise ValueError(f"quantiles: got {quantiles}; expected two increasing numbers from 0 to 1")
    everything = np.concatenate([image.ravel() for image in images])
    if centre is not None and everything.min() >= 0 and np.quantile(everything, 0.1) > FAR * centre > 0:
        centre = None
    colours = []
    for values in images:
        low, high = (float(q) for q in np.quantile(values, quantiles))
        if centre is not None:
            reach = max(high - centre, centre - low)
            if values.min() >= 0 < centre:
                reach = min(reach, centre)  # no colours for negative values
            low, high = centre - reach, centre + reach
        lacking = least_range * (max(abs(low), abs(high)) or 1.0) - (high - low)
        low, high = low - max(lacking, 0) / 2, high + max(lacking, 0) / 2
        cmap = "viridis" if centre is None else DIVERGING
        colours.append(Colours(low if vmin is None else vmin, high if vmax is None else vmax, cmap))
    return colours


def panel_colours(
    images: Sequence[np.ma.MaskedArray],
    limits: Sequence[tuple[float, float]] | None = None,
    shared: bool = False,
    **kwargs: Any,
) -> list[dict[str, Any]]:
    """Return the arguments of `scalar_image` for each image; `kwargs` are the arguments that all images share.

    The values of the first and the last colour of each image are its `limits`. Without `limits`, the colour range
    follows from the values of the image or, if `shared` is True, from the values of all images.
    """
    rules, cmap = {name: kwargs.pop(name) for name in RULES if name in kwargs}, kwargs.pop("cmap", None)
    if not images:
        return []
    if limits is not None:
        if np.shape(limits) != (len(images), 2):
            raise ValueError(f"limits: got shape {np.shape(limits)}; expected {(len(images), 2)}, a pair per time")
        return [{**kwargs, "cmap": cmap, "vmin": low, "vmax": high} for low, high in limits]
    values = [image.compressed() for image in images]
    colours = colours_of([np.concatenate(values)], **rules) * len(values) if shared else colours_of(values, **rules)
    return [{**kwargs, "cmap": cmap or own.cmap, "vmin": own.low, "vmax": own.high} for own in colours]
