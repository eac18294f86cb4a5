"""Figures, axes and colour bars that all plots share."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from matplotlib.transforms import ScaledTranslation

from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_checks import require_grid
from hks_jax.domain.tensor_field import require_field
from hks_jax.signatures.times import FREE
from hks_jax.storage import atomic_path

SMALL = "small"
RIM_NOTE = f"the boundary contributes over {100 * FREE:.0f} %"
"""What legends say of nodes near the boundary."""
LABELS = 21
"""The height of tick labels and an axis label below the axes, in points (1/72 inch)."""


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of the given size in inches, which arranges its axes without overlaps.

    Examples:
        >>> hj.plot.new_figure(4, 3).get_size_inches()
        array([4., 3.])
    """
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(fig: Figure, path: str | os.PathLike[str], *, dpi: float = 150) -> Path:
    """Write a figure to `path` atomically, in the format of the suffix, and return the path.

    A temporary file is written and then moved to `path`, so no incomplete file is visible. Missing parents are created.

    Raises:
        ValueError: if matplotlib cannot write the format of the suffix.

    Examples:
        >>> hj.plot.save_figure(hj.plot.new_figure(1, 1), folder / "blank.png").read_bytes()[1:4]
        b'PNG'
    """
    target = Path(path)
    formats = fig.canvas.get_supported_filetypes()
    suffix = target.suffix.lstrip(".").lower()
    if suffix not in formats:
        raise ValueError(
            f"path: got {str(target)!r}; expected a name that ends in a format matplotlib can write "
            f"({', '.join(sorted(formats))})"
        )
    with atomic_path(target) as temporary:
        fig.savefig(temporary, dpi=dpi, format=suffix)
    return target


def finished(fig: Figure, suptitle: str, path: str | os.PathLike[str] | None = None) -> Figure:
    """Add a title to a figure, save it if a path is given, and return it."""
    if suptitle:
        fig.suptitle(suptitle, fontsize="medium")
    if path is not None:
        save_figure(fig, path)
    return fig


def plane_of(field: Any) -> Grid:
    """Return the grid of a tensor field; raise an error unless the argument is a field in two dimensions."""
    require_field(field)
    require_plane("field", field.grid)
    return field.grid


def require_plane(name: str, grid: Any) -> None:
    """Raise an error unless the argument `name` is a grid in two dimensions."""
    require_grid(grid)
    if grid.dimension != 2:
        raise ValueError(
            f"{name}: got a grid of {grid.dimension} dimensions with shape {grid.shape}; expected 2. Draw a slice "
            "with a Grid of two axes and the values or tensors at one index of the third"
        )


def cell_extent(grid: Grid) -> tuple[float, float, float, float]:
    """Return (x_min, x_max, y_min, y_max) of the nodes' cells, which extend half a spacing beyond the nodes."""
    (x0, x1, y0, y1), (hx, hy) = grid.extent, grid.spacing
    return x0 - hx / 2, x1 + hx / 2, y0 - hy / 2, y1 + hy / 2


def panel_size(grid: Grid, side: float, steepest: float = 4.0) -> tuple[float, float]:
    """Return an image's width of at most `side`, and its height, with an aspect ratio of at most `steepest`."""
    x0, x1, y0, y1 = cell_extent(grid)
    aspect = min(max((y1 - y0) / (x1 - x0), 1 / steepest), steepest)
    width = side / max(1.0, aspect**0.5)
    return width, width * aspect


def frame(ax: Axes, grid: Grid) -> None:
    """Set the limits of `ax` to the grid, with equal aspect, array axis 0 horizontal, and few ticks."""
    x0, x1, y0, y1 = cell_extent(grid)
    ax.set_aspect("equal")
    ax.set_xlim(x0, x1)
    ax.set_ylim(y0, y1)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    ax.tick_params(labelsize=SMALL)


def figure_of(ax: Axes) -> Figure:
    """Return the figure that contains the axes."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def inches(ax: Axes) -> Float[np.ndarray, "2"]:
    """Return the width and height in inches of axes before layout."""
    return np.multiply(ax.get_position().size, figure_of(ax).get_size_inches())


def side_in_inches(ax: Axes, extent: Sequence[float]) -> float:
    """Return the length in inches of the longer side of an extent that is drawn on the axes with equal aspect."""
    return float(np.min(inches(ax) / extent) * np.max(extent))


def legend_below(ax: Axes, handles: Sequence[Artist], title: str = "") -> None:
    """Add a legend below the axes, where it does not cover the image."""
    ax.legend(
        handles=handles,
        title=title,
        title_fontsize=SMALL,
        fontsize=SMALL,
        ncols=min(len(handles), 4, max(1, int(1.5 * inches(ax)[0]))),
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        bbox_transform=ax.transAxes + ScaledTranslation(0, -LABELS / 72, figure_of(ax).dpi_scale_trans),
        frameon=False,
        columnspacing=1.2,
    )


def colour_bar(ax: Axes, mappable: ScalarMappable, label: str = "", **kwargs: Any) -> Colorbar:
    """Add a colour bar to the right of `ax` with exactly the same height."""
    # An inset follows its parent's box, so the bar keeps the height of an image with equal aspect.
    return colour_bar_in(ax.inset_axes((1.03, 0.0, 0.045, 1.0)), mappable, label, **kwargs)


def colour_bar_in(
    bar_axes: Axes, mappable: ScalarMappable, label: str = "", values: np.ma.MaskedArray | None = None, **kwargs: Any
) -> Colorbar:
    """Draw a colour bar in separate axes, with few ticks, powers of ten, and arrows if values exceed its range."""
    drawn: Any = mappable.get_array() if values is None else values
    bar = figure_of(bar_axes).colorbar(mappable, cax=bar_axes, extend=arrows(mappable, drawn), **kwargs)
    formatter = ScalarFormatter(useOffset=False, useMathText=True)
    formatter.set_powerlimits((-3, 4))
    if "format" not in kwargs and "ticks" not in kwargs:
        bar.locator = MaxNLocator(5 if bar.orientation == "vertical" else 3, steps=[1, 2, 2.5, 5, 10])
        bar.formatter = formatter
        bar.update_ticks()
    bar_axes.tick_params(labelsize=SMALL)
    (bar_axes.yaxis if bar.orientation == "vertical" else bar_axes.xaxis).get_offset_text().set_fontsize(SMALL)
    bar.outline.set_linewidth(0.6)
    if label:
        bar.set_label(label, fontsize=SMALL)
    return bar


def arrows(mappable: ScalarMappable, drawn: Any) -> str:
    """Return the ends of a colour bar that have arrows, because drawn values exceed its range."""
    low, high = mappable.get_clim()
    rounding = 1e-6 * (high - low)  # a range that is symmetric about a centre ends near the least value
    return ("neither", "min", "max", "both")[(drawn.min() < low - rounding) + 2 * (drawn.max() > high + rounding)]


def lines_in(text: str) -> int:
    """Return the number of lines of a title; an empty title has none."""
    return text.count("\n") + 1 if text else 0


def number_text(value: float) -> str:
    """Return a number as text with three significant digits, with a power of ten if necessary.

    Examples:
        >>> hj.plot.number_text(2 / 3)
        '0.667'
    """
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return f"{float(f'{value:.3g}'):g}"
    mantissa, exponent = f"{value:.2e}".split("e")
    return rf"${float(mantissa):g}\times 10^{{{int(exponent)}}}$"
