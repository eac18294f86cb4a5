"""Read masks, which mark the voxels of the domain, and label maps, which number the regions."""

import math
import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Integer
from scipy import ndimage

from hks_jax.checks import require_count
from hks_jax.domain.components import as_mask
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io.formats import IMAGES, format_of
from hks_jax.io.tables import read_table
from hks_jax.io.volume import TensorVolume, corners, mask_in_file, require_position
from hks_jax.storage import reading


def read_mask(path: str | os.PathLike[str], affine: np.ndarray | None = None) -> Bool[np.ndarray, "*shape"]:
    """Read a mask of zeros and ones from NIfTI, MRtrix, NRRD, ``.npy``, or the array ``mask`` of an ``.npz``.

    Zeros and one larger number, such as 255, are also a mask; a warning reports the number.

    Args:
        path: the file.
        affine: the affine of the image to which the mask belongs, for a comparison with the mask's affine.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the kind of file is unknown, there are other values, such as fractions, or the mask is displaced
            from the image.
        ImportError: nibabel (for NIfTI) or pynrrd (for NRRD) is missing.

    Examples:
        >>> np.save(folder / "mask.npy", field.grid.nodes[..., 0] < 0.5)
        >>> print(hj.io.read_mask(folder / "mask.npy").sum())  # 4 × 9 nodes
        36
    """
    name = os.fspath(path)
    values, place = image_of(name, affine, IMAGES)
    require_position(name, place, affine, values.shape)
    return mask_in_file(name, values)


def mask_on(
    shape: tuple[int, ...], affine: np.ndarray | None, mask: str | os.PathLike[str] | np.ndarray
) -> Bool[np.ndarray, "*shape"]:
    """Return the mask in a file or an array; raise ValueError unless the mask has the shape of the image."""
    inside = read_mask(mask, affine) if isinstance(mask, str | os.PathLike) else as_mask("mask", mask)
    if inside.shape != shape:
        raise ValueError(f"mask: got shape {inside.shape}; expected the shape of the image, {shape}")
    return inside


def erode(mask: Bool[np.ndarray, "*shape"], iterations: int = 1) -> Bool[np.ndarray, "*shape"]:
    """Remove the boundary voxels of a mask, because they contain several tissues and their tensors are unreliable.

    Each iteration removes the voxels with a face neighbour outside the mask. Voxels beyond the image count as inside,
    so a volume that ends inside the head keeps its last slices.

    Raises:
        ValueError: the number of iterations is negative, or no voxel is left.

    Examples:
        >>> print(hj.io.erode(np.pad(np.ones((3, 3), bool), 1)).sum())
        1
    """
    require_count("iterations", iterations, 0)
    if iterations == 0:
        return mask
    eroded = ndimage.binary_erosion(as_mask("mask", mask), iterations=iterations, border_value=1)
    if not eroded.any():
        raise ValueError(f"iterations: got {iterations}, which removes all {int(np.sum(mask))} voxels. Choose fewer")
    return eroded


def read_labels(path: str | os.PathLike[str], on: TensorVolume | SimplicialMesh) -> Integer[np.ndarray, "*shape"]:
    """Read integer labels at the voxels of an image or the vertices of a mesh; 0 means unlabelled.

    The formats are NIfTI, MRtrix, NRRD and ``.npy``. If labels and image have affines, each voxel of the image must
    coincide with a voxel of the labels, and labels for a slice may cover the whole volume, or the slice in 2D. If
    labels or image have no affine, they must have the same shape. A mesh needs one label per vertex.
    """
    shape, affine = (on.shape, on.affine) if isinstance(on, TensorVolume) else ((len(on.vertices),), None)
    name = os.fspath(path)
    values, place = image_of(name, affine, tuple(suffix for suffix in IMAGES if suffix != ".npz"))
    if isinstance(on, TensorVolume) and affine is not None and place is not None and values.ndim in (2, 3):
        if values.ndim == 2:  # the file's two axes are the axes of the slice
            values = np.expand_dims(values, on.thin_axis)
            place = np.insert(np.delete(place, 2, axis=1), on.thin_axis, place[:, 2], axis=1)
        values = at_voxels(name, values, np.linalg.solve(place, affine), on)
    if values.shape != shape:
        expected = f"the shape of the image, {shape}"
        if not isinstance(on, TensorVolume):
            expected = (
                f"{shape}, one for each vertex of the result. Cleaning a mesh removes vertices and renumbers them"
            )
        raise ValueError(f"{name}: got labels of shape {values.shape}; expected {expected}")
    if not np.isfinite(values).all() or not np.array_equal(values, np.rint(values)):
        raise ValueError(f"{name}: got fractional numbers; expected integer labels. Resample by the nearest neighbour")
    return np.asarray(values).astype(np.int64)


