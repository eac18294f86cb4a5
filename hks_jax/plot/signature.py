"""The figure of a result: its signature over t, cropped to the domain and oriented in space."""

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Real
from matplotlib.figure import Figure
from scipy import ndimage

from hks_jax import Grid, SurfaceMesh, TetMesh
from hks_jax.domain.components import bounding_box
from hks_jax.io import TensorVolume
from hks_jax.io.result import Result, require_result
from hks_jax.io.units import MM2_PER_S
from hks_jax.plot.figure import RIM_NOTE, number_text
from hks_jax.plot.images import DIVERGING, FADED, FADED_NOTE, Colours, colours_of
from hks_jax.plot.orientation import Orientation, View
from hks_jax.plot.panels import hks_panels, panel_titles
from hks_jax.plot.surfaces import surface_panels
from hks_jax.plot.volumes import volume_panels

ENOUGH = 0.1
"""The share of free nodes above which the range of colours is that of the nodes free of the boundary."""
SPAN = (0.002, 0.998)
"""The quantiles of the values away from the boundary that the first and last colours represent."""
POWERS = {2: (r"4\pi t", "t^{-1}"), 3: (r"(4\pi t)^{3/2}", "t^{-3/2}")}
"""The factor of the normalisation "flat" and the unit of the signature, by dimension; t is a squared length."""
METRICS = {"tensor": "D", "inverse": "D⁻¹", "adjugate": "|D|D⁻¹"}
FICK = "Fick's, div(D∇u)"
LEAST_RANGE = 0.01
"""The colour range is at least 1 % of the values, so that the contrast of nearly constant values is low."""
RIM = 5
"""If the boundary's influence is not known, values within 5 nodes of the boundary do not affect the colour range."""


def signature_panels(
    result: Result,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str = "",
    view: View = "neurological",
    through: tuple[int, int, int] | None = None,
    show_rim: bool = False,
) -> Figure:
    """Return a figure of a signature on a slice, on three slices of a volume, or on two sides of a mesh, for each time.

    Each time has separate colours. The mean diffusivity, if it is known, is drawn in grey after the last time.

    The colour range contains nearly all values away from the boundary, and colour bars have arrows if other values
    exceed the range; the title has the share of these values. With "flat" normalisation the colours diverge from 1, the
    value for a flat metric, unless nine tenths of the values exceed 1.5. Values that noise explains fade to grey, and
    titles contain the share of the nodes that are not grey. Nodes at which the boundary contributes over a tenth of the
    signature are hatched, if `result.arrays` has the influence. Titles contain diffusion lengths √(Dt), if known.

    Args:
        result: the signature to draw.
        path: the file in which to save the figure, if given.
        title: the title, by default the normalisation and the metric.
        view: ``"neurological"`` (left is on the left) or ``"radiological"`` (left is on the right), for data in space.
        through: the voxel through which slices run, or the nearest voxel in the domain; by default a central voxel.
        show_rim: whether nodes near the boundary are not hatched.

    Raises:
        TypeError: if the result is no `hks_jax.io.Result`.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), field.grid.spacing, field.grid.origin)
        >>> result = hj.io.Result(volume, np.array(hj.hks(pairs, [0.2, 0.5])), np.array([0.2, 0.5]))
        >>> len(hj.plot.signature_panels(result).axes)
        2
    """
    require_result(result)
    near = None if show_rim else result.near_rim
    if not isinstance(result.place, TensorVolume):
        return _on_mesh(result, near, title, path)
    volume, inside = result.volume, np.isfinite(result.values[0])
    grid, box = cropped(volume, inside)
    nodes = inside if result.near_rim is not None else away_from_rim(inside)
    colours = free_colours(result.values, result.near_rim, nodes, result.centre)
    words = [title or caption(result), *legend(result, near), *range_notes(result, result.values, colours)]
    style: dict[str, Any] = {
        "titles": titles_of(result),
        "suptitle": "\n".join(words),
        "hatched": None if near is None else near[:, *box],
        "limits": [each[:2] for each in colours],
        "cmap": colours[0].cmap,
        "label": quantity(result),
        "length_unit": result.length_unit,
        "beside": {name: scalar[box] for name, scalar in anatomy(result).items()},
        "orientation": placed(volume, box, view),
        "z": None if result.z is None else result.z[:, *box],
        "path": path,
    }
    if volume.dimension == 2:
        return hks_panels(result.values[:, *box], result.times, grid, **style)
    if through is not None:
        style["node"] = [voxel - part.start for voxel, part in zip(through, box, strict=True)]
    return volume_panels(result.values[:, *box], result.times, grid, **style)


