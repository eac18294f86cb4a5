"""The picture that a job leaves: the signature over t, and what it is of."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hks_jax.cli.job import Result
from hks_jax.domain.grid import Grid
from hks_jax.plot import new_figure, number_text, save_figure, scalar_image

RIM = 5
"""Nodes from the boundary. At small t it raises a Neumann signature up to fourfold: no colours would be left inside."""


def draw(
    result: Result,
    path: Path,
    *,
    titles: Sequence[str] | None = None,
    first: tuple[str, Float[np.ndarray, "*shape"]] | None = None,
    title: str = "",
) -> None:
    """Draw the signature, one image per time with its own colours; of a volume, the middle slice along z.

    The colours span the values away from the boundary; arrows at a colour bar's ends say that some lie beyond.

    Args:
        result: what to draw.
        path: the picture's file.
        titles: one per time; None: “t = …”.
        first: a title and a scalar (*shape,), drawn before the signature in grey.
        title: of the whole picture.
    """
    values, inside = result.values, np.isfinite(result.values[0])
    if titles is None:
        titles = [f"$t$ = {number_text(t)}" for t in result.times]
    if first is not None:
        titles, values = [first[0], *titles], np.concatenate([first[1][None], values])
    if result.volume.dimension == 3:
        index = middle(inside)
        values, inside = values[..., index], inside[..., index]
        title = f"{title}, slice z = {index}".lstrip(", ")
    box = bounding_box(inside)
    values, inside = values[:, *box], inside[box]
    spacing = result.volume.spacing[:2]
    origin = [o + h * part.start for o, h, part in zip(result.volume.origin, spacing, box, strict=False)]
    grid = Grid(inside.shape, spacing, origin)

    rows = math.ceil(len(values) / 4)
    columns = math.ceil(len(values) / rows)
    aspect = min(max(inside.shape[1] * spacing[1] / (inside.shape[0] * spacing[0]), 0.3), 3.0)
    figure = new_figure(columns * 3.3, rows * (2.4 * aspect + 0.4) + 0.4 * bool(title))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    deep = away_from_rim(inside)
    for i, (ax, image, text) in enumerate(zip(panels, values, titles, strict=False)):
        grey = first is not None and i == 0
        low, high = np.quantile(image[inside if grey else deep], (0.01, 0.96) if grey else (0.002, 0.998))
        constant = high - low <= 1e-6 * abs(high)  # the colours of rounding errors would say nothing
        vmin, vmax = (None, None) if constant else (float(low), float(high))
        image = np.where(inside, image, np.nan)
        scalar_image(ax, image, grid, cmap="gray" if grey else "viridis", vmin=vmin, vmax=vmax)
        ax.set_title(text, fontsize="medium")
        ax.set_axis_off()
    for ax in panels[len(values) :]:
        ax.remove()
    if title:
        figure.suptitle(title)
    save_figure(figure, path)


def middle(inside: Bool[np.ndarray, "nx ny nz"]) -> int:
    """Return the index along z of the slice in the middle of the domain."""
    layers = np.flatnonzero(inside.any(axis=(0, 1)))
    return int(layers[len(layers) // 2])


def bounding_box(inside: Bool[np.ndarray, "nx ny"], margin: int = 2) -> tuple[slice, slice]:
    """Return the slices that cut a box around the True entries, with a margin."""
    rows, columns = (np.flatnonzero(inside.any(axis=1 - a)) for a in (0, 1))
    first, second = (
        slice(max(int(along[0]) - margin, 0), min(int(along[-1]) + margin + 1, n))
        for along, n in zip((rows, columns), inside.shape, strict=True)
    )
    return first, second


def away_from_rim(inside: Bool[np.ndarray, "nx ny"]) -> Bool[np.ndarray, "nx ny"]:
    """Mark the nodes over `RIM` nodes from the boundary, or all of them if those are few."""
    deep = ndimage.binary_erosion(inside, iterations=RIM)
    return deep if deep.sum() > inside.sum() / 3 else inside
