"""How programs lay out the components of a symmetric tensor, and along which axes.

Two files with the same numbers mean different tensors when their programs differ in either:

=========  =================  =======================================================================
order      components         axes
=========  =================  =======================================================================
"nifti"    xx xy yy xz yz zz  NIfTI's symmetric matrix, DIPY, ANTs; here along the voxel axes
"fsl"      xx xy xz yy yz zz  FSL: voxel axes, the first reversed where the affine keeps orientation
"mrtrix"   xx yy zz xy xz yz  MRtrix: scanner axes
"vtk"      xx yy zz xy yz xz  VTK, ParaView: the axes of space
=========  =================  =======================================================================

The three components of a 2×2 tensor follow each other as they do among the six. NRRD's kinds of
matrix have xx xy xz yy yz zz, along the measurement frame.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import MANY

Order = Literal["nifti", "fsl", "mrtrix", "vtk"]
Frame = Literal["voxel", "fsl", "world", "measurement"]

ORDERS: dict[str, tuple[str, ...]] = {
    "nifti": ("xx", "xy", "yy", "xz", "yz", "zz"),
    "fsl": ("xx", "xy", "xz", "yy", "yz", "zz"),
    "mrtrix": ("xx", "yy", "zz", "xy", "xz", "yz"),
    "vtk": ("xx", "yy", "zz", "xy", "yz", "xz"),
}
"""The components of each order, as they follow each other in a file."""

FRAMES: dict[str, Frame] = {"nifti": "voxel", "fsl": "fsl", "mrtrix": "world", "vtk": "world"}
"""The axes along which the programs of each order give their components."""


def unpack(components: Float[np.ndarray, "*shape n"], order: str) -> Float[np.ndarray, "*shape d d"]:
    """Return the matrices of components in the given order: six of 3×3 matrices, or three of 2×2."""
    d = 3 if components.shape[-1] == 6 else 2
    tensors = np.empty((*components.shape[:-1], d, d), components.dtype)
    for c, (i, j) in enumerate(_indices(order, d)):
        tensors[..., i, j] = tensors[..., j, i] = components[..., c]
    return tensors


def pack(tensors: Float[np.ndarray, "*shape d d"], order: str) -> Float[np.ndarray, "*shape n"]:
    """Return the components of symmetric matrices in the given order: six, or three of 2×2 matrices."""
    return np.stack([tensors[..., i, j] for i, j in _indices(order, tensors.shape[-1])], axis=-1)


def to_voxel_axes(
    tensors: Float[np.ndarray, "*shape d d"], frame: str, affine: Float[np.ndarray, "m m"]
) -> Float[np.ndarray, "*shape d d"]:
    """Return the tensors with components along the voxel axes, from components along those of `frame`.

    The affine, or its linear part alone, maps voxel indices to world coordinates. ``"voxel"``: unchanged; ``"fsl"``:
    the first axis is reversed where det(affine) > 0; ``"world"``: along the axes that the affine maps to,
    D_voxel = RᵀDR with R the rotation (or reflection) nearest to the affine.
    """
    if frame == "voxel":
        return tensors
    d = tensors.shape[-1]
    linear = affine[:d, :d]
    if frame == "fsl":
        sign = fsl_signs(linear)
        return tensors * np.outer(sign, sign).astype(tensors.dtype)
    if frame == "world":
        rotation = nearest_rotation(linear).astype(tensors.dtype)
        return rotation.T @ tensors @ rotation
    raise ValueError(
        f'frame: got {frame!r}; expected "voxel", "fsl" or "world" ("measurement" is for NRRD files that have one)'
    )


def fsl_signs(linear: Float[np.ndarray, "d d"]) -> Float[np.ndarray, " d"]:
    """Return the signs that take FSL's axes to the voxels': −1 for the first where the affine keeps orientation."""
    return np.array([-1.0 if np.linalg.det(linear) > 0 else 1.0, 1.0, 1.0])[: len(linear)]


def nearest_rotation(linear: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """Return the rotation or reflection nearest to the directions of the columns."""
    u, _, vt = np.linalg.svd(linear / np.linalg.norm(linear, axis=0))
    return u @ vt


def _indices(order: str, d: int) -> list[tuple[int, int]]:
    components = ORDERS["fsl" if order == "nrrd" else order]  # the same components, along other axes
    pairs = [("xyz".index(pair[0]), "xyz".index(pair[1])) for pair in components]
    return [pair for pair in pairs if max(pair) < d]


_SAMPLE = 20_000
"""Tensors that are looked at before all are."""


class InvalidByOrder(NamedTuple):
    """How many tensors of a file are not positive definite under each order of components."""

    order: str  # in which they were read
    counts: dict[str, int]  # how many are invalid, by order
    of: int  # how many there are, those that are exactly zero aside

    @property
    def fewer(self) -> list[str]:
        """The orders under which less than half as many are invalid, the fewest first."""
        own = self.counts[self.order]
        return sorted((name for name in self.counts if 2 * self.counts[name] < own), key=self.counts.__getitem__)

    @property
    def question(self) -> str:
        """Ask whether the order is wrong, with the counts; the empty text where no other has fewer invalid tensors."""
        if not self.fewer:
            return ""
        others = ", ".join(f'{count} in "{name}"' for name, count in self.counts.items() if name != self.order)
        return (
            f"Wrong order? Of {self.of} tensors that are not zero, {self.counts[self.order]} are not positive definite "
            f'as "{self.order}", {others}: try order "{self.fewer[0]}"'
        )


def invalid_by_order(components: Float[np.ndarray, "*shape n"], order: str) -> InvalidByOrder | None:
    """Count the tensors that are not positive definite under each order; None where few are under their own.

    The axes of components do not matter for this. It hardly tells ``"mrtrix"`` from ``"vtk"``, which exchange two
    components beside the diagonal.
    """
    rows = components.reshape(-1, components.shape[-1])
    rows = rows[np.any(rows != 0, axis=-1)]
    sample = rows[:: max(1, len(rows) // _SAMPLE)]
    if not len(rows) or np.mean(spd.is_spd(unpack(sample, order))) >= 1 - MANY:
        return None
    counts = {name: int(np.sum(~spd.is_spd(unpack(rows, name)))) for name in ORDERS}
    return InvalidByOrder(order, counts, len(rows))


class Matrices(NamedTuple):
    """The tensors of a file, along the file's axes."""

    tensors: Float[np.ndarray, "*shape d d"]
    order: str  # of their components; "matrix" if they were whole matrices
    invalid: InvalidByOrder | None
    of: str = ""  # what notes say of the components

    def note(self, frame: str) -> str:
        """Say how they were read."""
        what = "whole matrices" if self.order == "matrix" else f'components in order "{self.order}"'
        return f"{what}{self.of}, given along the {frame} axes, taken to the voxel axes"


def matrices(name: str, components: Float[np.ndarray, "*shape n"], order: str | None, declared: str = "") -> Matrices:
    """Return the tensors that components make: all d² entries of matrices, or the d(d+1)/2 of symmetric ones.

    Raises:
        ValueError: an unknown order; one for whole matrices; neither an order nor a `declared` one for symmetric ones.
    """
    n = components.shape[-1]
    if n in (4, 9):
        if order is not None:
            raise ValueError(f"order: {name} holds whole matrices; leave this out")
        return Matrices(components.reshape(*components.shape[:-1], math.isqrt(n), -1), "matrix", None)
    used = order or declared
    choices = ", ".join(f'"{known}" ({" ".join(parts)})' for known, parts in ORDERS.items())
    if not used:
        raise ValueError(
            f"{name}: it has {n} components of each tensor and does not declare their order, and programs differ. "
            f"Pass order (--order), one of {choices}"
        )
    if used not in ORDERS and used != declared:
        raise ValueError(f"order: got {used!r}; expected {choices}")
    return Matrices(unpack(components, used), used, invalid_by_order(components, used) if used in ORDERS else None)