def _on_mesh(
    result: Result, near: Bool[np.ndarray, "n_times V"] | None, title: str, path: str | os.PathLike[str] | None
) -> Figure:
    mesh = result.place
    assert isinstance(mesh, SurfaceMesh | TetMesh)
    cells, words = mesh.triangulation, legend(result, near)
    visible = cells.boundary_vertices if isinstance(mesh, TetMesh) else cells.used
    if near is not None and near[:, visible].all():  # as on the boundary of a solid, where hatching would show nothing
        near, words = None, [f"{RIM_NOTE} at all vertices"]
    colours = free_colours(result.values, result.near_rim, visible, result.centre)
    words = [title or caption(result), *words, *range_notes(result, result.values[:, visible], colours)]
    style: dict[str, Any] = {"hatched": near, "label": quantity(result), "suptitle": "\n".join(words), "path": path}
    return surface_panels(mesh, list(result.values), titles_of(result), colours, **style)


def anatomy(result: Result) -> dict[str, Real[np.ndarray, "*shape"]]:
    """Return the mean diffusivity (*shape,), NaN outside the domain, by its title; nothing if no diffusion is known.

    In a slice, it is the mean of the in-plane block of each tensor.
    """
    if result.diffusivity is None or result.tensors is None:
        return {}
    values = np.trace(result.tensors, axis1=-2, axis2=-1) / result.dimension
    values = np.where(np.isfinite(result.values[0]), values, np.nan)
    name = _in_plane(result) + "mean diffusivity"
    if result.unit != "s":
        return {name: values}
    return {f"{name}\nin $10^{{-3}}$ {MM2_PER_S}": 1e3 * values}


def _in_plane(result: Result) -> str:
    return "in-plane " * (result.dimension == 2)


def quantity(result: Result) -> str:
    """Return the name of a signature's values, for colour bars."""
    factor, _ = POWERS[result.dimension]
    root = r"\sqrt{|D|}\," if result.settings.get("operator") == "fick" else ""
    names = {"heat-trace": "HKS / heat trace", "volume": "HKS · volume", "flat": f"${factor}{root}$·HKS"}
    base, _, power = result.unit_of_values.partition("^-")
    power = {"1": "", "1.5": "$^{3/2}$"}.get(power, f"$^{power}$")
    return names.get(result.normalisation, f"HKS in 1/{base}{power}" if base else "HKS")


def range_notes(result: Result, values: Real[np.ndarray, "n_times *shape"], colours: Sequence[Colours]) -> list[str]:
    """Return lines of a legend: the share of values beyond the colours, and why colours do not diverge from 1."""
    known = [each[np.isfinite(each)] for each in values]
    beyond = [np.mean((v < low) | (v > high)) for v, (low, high, _) in zip(known, colours, strict=True)]
    words = []
    if (most := 100 * max(beyond)) >= 0.1:
        words.append(f"arrows: up to {most:.2g} % of the values are beyond the colours")
    if result.centre is not None and colours[0].cmap != DIVERGING:
        words.append("colours do not diverge from 1, because nine tenths of the values are above 1.5")
    return words


def caption(result: Result) -> str:
    """Return the title of a signature's figure: the normalisation, the unit, and the metric."""
    (factor, unit), fick = POWERS[result.dimension], result.settings.get("operator") == "fick"
    if fick:  # whose eigenfunctions are normalised in the volume of space
        unit = rf"\mathrm{{length}}^{{-{result.dimension}}}"
    names = {
        "raw": f"HKS in units of ${unit}$",
        "heat-trace": f"HKS / heat trace in units of ${unit}$",
        "volume": "HKS · volume",
        "flat": f"${factor}$·HKS, which is 1 for flat space",
    }
    metric = METRICS.get(result.settings.get("metric") or "")
    if fick:
        names["flat"] = rf"${factor}\sqrt{{|D|}}\,$HKS, which is 1 for constant D"
        return f"{names[result.normalisation]}, Fick's operator"
    return names[result.normalisation] + f", metric {metric}" * (metric is not None)


