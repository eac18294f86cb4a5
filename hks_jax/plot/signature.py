"""The picture of a result: the signature over t, cropped to the domain and placed in space."""

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
"""The quantiles, away from the boundary, that the colours span."""
LABELS = {
    "raw": "HKS, in units of $t^{-3/2}$",
    "heat-trace": "HKS / heat trace, in units of $t^{-3/2}$",
    "volume": "HKS · volume",
    "flat": r"HKS · $(4\pi t)^{3/2}$",
}
"""The labels of the colours of a volume's picture; t has the unit of the squared lengths in the metric."""
LEAST_RANGE = 0.01
"""The least range of the colours, relative to the values: less contrast than this looks like what it is."""
RIM = 5
"""Nodes from the boundary. At small t it raises a Neumann signature up to fourfold: no colours would be left inside."""


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
    """Return a figure of a signature for each time, with its own colours: a slice, or three slices of a volume.

    The colours span the values away from the boundary; arrows at a colour bar's ends say that some lie beyond. Under
    "flat" normalisation they diverge from 1, which the signature is where the metric is flat. With error bars, what
    noise could make of flat space fades.

    Args:
        result: the signature to draw.
        path: where to save the figure; None: nowhere.
        titles: of a slice, one per time; None: “t = …”.
        first: a title and a scalar (*shape,), drawn before the signature of a slice in grey.
        title: of the whole picture of a slice.
        view: what lies in space has left on the left (``"neurological"``) or on the right (``"radiological"``).
        through: the voxel that slices run through, or the nearest one in the domain; None: one in the middle.

    Raises:
        ValueError: a result on a mesh.
    """
    volume, inside, z = result.volume, np.isfinite(result.values[0]), result.z
    grid, box = cropped(volume, inside)
    orientation, values = placed(volume, box, view), result.values[:, *box]
    z = None if z is None else z[:, *box]
    colours = _colours(result, inside)
    if volume.dimension == 3:
        node = None
        if through is not None:  # the mask's thinnest parts are no part of the domain
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
    """Return for each time the colours, which span the values away from the boundary but for a few."""
    rim = normalise_boundary(result.settings["boundary"], inside.ndim)[-1]
    # Under the mean the rim is like all else, but for its corners; in a volume but for the mask's thin parts, too.
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
    """Return how a volume or slice, or a box of it, lies in space; None where that is not known."""
    if volume.affine is None:
        return None
    thin = volume.thin_axis if volume.dimension == 2 else None
    first = np.zeros(4)
    first[[a for a in range(3) if a != thin]] = 0 if box is None else [part.start for part in box]
    affine = volume.affine.copy()
    affine[:, 3] += affine @ first
    return Orientation.of(affine, thin, view=view)


def proportion(grid: Grid, orientation: Orientation | None) -> float:
    """Return the height of a slice's picture relative to its width, within bounds that suit a figure."""
    shown = grid if orientation is None else orientation.grid(grid)
    width, height = np.multiply(shown.shape, shown.spacing)
    return float(np.clip(height / width, 0.3, 3.0))


def bounding_box(inside: Bool[np.ndarray, "*shape"], margin: int = 2) -> tuple[slice, ...]:
    """Return the slices that cut a box around the True entries, with a margin."""
    (box,) = ndimage.find_objects(inside.astype(int))
    ends = zip(box, inside.shape, strict=True)
    return tuple(slice(max(part.start - margin, 0), min(part.stop + margin, n)) for part, n in ends)


def away_from_rim(inside: Bool[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes over `RIM` nodes from the boundary, or over as many as leave a third of the nodes."""
    deep = inside
    for _ in range(RIM):
        smaller = ndimage.binary_erosion(deep)
        if smaller.sum() <= inside.sum() / 3:
            break
        deep = smaller
    return deep
