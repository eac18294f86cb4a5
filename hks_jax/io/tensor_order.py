"""How programs lay out the six components of a symmetric 3×3 tensor, and along which axes.

Two files with the same numbers mean different tensors when their programs differ in either:

=========  =================  =======================================================================
order      components         axes
=========  =================  =======================================================================
"nifti"    xx xy yy xz yz zz  NIfTI's symmetric matrix, DIPY, ANTs; here along the voxel axes
"fsl"      xx xy xz yy yz zz  FSL: voxel axes, the first reversed where the affine keeps orientation
"mrtrix"   xx yy zz xy xz yz  MRtrix: scanner axes
=========  =================  =======================================================================
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

Order = Literal["nifti", "fsl", "mrtrix"]
Frame = Literal["voxel", "fsl", "world"]

ORDERS: dict[str, tuple[str, ...]] = {
    "nifti": ("xx", "xy", "yy", "xz", "yz", "zz"),
    "fsl": ("xx", "xy", "xz", "yy", "yz", "zz"),
    "mrtrix": ("xx", "yy", "zz", "xy", "xz", "yz"),
}
"""The components of each order, as they follow each other in a file."""

FRAMES: dict[str, Frame] = {"nifti": "voxel", "fsl": "fsl", "mrtrix": "world"}
"""The axes along which the programs of each order give their components."""


def unpack(components: Float[np.ndarray, "*shape 6"], order: str) -> Float[np.ndarray, "*shape 3 3"]:
    """Return the matrices of six components in the given order."""
    tensors = np.empty((*components.shape[:-1], 3, 3), components.dtype)
    for c, (i, j) in enumerate(_indices(order)):
        tensors[..., i, j] = tensors[..., j, i] = components[..., c]
    return tensors


def pack(tensors: Float[np.ndarray, "*shape 3 3"], order: str) -> Float[np.ndarray, "*shape 6"]:
    """Return the six components of symmetric matrices in the given order."""
    return np.stack([tensors[..., i, j] for i, j in _indices(order)], axis=-1)


def to_voxel_axes(
    tensors: Float[np.ndarray, "*shape 3 3"], frame: str, affine: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "*shape 3 3"]:
    """Return the tensors with components along the voxel axes, from components along those of `frame`.

    Args:
        tensors: (*shape, 3, 3).
        frame: ``"voxel"``: unchanged; ``"fsl"``: the first axis is reversed where det(affine) > 0; ``"world"``: along
            the axes that the affine maps to, D_voxel = RᵀDR with R the rotation (or reflection) nearest to the affine.
        affine: voxel indices to world coordinates.
    """
    if frame == "voxel":
        return tensors
    linear = affine[:3, :3]
    if frame == "fsl":
        sign = np.array([-1.0 if np.linalg.det(linear) > 0 else 1.0, 1.0, 1.0])
        return tensors * np.outer(sign, sign).astype(tensors.dtype)
    if frame == "world":
        u, _, vt = np.linalg.svd(linear / np.linalg.norm(linear, axis=0))
        rotation = (u @ vt).astype(tensors.dtype)
        return rotation.T @ tensors @ rotation
    raise ValueError(f'frame: got {frame!r}; expected "voxel", "fsl" or "world"')


def _indices(order: str) -> list[tuple[int, int]]:
    if order not in ORDERS:
        raise ValueError(f"order: got {order!r}; expected {choices()}")
    return [("xyz".index(pair[0]), "xyz".index(pair[1])) for pair in ORDERS[order]]


def choices() -> str:
    """Name the orders, for messages."""
    return ", ".join(f'"{name}" ({" ".join(components)})' for name, components in ORDERS.items())