def legend(result: Result, near: Bool[np.ndarray, "n_times *shape"] | None) -> list[str]:
    """Return the lines of a legend: the diffusivity D of √(Dt), and the meaning of grey and of the hatching."""
    words = []
    if result.diffusivity is not None:
        unit = f" {MM2_PER_S}" * (result.unit == "s")
        words.append(f"D = {number_text(result.diffusivity)}{unit}, the median {_in_plane(result)}mean diffusivity")
    if near is not None and near.any():
        words.append(f"hatched: {RIM_NOTE}")
    return words if result.z is None else [*words, FADED_NOTE]


def titles_of(result: Result, unit: str | None = None) -> Sequence[str]:
    """Return a title for each time, with √(Dt) and the share of nodes above the noise if they are known.

    On a surface with the metric of space, √t is a length in the mesh's unit, and takes the place of √(Dt).

    The text `unit` replaces the unit of t.
    """
    early = [" (too few eigenpairs)" * bool(t < result.smallest_time) for t in result.times]
    names = panel_titles(result.times, None, unit or result.unit)
    titles = [title + why for title, why in zip(names, early, strict=True)]
    if result.lengths is not None:
        lengths = (f"{length:.3g} {result.length_unit}".rstrip() for length in result.lengths)
        titles = [f"{title}\n$\\sqrt{{Dt}}$ = {length}" for title, length in zip(titles, lengths, strict=True)]
    elif not isinstance(result.place, TensorVolume) and not result.settings.get("metric") and not result.in_time:
        titles = [f"{title}\n$\\sqrt{{t}}$ = {t**0.5:.3g}" for title, t in zip(titles, result.times, strict=True)]
    if result.z is not None:
        shares = (np.mean(np.abs(z[np.isfinite(z)]) > FADED) for z in result.z)
        titles = [f"{title}\n{100 * share:.0f} % without grey" for title, share in zip(titles, shares, strict=True)]
    return titles


def free_colours(
    values: Real[np.ndarray, "n_times *shape"],
    near: Bool[np.ndarray, "n_times *shape"] | None,
    nodes: Bool[np.ndarray, "*shape"],
    centre: float | None,
    shared: bool = False,
) -> list[Colours]:
    """Return the colours for each time, which span nearly all values at those of the nodes free of the boundary.

    If less than a tenth of the nodes are free, all nodes count. If `shared`, one range spans the values of all times.
    """
    free = [nodes if near is None else nodes & ~near[i] for i in range(len(values))]
    chosen = [one if one.sum() > ENOUGH * nodes.sum() else nodes for one in free]
    images = [each[one] for each, one in zip(values, chosen, strict=True)]
    rules = (SPAN, LEAST_RANGE, centre)
    return colours_of([np.concatenate(images)], *rules) * len(images) if shared else colours_of(images, *rules)


def middle_slice(
    volume: TensorVolume, inside: Bool[np.ndarray, "*shape"]
) -> tuple[TensorVolume, Callable[[np.ndarray], np.ndarray]]:
    """Return the slice of a volume across z in the middle of the domain, and the function that cuts (…, *shape) arrays.

    A slice stays.
    """
    if volume.dimension == 2:
        return volume, lambda values: values
    planes = np.flatnonzero(inside.any(axis=(0, 1)))
    index = int(planes[(len(planes) - 1) // 2])  # of the domain, even if it has a gap
    return volume.slice("z", index), lambda values: values[..., index]


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


def away_from_rim(inside: Bool[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Mark nodes at least `RIM` nodes from the boundary, or at a smaller distance if less than a third were marked."""
    deep = inside
    for _ in range(RIM):
        smaller = ndimage.binary_erosion(deep)
        if smaller.sum() <= inside.sum() / 3:
            break
        deep = smaller
    return deep
