"""A field of diffusion tensors as it came from a file: NumPy arrays, where they lie in space, where they came from."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from hks_jax import __version__
from hks_jax.arrays import describe_array
from hks_jax.checks import require_real
from hks_jax.domain.grid import Grid
from hks_jax.io.tensor_order import InvalidByOrder, Matrices, to_voxel_axes

AXES = "xyz"


@dataclass(frozen=True)
class Format:
    """A file format of images on grids. A new one is a module with a `Format`, which `hks_jax.io.formats` lists."""

    names: tuple[str, ...]  # how the names of its files end
    read_tensors: Callable[..., "TensorVolume"]  # of a name, the order and the frame asked for, and the `options`
    options: tuple[str, ...] = ()  # what of the arguments of `hks_jax.io.read_tensors` it takes
    # Masks, labels: of a path, and the affine of the image beside which it belongs, to values and their own affine.
    read_image: Callable[..., tuple[np.ndarray, np.ndarray | None]] | None = None
    written: tuple[str, ...] = ()  # which of the names it writes
    # Results: of a path, an array, the volume, the array's name, more arrays, and the provenance.
    write: Callable[[Path, np.ndarray, "TensorVolume", str, dict[str, Any], str], None] | None = None
    write_tensors: Callable[[Path, "TensorVolume", Mapping[str, Any] | None], None] | None = None
    image: str = ""  # the suffix of results beside tensors in this format; empty where an npz is enough


@dataclass(frozen=True, eq=False)
class TensorVolume:
    """Tensors on a regular grid of voxels, along the voxel axes.

    Attributes:
        tensors: (*shape, d, d); values outside the mask mean nothing.
        spacing: distance between voxels per axis.
        origin: coordinates of voxel (0, …, 0) on the grid (the affine places it in space).
        mask: bool (*shape), or None for all voxels.
        affine: (4, 4) voxel indices to world coordinates, or None; for a slice, those of a volume one voxel thick.
        slice_axis: for a slice, the axis of the volume that it cuts; None for a volume.
        order: the order of components in the file, ``"matrix"`` if they were whole matrices.
        frame: the axes along which the file's components were.
        notes: the reader's decisions, in sentences.
        source: the file.
        digest: the SHA-256 of the file; empty where the data are in more than one.
        repair: how tensors that are not positive definite were changed, for reports; empty if none were.
        invalid_by_order: how many tensors of the file are not positive definite under each order of components, where
            many are under the one in which they were read; else None.
        length_unit: ``"mm"``, which the lengths of a file that has a unit are converted to; empty where it has none.
        unit: ``"mm²/s"`` where the tensors' unit is known, because it was told, or they were fitted; else empty.
        covariance: (*shape, m, m) of the components xx xy yy (xz yz zz) along the voxel axes, in the squared unit of
            the tensors, where it is known (`fit_dwi`); else None.

    Raises:
        ValueError: shapes that do not agree; spacings that are not positive, numbers that are not finite.
    """

    tensors: Float[np.ndarray, "*shape d d"]
    spacing: tuple[float, ...]
    origin: tuple[float, ...]
    mask: Bool[np.ndarray, "*shape"] | None = None
    affine: Float[np.ndarray, "4 4"] | None = None
    slice_axis: int | None = None
    order: str = "matrix"
    frame: str = "voxel"
    notes: tuple[str, ...] = ()
    source: str = ""
    digest: str = ""
    repair: Mapping[str, Any] = field(default_factory=dict)
    invalid_by_order: InvalidByOrder | None = None
    length_unit: str = ""
    unit: str = ""
    covariance: Float[np.ndarray, "*shape m m"] | None = None

    def __post_init__(self) -> None:
        where = f"{self.source}: " if self.source else ""
        tensors, mask, covariance = self.tensors, self.mask, self.covariance
        require_real(f"{where}tensors", tensors)
        shape, d = tensors.shape[:-2], tensors.shape[-1]
        if tensors.ndim not in (4, 5) or tensors.shape[-2:] != (len(shape),) * 2:
            raise ValueError(
                f"{where}tensors: got shape {tensors.shape}; expected (nx, ny, 2, 2) or (nx, ny, nz, 3, 3)"
            )
        for name, value in (("spacing", self.spacing), ("origin", self.origin)):
            if len(value) != d or not np.isfinite(value).all():
                raise ValueError(f"{where}{name}: got {value}; expected {d} finite numbers, one per axis")
        if min(self.spacing) <= 0:
            raise ValueError(f"{where}spacing: got {self.spacing}; expected positive numbers")
        if mask is not None and (mask.shape != shape or mask.dtype != bool):
            raise ValueError(f"{where}mask: got shape {mask.shape}, {mask.dtype}; expected booleans of shape {shape}")
        if self.affine is not None and (self.affine.shape != (4, 4) or not np.isfinite(self.affine).all()):
            raise ValueError(f"{where}affine: got shape {self.affine.shape}; expected (4, 4), finite")
        if covariance is not None and covariance.shape != (*shape, *[d * (d + 1) // 2] * 2):
            raise ValueError(f"{where}covariance: got shape {covariance.shape}; expected (*shape, m, m), m = d(d+1)/2")

    def __repr__(self) -> str:
        """Return one line without the arrays."""
        inside = "" if self.mask is None else f", mask={int(self.mask.sum())} of {self.mask.size} voxels"
        cut = "" if self.slice_axis is None else f", slice_axis={self.slice_axis}"
        return (
            f"TensorVolume({describe_array(self.tensors)}, spacing={self.spacing}{inside}{cut}, order={self.order!r}, "
            f"frame={self.frame!r}, source={self.source!r}, {len(self.notes)} notes)"
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of voxels per axis."""
        return self.tensors.shape[:-2]

    @property
    def dimension(self) -> int:
        """The number of axes d: 3 for a volume, 2 for a slice."""
        return len(self.shape)

    @property
    def inside(self) -> Bool[np.ndarray, "*shape"]:
        """The mask, or True everywhere."""
        return np.ones(self.shape, bool) if self.mask is None else self.mask

    def grid(self, components: Literal["raise", "largest", "all"] = "raise") -> Grid:
        """Return the grid of the voxel centres, with the mask. See `hks_jax.Grid` for `components`."""
        return Grid(self.shape, self.spacing, self.origin, self.mask, components)

    def with_mask(self, mask: Bool[np.ndarray, "*shape"] | None) -> "TensorVolume":
        """Return the same volume with another mask."""
        return replace(self, mask=mask)

    def slice(self, axis: int | str, index: int) -> "TensorVolume":
        """Return the slice at one index of an axis (0, 1, 2 or ``"x"``, ``"y"``, ``"z"``): a two-dimensional volume.

        The slice carries the in-plane 2×2 block of each tensor. For diffusion tensors this means diffusion confined to
        the slice, with the in-plane diffusivities that were measured, and the metric is chosen from that block:
        g = (block of D)⁻¹. The other reading, the block of D⁻¹, is the metric that the slice inherits as a surface in
        the volume; the two differ wherever a principal axis is oblique to the slice.

        Raises:
            ValueError: a volume that is a slice already; an axis or index out of range; a mask empty in this slice.
        """
        if self.dimension != 3:
            raise ValueError("slice: this is a slice already (two axes); only volumes can be sliced")
        a = AXES.find(axis) if isinstance(axis, str) and len(axis) == 1 else axis
        if a not in (0, 1, 2):
            raise ValueError(f'axis: got {axis!r}; expected 0, 1, 2 or "x", "y", "z"')
        if not 0 <= index < self.shape[a]:
            raise ValueError(f"index: got {AXES[a]} = {index}; expected 0 … {self.shape[a] - 1}")
        mask = None
        if self.mask is not None:
            mask = np.take(self.mask, index, axis=a)
            if not mask.any():
                filled = np.flatnonzero(self.mask.any(axis=tuple(b for b in range(3) if b != a)))
                where = f"{AXES[a]} = {filled[0]} … {filled[-1]}" if filled.size else "no slice at all"
                raise ValueError(f"mask: empty in slice {AXES[a]} = {index}; it has voxels inside at {where}")
        keep = [b for b in range(3) if b != a]
        affine = covariance = None
        if self.covariance is not None:
            rows, columns = np.tril_indices(3)
            within = np.flatnonzero((rows != a) & (columns != a))
            covariance = np.take(self.covariance, index, axis=a)[..., within, :][..., within]
        if self.affine is not None:
            affine = self.affine.copy()
            affine[:3, 3] += index * affine[:3, a]
        return replace(
            self,
            tensors=np.take(self.tensors, index, axis=a)[..., keep, :][..., keep],
            spacing=tuple(self.spacing[b] for b in keep),
            origin=tuple(self.origin[b] for b in keep),
            mask=mask,
            affine=affine,
            slice_axis=a,
            covariance=covariance,
            notes=(*self.notes, f"slice {AXES[a]} = {index}: the in-plane block of each tensor"),
        )

    @property
    def volume_affine(self) -> Float[np.ndarray, "4 4"]:
        """The affine, or where there is none the one that spacing and origin make."""
        if self.affine is not None:
            return self.affine
        affine = np.eye(4)
        axes = [b for b in range(3) if b != self.thin_axis] if self.dimension == 2 else [0, 1, 2]
        affine[axes, axes] = self.spacing
        affine[axes, 3] = self.origin
        return affine

    @property
    def thin_axis(self) -> int:
        """For a slice, the axis along which it is one voxel thick as a volume: z unless it was cut otherwise."""
        return 2 if self.slice_axis is None else self.slice_axis


