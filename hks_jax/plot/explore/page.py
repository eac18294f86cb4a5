"""From a signature to the page: numbers in base64, and the page's own files around them."""

import base64
import html
import json
import math
import os
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Real
from matplotlib import colormaps

from hks_jax import __version__
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SurfaceMesh
from hks_jax.plot.explore.layers import Layer, Regions, regions, scalar_layers, tensor_layers
from hks_jax.plot.orientation import LETTERS
from hks_jax.plot.panels import checked_times
from hks_jax.plot.signature import bounding_box
from hks_jax.signatures.hks import Normalisation
from hks_jax.storage import atomic_path

SCRIPTS = ("data", "colours", "image", "mesh", "curves", "regions", "controls", "main")
"""The page's scripts, in the order in which they need one another."""
COLOURS = {"sequential": "viridis", "diverging": "RdBu_r", "distance": "inferno_r", "grey": "gray"}
LIMIT = 256 * 1024**2
"""Bytes of numbers in a page at most. They are a text a third longer, and browsers hold no text of over 512 MiB."""


def explore(
    values: Real[ArrayLike, "n_times *shape"],
    times: Sequence[float] | Real[ArrayLike, " n_times"],
    grid: Grid | SurfaceMesh,
    path: str | os.PathLike[str],
    *,
    deviation: Real[ArrayLike, "n_times *shape"] | None = None,
    tensors: Real[ArrayLike, "*shape d d"] | None = None,
    maps: Mapping[str, Any] | None = None,
    labels: Real[ArrayLike, "*shape"] | None = None,
    label_names: Mapping[int, str] | None = None,
    normalisation: Normalisation = "raw",
    title: str = "Heat kernel signature",
    facts: Mapping[str, Any] | None = None,
    unit: str = "",
    lengths: Sequence[float] | Real[ArrayLike, " n_times"] | None = None,
    length_unit: str = "",
    world: Real[ArrayLike, "3 d_and_1"] | None = None,
) -> Path:
    """Write a page to explore a signature on a grid or a surface: an HTML file for any browser, without a network.

    It shows the signature with sliders for t and, of a volume, the slice; beside it maps of the tensors. A point that
    is chosen, by a click or with the arrow keys, draws its signature over t, and colours all others by the distance of
    their curves to its own (Sun, Ovsjanikov and Guibas 2009): the root mean square over log t of the difference of the
    two signatures, each relative to the mean over the domain. Two points can be compared; a lasso, the points alike, or
    a label give a region's mean curve and its spread. Curves can be saved as CSV.

    The numbers are in the file in single precision: 4 bytes and a third for each node inside, time and map.

    Args:
        values: (n_times, *shape), as `hks_jax.hks` returns them; nodes that are not finite are left out. On a surface
            (n_times, V), all finite; what follows is then (V,) where it is (*shape) here.
        times: (n_times,), positive and increasing.
        grid: the grid of the values, 2D or 3D, or the surface.
        path: the page; its folder is made.
        deviation: (n_times, *shape), the standard deviation that noise gives the values (`hks_jax.uncertainty`): the
            curves of points have a band of it, and what noise could make of flat space, or of the mean, fades.
        tensors: (*shape, d, d), as they were measured, such as diffusivities: their mean eigenvalue, anisotropy and
            principal direction (as red, green and blue for x, y and z) are shown. Not on surfaces.
        maps: more maps (*shape) by name.
        labels: (*shape), whole numbers, 0 for none: regions.
        label_names: the names of the labels.
        normalisation: that of the values. ``"raw"`` and ``"flat"`` are shown as (4πt)^(d/2)·HKS, which is 1 where space
            is flat and has no boundary, with colours that diverge from 1.
        title: the page's title.
        facts: what else the page should say of the data, by name.
        unit: the unit of t.
        lengths: (n_times,), how far heat has spread at each time, such as √(Dt): said beside t.
        length_unit: the unit of lengths, in the grid or in `world`.
        world: (3, d + 1), node indices to coordinates in space, the last column those of node 0: positions are then
            given there, and the sides of the images named by L and R, P and A, I and S, for coordinates that grow to
            the right, the front and the top, as NIfTI's do.

    Returns:
        The path.

    Raises:
        ValueError: shapes that do not agree, times that do not increase, nothing finite, an unknown normalisation, or
            more numbers than a browser can open.
    """
    shape, d = ((len(grid.vertices),), 2) if isinstance(grid, SurfaceMesh) else (grid.shape, grid.dimension)
    t = checked_times(times, shape, values=values, deviation=deviation)
    if not (np.isfinite(t).all() and t[0] > 0 and (np.diff(t) > 0).all()):
        raise ValueError(f"times: got {times}; expected positive numbers that increase")
    if normalisation not in get_args(Normalisation):
        raise ValueError(f"normalisation: got {normalisation!r}; expected one of {', '.join(get_args(Normalisation))}")
    array: np.ndarray = np.asarray(values, dtype=np.float64)
    inside, surface, place = np.isfinite(array).all(axis=0), {}, {}
    if isinstance(grid, SurfaceMesh):
        if not (inside.all() and tensors is None and world is None):
            raise ValueError("values, tensors, world: on a surface values must be finite, and the others left out")
        surface = {"vertices": np.asarray(grid.vertices, "<f4"), "faces": grid.faces.astype("<i4")}
    else:
        inside &= grid.inside
        place = {"spacing": grid.spacing, "origin": grid.origin}
    if not inside.any():
        raise ValueError("values: nothing is finite inside the grid's mask at all times; nothing to show")
    spread = None if lengths is None else np.asarray(lengths, dtype=np.float64)
    if spread is not None and (spread.shape != t.shape or not np.isfinite(spread).all()):
        raise ValueError(f"lengths: got shape {spread.shape}; expected {t.shape}, one finite number per time")
    layers = [] if tensors is None else tensor_layers(tensors, inside)
    layers += scalar_layers(maps or {}, inside)
    noise = None if deviation is None else np.asarray(deviation, dtype=np.float64)
    parts = None if labels is None else regions(labels, label_names, inside)
    size = 4 * (int(inside.sum()) * t.size * (2 if noise is not None else 1) + sum(each.values.size for each in layers))
    if size > LIMIT:
        raise ValueError(
            f"values: {t.size} times at {int(inside.sum())} nodes take {size / 1024**2:.0f} MiB; expected at most "
            f"{LIMIT // 1024**2}, which a browser can open. Show fewer times, one slice, or part of the domain"
        )
    flat = (4 * math.pi * t) ** (d / 2)
    # (4πt)^(d/2)·HKS is of order 1 in any unit: no float32 is too small for it.
    scale = flat[:, None] if normalisation == "raw" else 1.0
    shown = {"values": scale * array[:, inside]} | ({} if noise is None else {"deviation": scale * noise[:, inside]})
    box = bounding_box(inside, margin=0)
    about = {
        "title": title,
        "facts": [[str(name), str(value)] for name, value in (facts or {}).items()],
        "software": f"hks-jax {__version__}",
        "dimension": d,
        "mesh": bool(surface),
        "shape": inside[box].shape,
        "offset": [part.start for part in box],
        **place,
        **_in_space(world, d),
        "unit": unit,
        "lengthUnit": length_unit,
        "times": t.tolist(),
        "lengths": None if spread is None else spread.tolist(),
        "flat": flat.tolist(),
        "normalisation": normalisation,
        "noise": noise is not None,
        "start": [0] if surface else _deep_node(inside[box]),
        "layers": [{"name": layer.name, "kind": layer.kind} for layer in layers],
        "labels": [] if parts is None else [[label, name] for label, name in parts.names.items()],
        "colours": {name: _colour_table(colours) for name, colours in COLOURS.items()},
    }
    page = _assemble(about, inside[box], shown, layers, parts, surface)
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return Path(path)


