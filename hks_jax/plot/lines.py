"""Integral lines of eigenvector fields, drawn."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from hks_jax.domain.tensor_field import TensorField
from hks_jax.plot.figure import frame, require_plane, side_in_inches
from hks_jax.plot.tracing import Which, evenly_spaced_lines, trace


def integral_lines(
    ax: Axes,
    field: TensorField,
    which: Which = "major",
    *,
    seeds: Float[np.ndarray, "n 2"] | None = None,
    density: float = 1.0,
    step: float | None = None,
    max_length: float | None = None,
    **kwargs: Any,
) -> LineCollection:
    """Draw integral lines of an eigenvector field over whatever `ax` shows.

    Args:
        ax: the axes to draw on.
        field: a 2D field.
        which: ``"major"``, the eigenvector of the larger eigenvalue of T, or ``"minor"``.
        seeds: (n, 2) points that the lines go through; None: evenly spaced lines.
        density: with evenly spaced lines, how dense: 1 leaves a 25th of the longer side between neighbours,
            or more where the axes are small.
        step: arc length of an integration step; None: half the smaller grid spacing.
        max_length: longest arc length of a line; None: eight times the longer side.
        **kwargs: passed to `matplotlib.collections.LineCollection` (``colors``, ``linewidths``, ``alpha``).

    Raises:
        ValueError: a 3D field; options that do not exist; sizes that are not positive.
    """
    require_plane("field", field.grid)
    if seeds is None:
        if not density > 0:
            raise ValueError(f"density: got {density}; expected a positive number")
        x0, x1, y0, y1 = field.grid.extent
        side = max(x1 - x0, y1 - y0)
        gaps = min(25.0, max(4.0, 11 * side_in_inches(ax, (x1 - x0, y1 - y0))))
        lines = evenly_spaced_lines(field, which, separation=side / (gaps * density), step=step, max_length=max_length)
    else:
        lines = [line for line in trace(field, seeds, which, step=step, max_length=max_length) if len(line) > 1]
    collection = LineCollection(lines, **{"colors": "black", "linewidths": 0.7, "capstyle": "round", **kwargs})
    frame(ax, field.grid)
    ax.add_collection(collection, autolim=False)
    return collection
