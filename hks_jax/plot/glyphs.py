"""Ellipses of a tensor field, its degenerate points, and crosses for indefinite tensors such as derivatives."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from scipy.spatial import cKDTree

from hks_jax.domain.degenerate import degenerate_points as find_degenerate_points
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.plot.figure import cell_extent, colour_bar, frame, legend_below, plane_of, require_plane, side_in_inches

FILL = 0.92
"""The size of the largest ellipse or cross relative to its cell; at most 1, because larger glyphs overlap."""


def ellipses(
    ax: Axes,
    field: TensorField,
    every: int | Sequence[int] | None = None,
    *,
    kind: Literal["metric", "tensor"] = "metric",
    sizes: Literal["common", "fit"] = "common",
    color: str = "anisotropy",
    cmap: str | None = None,
    colorbar: bool = True,
    **kwargs: Any,
) -> EllipseCollection:
    """Draw the tensors of a 2D field at a subset of nodes as ellipses, scaled to prevent overlaps.

    Args:
        ax: the axes to draw on.
        field: the field; nodes outside its mask are omitted.
        every: the step between drawn nodes, one number or one per axis; by default about 24 nodes on the longer side,
            or fewer on small axes.
        kind: ``"metric"`` draws the unit circle {v : vᵀTv = const} of the metric, with half axes ∝ 1/√λ for the
            eigenvalues λ of T. ``"tensor"`` draws the image of a circle under T^(1/2), with half axes ∝ √λ, as is usual
            for diffusion tensors.
        sizes: ``"common"`` uses one scale, so that sizes are comparable; ``"fit"`` fills each cell with its ellipse.
        color: ``"anisotropy"`` (λ₁ − λ₂)/(λ₁ + λ₂), ``"orientation"`` of the longer axis in degrees, or a colour.
        cmap: the colour map, by default viridis for anisotropy and the cyclic twilight for orientation.
        colorbar: whether to add a colour bar.
        **kwargs: arguments of `matplotlib.collections.EllipseCollection`.

    Raises:
        ValueError: if the field is 3D, if an option is unknown, or if no node can be drawn.

    Examples:
        >>> marks = hj.plot.ellipses(hj.plot.new_figure(3, 3).add_subplot(), field, every=1)
        >>> len(marks.get_offsets())  # one at each node
        81
    """
    grid = plane_of(field)
    if kind not in ("metric", "tensor"):
        raise ValueError(f'kind: got {kind!r}; expected "metric" or "tensor"')
    if sizes not in ("common", "fit"):
        raise ValueError(f'sizes: got {sizes!r}; expected "common" or "fit"')
    steps, pick = nodes_drawn(grid, every, ax)
    inside = grid.inside[pick]
    if not inside.any():
        raise ValueError(f"every: got {every}, for which no drawn node lies inside the mask; use a smaller step")
    tensors = np.asarray(field.tensors, dtype=np.float64)[pick][inside]
    centres = grid.nodes[pick][inside]

    eigenvalues, vectors = np.linalg.eigh(tensors)
    power = -0.5 if kind == "metric" else 0.5
    half_axes = eigenvalues**power
    longer = 0 if kind == "metric" else 1
    axis = vectors[:, :, longer]
    # Along axis a, the half width of an ellipse's bounding box is √((T⁻¹)_aa) for a metric and √(T_aa) for a tensor.
    box = np.sqrt(np.einsum("nai,ni->na", vectors**2, half_axes**2))
    scale = 0.5 * FILL / np.max(box / (np.array(steps) * grid.spacing), axis=1)
    if sizes == "common":
        scale[:] = scale.min()
    half_axes *= scale[:, None]
    angles = np.degrees(np.arctan2(axis[:, 1], axis[:, 0])) % 180.0

    collection = EllipseCollection(
        2 * half_axes[:, longer],
        2 * half_axes[:, 1 - longer],
        angles,
        units="xy",
        offsets=centres,
        offset_transform=ax.transData,
        **{"linewidths": 0.3, "edgecolors": "black", **kwargs},
    )
    frame(ax, grid)
    ax.add_collection(collection, autolim=False)
    anisotropies = (eigenvalues[:, 1] - eigenvalues[:, 0]) / eigenvalues.sum(axis=1)
    coloured = {
        "anisotropy": (anisotropies, "viridis", 1, "anisotropy"),
        "orientation": (angles, "twilight", 180, "orientation in degrees"),
    }
    if not isinstance(color, str) or color not in coloured:
        collection.set_facecolor(color)
        return collection
    values, own, largest, label = coloured[color]
    collection.set(array=values, cmap=cmap or own, clim=(0, largest))
    if colorbar:
        colour_bar(ax, collection, label, ticks=largest * np.linspace(0, 1, 5))
    return collection


def nodes_drawn(grid: Grid, every: int | Sequence[int] | None, ax: Axes) -> tuple[tuple[int, ...], tuple[slice, ...]]:
    """Return the step along each axis, and the slices that select the drawn nodes.

    By default, about 10 nodes per inch and at most 24 nodes are drawn along the longer side.
    """
    if every is None:
        width, height = (n * h for n, h in zip(grid.shape, grid.spacing, strict=True))
        cell = max(width, height) / min(24, max(4, 10.5 * side_in_inches(ax, (width, height))))
        steps = tuple(max(1, round(cell / h)) for h in grid.spacing)
    else:
        given = np.broadcast_to(np.asarray(every), (grid.dimension,))
        if not np.issubdtype(given.dtype, np.integer) or given.min() < 1:
            raise ValueError(f"every: got {every}; expected one positive integer, or one for each axis")
        steps = tuple(given.tolist())
    counts = [max(1, n // step) for n, step in zip(grid.shape, steps, strict=True)]
    firsts = [(n - m * s) // 2 + s // 2 for n, m, s in zip(grid.shape, counts, steps, strict=True)]
    return steps, tuple(slice(a, a + (m - 1) * s + 1, s) for a, m, s in zip(firsts, counts, steps, strict=True))


def sensitivity(
    ax: Axes,
    grid: Grid,
    gradient: Any,
    every: int | Sequence[int] | None = None,
    *,
    power: float = 0.5,
    colors: tuple[str, str] = ("#b2182b", "#2166ac"),
    legend: bool = True,
    **kwargs: Any,
) -> LineCollection:
    """Draw the derivative of a scalar quantity with respect to the tensor at each node as a cross.

    A cross has two bars along the eigenvectors of the gradient, whose lengths are proportional to |μ|^power for the
    eigenvalues μ. If the eigenvalue is positive, the scalar quantity increases with the metric's length along the bar.

    Args:
        ax: the axes to draw on.
        grid: the 2D grid.
        gradient: (*shape, 2, 2) symmetric, as `jax.grad` returns it; nodes outside the mask are omitted.
        every: the step between drawn nodes, one number or one per axis; by default about 24 nodes along the longer
            side. The gradient belongs to the drawn nodes, not to the area around them.
        power: an exponent; values below 1 make small derivatives visible beside large ones.
        colors: the colours of positive and negative eigenvalues.
        legend: whether to add a legend of the colours.
        **kwargs: arguments of `matplotlib.collections.LineCollection`.

    Raises:
        ValueError: if the grid is 3D, or if the gradient has another shape or is NaN inside the mask.

    Examples:
        >>> gradient = jax.grad(lambda T: jnp.log(jnp.linalg.det(T)).sum())(field.tensors)
        >>> bars = hj.plot.sensitivity(hj.plot.new_figure(3, 3).add_subplot(), field.grid, gradient, every=1)
        >>> len(bars.get_segments())  # two at each node
        162
    """
    require_plane("grid", grid)
    array = np.asarray(gradient, dtype=np.float64)
    if array.shape != (*grid.shape, 2, 2):
        raise ValueError(f"gradient: got shape {array.shape}; expected {(*grid.shape, 2, 2)}, as jax.grad returns it")
    steps, pick = nodes_drawn(grid, every, ax)
    inside = grid.inside[pick]
    matrices, centres = array[pick][inside], grid.nodes[pick][inside]
    if not np.isfinite(matrices).all():
        raise ValueError("gradient: got NaN or infinite tensors at drawn nodes; expected finite tensors")
    eigenvalues, vectors = np.linalg.eigh((matrices + np.swapaxes(matrices, 1, 2)) / 2)
    lengths = np.abs(eigenvalues) ** power
    cell = min(s * h for s, h in zip(steps, grid.spacing, strict=True))
    lengths *= 0.5 * FILL * cell / max(lengths.max(initial=0.0), np.finfo(float).tiny)
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


def degenerate_points(
    ax: Axes,
    field: TensorField,
    *,
    merge: float = 2,
    periodic: bool | Sequence[bool] = False,
    size: float = 0.022,
    cmap: str = "PuOr",
    legend: bool = True,
    **kwargs: Any,
) -> PolyCollection:
    """Mark the degenerate points of a 2D field on `ax` with shapes and colours that depend on their index.

    Trisectors (index −½) are triangles, wedges (½) are discs, and other points are polygons with |2·index| + 2 sides.
    The sizes of marks are in coordinate units, and are reduced where marks would overlap.

    Args:
        ax: the axes to draw on.
        field: the field.
        merge: the same as for `hks_jax.degenerate_points`, which computes the points.
        periodic: the same.
        size: the radius of a mark, relative to the longer side of the grid.
        cmap: a diverging colour map; its middle belongs to index 0.
        legend: whether to add a legend with each index and the number of its points.
        **kwargs: arguments of `matplotlib.collections.PolyCollection`.

    Raises:
        ValueError: if the field is 3D, `merge` or `periodic` is bad, or `size` is not positive.

    Examples:
        >>> wedge = hj.examples.degenerate_point_field(0.5, 9)
        >>> marks = hj.plot.degenerate_points(hj.plot.new_figure(3, 3).add_subplot(), wedge)
        >>> len(marks.get_paths())
        1
    """
    if not size > 0:
        raise ValueError(f"size: got {size}; expected a positive number, relative to the longer side")
    positions, indices = find_degenerate_points(field, merge, periodic)
    x0, x1, y0, y1 = cell_extent(field.grid)
    radii = np.full(len(indices), size * max(x1 - x0, y1 - y0))
    if len(indices) > 1:
        nearest = cKDTree(positions).query(positions, k=2)[0][:, 1]
        radii = np.minimum(radii, 0.48 * nearest)
    limit = max(1.5, np.abs(indices).max(initial=0))
    colours = {index: colormaps[cmap](0.5 - 0.5 * index / limit) for index in np.unique(indices)}
    outlines = {
        i: np.asarray(Path.unit_regular_polygon(32 if i == 0.5 else _corners(i)).vertices)[:-1] for i in colours
    }
    marks = [r * outlines[index] + x for x, index, r in zip(positions, indices, radii, strict=True)]
    collection = PolyCollection(
        marks,
        **{
            "facecolors": [colours[i] for i in indices],
            "edgecolors": "black",
            "linewidths": 0.8,
            "zorder": 3,
            "path_effects": [withStroke(linewidth=2.5, foreground="white")],
            **kwargs,
        },
    )
    frame(ax, field.grid)
    ax.add_collection(collection, autolim=False)
    handles = []
    for index, colour in colours.items():
        marker = "o" if index == 0.5 else (_corners(index), 0, 0)
        name = ("−" if index < 0 else "") + ("½" if abs(index) == 0.5 else str(Fraction(abs(index))))
        style = {"linestyle": "", "color": colour, "markeredgecolor": "black", "marker": marker}
        handles.append(Line2D([], [], label=f"{name}  ({np.sum(indices == index)})", **style))
    if legend and handles:
        legend_below(ax, handles, "index (how many)")
    return collection


def _corners(index: float) -> int:
    return round(abs(2 * index)) + 2
