"""The construction of the page from a signature, with its numbers compressed and in base64."""

import base64
import html
import json
import os
import zlib
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Real
from matplotlib import colormaps

from hks_jax import __version__
from hks_jax.checks import require_real
from hks_jax.domain.components import bounding_box
from hks_jax.domain.simplicial_mesh import SurfaceMesh, TetMesh
from hks_jax.io import TensorVolume
from hks_jax.io.result import Result, require_result
from hks_jax.io.units import MEDIAN, MM2_PER_S
from hks_jax.plot.orientation import Orientation, View
from hks_jax.plot.panels import checked_times
from hks_jax.plot.signature import FICK, METRICS, placed
from hks_jax.plot.volumes import middle_node
from hks_jax.signatures.regions import region_statistics
from hks_jax.signatures.times import FREE
from hks_jax.storage import atomic_path

SCRIPTS = ("data", "colours", "image", "mesh", "curves", "regions", "controls", "main")
"""The page's scripts in the order of their dependencies."""
COLOURS = {"sequential": "viridis", "diverging": "RdBu_r", "distance": "inferno_r", "grey": "gray"}
AROUND = 6
"""The number of nodes around the domain at which the anatomical image is shown."""
LIMIT = 256 * 1024**2
"""The maximum bytes of numbers in a page, which the browser keeps in single precision."""


