"""The HKS over time at chosen points."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from hks_jax.domain.grid import Grid


def hks_curves(
    ax: Axes,
    values: Float[ArrayLike, "n_times *shape"],
    times: Sequence[float] | Float[ArrayLike, " n_times"],
    grid: Grid,
    points: Sequence[Sequence[float]],
    *,
    expansion: Float[ArrayLike, "n_times *shape"] | None = None,
    labels: Sequence[str] | None = None,
    scaled: bool = False,
    cmap: str = "viridis",
    **kwargs: Any,
) -> list[Line2D]:
    """Draw HKS(t) at the nodes nearest to `points`, with the expansion dashed in the same colour.

    Args:
        ax: the axes to draw on.
        values: (n_times, *shape), as `hks_jax.hks` returns them.
        times: (n_times,), increasing.
        grid: the grid of the values, 2D or 3D.
        points: coordinates, one row of d numbers per curve.
        expansion: (n_times, *shape), as `hks_jax.hks_expansion` returns it.
        labels: one per point; None: its coordinates.
        scaled: draw (4πt)^(d/2)·HKS, which is 1 for flat space without boundary, on a linear scale.
        cmap: colour map; the curves take evenly spaced colours.
        **kwargs: passed to `Axes.plot` for the HKS.

    Raises:
        ValueError: shapes that do not agree, or a point whose nearest node is outside the mask.
    """
    t = np.asarray(times, dtype=np.float64)
    curves = np.asarray(values, dtype=np.float64)
    if curves.shape != (t.size, *grid.shape):
        raise ValueError(f"values: got shape {curves.shape}; expected (n_times, *grid.shape) = {(t.size, *grid.shape)}")
    nodes = _nearest_nodes(np.asarray(points, dtype=np.float64), grid)
    if labels is None:
        labels = ["(" + ", ".join(f"{c:.3g}" for c in grid.nodes[node]) + ")" for node in nodes]
    factor = (4 * math.pi * t) ** (grid.dimension / 2) if scaled else np.ones_like(t)
    colours = colormaps[cmap](np.linspace(0.0, 0.85, len(nodes)))
    lines = []
    for node, label, colour in zip(nodes, labels, colours, strict=True):
        history: Any = (slice(None), *node)
        style = {"color": colour, "label": label, **kwargs}
        lines += ax.plot(t, factor * curves[history], **style)
        if expansion is not None:
            approximation = np.asarray(expansion, dtype=np.float64)[history]
            ax.plot(t, factor * approximation, color=style["color"], linestyle="--", linewidth=1.0)
    ax.set_xscale("log")
    if not scaled:
        ax.set_yscale("log")
    elif expansion is not None:
        # The series leaves the picture at large t: the curves, not it, choose the scale.
        low, high = _span([np.asarray(line.get_ydata()) for line in lines])
        ax.set_ylim(low, high)
    ax.set_xlabel("$t$")
    power = {2: r"4\pi t\,", 3: r"(4\pi t)^{3/2}\,"}[grid.dimension] if scaled else ""
    ax.set_ylabel(rf"${power}\mathrm{{HKS}}(t)$")
    handles = list(lines)
    if expansion is not None:
        handles.append(Line2D([], [], color="0.3", linestyle="--", linewidth=1.0, label="expansion"))
    ax.legend(handles=handles, fontsize="small", frameon=False)
    ax.grid(visible=True, which="major", linewidth=0.4, alpha=0.5)
    return lines


def _nearest_nodes(points: np.ndarray, grid: Grid) -> list[tuple[int, ...]]:
    if points.ndim != 2 or points.shape[1] != grid.dimension or len(points) == 0:
        raise ValueError(f"points: got shape {points.shape}; expected (n, {grid.dimension}), one point per row")
    index = np.rint((points - grid.origin) / grid.spacing).astype(int)
    beyond = np.any((index < 0) | (index >= np.array(grid.shape)), axis=1)
    nodes = [tuple(int(i) for i in row) for row in index]
    for point, node, out in zip(points, nodes, beyond, strict=True):
        if out or not grid.inside[node]:
            raise ValueError(f"points: {tuple(point.tolist())} lies outside the grid or its mask; choose one inside")
    return nodes


def _span(curves: list[np.ndarray]) -> tuple[float, float]:
    low, high = min(c.min() for c in curves), max(c.max() for c in curves)
    margin = 0.08 * (high - low) or 0.1
    return low - margin, high + margin