def placed(name: str, found: Matrices, frame: str, affine: Float[np.ndarray, "4 4"], **known: Any) -> TensorVolume:
    """Return the tensors of a file whose voxels an affine places, taken from the axes of `frame` to the voxels'."""
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not (np.isfinite(affine).all() and spacing.min() > 0):
        raise ValueError(f"{name}: the affine is singular or not finite; expected one that places the voxels in space")
    return TensorVolume(
        np.ascontiguousarray(to_voxel_axes(found.tensors, frame, affine)),
        tuple(spacing.tolist()),
        (0.0, 0.0, 0.0),
        affine=affine,
        order=found.order,
        frame=frame,
        notes=(found.note(frame),),
        source=name,
        invalid_by_order=found.invalid,
        **{"length_unit": "mm", **known},
    )


def corners(shape: tuple[int, ...]) -> Int[np.ndarray, "8 4"]:
    """Return the indices of the voxels at the corners of a volume, with a 1 behind each, which affines map."""
    return np.stack(np.meshgrid(*((0, n - 1) for n in shape[:3]), [1], indexing="ij"), -1).reshape(-1, 4)


def images_of(array: np.ndarray, volume: TensorVolume) -> np.ndarray:
    """Return scalars (*shape,) or (n_times, *shape) as image files have them: slices one voxel thick, times last."""
    n = array.ndim - volume.dimension
    if volume.dimension == 2:
        array = np.expand_dims(array, n + volume.thin_axis)
    return np.moveaxis(array, 0, -1) if n else array