def explore(
    result: Result,
    path: str | os.PathLike[str],
    *,
    maps: Mapping[str, Any] | None = None,
    anatomy: Real[ArrayLike, "*shape"] | None = None,
    labels: Real[ArrayLike, "*shape"] | None = None,
    label_names: Mapping[int, str] | None = None,
    title: str = "Heat kernel signature",
    unit: str | None = None,
    view: View = "neurological",
) -> Path:
    """Write an HTML page to explore a signature on a grid or a surface in any browser, without a network.

    The page shows the signature with sliders for t and, for a volume, the slice, and maps of the tensors. A click or
    the arrow keys choose a point, whose signature is drawn over t. Points are coloured by the distance of their
    signature from the signature of the chosen point (Sun, Ovsjanikov and Guibas 2009): the root mean square over log t
    of their difference, divided by the domain's mean at each t. Two points can be compared. A lasso, a maximum distance
    or a label defines a region, whose mean curve and spread are drawn. Curves can be saved as CSV.

    The file contains the numbers rounded to 24 bits, with a relative error of 1.6e-5, and compressed, in 1 to 4 bytes
    for each inside node at each time and in each map.

    Args:
        result: the signature at increasing times. Nodes without finite values at all times are omitted; on a surface,
            all values must be finite. The normalisations ``"raw"`` and ``"flat"`` are shown as (4πt)^(d/2)·HKS, which
            is 1 for flat space without boundary, with colours that diverge from 1. If ``arrays["deviation"]`` is given,
            curves have error bands. If ``arrays["z"]`` (`hks_jax.Uncertainty.z`) is given, values fade if noise
            explains their difference from constant tensors. Tensors, if given, appear as mean eigenvalue, anisotropy
            and direction (red, green and blue for x, y and z). With an affine, positions are shown in space, images are
            turned as by `Orientation`, and their sides have the letters L and R, P and A, I and S. If t is a time, the
            diffusion length √(Dt) is shown beside it. If ``arrays["influence"]`` is given, nodes at which the boundary
            contributes over a tenth are hatched.
        path: the file of the page; its folder is created.
        maps: additional maps (*shape) by name.
        anatomy: (*shape) an anatomical image at the nodes of a grid (`hks_jax.io.sample_image`), which lies in grey
            under the signature and the distances, and around the domain; NaN where it has no value. A slider sets the
            opacity of the signature and the distances.
        labels: (*shape) integers that define regions, 0 for none.
        label_names: the names of the labels.
        title: the page's title.
        unit: the unit of t, by default the unit of the result.
        view: ``"neurological"`` (left is on the left) or ``"radiological"`` (left is on the right), for data in space.

    Returns:
        The path.

    Raises:
        ValueError: if the result is on tetrahedra, if times do not increase, if no node is finite, if maps, labels or
            the anatomy have another shape, or if there are more numbers than a browser can open.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), field.grid.spacing, field.grid.origin)
        >>> result = hj.io.Result(volume, np.array(hj.hks(pairs, [0.2, 0.5])), np.array([0.2, 0.5]))
        >>> page = hj.plot.explore(result, folder / "page.html")
        >>> page.read_text(encoding="utf-8")[:15]
        '<!doctype html>'
    """
    require_result(result)
    axes, turned, facts, stored = None, None, _facts(result), result.place
    grey = None if anatomy is None else _grey(anatomy, result)
    if isinstance(result.place, TensorVolume) and (turned := placed(result.place, None, view)) is not None:
        result, maps, labels, axes = _turned(result, maps, labels, turned)
        grey = None if grey is None else turned.array(grey)
    mesh, noise = result.place, result.arrays.get("deviation")
    if isinstance(mesh, TetMesh):
        raise ValueError(f"{result.source}: got a result on tetrahedra; expected a grid or a surface. Use ParaView")
    t = checked_times(result.times, result.values.shape[1:], values=result.values, deviation=noise, z=result.z)
    if not (np.isfinite(t).all() and t[0] > 0 and (np.diff(t) > 0).all()):
        raise ValueError(f"times: got {t}; expected positive numbers in increasing order")
    inside = np.isfinite(result.values).all(axis=0)
    surface, place = {}, {}
    if isinstance(mesh, SurfaceMesh):
        used = mesh.triangulation.used
        if not inside[used].all():
            raise ValueError("values: got NaN or infinite values on a surface; expected finite values")
        inside, renumbered = used, np.cumsum(used) - 1
        surface = {"faces": _packed(renumbered[mesh.faces], "<i4"), "numbers": _packed(np.flatnonzero(used), "<i4")}
        surface["vertices"] = _floats(np.asarray(mesh.vertices)[used])
    else:
        inside &= result.volume.inside
        place = {"spacing": result.volume.spacing, "origin": result.volume.origin}
    if not inside.any():
        raise ValueError("values: got no node inside the mask with finite values at all times; expected at least one")
    layers = {} if result.tensors is None else _tensor_layers(result.tensors, inside)
    for name, values in (maps or {}).items():
        if np.shape(values) != inside.shape:
            raise ValueError(f"maps[{name!r}]: got shape {np.shape(values)}; expected the grid's shape {inside.shape}")
        require_real(f"maps[{name!r}]", values)
        layers[name] = np.asarray(values)[inside]
    maps_shown = 1 + (noise is not None) + (result.z is not None)
    size = 4 * (int(inside.sum()) * t.size * maps_shown + sum(map(np.size, layers.values())))
    if size > LIMIT:
        raise ValueError(
            f"values: {t.size} times at {int(inside.sum())} nodes take {size / 1024**2:.0f} MiB; expected at most "
            f"{LIMIT // 1024**2} MiB, which a browser can open. Show fewer times, one slice, or part of the domain"
        )
    # (4πt)^(d/2)·HKS is of order 1 in any unit, so float32 does not underflow. With Fick's operator, the page has √|D|
    # beside it, because the mean and distances are those of the HKS.
    fick, is_flat = result.settings.get("operator") == "fick", result.normalisation in ("raw", "flat")
    scale: Any = 1.0
    if is_flat:
        scale = result.flat_scale / (1.0 if result.normalisation == "raw" else result.to_flat)
    shown = {"values": (scale * result.values)[:, inside]}
    if noise is not None:
        shown["deviation"] = (scale * noise)[:, inside]
    if result.z is not None:
        shown["z"] = result.z[:, inside]
    near = result.near_rim
    if near is not None:
        shown["near"] = near[:, inside]
    box = bounding_box(inside, margin=0 if grey is None else AROUND)
    shown_inside = inside[inside] if surface else inside[box]
    numbers = {"inside": _packed(shown_inside, "u1")}
    if grey is not None:
        numbers["anatomy"] = _packed(grey[box], "u1")
    numbers |= {name: _packed(array, "u1") if name == "near" else _floats(array) for name, array in shown.items()}
    if fick and is_flat:
        numbers["density"] = _floats((result.to_flat / result.flat_scale)[0][inside])
    numbers |= {f"layer-{i}": _floats(array) for i, array in enumerate(layers.values())}
    names: dict[int, str] = {}
    if labels is not None:
        numbers["labels"], names = _regions(labels, label_names, inside)
    about = {
        "title": title,
        "facts": [[name, str(value)] for name, value in facts.items()],
        "software": f"hks-jax {__version__}",
        "dimension": result.dimension,
        "mesh": bool(surface),
        "shape": shown_inside.shape,
        "offset": [part.start for part in box],
        **place,
        **_in_space(stored, axes),
        "ends": None if turned is None else list(turned.ends),
        "mirrored": view == "radiological",
        "unit": result.unit if unit is None else unit,
        "lengthUnit": result.length_unit,
        "times": t.tolist(),
        "lengths": None if result.lengths is None else result.lengths.tolist(),
        "flat": result.flat_scale.ravel().tolist(),
        "fick": fick,
        "density": "density" in numbers,
        "normalisation": result.normalisation,
        "noise": noise is not None,
        "fades": result.z is not None,
        "rim": None if near is None else FREE,
        "anatomy": grey is not None,
        "start": [0] if surface else middle_node(shown_inside),
        "layers": [
            {"name": name, "kind": "scalar" if array.ndim == 1 else "direction"} for name, array in layers.items()
        ],
        "labels": list(names.items()),
        "colours": {
            name: _base64(255 * colormaps[of](np.arange(256))[:, :3] + 0.5, "u1") for name, of in COLOURS.items()
        },
    }
    page = _assemble(about, numbers | surface)
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="replace")  # the title may be a file name
    return Path(path)


