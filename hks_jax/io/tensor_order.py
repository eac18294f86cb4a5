"""The orders in which programs store the components of a symmetric tensor, and the axes of the components.

The same six numbers represent different tensors in programs that differ in the order or the axes of the components. In
each order, the components xx, xy and yy of a 2×2 tensor have the same sequence as in a 3×3 tensor. NRRD's kinds of
symmetric matrix have the order xx xy xz yy yz zz, along the axes of the measurement frame.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import MANY
from hks_jax.naming import argument

Order = Literal["nifti", "fsl", "mrtrix", "vtk"]
Frame = Literal["voxel", "fsl", "world", "measurement"]

ORDERS: dict[str, tuple[str, ...]] = {
    "nifti": ("xx", "xy", "yy", "xz", "yz", "zz"),  # NIfTI's symmetric matrix, DIPY, ANTs
    "fsl": ("xx", "xy", "xz", "yy", "yz", "zz"),
    "mrtrix": ("xx", "yy", "zz", "xy", "xz", "yz"),
    "vtk": ("xx", "yy", "zz", "xy", "yz", "xz"),  # VTK, ParaView
}
"""For each named order, the sequence of a tensor's components."""

FRAMES: dict[str, Frame] = {"nifti": "voxel", "fsl": "fsl", "mrtrix": "world", "vtk": "world"}
"""For each order of components, the default axes of the components."""


def unpack(components: Float[np.ndarray, "*shape n"], order: str) -> Float[np.ndarray, "*shape d d"]:
    """Return symmetric 3×3 matrices from six components, or 2×2 matrices from three, in the given order."""
    d = 3 if components.shape[-1] == 6 else 2
    tensors = np.empty((*components.shape[:-1], d, d), components.dtype)
    for c, (i, j) in enumerate(indices(order, d)):
        tensors[..., i, j] = tensors[..., j, i] = components[..., c]
    return tensors


def pack(tensors: Float[np.ndarray, "*shape d d"], order: str) -> Float[np.ndarray, "*shape n"]:
    """Return the six components of symmetric 3×3 matrices, or the three of 2×2 matrices, in the given order."""
    return np.stack([tensors[..., i, j] for i, j in indices(order, tensors.shape[-1])], axis=-1)


def to_voxel_axes(
    tensors: Float[np.ndarray, "*shape d d"], frame: str, affine: Float[np.ndarray, "m m"]
) -> Float[np.ndarray, "*shape d d"]:
    """Transform the components of tensors from the axes of `frame` to the voxel axes.

    The matrix `affine` (or its linear part) maps voxel indices to world coordinates. ``"voxel"`` changes nothing.
    ``"fsl"`` reverses the first axis if det(affine) > 0. ``"world"`` transforms a tensor D to RᵀDR, where R is the
    rotation or reflection nearest to the affine.
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
        f'frame: got {frame!r}; expected "voxel", "fsl" or "world". Only NRRD files may have the frame "measurement"'
    )


def fsl_signs(linear: Float[np.ndarray, "d d"]) -> Float[np.ndarray, " d"]:
    """Return the signs that transform FSL's axes to voxel axes: −1 for the first if the determinant is positive."""
    return np.array([-1.0 if np.linalg.det(linear) > 0 else 1.0, 1.0, 1.0])[: len(linear)]


