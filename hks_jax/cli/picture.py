"""The picture that a job leaves: the signature over t, and what it is of."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hks_jax.cli.noise import z_of
from hks_jax.cli.result import Result
from hks_jax.domain.grid import Grid
from hks_jax.fem.boundary import normalise_boundary
from hks_jax.io.volume import TensorVolume
from hks_jax.plot import Orientation, new_figure, number_text, save_figure, scalar_image, volume_panels
from hks_jax.plot.images import colours_of
from hks_jax.plot.orientation import View

SPAN = (0.002, 0.998)
"""The quantiles, away from the boundary, that the colours span."""
LABELS = {
    "raw": "HKS, in units of $t^{-3/2}$",
    "heat-trace": "HKS / heat trace, in units of $t^{-3/2}$",
    "volume": "HKS · volume",
    "flat": r"HKS · $(4\pi t)^{3/2}$",
}
"""What the colours of a volume's picture are; t has the unit of the squared lengths in the metric."""
LEAST_RANGE = 0.01
"""The least range of the colours, relative to the values: less contrast than this looks like what it is."""
RIM = 5
"""Nodes from the boundary. At small t it raises a Neumann signature up to fourfold: no colours would be left inside."""


def draw(
    result: Result,
    path: Path,
    *,
    titles: Sequence[str] | None = None,
    first: tuple[str, Float[np.ndarray, "*shape"]] | None = None,
    title: str = "",
    view: View = "neurological",
) -> None:
    """Draw the signature of a slice, one image per time with its own colours.

    The colours span the values away from the boundary; arrows at a colour bar's ends say that some lie beyond. Under
    "flat" normalisation they diverge from 1, which the signature is where the metric is flat. With error bars, what
    noise could make of flat space fades.

    Args:
        result: what to draw.
        path: the picture's file.
        titles: one per time; None: “t = …”.
        first: a title and a scalar (*shape,), drawn before the signature in grey.
        title: of the whole picture.
        view: what is on the left, see `placed`.
    """
    values, inside, volume = result.values, np.isfinite(result.values[0]), result.volume
    titles = titles or [f"$t$ = {number_text(t)} {result.unit}".rstrip() for t in result.times]
    if first is not None:
        titles, values = [first[0], *titles], np.concatenate([first[1][None], values])
    grid, box = cropped(volume, inside)
    values, inside, orientation = values[:, *box], inside[box], placed(volume, box, view)

    z = z_of(result)
    z = None if z is None else z[:, *box]
    rows = math.ceil(len(values) / 4)
    columns = math.ceil(len(values) / rows)
    figure = new_figure(columns * 3.3, rows * (2.4 * proportion(grid, orientation) + 0.4) + 0.4 * bool(title))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    deep, span = _coloured(result, inside)
    for i, (ax, image, text) in enumerate(zip(panels, values, titles, strict=False)):
        grey = first is not None and i == 0
        if grey:
            colours = colours_of(image[inside], (0.01, 0.96))._replace(cmap="gray")
        else:
            colours = colours_of(image[deep], span, LEAST_RANGE, _centre(result))
        low, high, cmap = colours
        image = np.where(inside, image, np.nan)
        faded = None if z is None or grey else z[i - (first is not None)]
        scalar_image(ax, image, grid, cmap=cmap, vmin=low, vmax=high, orientation=orientation, z=faded)
        ax.set_title(text, fontsize="medium")
        ax.set_axis_off()
    for ax in panels[len(values) :]:
        ax.remove()
    if title:
        figure.suptitle(title)
    save_figure(figure, path)


def draw_volume(
    result: Result, path: Path, through: tuple[int, int, int] | None = None, view: View = "neurological"
) -> None:
    """Draw the signature of a volume: for each time, with its own colours, three orthogonal slices; noise fades.

    Args:
        result: what to draw.
        path: the picture's file.
        through: the voxel that the slices run through, or the nearest one in the domain; None: one in the middle.
        view: what is on the left, see `placed`.
    """
    inside, volume = np.isfinite(result.values[0]), result.volume
    node = None if through is None else _nearest(inside, through)
    grid, box = cropped(volume, inside)
    deep, span = _coloured(result, inside)
    colours = [colours_of(values[deep], span, LEAST_RANGE, _centre(result)) for values in result.values]
    z = z_of(result)
    volume_panels(
        result.values[:, *box],
        result.times,
        grid,
        node=node and [i - part.start for i, part in zip(node, box, strict=True)],
        limits=[each[:2] for each in colours],
        cmap=[each.cmap for each in colours],
        length_unit="mm" if volume.affine is not None else "",
        label=LABELS[result.settings["normalisation"]],
        orientation=placed(volume, box, view),
        z=None if z is None else z[:, *box],
        path=path,
    )


def _centre(result: Result) -> float | None:
    """Return the value of the middle colour, if there is one that means something."""
    return 1.0 if result.settings["normalisation"] == "flat" else None


def _coloured(
    result: Result, inside: Bool[np.ndarray, "*shape"]
) -> tuple[Bool[np.ndarray, "*shape"], tuple[float, float]]:
    """Return which nodes' values the colours span, and from which quantile to which."""
    rim = normalise_boundary(result.settings["boundary"], inside.ndim)[-1]
    if "mean" not in rim:
        return away_from_rim(inside), SPAN
    # The rim is like all else, but for its corners; and in a volume but for the mask's thin parts, which are many.
    return inside if inside.ndim == 2 else away_from_rim(inside), (0.01, 0.99)


def _nearest(inside: Bool[np.ndarray, "nx ny nz"], voxel: tuple[int, int, int]) -> tuple[int, ...]:
    """Return the voxel inside that is nearest: the mask's thinnest parts are no part of the domain."""
    voxels = np.argwhere(inside)
    return tuple(voxels[np.argmin(np.sum((voxels - voxel) ** 2, axis=1))].tolist())


def cropped(volume: TensorVolume | Grid, inside: Bool[np.ndarray, "*shape"]) -> tuple[Grid, tuple[slice, ...]]:
    """Return the grid of the domain's bounding box, without a mask, and the slices that cut the box out."""
    box = bounding_box(inside)
    origin = [o + h * part.start for o, h, part in zip(volume.origin, volume.spacing, box, strict=True)]
    return Grid(inside[box].shape, volume.spacing, origin), box


def placed(volume: TensorVolume, box: Sequence[slice], view: View) -> Orientation | None:
    """Return how a box of a volume or slice lies in space; None where that is not known.

    Args:
        volume: what the box is cut out of.
        box: the box, a slice along each axis.
        view: whether left is on the left (``"neurological"``) or on the right (``"radiological"``).
    """
    if volume.affine is None:
        return None
    thin = volume.thin_axis if volume.dimension == 2 else None
    first = np.zeros(4)
    first[[a for a in range(3) if a != thin]] = [part.start for part in box]
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
    ends = [(int(along.min()), int(along.max()) + 1) for along in np.nonzero(inside)]
    return tuple(
        slice(max(low - margin, 0), min(high + margin, n)) for (low, high), n in zip(ends, inside.shape, strict=True)
    )


def away_from_rim(inside: Bool[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes over `RIM` nodes from the boundary, or over as many as leave a third of the nodes."""
    deep = inside
    for _ in range(RIM):
        smaller = ndimage.binary_erosion(deep)
        if smaller.sum() <= inside.sum() / 3:
            break
        deep = smaller
    return deep