def as_mask(name: str, values: Any) -> Bool[np.ndarray, "*shape"]:
    """Return zeros and ones as booleans; raise ValueError for anything else."""
    array = np.asarray(values)
    require_real(name, array)
    if array.dtype != bool and not np.isin(array, (0, 1)).all():
        raise ValueError(f"{name}: got mask values other than 0 and 1; threshold it first, for example mask > 0.5")
    return array.astype(bool)


def digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def describe(volume: TensorVolume | None, more: Mapping[str, Any] | None) -> str:
    """Return one line of JSON: the version, the tensors' file, the reader's decisions, and `more`."""
    record: dict[str, Any] = {"software": f"hks-jax {__version__}"}
    if volume is not None:
        record |= {"source": volume.source, "sha256": volume.digest, "order": volume.order, "frame": volume.frame}
        record |= {"notes": list(volume.notes)}
    return json.dumps(
        {**record, **(more or {})}, default=lambda value: value.tolist() if hasattr(value, "tolist") else str(value)
    )  # in ASCII, which NRRD's header needs


def describe_tensors(volume: TensorVolume, order: str, frame: str, more: Mapping[str, Any] | None) -> str:
    """Return the same of tensors that are written, with their order, frame, axes and units in the new file."""
    stored = {"order": order, "frame": frame, "source_order": volume.order, "source_frame": volume.frame}
    stored |= {"axes": volume.volume_affine[:3, :3].tolist(), "length_unit": volume.length_unit, "unit": volume.unit}
    return describe(volume, {**stored, **(more or {})})


def own_record(text: str | bytes) -> dict[str, Any]:
    """Return what `describe_tensors` wrote; empty where the text is anything else."""
    try:
        record = json.loads(text.rstrip(b"\0") if isinstance(text, bytes) else text)
    except ValueError:
        return {}
    ours = isinstance(record, dict) and str(record.get("software", "")).startswith("hks-jax ")
    return record if ours and "source_frame" in record else {}