def nearest_rotation(linear: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """Normalise the columns of a matrix, and return the nearest rotation or reflection."""
    u, _, vt = np.linalg.svd(linear / np.linalg.norm(linear, axis=0))
    return u @ vt


def shear_notes(directions: Float[np.ndarray, "d d"]) -> list[str]:
    """Return a note if the voxel axes (the columns) are not orthogonal, because grids have orthogonal axes."""
    axes = directions / np.linalg.norm(directions, axis=0)
    cosine = np.abs(axes.T @ axes - np.eye(len(axes))).max()
    if cosine <= 1e-3:
        return []
    angle = math.degrees(math.acos(min(cosine, 1.0)))
    return [
        f"the voxel axes are not orthogonal (two meet at {angle:.3g}°), and the shear is ignored: the computation "
        "takes them as orthogonal. Resample the tensors to orthogonal axes"
    ]


def indices(order: str, d: int) -> list[tuple[int, int]]:
    """Return the row and the column of each component of a symmetric d × d matrix in the given order."""
    components = ORDERS["fsl" if order == "nrrd" else order]  # NRRD has FSL's order of components
    pairs = [("xyz".index(pair[0]), "xyz".index(pair[1])) for pair in components]
    return [pair for pair in pairs if max(pair) < d]


_SAMPLE = 20_000
"""The number of tensors in a first sample; all tensors are checked only if many tensors in the sample are invalid."""


class InvalidByOrder(NamedTuple):
    """The number of a file's tensors that would not be positive definite in each order of components."""

    order: str  # the order of components in which the tensors were read
    counts: dict[str, int]  # the number of invalid tensors for each order of components
    of: int  # the number of nonzero tensors

    @property
    def fewer(self) -> list[str]:
        """The orders of components with less than half as many invalid tensors as `order`, best first."""
        own = self.counts[self.order]
        return sorted((name for name in self.counts if 2 * self.counts[name] < own), key=self.counts.__getitem__)

    @property
    def question(self) -> str:
        """A question whether the order of components is wrong; empty if no order has clearly fewer invalid tensors."""
        if not self.fewer:
            return ""
        others = ", ".join(f'{count} in "{name}"' for name, count in self.counts.items() if name != self.order)
        return (
            f"Wrong order? Of {self.of} nonzero tensors, {self.counts[self.order]} are not positive definite in order "
            f'"{self.order}", but {others}: try {argument("order", self.fewer[0])}'
        )


def invalid_by_order(components: Float[np.ndarray, "*shape n"], order: str) -> InvalidByOrder | None:
    """Count the tensors that are not positive definite, by order of components; None if they are few in `order`.

    The counts do not depend on the axes of the components, and hardly distinguish ``"mrtrix"`` from ``"vtk"``, two
    orders that differ by an exchange of two off-diagonal components.
    """
    rows = components.reshape(-1, components.shape[-1])
    rows = rows[np.any(rows != 0, axis=-1)]

    def invalid(some: np.ndarray, order: str) -> Bool[np.ndarray, " n"]:
        tensors = unpack(some, order)
        return ~spd.is_spd(tensors)

    if not len(rows) or np.mean(invalid(rows[:: max(1, len(rows) // _SAMPLE)], order)) <= MANY:
        return None
    counts = {name: int(invalid(rows, name).sum()) for name in ORDERS}
    return InvalidByOrder(order, counts, len(rows))


class Matrices(NamedTuple):
    """The tensors of a file, before their transformation to the voxel axes."""

    tensors: Float[np.ndarray, "*shape d d"]
    order: str  # the order of components; "matrix" for whole matrices
    invalid: InvalidByOrder | None
    of: str = ""  # words about the source of the components, for the text of `note`

    def note(self, frame: str) -> str:
        """Return a note about the order and the frame in which the tensors were read."""
        what = "whole matrices" if self.order == "matrix" else f'components in order "{self.order}"'
        return f"{what}{self.of}, transformed from the {frame} axes to the voxel axes"


def matrices(name: str, components: Float[np.ndarray, "*shape n"], order: str | None, declared: str = "") -> Matrices:
    """Return tensors from all d² entries of matrices, or from the d(d+1)/2 components of symmetric matrices.

    Raises:
        ValueError: the order is unknown; an order is given for whole matrices; or no order is given or declared.
    """
    n = components.shape[-1]
    if n in (4, 9):
        if order is not None:
            raise ValueError(f"order: got {order!r}, but {name} holds whole matrices. Leave this argument out")
        return Matrices(components.reshape(*components.shape[:-1], math.isqrt(n), -1), "matrix", None)
    used = order or declared
    choices = ", ".join(f'"{known}" ({" ".join(parts)})' for known, parts in ORDERS.items())
    if not used:
        raise ValueError(
            f"{name}: the file has {n} components per tensor and does not declare their order, which depends on the "
            f"program. Pass {argument('order')}, one of {choices}"
        )
    if used not in ORDERS and used != declared:
        raise ValueError(f"order: got {used!r}; expected {choices}")
    return Matrices(unpack(components, used), used, invalid_by_order(components, used) if used in ORDERS else None)
