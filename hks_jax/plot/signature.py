"""The figure of a result: its signature over t, cropped to the domain and oriented in space."""

import math
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from scipy import ndimage

from hks_jax import Grid
from hks_jax.fem.boundary import normalise_boundary
from hks_jax.io import TensorVolume
from hks_jax.io.result import Result
from hks_jax.plot.figure import finished, new_figure
from hks_jax.plot.images import Colours, colours_of, scalar_image
from hks_jax.plot.orientation import Orientation, View
from hks_jax.plot.panels import axes_in_rows, panel_titles
from hks_jax.plot.volumes import volume_panels

SPAN = (0.002, 0.998)
"""The quantiles of the values away from the boundary that the first and last colours represent."""
LABELS = {
    "raw": "HKS, in units of $t^{-3/2}$",
    "heat-trace": "HKS / heat trace, in units of $t^{-3/2}$",
    "volume": "HKS · volume",
    "flat": r"HKS · $(4\pi t)^{3/2}$",
}
"""The labels of a volume's colour bars; t has the unit of squared lengths in the metric."""
LEAST_RANGE = 0.01
"""The least range of the colours relative to the values, below which contrast is not enhanced."""
RIM = 5
"""The least distance from the boundary, in nodes, of values that set the colours. The HKS is higher near it."""


def signature_panels(
    result: Result,
    path: str | os.PathLike[str] | None = None,
    *,
    titles: Sequence[str] | None = None,
    first: tuple[str, Float[np.ndarray, "*shape"]] | None = None,
    title: str = "",
    view: View = "neurological",
    through: tuple[int, int, int] | None = None,
) -> Figure:
    """Return a figure of a signature on a slice, or on three slices of a volume, with separate colours for each time.

    The colours span the values away from the boundary, and a colour bar has arrows if other values lie beyond. With
    "flat" normalisation they diverge from 1, the value for a flat metric. With error bars, deviations within the noise
    fade.

    Args:
        result: the signature to draw.
        path: the file in which to save the figure, if given.
        titles: a title for each time of a slice, by default “t = …”.
        first: a title and a scalar (*shape,), drawn in grey before the signature of a slice.
        title: the title of the whole figure of a slice.
        view: ``"neurological"`` (left is on the left) or ``"radiological"`` (left is on the right), for data in space.
        through: the voxel through which slices run, or the nearest voxel in the domain; by default a central voxel.

    Raises:
        ValueError: if the result is on a mesh.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), field.grid.spacing, field.grid.origin)
        >>> report = {"settings": {"boundary": "neumann", "normalisation": "raw"}}
        >>> values, times = np.array(hj.hks(pairs, [0.2, 0.5])), np.array([0.2, 0.5])
        >>> len(hj.plot.signature_panels(hj.io.Result(volume, values, times, np.zeros(0), report)).axes)
        2
    """
    volume, inside, z = result.volume, np.isfinite(result.values[0]), result.z
    grid, box = cropped(volume, inside)
    orientation, values = placed(volume, box, view), result.values[:, *box]
    z = None if z is None else z[:, *box]
    colours = _colours(result, inside)
    if volume.dimension == 3:
        node = None
        if through is not None:  # the domain excludes the thinnest parts of the mask
            nodes, corner = np.argwhere(inside[box]), [part.start for part in box]
            node = nodes[np.argmin(np.sum((nodes + corner - through) ** 2, axis=1))].tolist()
        return volume_panels(
            values,
            result.times,
            grid,
            node=node,
            limits=[each[:2] for each in colours],
            cmap=[each.cmap for each in colours],
            length_unit="mm" if volume.affine is not None else "",
            label=LABELS[result.settings["normalisation"]],
            orientation=orientation,
            z=z,
            path=path,
        )
    inside = inside[box]
    titles = panel_titles(result.times, titles or None, result.unit)
    panels = list(zip(titles, values, colours, [None] * len(values) if z is None else z, strict=True))
    if first is not None:
        grey = first[1][box]
        panels.insert(0, (first[0], grey, colours_of(grey[inside], (0.01, 0.96))._replace(cmap="gray"), None))
    rows = math.ceil(len(panels) / 4)
    columns = math.ceil(len(panels) / rows)
    figure = new_figure(columns * 3.3, rows * (2.4 * proportion(grid, orientation) + 0.4) + 0.4 * bool(title))
    axes = axes_in_rows(figure, len(panels), columns)
    for ax, (text, image, (low, high, cmap), noise) in zip(axes, panels, strict=True):
        image = np.where(inside, image, np.nan)
        scalar_image(ax, image, grid, cmap=cmap, vmin=low, vmax=high, orientation=orientation, z=noise)
        ax.set_title(text, fontsize="medium")
        ax.set_axis_off()
    return finished(figure, title, path)


def _colours(result: Result, inside: Bool[np.ndarray, "*shape"]) -> list[Colours]:
    """Return the colours for each time, which span nearly all values away from the boundary."""
    rim = normalise_boundary(result.settings["boundary"], inside.ndim)[-1]
    # For "mean" the boundary is no exception, apart from its corners and, in a volume, thin parts of the mask.
    deep = inside if "mean" in rim and inside.ndim == 2 else away_from_rim(inside)
    span = (0.01, 0.99) if "mean" in rim else SPAN
    centre = 1.0 if result.settings["normalisation"] == "flat" else None
    return [colours_of(values[deep], span, LEAST_RANGE, centre) for values in result.values]


def cropped(volume: TensorVolume | Grid, inside: Bool[np.ndarray, "*shape"]) -> tuple[Grid, tuple[slice, ...]]:
    """Return the grid of the domain's bounding box, without a mask, and the slices that cut the box out."""
    box = bounding_box(inside)
    origin = [o + h * part.start for o, h, part in zip(volume.origin, volume.spacing, box, strict=True)]
    return Grid(inside[box].shape, volume.spacing, origin), box


def placed(volume: TensorVolume, box: Sequence[slice] | None, view: View) -> Orientation | None:
    """Return the orientation of a box of a volume or slice, or None if it is not known."""
    if volume.affine is None:
        return None
    thin = volume.thin_axis if volume.dimension == 2 else None
    first = np.zeros(4)
    first[[a for a in range(3) if a != thin]] = 0 if box is None else [part.start for part in box]
    affine = volume.affine.copy()
    affine[:, 3] += affine @ first
    return Orientation.of(affine, thin, view=view)


def proportion(grid: Grid, orientation: Orientation | None) -> float:
    """Return the ratio of height to width of a slice's image, limited to a range that suits a figure."""
    shown = grid if orientation is None else orientation.grid(grid)
    width, height = np.multiply(shown.shape, shown.spacing)
    return float(np.clip(height / width, 0.3, 3.0))


def bounding_box(inside: Bool[np.ndarray, "*shape"], margin: int = 2) -> tuple[slice, ...]:
    """Return the slices of the bounding box of the True entries, with a margin."""
    (box,) = ndimage.find_objects(inside.astype(int))
    ends = zip(box, inside.shape, strict=True)
    return tuple(slice(max(part.start - margin, 0), min(part.stop + margin, n)) for part, n in ends)


def away_from_rim(inside: Bool[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes at least `RIM` nodes from the boundary, or closer if less than a third would remain."""
    deep = inside
    for _ in range(RIM):
        smaller = ndimage.binary_erosion(deep)
        if smaller.sum() <= inside.sum() / 3:
            break
        deep = smaller
    return deep