def _grey(anatomy: Any, result: Result) -> np.ndarray:
    """Return the levels of grey from 1 to 255 of an image at the nodes of a grid, and 0 where it has no value."""
    require_real("anatomy", anatomy)
    image, shape = np.asarray(anatomy, np.float64), result.volume.shape
    if image.shape != shape:
        raise ValueError(f"anatomy: got shape {image.shape}; expected the grid's shape {shape}")
    known = np.isfinite(image)
    if not known.any():
        raise ValueError("anatomy: got no finite value; expected an image of the domain")
    low, high = np.quantile(image[known], [0.01, 0.99])
    levels = 1 + 254 * np.clip((np.where(known, image, low) - low) / max(high - low, np.finfo(float).tiny), 0, 1)
    return np.where(known, np.rint(levels), 0)


def _facts(result: Result) -> dict[str, Any]:
    settings, place, facts = result.settings, result.place, dict[str, Any]()
    if isinstance(place, TensorVolume):
        facts["grid"] = " × ".join(map(str, place.shape))
        facts |= {note[:5]: note[6:].partition(":")[0] for note in place.notes if note.startswith("slice ")}
    else:
        facts |= {"vertices": len(place.vertices), "triangles": len(place.triangulation.cells)}
    if metric := settings.get("metric"):
        facts["metric"] = METRICS[metric]
    if settings.get("operator") == "fick":
        facts["operator"] = FICK
    if boundary := settings.get("boundary"):
        facts["boundary"] = boundary if isinstance(boundary, str) else json.dumps(boundary)
    if result.diffusivity is not None:
        facts["D in √(Dt)"] = f"{result.diffusivity:.3g}{f' {MM2_PER_S}' * (result.unit == 's')}, {MEDIAN}"
    if result.eigenvalues.size and settings.get("method", "spectral") == "spectral":
        facts["eigenpairs"] = len(result.eigenvalues)
    return facts


def _tensor_layers(tensors: Real[ArrayLike, "*shape d d"], inside: Bool[np.ndarray, "*shape"]) -> dict[str, np.ndarray]:
    """Return mean eigenvalue, anisotropy and principal direction (n_nodes, 3), whose length is the anisotropy."""
    array, d = np.asarray(tensors, np.float64)[inside], inside.ndim
    if not np.isfinite(array).all():
        raise ValueError("tensors: got NaN or infinite values in the domain; exclude their nodes by the mask")
    values, vectors = np.linalg.eigh((array + array.swapaxes(-1, -2)) / 2)
    mean = values.mean(axis=-1)
    spread = np.sqrt(np.sum(np.square(values - mean[:, None]), axis=-1))
    # The anisotropies in 2D and 3D are 0 for multiples of the identity, and 1 if only one eigenvalue is nonzero.
    size = np.abs(values.sum(axis=-1)) / np.sqrt(2) if d == 2 else np.sqrt(np.sum(values**2, axis=-1) / 1.5)
    anisotropy = spread / np.where(size > 0, size, 1)
    largest = np.argmax(np.abs(values), axis=-1)
    direction = np.zeros((len(array), 3))
    direction[:, :d] = anisotropy[:, None] * np.take_along_axis(vectors, largest[:, None, None], axis=2)[..., 0]
    return {
        "Mean eigenvalue": mean,
        "Anisotropy (λ₁ − λ₂)/(λ₁ + λ₂)" if d == 2 else "Fractional anisotropy": anisotropy,
        "Principal direction": direction,
    }


