"""Tensors of a volume at points in space, such as the vertices of a cortex."""

from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from scipy.ndimage import map_coordinates

from hks_jax.checks import require_real
from hks_jax.io.tensor_order import nearest_rotation
from hks_jax.io.volume import TensorVolume


def sample_tensors(volume: TensorVolume, points: Any) -> Float[np.ndarray, "n 3 3"]:
    """Return the tensors of a volume at points in space, with components along the axes of space.

    So ``SurfaceMesh.from_tensors(mesh.vertices, mesh.faces, sample_tensors(volume, mesh.vertices), "inverse")`` is the
    metric of a surface in a volume, with ``mesh = read_mesh(path, in_space=True)``. Components are interpolated
    linearly between the centres of the voxels inside the mask; those outside have no weight.

    Args:
        volume: of three dimensions, with an affine.
        points: (n, 3) in the coordinates that the affine maps voxels to, those of the scanner in mm.

    Raises:
        ValueError: a slice, or a volume without an affine; points around which no voxel is inside the mask.
    """
    if volume.affine is None or volume.dimension != 3:
        raise ValueError("volume: got a slice, or one without an affine; expected a volume that has a place in space")
    require_real("points", points)
    places = np.asarray(points, np.float64)
    if places.ndim != 2 or places.shape[1] != 3:
        raise ValueError(f"points: got shape {places.shape}; expected (n, 3)")
    linear, origin = volume.affine[:3, :3], volume.affine[:3, 3]
    rotation, voxels, inside = nearest_rotation(linear), np.linalg.solve(linear, (places - origin).T), volume.inside

    def at(values: Shaped[np.ndarray, "*shape"]) -> Float[np.ndarray, " n"]:
        return map_coordinates(values.astype(np.float64), voxels, order=1, mode="grid-constant")

    weights = at(inside)
    lost = ~(weights > 1e-9)
    if lost.any():
        ends = [
            f"{low.round(1).tolist()} … {high.round(1).tolist()}"
            for x in (places, np.argwhere(inside) @ linear.T + origin)
            for low, high in [(x.min(axis=0), x.max(axis=0))]
        ]
        raise ValueError(
            f"points: {int(lost.sum())} of {len(places)} have no voxel inside the mask around them (the first is point "
            f"{int(np.argmax(lost))}); they span {ends[0]}, the mask {ends[1]}, in mm. Read surfaces with "
            "in_space=True; take a larger mask, or leave these points out"
        )
    sampled = np.zeros((len(places), 3, 3))
    for i, j in zip(*np.triu_indices(3), strict=True):
        sampled[:, i, j] = sampled[:, j, i] = at(np.where(inside, volume.tensors[..., i, j], 0)) / weights
    return rotation @ sampled @ rotation.T
