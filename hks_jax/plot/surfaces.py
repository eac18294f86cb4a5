"""Surfaces in space: meshes coloured by a scalar, and isosurfaces of a volume.

Matplotlib draws meshes, because it needs no display and no OpenGL. PyVista, where it is installed, draws isosurfaces.
"""

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Real
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from hks_jax.checks import require_real
from hks_jax.domain.components import active_elements, as_mask
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SurfaceMesh, TetMesh
from hks_jax.optional import optional
from hks_jax.plot.figure import SMALL, arrows, finished, inches, lines_in, new_figure
from hks_jax.plot.images import Colours, colours_of, masked
from hks_jax.plot.volumes import require_volume

STRIPES = 30
"""The largest number of dark stripes of hatched vertices along a side of a surface."""
SIDES = ((30, -60), (-30, 120))
"""The elevation and the azimuth, in degrees, of the two opposite directions from which figures show a surface."""
LIGHT = (0.3, -0.5, 0.8)
"""The direction towards the light."""


def surface(
    ax: Axes3D,
    mesh: SurfaceMesh | TetMesh,
    values: Real[ArrayLike, " V"],
    *,
    cmap: str = "viridis",
    vmin: float | None = None,
    vmax: float | None = None,
    relief: float = 0.35,
    zoom: float = 1.25,
    hatched: Bool[ArrayLike, " V"] | None = None,
    **kwargs: Any,
) -> ScalarMappable:
    """Draw a surface, or the boundary of a solid, coloured by vertex values; return the mappable for a colour bar.

    The axes are hidden. The colours of a solid depend only on the values at its boundary.

    Args:
        ax: three-dimensional axes, from ``fig.add_subplot(projection="3d")``.
        mesh: a surface or solid mesh. Drawing tens of thousands of triangles takes a few seconds.
        values: (V,) a value for each vertex. A triangle has the colour of the mean of its three values.
        cmap: colour map.
        vmin: the value of the first colour, by default the least value.
        vmax: the value of the last colour, by default the greatest value.
        relief: the strength of the shading between 0 and 1, where 0 means no shading.
        zoom: the size of the surface in its axes.
        hatched: (V,) the vertices around which dark stripes are drawn, such as those near the boundary.
        **kwargs: arguments of `Poly3DCollection`.

    Raises:
        ValueError: if the values do not have the shape (V,).

    Examples:
        >>> sphere = hj.examples.sphere_mesh(2)
        >>> ax = hj.plot.new_figure(3, 3).add_subplot(projection="3d")
        >>> hj.plot.surface(ax, sphere, sphere.vertices[:, 2]).get_clim()
        (-1.0, 1.0)
    """
    if not hasattr(ax, "add_collection3d"):
        raise TypeError('ax: got axes in two dimensions; expected fig.add_subplot(projection="3d")')
    if not isinstance(mesh, SurfaceMesh | TetMesh):
        raise TypeError(f"mesh: got {type(mesh).__name__}; expected hks_jax.SurfaceMesh or hks_jax.TetMesh")
    require_real("values", values)
    scalars = np.asarray(values, dtype=np.float64)
    if scalars.shape != (len(mesh.vertices),):
        raise ValueError(f"values: got shape {scalars.shape}; expected ({len(mesh.vertices)},), one per vertex")
    lines = np.zeros(scalars.shape, bool) if hatched is None else as_mask("hatched", hatched)
    if lines.shape != scalars.shape:
        raise ValueError(f"hatched: got shape {lines.shape}; expected {scalars.shape}, as for the values")
    if isinstance(mesh, TetMesh):
        mesh, numbers = mesh.boundary()
        scalars, lines = scalars[numbers], lines[numbers]
    vertices, used = np.asarray(mesh.vertices, dtype=np.float64), mesh.triangulation.used
    corners = vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # The absolute value of the cosine between the normal and the light makes the orientation of triangles irrelevant.
    brightness = 1 - relief * (1 - np.abs(normals @ LIGHT) / np.linalg.norm(LIGHT))

    mappable = ScalarMappable(Normalize(vmin, vmax), colormaps[cmap])
    mappable.set_array(scalars[used])
    mappable.autoscale_None()
    colours = mappable.to_rgba(scalars[mesh.faces].mean(axis=1))
    colours[:, :3] *= brightness[:, None]
    # The stripes lie on the surface: across them runs a diagonal of space, along which two triangles make a period.
    edge = np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1))
    period = max(np.ptp(vertices[used], axis=0).max() / STRIPES, 4 * edge)
    stripe = (corners.mean(axis=1) @ np.ones(3) / period) % 1 < 0.4
    colours[stripe & (lines[mesh.faces].mean(axis=1) > 0.5), :3] *= 0.45
    # Edges with the faces' colours hide the gaps that antialiasing causes between triangles.
    ax.add_collection3d(
        Poly3DCollection(corners, facecolors=colours, edgecolors=colours, **{"linewidths": 0.2, **kwargs})
    )
    low, high = vertices[used].min(axis=0), vertices[used].max(axis=0)
    thin = np.maximum(1e-3 * (high - low).max() - (high - low), 0) / 2  # gives a flat surface a thin bounding box
    low, high = low - thin, high + thin
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(tuple(high - low), zoom=0.8 * zoom if thin.any() else zoom)  # shows a flat surface's corners
    ax.set_axis_off()
    return mappable


