"""Masks and label maps: which voxels belong to the domain, and to which region each of them does."""

import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Integer
from scipy import ndimage

from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io import nifti
from hks_jax.io.formats import IMAGES, format_of
from hks_jax.io.tables import read_table
from hks_jax.io.volume import TensorVolume, as_mask, corners
from hks_jax.storage import existing, reading


def read_mask(path: str | os.PathLike[str], affine: np.ndarray | None = None) -> Bool[np.ndarray, "*shape"]:
    """Read a mask of zeros and ones: NIfTI, MRtrix, NRRD, ``.npy``, or the array ``mask`` of an ``.npz``.

    Args:
        path: the file.
        affine: where the image lies that the mask is for; a mask that lies elsewhere is refused.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown kind of file, values other than 0 and 1, or a mask that lies elsewhere.
        ImportError: NIfTI without nibabel, NRRD without pynrrd.
    """
    name = os.fspath(path)
    values, place = _image(name, affine, IMAGES)
    if affine is not None and place is not None:
        shift = np.linalg.norm(corners(values.shape) @ (place - affine).T, axis=1).max()
        if shift > 0.5 * np.linalg.norm(affine[:3, :3], axis=0).min():
            raise ValueError(
                f"{name}: the mask's affine places it up to {shift:.3g} away from the tensors'; expected the same "
                "place. Resample the mask to the tensors' voxels"
            )
    return as_mask(name, values)


def erode(mask: Bool[np.ndarray, "*shape"], iterations: int = 1) -> Bool[np.ndarray, "*shape"]:
    """Peel voxels off the rim of a mask, where voxels mix tissues and tensors are least reliable.

    A voxel goes when a face neighbour is outside, once per iteration. The image's own border is no rim: a volume
    that ends inside the head keeps its last slices.

    Raises:
        ValueError: a negative number of iterations, or nothing left.
    """
    if iterations < 0:
        raise ValueError(f"iterations: got {iterations}; expected 0 or more")
    if iterations == 0:
        return mask
    eroded = ndimage.binary_erosion(mask, iterations=iterations, border_value=1)
    if not eroded.any():
        raise ValueError(f"iterations: eroding by {iterations} voxels leaves nothing of {int(mask.sum())} voxels")
    return eroded


NEAR = 0.1
"""By how many voxels two images may lie apart and still be on the same voxels."""


def read_labels(path: str | os.PathLike[str], on: TensorVolume | SimplicialMesh) -> Integer[np.ndarray, "*shape"]:
    """Read whole numbers, 0 for none, at the voxels of an image, or a mesh's vertices: NIfTI, or ``.npy`` of the shape.

    NIfTI has its place in space. Where the image has one, the two must have the same voxels; a slice takes its own from
    a label map of the volume.
    """
    shape, affine = (on.shape, on.affine) if isinstance(on, TensorVolume) else ((len(on.vertices),), None)
    name = os.fspath(path)
    values, place = _image(name, affine, (*nifti.SUFFIXES, ".npy"))
    if isinstance(on, TensorVolume) and affine is not None and place is not None and values.ndim == 3:
        values = _at_voxels(name, values, np.linalg.solve(place, affine), on)
    if values.shape != shape:
        raise ValueError(f"{name}: got labels of shape {values.shape}; expected the shape of the image, {shape}")
    if not np.isfinite(values).all() or not np.array_equal(values, np.rint(values)):
        raise ValueError(f"{name}: got numbers that are not whole; expected labels. Resample by the nearest neighbour")
    return np.asarray(values).astype(np.int32)


def read_names(path: str | os.PathLike[str]) -> dict[int, str]:
    """Read names of labels: a table with the columns ``index`` and ``name`` (BIDS), or lines of a number and a name.

    Of a line, the name goes from the number to the next tab, if there is one, and is without the four numbers of a
    colour that FreeSurfer's tables end in.
    """
    file = existing(path)
    with reading(file, "a text in UTF-8"):
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
    """Return the table of names beside a label map, in BIDS ``…_dseg.tsv`` for ``…_dseg.nii.gz``, if it is there."""
    table = Path(os.fspath(path).removesuffix(".gz")).with_suffix(".tsv")
    return str(table) if table.is_file() else None


def _image(name: str, affine: np.ndarray | None, suffixes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the voxel values, without a fourth axis of one entry, and the affine where the file has one."""
    read = format_of(name, suffixes).read_image
    assert read is not None
    values, place = read(name, affine)
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    return values, place


def _at_voxels(name: str, values: np.ndarray, to_labels: np.ndarray, volume: TensorVolume) -> np.ndarray:
    """Return the labels at an image's voxels; raise ValueError where the two are not on the same voxels."""
    size = list(volume.shape)
    if len(size) == 2:
        size.insert(volume.thin_axis, 1)
    first, ends = np.rint(to_labels[:3, 3]).astype(int), corners(tuple(size))
    apart = np.abs((ends @ to_labels.T)[:, :3] - ends[:, :3] - first).max()
    box = tuple(slice(int(i), int(i) + n) for i, n in zip(first, size, strict=True))
    inside = all(i >= 0 and i + n <= m for i, n, m in zip(first, size, values.shape, strict=True))
    if apart > NEAR or not inside:
        if values.shape != tuple(size) and np.allclose(to_labels, np.eye(4)):
            raise ValueError(
                f"{name}: its affine is the image's, and its shape {values.shape} is not, which is {tuple(size)}; "
                "expected labels of the image's voxels. One of them was cropped or resampled without its affine"
            )
        raise ValueError(
            f"{name}: its affine places the labels on other voxels than the image's; expected the image's own. "
            "Resample them to the image, by the nearest neighbour"
        )
    return values[box].reshape(volume.shape)
