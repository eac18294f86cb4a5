"""Interpolate tensors at points in space, such as the vertices of a cortical surface, and images at others' voxels."""

import os
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from scipy.ndimage import map_coordinates

from hks_jax.checks import require_real
from hks_jax.io.formats import IMAGES
from hks_jax.io.masks import image_of
from hks_jax.io.tensor_order import nearest_rotation
from hks_jax.io.volume import TensorVolume


class OutsideMaskError(ValueError):
    """The error for points outside the mask, with the attribute `fact`, the message without its remedy."""

    def __init__(self, fact: str, remedy: str) -> None:
        super().__init__(f"{fact}. {remedy}")
        self.fact = fact


def sample_tensors(volume: TensorVolume, points: Any) -> Float[np.ndarray, "n 3 3"]:
    """Return the tensors of a volume at points in space, with components along the axes of space.

    With ``mesh = read_mesh(path, in_space=True)``, ``SurfaceMesh.from_tensors(mesh.vertices, mesh.faces,
    sample_tensors(volume, mesh.vertices), "inverse")`` gives a surface the metric of the volume. Components are
    interpolated linearly between centres of voxels inside the mask. Voxels outside have no weight.

    Args:
        volume: a three-dimensional volume with an affine.
        points: (n, 3), in the coordinates to which the affine maps voxel indices, which are scanner coordinates in mm.

    Raises:
        ValueError: the volume is a slice or has no affine, or no voxel around a point is inside the mask.

    Examples:
        >>> tensors = np.eye(3) * np.indices((3, 3, 3))[0][..., None, None]
        >>> volume = hj.io.TensorVolume(tensors, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), affine=np.eye(4))
        >>> hj.io.sample_tensors(volume, [[0.5, 1.0, 1.0]])[0].diagonal()
        array([0.5, 0.5, 0.5])
    """
    if volume.affine is None or volume.dimension != 3:
        raise ValueError("volume: got a slice, or a volume without an affine; expected a volume with an affine")
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
            f"{x.min(axis=0).round(1).tolist()} … {x.max(axis=0).round(1).tolist()}"
            for x in (places, np.argwhere(inside) @ linear.T + origin)
        ]
        raise OutsideMaskError(
            f"points: got {int(lost.sum())} of {len(places)} points without a voxel inside the mask around them (the "
            f"first is point {int(np.argmax(lost))}). The points span {ends[0]} and the mask spans {ends[1]}, in mm",
            "Read surfaces with in_space=True, use a larger mask, or leave these points out",
        )
    sampled = np.zeros((len(places), 3, 3))
    for i, j in zip(*np.triu_indices(3), strict=True):
        sampled[:, i, j] = sampled[:, j, i] = at(np.where(inside, volume.tensors[..., i, j], 0)) / weights
    return rotation @ sampled @ rotation.T


def sample_image(path: str | os.PathLike[str], on: TensorVolume) -> Float[np.ndarray, "*shape"]:
    """Read an image, such as a T1-weighted one, and interpolate it linearly at the voxels of a volume or slice.

    Both have affines, which say where the voxels are in space. The result is NaN at voxels outside the image.

    Args:
        path: an image (nx, ny, nz) in NIfTI, MRtrix or NRRD.
        on: the volume or slice.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the kind of file is unknown, the image has other axes, an affine is missing, or the image contains
            no voxel of the volume.
        ImportError: nibabel (for NIfTI) or pynrrd (for NRRD) is missing.

    Examples:
        >>> import nibabel
        >>> image = nibabel.Nifti1Image(np.indices((3, 3, 3))[0] * 1.0, np.diag([2.0, 2, 2, 1]))
        >>> nibabel.save(image, folder / "T1.nii")
        >>> volume = hj.io.TensorVolume(np.tile(np.eye(3), (4, 2, 2, 1, 1)), (1.0,) * 3, (0.0,) * 3, affine=np.eye(4))
        >>> hj.io.sample_image(folder / "T1.nii", volume)[:, 0, 0]  # every voxel of the image is two of the volume
        array([0. , 0.5, 1. , 1.5])
    """
    name = os.fspath(path)
    values, place = image_of(name, on.affine, tuple(suffix for suffix in IMAGES if not suffix.startswith(".np")))
    if values.ndim != 3:
        raise ValueError(f"{name}: got shape {values.shape}; expected an image of three axes")
    if place is None or on.affine is None:
        raise ValueError(f"{name}: got {'an image' if place is None else 'a volume'} without an affine; expected both")
    to_image = np.linalg.solve(place, on.affine)
    indices = np.indices(on.volume_shape).reshape(3, -1)
    voxels = np.round(to_image[:3, :3] @ indices + to_image[:3, 3:], 6)  # rounding errors leave the image's last voxels
    sampled = map_coordinates(values.astype(np.float64), voxels, order=1, mode="constant", cval=np.nan)
    if not np.isfinite(sampled).any():
        raise ValueError(
            f"{name}: the image contains no voxel of {on.source or 'the volume'}; expected images of one position in "
            f"space. The affines are {place.round(4).tolist()} and {on.affine.round(4).tolist()}"
        )
    return sampled.reshape(on.shape)
