"""Triangulated surfaces in space, and the boundaries of solids, coloured by a scalar."""

from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Real
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from hks_jax.domain.surface_mesh import SurfaceMesh
from hks_jax.domain.tet_mesh import TetMesh


def surface(
    ax: Axes3D,
    mesh: SurfaceMesh | TetMesh,
    values: Real[ArrayLike, " V"],
    *,
    cmap: str = "viridis",
    vmin: float | None = None,
    vmax: float | None = None,
    relief: float = 0.35,
    light: tuple[float, float, float] = (0.3, -0.5, 0.8),
    zoom: float = 1.25,
    **kwargs: Any,
) -> ScalarMappable:
    """Draw a surface, or a solid's boundary, coloured by its vertices' values; return what a colour bar needs.

    It is drawn without axes. The colours of a solid are those of what is seen of it.

    Args:
        ax: three-dimensional axes (``fig.add_subplot(projection="3d")``).
        mesh: the surface, or a solid mesh; tens of thousands of triangles draw in a few seconds.
        values: (V,), one per vertex; a triangle takes the mean of its three.
        cmap: colour map.
        vmin: value of the first colour; None: the least.
        vmax: value of the last colour; None: the greatest.
        relief: how much darker a triangle is that faces away from the light: 0 … 1, 0 for colours alone.
        light: the direction that light comes from.
        zoom: the size of the surface in its axes.
        **kwargs: passed to `Poly3DCollection`.

    Raises:
        ValueError: values that are not of shape (V,).
    """
    scalars = np.asarray(values, dtype=np.float64)
    if scalars.shape != (len(mesh.vertices),):
        raise ValueError(f"values: got shape {scalars.shape}; expected ({len(mesh.vertices)},), one per vertex")
    if isinstance(mesh, TetMesh):
        mesh, numbers = mesh.boundary()
        scalars = scalars[numbers]
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    corners = vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    direction = np.asarray(light) / np.linalg.norm(light)
    # |n·l|: the orientation of a mesh's triangles does not matter.
    brightness = 1 - relief * (1 - np.abs(normals @ direction))

    mappable = ScalarMappable(Normalize(vmin, vmax), colormaps[cmap])
    mappable.set_array(scalars)
    mappable.autoscale_None()
    colours = mappable.to_rgba(scalars[mesh.faces].mean(axis=1))
    colours[:, :3] *= brightness[:, None]
    # Edges in the faces' colours close the hairlines that antialiasing leaves between triangles.
    ax.add_collection3d(
        Poly3DCollection(corners, facecolors=colours, edgecolors=colours, **{"linewidths": 0.2, **kwargs})
    )
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    thin = np.maximum(1e-3 * (high - low).max() - (high - low), 0) / 2  # a flat surface has a box, too
    low, high = low - thin, high + thin
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(tuple(high - low), zoom=0.8 * zoom if thin.any() else zoom)  # of the former its corners show
    ax.set_axis_off()
    return mappable
