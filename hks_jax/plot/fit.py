"""Figures of fits: the metric and its agreement with the signature."""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Real
from matplotlib.axes import Axes
from matplotlib.colors import TABLEAU_COLORS
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hks_jax.plot.figure import SMALL, finished, new_figure, number_text, panel_size, require_plane
from hks_jax.plot.glyphs import ellipses
from hks_jax.plot.images import masked, panel_colours, scalar_image
from hks_jax.plot.orientation import Orientation
from hks_jax.plot.panels import checked_times

if TYPE_CHECKING:  # slow to import
    from hks_jax.inverse.metric_fit import MetricFit

LEAST_DIFFERENCE = 1e-6
"""The relative difference of the last colour is at least 1e-6, so errors of eigenpairs are not visible."""


def fit_panels(
    fit: "MetricFit",
    target: Real[ArrayLike, "n_times nx ny"],
    times: Sequence[float] | Real[ArrayLike, " n_times"] | None = None,
    *,
    max_times: int = 3,
    title: str = "",
    orientation: Orientation | None = None,
) -> Figure:
    """Return a figure of a fit in 2D with signatures, the metric and the loss.

    Each of a few times, including the first and the last, has a row with the target, the fitted signature in the same
    colours, and their relative difference in colours that all rows share. The figure's last row has the unit circles of
    the fitted metric, and the loss over the steps with a curve for each initial guess.

    Args:
        fit: the result of `hks_jax.fit_metric`.
        target: (n_times, *grid.shape) the target of the fit; NaN at unobserved entries.
        times: (n_times,) times or energies, by default those of the fit.
        max_times: the maximum number of rows with times.
        title: the figure's title.
        orientation: the orientation of the grid in space, as for `scalar_image`.

    Raises:
        ValueError: if the grid is 3D, if target or signature is not one image per time, or if no times are given.

    Examples:
        >>> larger = hj.TensorField(field.grid, 1.1 * field.tensors)
        >>> fit = hj.fit_metric(larger, hj.hks(pairs, [0.2, 0.5]), [0.2, 0.5], "conformal")
        >>> len(hj.plot.fit_panels(fit, hj.hks(pairs, [0.2, 0.5])).axes)  # 2 times 3 images, ellipses and the loss
        8
    """
    grid = fit.field.grid
    require_plane("fit", grid)
    if times is None:
        times = fit.problem.observation.times
    if times is None:
        raise ValueError("times: got None, and the fit has no times; expected one number for each image in the target")
    wanted, fitted = np.asarray(target, dtype=np.float64), np.asarray(fit.hks, dtype=np.float64)
    t = checked_times(times, grid.shape, **{"target": wanted, "fit.hks": fitted})
    with np.errstate(divide="ignore", invalid="ignore"):
        difference = np.where(wanted != 0, (fitted - wanted) / np.abs(wanted), np.nan)
    rows = np.unique(np.linspace(0, t.size - 1, max_times).round().astype(int))
    drawn = np.abs(difference[rows][:, grid.inside])
    limit = max(float(np.max(drawn[np.isfinite(drawn)], initial=0.0)), LEAST_DIFFERENCE)

    field = fit.field if orientation is None else orientation.field(fit.field)
    width, height = panel_size(field.grid, 2.5)
    # The last row is at least 1.8 inches high, because it also contains the plot of the loss.
    heights = [height] * len(rows) + [max(height, 1.8)]
    figure = new_figure(3 * (width + 0.9) + 0.4, sum(heights) + 0.3 * len(heights) + 0.6 + 0.3 * bool(title))
    # With a separate layout grid, the labels of the last row do not widen the columns of the other rows.
    halves = figure.add_gridspec(2, 1, height_ratios=[sum(heights[:-1]), heights[-1]])
    panels, last = halves[0].subgridspec(len(rows), 3), halves[1].subgridspec(1, 2, width_ratios=(1, 1.7))
    symbol = fit.problem.observation.signature.symbol or "t"
    for row, index in enumerate(rows):
        pair = masked("target", wanted[index], grid), masked("fit.hks", fitted[index], grid)
        images = {"target": pair[0], "fitted": pair[1], "fitted / target − 1": difference[index]}
        colours = [*panel_colours(pair, shared=True), {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}]
        for column, (text, values) in enumerate(images.items()):
            ax = figure.add_subplot(panels[row, column])
            scalar_image(ax, values, grid, orientation=orientation, **colours[column])
            ax.tick_params(labelleft=column == 0, labelbottom=row == len(rows) - 1)
            if row == 0:
                ax.set_title(text, fontsize="medium")
            if column == 0:
                ax.set_ylabel(f"${symbol}$ = {number_text(t[index])}")
    ax = figure.add_subplot(last[0])
    ellipses(ax, field)
    if orientation is not None:
        orientation.letter(ax)
    ax.set_title("fitted metric, unit circles", fontsize="medium")
    _draw_loss(figure.add_subplot(last[1]), fit)
    return finished(figure, title)


def _draw_loss(ax: Axes, fit: "MetricFit") -> None:
    starts = sorted({step.start for step in fit.history})
    for color, start in zip(itertools.cycle(TABLEAU_COLORS), starts, strict=False):
        steps = [step for step in fit.history if step.start == start]
        label = "loss" if len(starts) == 1 else f"start {start}"
        ax.plot([step.loss for step in steps], ".-", color=color, label=label)
        if fit.problem.regularisers:
            label = "misfit" if start == starts[0] else ""
            ax.plot([step.misfit for step in steps], ":", color=color, label=label)
    ax.set_yscale("log", nonpositive="mask")
    ax.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    ax.tick_params(labelsize=SMALL)
    ax.grid(alpha=0.3)
    ax.set_xlabel("step", fontsize=SMALL)
    ax.set_ylabel("loss", fontsize=SMALL)
    ax.set_title(fit.result, fontsize="medium")
    if len(starts) > 1 or fit.problem.regularisers:
        ax.legend(fontsize=SMALL)
