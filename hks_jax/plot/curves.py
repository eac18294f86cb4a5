"""Curves of the HKS over time at chosen points, and of a spectrum's counting function with Weyl's law."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Real
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from hks_jax.domain.components import as_mask
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_checks import require_grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.eigenpairs import Eigenpairs, require_pairs
from hks_jax.eigen.weyl import weyl_count
from hks_jax.plot.figure import RIM_NOTE, SMALL, number_text
from hks_jax.plot.panels import checked_times

PALE = 0.35
"""The opacity of the parts of curves that the boundary influences."""


def hks_curves(
    ax: Axes,
    values: Real[ArrayLike, "n_times *shape"],
    times: Sequence[float] | Real[ArrayLike, " n_times"],
    grid: Grid,
    points: Sequence[Sequence[float]],
    *,
    expansion: Real[ArrayLike, "n_times *shape"] | None = None,
    limit: float | None = None,
    near_rim: Bool[ArrayLike, "n_times *shape"] | None = None,
    labels: Sequence[str] | None = None,
    unit: str = "",
    scaled: bool = False,
    cmap: str = "viridis",
    **kwargs: Any,
) -> list[Line2D]:
    """Draw the HKS over t at the nodes nearest to `points`, with its short-time expansion as dashed lines if given.

    Args:
        ax: the axes to draw on.
        values: (n_times, *shape) the result of `hks_jax.hks`.
        times: (n_times,) in increasing order.
        grid: the grid of the values, 2D or 3D.
        points: (n, d) coordinates, one row for each curve.
        expansion: (n_times, *shape) the result of `hks_jax.hks_expansion`.
        limit: the smallest resolved time, `hks_jax.truncation(pairs, times).smallest_time`; smaller times are shaded.
        near_rim: (n_times, *shape) where curves are pale, such as where `hks_jax.boundary_influence` exceeds 0.1.
        labels: a label for each point, by default its coordinates.
        unit: the unit of t.
        scaled: whether to draw (4πt)^(d/2)·HKS, which is 1 for flat space without boundary, on a linear scale.
        cmap: a colour map, from which the curves take evenly spaced colours.
        **kwargs: arguments of `Axes.plot` for the HKS.

    Returns:
        A line for each point, whose values are NaN where the curve is pale.

    Raises:
        ValueError: if shapes disagree, or if the nearest node of a point is outside the mask.

    Examples:
        >>> ax, signature = hj.plot.new_figure(3, 3).add_subplot(), hj.hks(pairs, [0.2, 0.5])
        >>> (line,) = hj.plot.hks_curves(ax, signature, [0.2, 0.5], field.grid, [(0.5, 0.5)])
        >>> np.allclose(line.get_ydata(), signature[:, 4, 4])
        True
    """
    require_grid(grid)
    t = checked_times(times, grid.shape, values=values, expansion=expansion, near_rim=near_rim)
    curves = np.moveaxis(np.asarray(values, dtype=np.float64), 0, -1)
    series = None if expansion is None else np.moveaxis(np.asarray(expansion, dtype=np.float64), 0, -1)
    nodes = _nearest_nodes(np.asarray(points, dtype=np.float64), grid)
    if labels is None:
        labels = ["(" + ", ".join(f"{c:.3g}" for c in grid.nodes[node]) + ")" for node in nodes]
    if len(labels) != len(nodes):
        raise ValueError(f"labels: got {len(labels)} labels; expected {len(nodes)}, one per point")
    factor = (4 * math.pi * t) ** (grid.dimension / 2) if scaled else np.ones_like(t)
    colours = colormaps[cmap](np.linspace(0.0, 0.85, len(nodes)))
    ax.set(xscale="log", yscale="linear" if scaled else "log")
    if t.max() < 100 * t.min():  # by default, Matplotlib labels so many ticks that the labels overlap
        ax.xaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), minor_formatter=NullFormatter())
        ax.xaxis.set_major_formatter(lambda value, _: number_text(value))
    rim = None if near_rim is None else np.moveaxis(as_mask("near_rim", near_rim), 0, -1)
    pale = [np.zeros(t.size, bool) if rim is None else rim[node] for node in nodes]
    lines = []
    for node, label, colour, faint in zip(nodes, labels, colours, pale, strict=True):
        style = {"color": colour, "label": label, "marker": "o" if t.size == 1 else "", **kwargs}
        lines += ax.plot(t, np.where(faint, np.nan, factor * curves[node]), **style)
        if faint.any():
            ax.plot(t, factor * curves[node], **{**style, "alpha": PALE, "label": "_pale"})
    limits = ax.get_ylim()  # the expansion diverges at large t, so it does not set the limits
    if series is not None:
        for node, line in zip(nodes, lines, strict=True):
            ax.plot(t, factor * series[node], color=line.get_color(), linestyle="--", linewidth=1.0)
    ax.set_ylim(limits)
    ax.set_xlabel(f"$t${f' in {unit}' if unit else ''}")
    power = {2: r"4\pi t\,", 3: r"(4\pi t)^{3/2}\,"}[grid.dimension] if scaled else ""
    ax.set_ylabel(rf"${power}\mathrm{{HKS}}(t)$")
    handles: list[Artist] = list(lines)
    if series is not None:
        handles.append(Line2D([], [], color="0.3", linestyle="--", linewidth=1.0, label="expansion"))
    if np.any(pale):
        handles.append(Line2D([], [], color="0.3", alpha=PALE, label=f"pale: {RIM_NOTE}"))
    if limit is not None and limit > ax.get_xlim()[0]:
        end = min(limit, ax.get_xlim()[1])
        handles.append(ax.axvspan(ax.get_xlim()[0], end, color="0.88", linewidth=0, zorder=0, label="unresolved $t$"))
    ax.legend(handles=handles, fontsize="small", frameon=False)
    ax.grid(visible=True, which="major", linewidth=0.4, alpha=0.5)
    return lines


def _nearest_nodes(points: np.ndarray, grid: Grid) -> list[tuple[int, ...]]:
    if points.ndim != 2 or points.shape[1] != grid.dimension or len(points) == 0:
        raise ValueError(f"points: got shape {points.shape}; expected (n, {grid.dimension}), one point per row")
    index = np.rint((points - grid.origin) / grid.spacing).astype(int)
    on_grid = np.all((index >= 0) & (index < grid.shape), axis=1)
    for point, node, on in zip(points, index, on_grid, strict=True):
        if not (on and grid.inside[tuple(node)]):
            raise ValueError(f"points: got {tuple(point.tolist())} outside the grid or its mask; choose one inside")
    return [tuple(node) for node in index.tolist()]


def spectrum(
    ax: Axes,
    pairs: Eigenpairs,
    domain: TensorField | SimplicialMesh | None = None,
    *,
    remainder: bool = False,
    unit: str = "",
    **kwargs: Any,
) -> list[Line2D]:
    """Draw the number N(λ) of eigenvalues up to λ and its approximation by Weyl's law.

    Args:
        ax: the axes to draw on.
        pairs: the result of `eigenpairs`; eigenpairs with ``pairs.kept`` False are omitted.
        domain: the field or mesh of the eigenpairs, which determines the boundary term of Weyl's law. Without a domain,
            Weyl's law is drawn without its boundary term.
        remainder: whether to draw N(λ) minus Weyl's law. A falling difference shows that eigenvalues are missing, or
            that a coarse grid overestimates eigenvalues.
        unit: the unit of λ.
        **kwargs: arguments of `Axes.plot` for the line of N(λ).

    Returns:
        The curves of N(λ), of Weyl's law with both terms (if `domain` is given), and of its first term alone.

    Raises:
        ValueError: if the pairs do not belong to the domain.

    Examples:
        >>> count, law = hj.plot.spectrum(hj.plot.new_figure(3, 3).add_subplot(), pairs)
        >>> print(count.get_ydata().max())
        12.0
    """
    values = np.asarray(require_pairs(pairs).eigenvalues, np.float64)[np.asarray(pairs.kept)]
    # The staircase N(λ) has a vertical segment at each eigenvalue.
    steps = np.repeat(values, 2)
    count = np.repeat(np.arange(values.size + 1.0), 2)[1:-1]
    fine = np.linspace(0, values[-1], 400)
    bulk = "area" if pairs.space.dimension == 2 else "volume"

    def level(x: np.ndarray) -> np.ndarray | float:
        return weyl_count(pairs, x, domain) if remainder else 0.0

    style = {"color": "#21918c", "linewidth": 1.2, "label": r"$N(\lambda)$", **kwargs}
    lines = ax.plot(steps, count - level(steps), **style)
    if domain is not None:
        law = weyl_count(pairs, fine, domain) - level(fine)
        lines += ax.plot(fine, law, color="black", linewidth=0.9, label="Weyl's law")
    law = weyl_count(pairs, fine) - level(fine)
    lines += ax.plot(fine, law, "--", color="0.5", linewidth=0.9, label=f"Weyl's law, {bulk} alone")
    ax.set_xlim(0, 1.02 * fine[-1] or None)
    ax.set_xlabel(rf"$\lambda${f' in {unit}' if unit else ''}")
    ax.set_ylabel(r"$N(\lambda)$ minus Weyl's law" if remainder else r"$N(\lambda)$")
    ax.ticklabel_format(scilimits=(-3, 4), useMathText=True)
    ax.tick_params(labelsize=SMALL)
    ax.grid(visible=True, linewidth=0.4, alpha=0.5)
    ax.legend(fontsize=SMALL, frameon=False)
    return lines
