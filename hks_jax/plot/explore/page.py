"""The construction of the page from a signature, with its numbers in base64."""

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
"""The page's scripts in the order of their dependencies."""
COLOURS = {"sequential": "viridis", "diverging": "RdBu_r", "distance": "inferno_r", "grey": "gray"}
LIMIT = 256 * 1024**2
"""The maximum bytes of numbers in a page. Their text is a third longer, and browsers limit a text to 512 MiB."""


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
    """Write an HTML page to explore a signature on a grid or a surface in any browser, without a network.

    The page shows the signature with sliders for t and, for a volume, the slice, and maps of the tensors beside it. A
    click or the arrow keys choose a point, whose signature is drawn over t. All other points are coloured by the
    distance between their curves and the curve of this point (Sun, Ovsjanikov and Guibas 2009): the root mean square
    over log t of the difference of the two signatures, each relative to the mean over the domain. Two points can be
    compared. A lasso, a maximum distance or a label defines a region, whose mean curve and spread are drawn. Curves can
    be saved as CSV.

    The file contains the numbers in single precision, with 5⅓ bytes for each inside node at each time and in each map.

    Args:
        values: (n_times, *shape) the result of `hks_jax.hks`; nodes that are not finite are omitted. On a surface,
            (n_times, V) finite values; (V,) then replaces (*shape) below.
        times: (n_times,) in increasing order, positive.
        grid: the 2D or 3D grid of the values, or the surface.
        path: the file of the page; its folder is created.
        deviation: (n_times, *shape) the values' standard deviation due to noise (`hks_jax.uncertainty`). Curves of
            points then have a band, and deviations from flat space or the mean within the noise fade.
        tensors: (*shape, d, d) measured tensors such as diffusivities, on grids only. The page shows their mean
            eigenvalue, anisotropy and principal direction (as red, green and blue for x, y and z).
        maps: additional maps (*shape) by name.
        labels: (*shape) integers that define regions, 0 for none.
        label_names: the names of the labels.
        normalisation: the normalisation of the values. ``"raw"`` and ``"flat"`` are shown as (4πt)^(d/2)·HKS, which is
            1 for flat space without boundary, with colours that diverge from 1.
        title: the page's title.
        facts: further facts about the data, by name.
        unit: the unit of t.
        lengths: (n_times,) the distance of heat spread at each time, such as √(Dt), which is shown beside t.
        length_unit: the unit of lengths, in the grid or in `world`.
        world: (3, d + 1), maps node indices to coordinates in space, with node 0 in the last column. Positions are then
            shown in these coordinates. The sides of images have the letters L and R, P and A, I and S, for coordinates
            that increase to the right, front and top, as in NIfTI.

    Returns:
        The path.

    Raises:
        ValueError: if shapes disagree, if times do not increase, if no node is finite, if the normalisation is unknown,
            or if there are more numbers than a browser can open.

    Examples:
        >>> page = hj.plot.explore(hj.hks(pairs, [0.2, 0.5]), [0.2, 0.5], field.grid, folder / "page.html")
        >>> page.read_text(encoding="utf-8")[:15]
        '<!doctype html>'
    """
    shape, d = ((len(grid.vertices),), 2) if isinstance(grid, SurfaceMesh) else (grid.shape, grid.dimension)
    t = checked_times(times, shape, values=values, deviation=deviation)
    if not (np.isfinite(t).all() and t[0] > 0 and (np.diff(t) > 0).all()):
        raise ValueError(f"times: got {times}; expected positive numbers in increasing order")
    if normalisation not in get_args(Normalisation):
        raise ValueError(f"normalisation: got {normalisation!r}; expected one of {', '.join(get_args(Normalisation))}")
    array: np.ndarray = np.asarray(values, dtype=np.float64)
    inside, surface, place = np.isfinite(array).all(axis=0), {}, {}
    if isinstance(grid, SurfaceMesh):
        if not (inside.all() and tensors is None and world is None):
            raise ValueError("values, tensors, world: got NaN, tensors or world for a surface; expected finite values")
        surface = {"vertices": np.asarray(grid.vertices, "<f4"), "faces": grid.faces.astype("<i4")}
    else:
        inside &= grid.inside
        place = {"spacing": grid.spacing, "origin": grid.origin}
    if not inside.any():
        raise ValueError("values: got no node inside the mask with finite values at all times; expected at least one")
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
    # (4πt)^(d/2)·HKS is of order 1 in any unit, so float32 does not underflow.
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
    """Return the initial node, which is the node of the middle slice furthest from the boundary."""
    from scipy import ndimage

    depth = ndimage.distance_transform_edt(np.pad(inside, 1))[(slice(1, -1),) * inside.ndim]
    if inside.ndim == 3:
        middle = np.abs(np.arange(inside.shape[2]) - int(np.median(np.nonzero(inside)[2])))
        depth = np.where(middle == 0, depth, -1.0)
    return [int(i) for i in np.unravel_index(int(np.argmax(depth)), inside.shape)]


def _in_space(world: Any, d: int) -> dict[str, Any]:
    """Return the positions of the nodes, and the names of the grid's sides by the nearest world axes."""
    if world is None:
        return {"world": None, "ends": None}
    matrix = np.asarray(world, dtype=np.float64)
    if matrix.shape != (3, d + 1) or not np.isfinite(matrix).all():
        raise ValueError(f"world: got shape {matrix.shape}; expected finite numbers (3, d + 1) = {(3, d + 1)}")
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
    # "<" is escaped as JSON allows, so that no text can close its script element.
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
    # Inserted texts are not scanned again, because a title may contain any of these words.
    return "".join(filled[piece] if i % 2 else piece for i, piece in enumerate(pieces))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
