"""Figures of scalars on a plane over t: the HKS at each time, and several scalars in one row each."""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Real
from matplotlib.colors import Colormap
from matplotlib.figure import Figure

from hks_jax.arrays import describe_array
from hks_jax.checks import require_real
from hks_jax.domain.grid import Grid
from hks_jax.plot.figure import SMALL, finished, lines_in, new_figure, number_text, panel_size, require_plane
from hks_jax.plot.images import masked, panel_colours, scalar_image
from hks_jax.plot.orientation import Orientation

LINE = 0.18
"""The height of a line of a title, in inches."""
BESIDE: dict[str, Any] = {"cmap": "gray", "quantiles": (0.01, 0.99)}
"""The style of scalars beside a signature, which show the anatomy; their extreme values, as of fluid, are cut."""


def hks_panels(
    values: Real[ArrayLike, "n_times nx ny"],
    times: Sequence[float] | Real[ArrayLike, " n_times"],
    grid: Grid,
    *,
    titles: Sequence[str] | None = None,
    unit: str = "",
    length_unit: str = "",
    shared_range: bool = False,
    limits: Sequence[tuple[float, float]] | None = None,
    beside: Mapping[str, Real[ArrayLike, "nx ny"]] | None = None,
    path: str | os.PathLike[str] | None = None,
    suptitle: str = "",
    orientation: Orientation | None = None,
    z: Real[ArrayLike, "n_times nx ny"] | None = None,
    hatched: Bool[ArrayLike, "n_times nx ny"] | None = None,
    **kwargs: Any,
) -> Figure:
    """Return a figure with one image of the HKS per time, each with separate colours unless `shared_range` is set.

    Args:
        values: (n_times, *shape) the result of `hks_jax.hks`.
        times: (n_times,).
        grid: the 2D grid of the values.
        titles: a title for each time, by default “t = …”.
        unit: the unit of t, which titles show after the value of t.
        length_unit: the unit of the coordinates, which the axes show.
        shared_range: whether all images use the colours of one range.
        limits: the values of the first and the last colour for each time.
        beside: other scalars (*shape,) by title, such as the mean diffusivity, drawn in grey after the last time.
        path: the file in which to save the figure, if given.
        suptitle: the figure's title.
        orientation: the same as for `scalar_image`.
        z: (n_times, *shape); values within the noise fade as in `scalar_image`.
        hatched: (n_times, *shape) the nodes that are hatched.
        **kwargs: arguments of `scalar_image` for all images, such as cmap, vmin, vmax, centre, quantiles, least_range
            and label.

    Raises:
        ValueError: if shapes disagree, or if no time is given.

    Examples:
        >>> fig = hj.plot.hks_panels(hj.hks(pairs, [0.2, 0.5]), [0.2, 0.5], field.grid)
        >>> [ax.get_title() for ax in fig.axes]
        ['$t$ = 0.2', '$t$ = 0.5']
    """
    require_plane("grid", grid)
    t = checked_times(times, grid.shape, values=values, z=z, hatched=hatched)
    titles = panel_titles(t, titles, unit)
    images = [masked("values", v, grid) for v in np.ma.asarray(values)]
    colours = panel_colours(images, limits, shared_range, **kwargs)
    others = [masked(f"beside: {title}", each, grid) for title, each in (beside or {}).items()]
    images, colours = [*images, *others], [*colours, *panel_colours(others, **BESIDE)]
    titles, n = [*titles, *(beside or {})], len(images)
    rows = math.ceil(n / 4)
    columns = math.ceil(n / rows)
    width, height = panel_size(grid if orientation is None else orientation.grid(grid), 2.3, 5.0)
    over = LINE * (rows * max(map(lines_in, titles)) + lines_in(suptitle))
    bar = 0.65 + 0.25 * bool(kwargs.get("label"))
    axes = 0.2 * bool(length_unit)
    fig = new_figure(columns * (width + bar) + 0.3 + axes, rows * (height + 0.15) + 0.35 + axes + over)
    noise, lines = ([None] * n if each is None else [*np.asarray(each), *[None] * len(others)] for each in (z, hatched))
    panels = fig.subplots(rows, columns, squeeze=False).ravel()
    for ax in panels[n:]:
        ax.remove()
    for index, ax in enumerate(panels[:n]):
        masks: dict[str, Any] = {"z": noise[index], "hatched": lines[index]}
        scalar_image(ax, images[index], grid, orientation=orientation, **masks, **colours[index])
        ax.set_title(titles[index], fontsize="medium")
        left, lowest = index % columns == 0, index + columns >= n
        ax.tick_params(labelleft=left, labelbottom=lowest)
        ax.set_ylabel(length_unit if left else "", fontsize=SMALL)
        ax.set_xlabel(length_unit if lowest else "", fontsize=SMALL)
    return finished(fig, suptitle, path)