def _regions(
    labels: Real[ArrayLike, "*shape"], names: Mapping[int, str] | None, inside: Bool[np.ndarray, "*shape"]
) -> tuple[str, dict[int, str]]:
    found = region_statistics(np.where(inside, 1.0, np.nan)[None], labels)
    if np.abs(found.labels).max() >= 2**31:
        raise ValueError(f"labels: got {found.labels[np.abs(found.labels).argmax()]}; expected numbers below 2^31")
    present = found.labels[found.nodes > 0].tolist()
    known = {label: f"label {label}" for label in present} | dict(names or {})
    return _packed(np.asarray(labels)[inside], "<i4"), {label: known[label] for label in present}


class _Axes(NamedTuple):
    """For each axis of the volume, its axis in the page, and the index in the volume of its first node and its step."""

    shown: list[int]
    first: list[int]
    step: list[int]


def _turned(
    result: Result, maps: Mapping[str, Any] | None, labels: Any, by: Orientation
) -> tuple[Result, dict[str, Any], Any, _Axes]:
    """Return a result, maps and labels with nodes and components along the axes of images, and the axes."""
    volume, shape = result.volume, result.volume.shape
    for name, values in [*(maps or {}).items(), *([] if labels is None else [("labels", labels)])]:
        if np.shape(values) != shape:
            name = name if name == "labels" else f"maps[{name!r}]"
            raise ValueError(f"{name}: got shape {np.shape(values)}; expected the grid's shape {shape}")
    shown = [by.axes.index(a) for a in range(volume.dimension)]
    flipped = [by.turned[s] for s in shown]
    axes = _Axes(shown, [n - 1 if f else 0 for n, f in zip(shape, flipped, strict=True)], [1 - 2 * f for f in flipped])
    grid = by.grid(result.grid)
    place = replace(
        volume,
        tensors=by.tensors(volume.tensors),
        mask=by.array(volume.inside),
        spacing=grid.spacing,
        origin=grid.origin,
        affine=None,
        covariance=None,
        modes=None,
    )
    at_nodes = ("deviation", "z", "density", "influence")
    arrays = {name: by.array(a) for name, a in result.arrays.items() if name in at_nodes}
    arrays |= {name: a for name, a in result.arrays.items() if name == "input_tensors"}
    result = replace(result, place=place, values=by.array(result.values), arrays=arrays)
    return result, {k: by.array(v) for k, v in (maps or {}).items()}, None if labels is None else by.array(labels), axes


def _in_space(volume: Any, axes: _Axes | None) -> dict[str, Any]:
    """Return the matrix from the volume's indices to coordinates in space, and the indices of shown nodes."""
    if not isinstance(volume, TensorVolume) or volume.affine is None or axes is None:
        return {"world": None, "axes": None}
    matrix = volume.affine[:3, [a for a in range(4) if volume.dimension == 3 or a != volume.thin_axis]]
    return {"world": matrix.tolist(), "axes": axes._asdict()}


def _assemble(about: dict[str, Any], numbers: dict[str, str]) -> str:
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
        "SCRIPT": f'(async () => {{\n"use strict";\n{scripts}}})().catch(tell);',
    }
    pieces = (own / "page.html").read_text(encoding="utf-8").split("@@")
    # Inserted texts are not scanned again, because a title may contain any of the placeholders.
    return "".join(filled[piece] if i % 2 else piece for i, piece in enumerate(pieces))


# Rounding to 24 bits leaves a relative error of 2⁻¹⁶, and differences of neighbouring nodes are small numbers. Their
# first bytes, second bytes and third bytes stand together, so that compression finds the upper bytes nearly constant.
def _floats(array: ArrayLike) -> str:
    """Return numbers in the upper 24 bits of single precision, compressed."""
    words = np.ascontiguousarray(array, "<f4").ravel().view("<u4")
    upper = (words >> 8) + ((words >> 7) & 1)
    steps = np.diff(upper, prepend=np.uint32(0)).astype("<u4")
    return _packed(steps.view("u1").reshape(-1, 4)[:, :3].T, "u1")


def _packed(array: ArrayLike, dtype: str) -> str:
    """Return numbers, compressed."""
    return _base64(np.frombuffer(zlib.compress(np.asarray(array).astype(dtype).tobytes(), 5), "u1"), "u1")


def _base64(array: ArrayLike, dtype: str) -> str:
    return base64.b64encode(np.asarray(array).astype(dtype).tobytes()).decode("ascii")
