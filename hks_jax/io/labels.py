"""Label maps: to which region each voxel belongs, and the regions' names."""

import os
import re

import numpy as np
from jaxtyping import Integer

from hks_jax.io import nifti
from hks_jax.npz import load_npy
from hks_jax.reading import existing, reading

NEAR = 0.1
"""By how many voxels two images may lie apart and still be on the same voxels."""


def read_labels(
    path: str | os.PathLike[str],
    shape: tuple[int, ...],
    affine: np.ndarray | None = None,
    slice_axis: int | None = None,
) -> Integer[np.ndarray, "*shape"]:
    """Read whole numbers, 0 for none, at the voxels of an image: NIfTI, or ``.npy`` of the image's shape.

    NIfTI has its place in space. Where the image has one, the two must have the same voxels; a slice takes its own from
    a label map of the volume.

    Args:
        path: the file.
        shape: that of the image.
        affine: voxel indices of the image to world coordinates, (4, 4); for a slice, those of a volume one voxel thick.
        slice_axis: for a slice, the axis that it cuts.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown kind of file, numbers with a fraction, or labels on other voxels.
        ImportError: NIfTI without nibabel.
    """
    name = os.fspath(path)
    if nifti.is_nifti(path):
        image = nifti.load(path)
        values = np.asarray(nifti.voxels(path, image))
        while values.ndim > 3 and values.shape[-1] == 1:
            values = values[..., 0]
        if affine is not None and values.ndim == 3:
            place = nifti.affine_beside(name, image, affine)
            values = _at_voxels(name, values, place, affine, shape, slice_axis)
    elif name.endswith(".npy"):
        values = load_npy(path)
    else:
        raise ValueError(f"{name}: unknown kind of file; expected labels as .nii, .nii.gz or .npy")
    if values.shape != shape:
        raise ValueError(f"{name}: got labels of shape {values.shape}; expected the shape of the image, {shape}")
    if not np.isfinite(values).all() or not np.array_equal(values, np.rint(values)):
        raise ValueError(f"{name}: got numbers that are not whole; expected labels. Resample by the nearest neighbour")
    return np.asarray(values).astype(np.int32)


def read_names(path: str | os.PathLike[str]) -> dict[int, str]:
    """Read names of labels: a table with the columns ``index`` and ``name`` (BIDS), or lines of a number and a name.

    Of a line without such a table, the name is what follows the number: up to the next tab if there is one before it,
    and without the four numbers of a colour that FreeSurfer's tables end in.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no text in UTF-8; no line begins with a number.
    """
    file = existing(path)
    with reading(file, "a text in UTF-8"):
        lines = [line.strip("\r\n") for line in file.read_text(encoding="utf-8-sig").splitlines()]
    names = {}
    header = lines[0].split("\t") if lines else []
    if {"index", "name"} <= set(header):
        at = header.index("index"), header.index("name")
        for line in lines[1:]:
            cells = line.split("\t")
            if len(cells) > max(at) and cells[at[0]].strip().lstrip("-").isdecimal():
                names[int(cells[at[0]])] = cells[at[1]].strip()
    else:
        for line in lines:
            number, *words = line.split(None, 1)[:2] or [""]
            if number.lstrip("-").isdecimal() and words:
                names[int(number)] = re.sub(r"(\s+\d+){4}$", "", words[0].split("\t")[0].strip())
    if not names:
        raise ValueError(f"{file}: no line has a number and a name; expected lines such as '17 left hippocampus'")
    return names


def names_beside(path: str | os.PathLike[str]) -> str | None:
    """Return the table of names beside a label map, in BIDS ``…_dseg.tsv`` for ``…_dseg.nii.gz``, if it is there."""
    name = os.fspath(path)
    for suffix in (*nifti.SUFFIXES[::-1], ".npy"):
        if name.lower().endswith(suffix):
            table = name[: -len(suffix)] + ".tsv"
            return table if os.path.isfile(table) else None
    return None


def _at_voxels(
    name: str, values: np.ndarray, place: np.ndarray, affine: np.ndarray, shape: tuple[int, ...], slice_axis: int | None
) -> np.ndarray:
    """Return the labels at the image's voxels; raise ValueError where the two are not on the same voxels."""
    to_labels = np.linalg.solve(place, affine)
    size = list(shape)
    if len(size) == 2:
        size.insert(2 if slice_axis is None else slice_axis, 1)
    corners = np.stack(np.meshgrid(*[(0, n - 1) for n in size], [1], indexing="ij"), -1).reshape(-1, 4)
    first = np.rint(to_labels[:3, 3]).astype(int)
    apart = np.abs((corners @ to_labels.T)[:, :3] - corners[:, :3] - first).max()
    box = tuple(slice(int(i), int(i) + n) for i, n in zip(first, size, strict=True))
    inside = all(i >= 0 and i + n <= m for i, n, m in zip(first, size, values.shape, strict=True))
    if apart > NEAR or not inside:
        if values.shape != tuple(size) and np.allclose(place, affine):
            raise ValueError(
                f"{name}: its affine is the image's, and its shape {values.shape} is not, which is {tuple(size)}; "
                "expected labels of the image's voxels. One of them was cropped or resampled without its affine"
            )
        raise ValueError(
            f"{name}: its affine places the labels on other voxels than the image's; expected the image's own. "
            "Resample them to the image, by the nearest neighbour"
        )
    return values[box].reshape(shape)
