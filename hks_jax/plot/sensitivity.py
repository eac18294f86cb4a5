"""Symmetric tensors of either sign, such as the derivative of a signature with respect to the metric."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from hks_jax.domain.grid import Grid
from hks_jax.plot.ellipses import centred, node_steps
from hks_jax.plot.figure import frame, legend_below, require_plane


def sensitivity(
    ax: Axes,
    grid: Grid,
    gradient: Any,
    every: int | Sequence[int] | None = None,
    *,
    power: float = 0.5,
    colors: tuple[str, str] = ("#b2182b", "#2166ac"),
    fill: float = 0.95,
    legend: bool = True,
    **kwargs: Any,
) -> LineCollection:
    """Draw the derivative of a number with respect to the tensors: which one, in which direction, drives it.

    At each node a cross of two bars along the eigenvectors of the gradient, of lengths |μ|^power for its eigenvalues μ:
    in the first colour where the number grows with the metric's length in that direction, in the second where it falls.

    Args:
        ax: the axes to draw on.
        grid: the 2D grid.
        gradient: (*shape, 2, 2) symmetric, as `jax.grad` returns it; nodes outside the mask are left out.
        every: draw every such node (one number or one per axis); None: about 24 along the longer side. The gradient
            is of the drawn nodes, not of the area around them.
        power: below 1 shows small derivatives beside large ones.
        colors: for positive and negative eigenvalues.
        fill: the part of its cell that the longest bar may fill.
        legend: whether to say what the colours mean.
        **kwargs: passed to `matplotlib.collections.LineCollection`.

    Raises:
        ValueError: a 3D grid, a gradient of another shape, or NaN inside the mask.
    """
    require_plane("grid", grid)
    array = np.asarray(gradient, dtype=np.float64)
    if array.shape != (*grid.shape, 2, 2):
        raise ValueError(f"gradient: got shape {array.shape}; expected {(*grid.shape, 2, 2)}, as jax.grad returns it")
    steps = node_steps(grid.shape, grid.spacing, every, ax)
    pick = tuple(centred(n, s) for n, s in zip(grid.shape, steps, strict=True))
    inside = grid.inside[pick]
    matrices, centres = array[pick][inside], grid.nodes[pick][inside]
    if not np.isfinite(matrices).all():
        bad = int((~np.isfinite(matrices)).any(axis=(1, 2)).sum())
        raise ValueError(f"gradient: {bad} of {len(matrices)} tensors drawn are NaN or infinite; expected finite ones")
    eigenvalues, vectors = np.linalg.eigh((matrices + np.swapaxes(matrices, 1, 2)) / 2)
    lengths = np.abs(eigenvalues) ** power
    cell = min(s * h for s, h in zip(steps, grid.spacing, strict=True))
    lengths *= 0.5 * fill * cell / max(lengths.max(initial=0.0), np.finfo(float).tiny)
    ends = np.einsum("nai,ni->nia", vectors, lengths)
    bars = np.stack([centres[:, None] - ends, centres[:, None] + ends], axis=2).reshape(-1, 2, 2)
    chosen = np.where(eigenvalues.ravel() > 0, colors[0], colors[1])
    collection = LineCollection(list(bars), **{"colors": list(chosen), "linewidths": 1.2, **kwargs})
    frame(ax, grid)
    ax.add_collection(collection, autolim=False)
    if legend:
        handles = [Line2D([], [], color=c, label=text) for c, text in zip(colors, ("grows", "falls"), strict=True)]
        legend_below(ax, handles)
    return collection