def time_rows(
    rows: Mapping[str, Real[ArrayLike, "n_times nx ny"]],
    times: Sequence[float] | Real[ArrayLike, " n_times"],
    grid: Grid,
    *,
    unit: str = "",
    shared_range: bool = False,
    cmap: str | Colormap | Mapping[str, str] = "viridis",
    quantiles: tuple[float, float] = (0.0, 1.0),
    suptitle: str = "",
) -> Figure:
    """Return a figure with a row of images for each scalar and a column for each time.

    Args:
        rows: the scalars (n_times, *shape) by name, with NaN at nodes without a value.
        times: (n_times,).
        grid: the 2D grid of the values.
        unit: the unit of t.
        shared_range: whether the images of a row use the colours of one range.
        cmap: a colour map, or one for each row by name.
        quantiles: the same as for `scalar_image`.
        suptitle: the figure's title.

    Raises:
        ValueError: if no rows or no times are given, or if values are not one image per time.

    Examples:
        >>> fig = hj.plot.time_rows({"HKS": hj.hks(pairs, [0.2, 0.5])}, [0.2, 0.5], field.grid)
        >>> len(fig.axes)
        2
    """
    require_plane("grid", grid)
    if not isinstance(rows, Mapping) or not rows:
        raise ValueError(f"rows: got {describe_array(rows)}; expected a dictionary of at least one scalar by name")
    t = checked_times(times, grid.shape, **{f"rows: {name}": values for name, values in rows.items()})
    width, height = panel_size(grid, 1.9)
    figure = new_figure(t.size * (width + 0.65) + 0.6, len(rows) * (height + 0.2) + 0.5 + 0.3 * bool(suptitle))
    panels = figure.subplots(len(rows), t.size, squeeze=False)
    for line, (name, values) in zip(panels, rows.items(), strict=True):
        images = [masked(f"rows: {name}", each, grid) for each in np.ma.asarray(values)]
        own = cmap[name] if isinstance(cmap, Mapping) else cmap
        colours = panel_colours(images, shared=shared_range, cmap=own, quantiles=quantiles)
        for ax, image, style in zip(line, images, colours, strict=True):
            scalar_image(ax, image, grid, **style)
            ax.set(xticks=[], yticks=[])
        line[0].set_ylabel(name, fontsize=SMALL)
    for ax, title in zip(panels[0], panel_titles(t, None, unit), strict=True):
        ax.set_title(title, fontsize="medium")
    return finished(figure, suptitle)


def checked_times(times: Any, shape: tuple[int, ...], **arrays: Any) -> Float[np.ndarray, " n_times"]:
    """Return the times; raise ValueError unless each array has one value per time and node, for at least one time."""
    require_real("times", times)
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    for name, array in arrays.items():
        if array is not None and (np.shape(array) != (t.size, *shape) or t.ndim != 1 or t.size == 0):
            raise ValueError(
                f"{name}: got shape {np.shape(array)} and times of shape {t.shape}; expected "
                f"(n_times, *shape) = {(t.size, *shape)} and at least one time"
            )
    return t


def panel_titles(t: Float[np.ndarray, " n_times"], titles: Sequence[str] | None, unit: str) -> Sequence[str]:
    """Return a title for each time; raise ValueError if the number of titles differs from the number of times."""
    if titles is None:
        return [f"$t$ = {number_text(s)} {unit or ''}".rstrip() for s in t]
    if len(titles) != t.size:
        raise ValueError(f"titles: got {len(titles)} titles; expected {t.size}, one per time")
    return titles