def surface_panels(
    mesh: SurfaceMesh | TetMesh,
    values: Sequence[Real[ArrayLike, " V"]],
    titles: Sequence[str],
    colours: Sequence[Colours],
    *,
    hatched: Bool[np.ndarray, "n V"] | None = None,
    label: str = "",
    suptitle: str = "",
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Return a figure of a surface, or of the boundary of a solid, from two sides for each array of values.

    Each array has colours of its own, and a colour bar with the label for both sides.
    """
    columns = min(len(values), 4)
    rows = math.ceil(len(values) / columns)
    figure = new_figure(3.1 * columns, 4.6 * rows + 0.2 + 0.18 * lines_in(suptitle))
    blocks = np.atleast_1d(np.asarray(figure.subfigures(rows, columns, squeeze=False), dtype=object)).ravel()
    for i, (block, title, one, (low, high, cmap)) in enumerate(zip(blocks, titles, values, colours, strict=False)):
        sides: list[Any] = [block.add_subplot(2, 1, 1 + side, projection="3d") for side in range(2)]
        lines = None if hatched is None else hatched[i]
        for ax, direction in zip(sides, SIDES, strict=True):
            ax.view_init(*direction)
            shown = surface(ax, mesh, one, vmin=low, vmax=high, cmap=cmap, hatched=lines)
        bar = block.colorbar(shown, ax=sides, shrink=0.6, extend=arrows(shown, shown.get_array()))
        bar.ax.tick_params(labelsize=SMALL)
        bar.set_label(label, fontsize=SMALL)
        sides[0].set_title(title, fontsize="medium")
    return finished(figure, suptitle, path)


def isosurfaces(
    ax: Axes,
    values: Real[ArrayLike, "nx ny nz"],
    grid: Grid,
    *,
    levels: int | Sequence[float] = 4,
    cmap: str | Colormap = "viridis",
    vmin: float | None = None,
    vmax: float | None = None,
    quantiles: tuple[float, float] = (0.0, 1.0),
    opacity: float = 0.4,
    view: tuple[float, float, float] = (1.0, -1.6, 0.9),
    zoom: float = 1.0,
    outline: bool = True,
    resolution: float = 200.0,
) -> ScalarMappable:
    """Render isosurfaces in parallel projection on axes, and return the mappable for a colour bar.

    The isosurfaces are drawn as an image with the current size of the axes. Rendering needs PyVista (``pip install
    "hks-jax[pyvista]"``) and, without a display, EGL or OSMesa.

    Args:
        ax: two-dimensional axes, whose frame and ticks are removed.
        values: (*shape,), with NaN at nodes without a value. Surfaces end at elements with a NaN.
        grid: the 3D grid of the values.
        levels: the values of the surfaces, or the number of evenly spaced values between the first and the last colour.
        cmap: colour map.
        vmin: the value of the first colour, by default from `quantiles`.
        vmax: the value of the last colour, by default from `quantiles`.
        quantiles: the quantiles of the values that get the first and the last colour, unless vmin and vmax are given.
        opacity: the opacity of each surface, above 0 and at most 1.
        view: the direction from the volume to the viewer; z is up.
        zoom: the size of the volume in its axes.
        outline: whether to draw the grid's box, the boundary of a mask, and the directions of the axes.
        resolution: pixels per inch.

    Raises:
        ImportError: if PyVista is not installed.
        ValueError: if the grid is not 3D, if the values have another shape or none is finite, if there is no level, if
            the opacity is not in (0, 1], or if the view is zero or along z.

    Examples:
        >>> grid = hj.Grid.from_bounds(-1, 1, (9, 9, 9))
        >>> ax, squared = hj.plot.new_figure(3, 3).add_subplot(), (grid.nodes**2).sum(axis=-1)
        >>> hj.plot.isosurfaces(ax, squared, grid, levels=[0.5]).get_clim()  # a ball
        (0.0, 3.0)
    """
    require_volume(grid)
    array = masked("values", values, grid)
    ((low, high, _),) = colours_of([array.compressed()], quantiles, vmin=vmin, vmax=vmax)
    heights = np.linspace(low, high, levels + 2)[1:-1] if isinstance(levels, int) else np.asarray(levels, np.float64)
    if heights.ndim != 1 or not heights.size or not np.isfinite(heights).all():
        raise ValueError(f"levels: got {levels}; expected a positive number of levels, or finite values")
    if not 0 < opacity <= 1:
        raise ValueError(f"opacity: got {opacity}; expected a number in (0, 1]")
    if not np.isfinite(view).all() or np.hypot(view[0], view[1]) == 0:
        raise ValueError(f"view: got {view}; expected a nonzero direction that is not along z")
    pyvista = optional("pyvista")
    with _quiet_about_displays():
        size = tuple(max(round(resolution * side), 64) for side in inches(ax))
        plotter = pyvista.Plotter(off_screen=True, window_size=size)
        try:
            cells = pyvista.ImageData(dimensions=grid.shape, spacing=grid.spacing, origin=grid.origin)
            cells.point_data["values"] = array.filled(0.0).ravel(order="F")  # VTK stores the first axis contiguously
            complete = active_elements(~np.ma.getmaskarray(array), (False,) * 3)
            domain = cells.extract_cells(np.flatnonzero(complete.ravel(order="F")))
            surfaces = domain.contour(heights, scalars="values")
            if surfaces.n_points:
                style = {"ambient": 0.3, "specular": 0.2, "smooth_shading": True, "show_scalar_bar": False}
                plotter.add_mesh(surfaces, scalars="values", cmap=cmap, clim=(low, high), opacity=opacity, **style)
            if outline:
                plotter.add_mesh(domain.outline(), color="#808080", line_width=2)
                if array.mask.any():
                    plotter.add_mesh(_rim(pyvista, domain), color="#999999", opacity=0.12, smooth_shading=True)
                plotter.add_axes(color="black", line_width=3)
            plotter.enable_parallel_projection()
            plotter.view_vector(view, viewup=(0, 0, 1))
            plotter.reset_camera(bounds=domain.bounds)
            plotter.camera.zoom(1.1 * zoom)
            plotter.enable_depth_peeling(8)
            plotter.enable_anti_aliasing("ssaa")
            picture = plotter.screenshot(return_img=True)
        finally:
            plotter.close()
    ax.imshow(picture)
    ax.set_axis_off()
    mappable = ScalarMappable(Normalize(low, high), cmap)
    mappable.set_array(array.compressed())
    return mappable


def _rim(pyvista: ModuleType, domain: Any) -> Any:
    from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter

    surface = vtkGeometryFilter()
    surface.SetInputData(domain)
    surface.Update()
    return pyvista.wrap(surface.GetOutput())


@contextmanager
def _quiet_about_displays() -> Iterator[None]:
    """Suppress VTK's message that there is no display, because EGL or OSMesa need none."""
    from vtkmodules.vtkCommonCore import vtkLogger

    cutoff = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    try:
        yield
    finally:
        vtkLogger.SetStderrVerbosity(cutoff)