def read_names(path: str | os.PathLike[str]) -> dict[int, str]:
    """Read the names of labels from a table with the columns ``index`` and ``name`` (BIDS), or from FreeSurfer's table.

    A line of FreeSurfer's table has a number, a name and four numbers of a colour. Further tab-separated columns are
    ignored.
    """
    with reading(path, "a text in UTF-8") as file:
        lines = [line.strip("\r\n") for line in file.read_text(encoding="utf-8-sig").splitlines()]
    if lines and {"index", "name"} <= set(lines[0].split("\t")):
        rows = [(row.get("index", ""), row.get("name", "")) for row in read_table(file)]
    else:
        pairs = [words for line in lines if len(words := line.split(None, 1)) == 2]
        rows = [(number, re.sub(r"(\s+\d+){4}$", "", name.split("\t")[0].strip())) for number, name in pairs]
    names = {int(number): name for number, name in rows if name and number.lstrip("-").isdecimal()}
    if not names:
        raise ValueError(f"{file}: no line has a number and a name; expected lines such as '17 left hippocampus'")
    return names


def names_beside(path: str | os.PathLike[str]) -> str | None:
    """Return the path of the table of names beside a label map (BIDS: ``…_dseg.tsv``), or None if there is none."""
    table = Path(os.fspath(path).removesuffix(".gz")).with_suffix(".tsv")
    return str(table) if table.is_file() else None


def image_of(name: str, affine: np.ndarray | None, suffixes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the values of an image without trailing axes of length one, and its affine or None."""
    read = format_of(name, suffixes).read_image
    assert read is not None
    values, place, unit = read(name)
    if place is not None and affine is not None and not unit:  # guess a lost unit (mm, m or µm) by the image's affine
        ratio = np.linalg.norm(affine[:3, :3]) / np.linalg.norm(place[:3, :3])
        scale = min((1.0, 1e3, 1e-3), key=lambda s: abs(math.log(ratio / s)))
        place = np.diag([scale, scale, scale, 1.0]) @ place
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    return values, place


def at_voxels(
    name: str, values: np.ndarray, to_labels: np.ndarray, volume: TensorVolume, what: str = "labels"
) -> np.ndarray:
    """Return labels or maps (…, *more) at an image's voxels; raise ValueError if they are not on the same voxels."""
    size = volume.volume_shape
    first, ends = np.rint(to_labels[:3, 3]).astype(int), corners(size)
    apart = np.abs((ends @ to_labels.T)[:, :3] - ends[:, :3] - first).max()
    box = tuple(slice(int(i), int(i) + n) for i, n in zip(first, size, strict=True))
    inside = all(i >= 0 and i + n <= m for i, n, m in zip(first, size, values.shape[:3], strict=True))
    if apart > 0.1 or not inside:  # in voxels
        if values.shape[:3] != size and np.allclose(to_labels, np.eye(4)):
            raise ValueError(
                f"{name}: got {what} of shape {values.shape[:3]} with the image's affine; expected the image's shape "
                f"{size}. One file was cropped or resampled without its affine: resample the {what} to the image"
            )
        raise ValueError(
            f"{name}: the affines put the {what} and the image on different voxels; expected the same voxels. "
            f"Resample the {what} to the image" + " by the nearest neighbour" * (what == "labels")
        )
    return values[box].reshape(*volume.shape, *values.shape[3:])