def _deep_node(inside: Bool[np.ndarray, "*shape"]) -> list[int]:
    """Return the node to start with: inside, in the middle slice, as far from the boundary as any there."""
    from scipy import ndimage

    depth = ndimage.distance_transform_edt(np.pad(inside, 1))[(slice(1, -1),) * inside.ndim]
    if inside.ndim == 3:
        middle = np.abs(np.arange(inside.shape[2]) - int(np.median(np.nonzero(inside)[2])))
        depth = np.where(middle == 0, depth, -1.0)
    return [int(i) for i in np.unravel_index(int(np.argmax(depth)), inside.shape)]


def _in_space(world: Any, d: int) -> dict[str, Any]:
    """Return where the nodes are, and the names of the grid's sides, each by the world axis that it is nearest to."""
    if world is None:
        return {"world": None, "ends": None}
    matrix = np.asarray(world, dtype=np.float64)
    if matrix.shape != (3, d + 1) or not np.isfinite(matrix).all():
        raise ValueError(f"world: got shape {matrix.shape}; expected (3, d + 1) = {(3, d + 1)}, finite")
    ends = []
    for direction in matrix[:, :d].T:
        axis = int(np.argmax(np.abs(direction)))
        ends.append(LETTERS[axis] if direction[axis] > 0 else LETTERS[axis][::-1])
    return {"world": matrix.tolist(), "ends": ends}


def _colour_table(name: str) -> str:
    colours = (255 * colormaps[name](np.linspace(0, 1, 256))[:, :3]).round().astype(np.uint8)
    return _base64(colours)


def _assemble(
    about: dict[str, Any],
    inside: Bool[np.ndarray, "*shape"],
    shown: dict[str, np.ndarray],
    layers: list[Layer],
    parts: Regions | None,
    surface: dict[str, np.ndarray],
) -> str:
    numbers = {
        "inside": _base64(inside.astype(np.uint8)),
        **{name: _base64(array.astype("<f4")) for name, array in shown.items()},
    }
    numbers |= {f"layer-{i}": _base64(layer.values.astype("<f4")) for i, layer in enumerate(layers)}
    if parts is not None:
        numbers["labels"] = _base64(parts.values.astype("<i4"))
    numbers |= {name: _base64(array) for name, array in surface.items()}
    own = files(__package__)
    scripts = "\n".join((own / f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS)
    # No text can end the script that it is in: "<" is written as JSON also writes it.
    described = json.dumps(about, allow_nan=False).replace("<", "\\u003c")
    blocks = [f'<script type="application/json" id="about">{described}</script>']
    blocks += [f'<script type="text/plain" id="{name}">{text}</script>' for name, text in numbers.items()]
    filled = {
        "TITLE": html.escape(about["title"]),
        "STYLE": (own / "style.css").read_text(encoding="utf-8"),
        "NUMBERS": "\n".join(blocks),
        "SCRIPT": f'(() => {{\n"use strict";\n{scripts}}})();',
    }
    pieces = (own / "page.html").read_text(encoding="utf-8").split("@@")
    # What is filled in is not looked at again: a title may hold any of these words.
    return "".join(filled[piece] if i % 2 else piece for i, piece in enumerate(pieces))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
