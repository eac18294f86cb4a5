"""The figure of modes: a few of them, the energy of maps by wavelength, and a map through a few numbers of modes."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from hks_jax.domain.simplicial_mesh import SimplicialMesh, SurfaceMesh, TetMesh
from hks_jax.io import TensorVolume
from hks_jax.plot.figure import SMALL, finished, new_figure, number_text, panel_size
from hks_jax.plot.images import Colours, scalar_image
from hks_jax.plot.orientation import View
from hks_jax.plot.signature import cropped, middle_slice, placed
from hks_jax.plot.surfaces import surface

_COLUMNS = 4
"""The number of modes and of maps in a row."""
_EXTREME = 0.01
"""The share of values below the first colour, and of values above the last."""
_DECADES = 1e-6
"""The least energy that is drawn, relative to the greatest."""


class _Canvas(NamedTuple):
    """A place on which values are drawn."""

    size: tuple[float, float]  # of a panel, in inches
    projection: str | None
    visible: Callable[[np.ndarray], np.ndarray]  # the values that are seen
    draw: Callable[..., None]  # (axes, values, colours, whether with a colour bar)


def modes_panels(
    place: TensorVolume | SimplicialMesh,
    modes: Float[np.ndarray, "k *shape"],
    wavelength: Float[np.ndarray, " k"],
    path: Path | None = None,
    *,
    energy: Float[np.ndarray, " k"] | None = None,
    explained: Float[np.ndarray, " k"] | None = None,
    counts: Sequence[int] = (),
    maps: Mapping[str, Float[np.ndarray, "*shape"]] | None = None,
    unit: str = "",
    view: View = "neurological",
) -> Figure:
    """Return a figure of a few modes on a slice, in the middle of a volume, on a surface, or on a solid's boundary.

    Args:
        place: the volume, slice or mesh.
        modes: (k, *shape) the eigenfunctions.
        wavelength: (k,) as in `hks_jax.ModeEnergies`.
        path: the file in which to save the figure, if given.
        energy: (k,) the energy of maps in each mode, which is drawn by wavelength.
        explained: (k,) the share of the maps' variance that the modes up to each explain, given with `energy`.
        counts: numbers of modes that are marked in the curve of variance.
        maps: up to four maps by title, with the colours of the last: a map, after its projections onto a few modes.
        unit: the unit of the wavelength.
        view: the orientation of slices, as for `signature_panels`.
    """
    canvas = _mesh_canvas(place) if isinstance(place, SimplicialMesh) else _slice_canvas(place, modes[0], view)
    width, height = canvas.size
    rows = [3.0] * (energy is not None) + [height + 0.35] * (1 + bool(maps))
    figure = new_figure(_COLUMNS * (width + 0.35) + 0.8, sum(rows) + 0.2)
    parts = list(np.atleast_1d(np.asarray(figure.subfigures(len(rows), 1, height_ratios=rows), dtype=object)))
    if energy is not None and explained is not None:
        _draw_curves(parts.pop(0), energy, explained, wavelength, counts, unit)
    waves = np.flatnonzero(np.isfinite(wavelength))
    if waves.size:
        chosen = waves[np.unique(np.rint(np.geomspace(1, waves.size, _COLUMNS)).astype(int)) - 1]
        titles = [f"mode {i + 1}: {wavelength[i]:.3g} {unit}".rstrip() for i in chosen]
        _draw_row(
            parts[0], canvas, [modes[i] for i in chosen], titles, [_around_zero(canvas, modes[i]) for i in chosen]
        )
    if maps:
        seen = canvas.visible(np.asarray([*maps.values()][-1]))
        low, high = np.quantile(seen[np.isfinite(seen)], [_EXTREME, 1 - _EXTREME]).tolist()
        colours = Colours(low, high if high > low else low + 1)
        _draw_row(parts[1], canvas, [*maps.values()], [*maps], [colours] * len(maps), bar=True)
    return finished(figure, "", path)


def _draw_row(
    part: Any,
    canvas: _Canvas,
    values: Sequence[np.ndarray],
    titles: Sequence[str],
    colours: Sequence[Colours],
    bar: bool = False,
) -> None:
    panels = part.subplots(1, _COLUMNS, squeeze=False, subplot_kw={"projection": canvas.projection})[0]
    for ax in panels[len(values) :]:
        ax.remove()
    for i, (ax, one, title, limits) in enumerate(zip(panels, values, titles, colours, strict=False)):
        canvas.draw(ax, one, limits, bar and i == len(values) - 1)
        ax.set_title(title, fontsize="medium")
        ax.tick_params(labelleft=i == 0)


def _draw_curves(
    part: Any, energy: np.ndarray, explained: np.ndarray, wavelength: np.ndarray, counts: Sequence[int], unit: str
) -> None:
    energies, shares = part.subplots(1, 2)
    waves = np.isfinite(wavelength)
    drawn = waves & (energy > _DECADES * np.max(energy, initial=0.0, where=waves))
    energies.plot(wavelength[drawn], energy[drawn], "o", color="#21918c", markersize=3)
    wavelengths = f"wavelength in {unit}" if unit else "wavelength"
    energies.set(xscale="log", yscale="log", ylabel="energy in the mode", xlabel=wavelengths)
    energies.xaxis.set_major_formatter(lambda x, _: number_text(x))
    if drawn.any() and wavelength[drawn].max() < 100 * wavelength[drawn].min():
        energies.xaxis.set_minor_formatter(lambda x, _: number_text(x) if f"{x:.0e}"[0] in "25" else "")
    numbers = 1 + np.arange(len(explained))
    shares.plot(numbers, explained, color="#21918c", linewidth=1.2)
    marked = np.asarray(counts) - 1
    shares.plot(numbers[marked], explained[marked], "o", color="black", markersize=4)
    least = float(np.nanmin(explained, initial=0.0))
    shares.set(xscale="log", xlabel="number of modes", ylabel="variance explained", ylim=(max(least, -0.1), 1.02))
    shares.xaxis.set_major_formatter(lambda x, _: number_text(x))
    shares.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    for ax in (energies, shares):
        ax.tick_params(labelsize=SMALL, which="both")
        ax.grid(visible=True, linewidth=0.4, alpha=0.5)


def _around_zero(canvas: _Canvas, mode: np.ndarray) -> Colours:
    seen = canvas.visible(mode)
    limit = float(np.quantile(np.abs(seen[np.isfinite(seen)]), 1 - _EXTREME)) or 1.0
    return Colours(-limit, limit, "RdBu_r")


def _slice_canvas(volume: TensorVolume, mode: np.ndarray, view: View) -> _Canvas:
    inside = np.isfinite(mode)
    volume, cut = middle_slice(volume, inside)
    grid, box = cropped(volume, cut(inside))
    orientation = placed(volume, box, view)

    def draw(ax: Any, values: np.ndarray, colours: Colours, bar: bool) -> None:
        style: dict[str, Any] = {"vmin": colours.low, "vmax": colours.high, "cmap": colours.cmap, "colorbar": bar}
        scalar_image(ax, cut(values)[box], grid, orientation=orientation, **style)

    size = panel_size(grid if orientation is None else orientation.grid(grid), 2.6, 5.0)
    return _Canvas(size, None, lambda values: cut(values)[box], draw)


def _mesh_canvas(mesh: SimplicialMesh) -> _Canvas:
    assert isinstance(mesh, SurfaceMesh | TetMesh)
    triangulation = mesh.triangulation
    nodes = triangulation.used if isinstance(mesh, SurfaceMesh) else triangulation.boundary_vertices

    def draw(ax: Any, values: np.ndarray, colours: Colours, bar: bool) -> None:
        drawn = surface(ax, mesh, values, vmin=colours.low, vmax=colours.high, cmap=colours.cmap)
        if bar:
            ax.figure.colorbar(drawn, ax=ax, shrink=0.6)

    return _Canvas((2.8, 2.6), "3d", lambda values: values[nodes], draw)
