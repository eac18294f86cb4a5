"""The class of tensor fields from files, with their position in space and their source, and the class of formats."""

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
from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import describe_array
from hks_jax.checks import require_real
from hks_jax.domain.components import as_mask
from hks_jax.domain.grid import Grid, per_axis
from hks_jax.io.json_files import plain
from hks_jax.io.tensor_order import InvalidByOrder, Matrices, shear_notes, to_voxel_axes
from hks_jax.uncertainty.noise import TensorNoise

AXES = "xyz"
_SAME_SPACING = 1e-3
"""The relative tolerance for the spacing of a volume and the voxel sizes of its affine."""
_ROUNDED_ONE = 0.999
"""The number above which the largest value in a mask is 1 up to the rounding of a scaled image, or more."""


@dataclass(frozen=True)
class Format:
    """A file format of images on grids. `hks_jax.io.formats` lists all formats; a new format is a new module."""

    names: tuple[str, ...]  # the suffixes of its files
    read_tensors: Callable[..., "TensorVolume"]  # called with a path, an order, a frame and the `options`
    options: tuple[str, ...] = ()  # further arguments of `hks_jax.io.read_tensors` that the format accepts
    # Reads masks and labels; returns voxel values, their affine or None, and the declared unit of length, or "".
    read_image: Callable[[str], tuple[np.ndarray, np.ndarray | None, str]] | None = None
    written: tuple[str, ...] = ()  # the suffixes that can be written
    # Writes results; called with a path, an array, the volume, the array's name, more arrays and the provenance.
    write: Callable[[Path, np.ndarray, "TensorVolume", str, dict[str, Any], str], None] | None = None
    write_tensors: Callable[[Path, "TensorVolume", Mapping[str, Any] | None], None] | None = None
    image: str = ""  # the suffix of result images for tensors in this format; empty if results are saved only as npz


@dataclass(frozen=True, eq=False)
class TensorVolume:
    """Tensors on a regular grid of voxels, with components along the voxel axes.

    Attributes:
        tensors: (*shape, d, d); values outside the mask are ignored.
        spacing: the distance between voxels along each axis; if there is an affine, the lengths of its columns.
        origin: the coordinates of voxel (0, …, 0) on the grid; the affine gives its position in space.
        mask: bool (*shape), or None for all voxels.
        affine: (4, 4), the map from voxel indices to world coordinates, or None. A slice has the affine of a volume one
            voxel thick.
        slice_axis: for a slice, the volume's axis perpendicular to the slice; None for a volume.
        order: the order of components in the file, or ``"matrix"`` for whole matrices.
        frame: the axes of the components in the file.
        notes: sentences about decisions made while the file was read.
        source: the path of the file.
        digest: the SHA-256 of the file; empty if the data are in several files.
        repair: a report of the repair of tensors that are not positive definite; empty without repair.
        invalid_by_order: for each order of components, the number of tensors that would not be positive definite; None
            if nearly all are positive definite in `order`.
        length_unit: ``"mm"`` if the file's unit of length is known, so that lengths are in mm; otherwise empty.
        unit: ``"mm²/s"`` if the tensors' unit is known (from an argument, a fit or the file); otherwise empty.
        covariance: (*shape, m, m), the covariance of the m components xx xy yy (xz yz zz) along the voxel axes, in the
            squared unit of the tensors, if known (`fit_dwi`); otherwise None.
        modes: (*shape, n, m), the contribution of each of n images to the noise of the m components of a tensor, if
            `fit_dwi` estimated the noise from residuals (in float32); otherwise None. Unlike `covariance`, `modes` also
            describes noise that is correlated between voxels.

    Raises:
        ValueError: shapes disagree, a spacing is not positive, spacing and affine disagree by more than a thousandth,
            or a number is not finite.

    Examples:
        >>> tensors, mask, spacing = hj.examples.phantom((24, 28))
        >>> volume = hj.io.TensorVolume(tensors, spacing, (0.0, 0.0), mask)
        >>> volume.dimension, volume.shape
        (2, (24, 28))
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
    modes: Float[np.ndarray, "*shape n m"] | None = None

    def __post_init__(self) -> None:
        where = f"{self.source}: " if self.source else ""
        for name in ("tensors", "affine", "covariance", "modes"):
            if (value := getattr(self, name)) is not None or name == "tensors":
                require_real(f"{where}{name}", value)
                object.__setattr__(self, name, np.asarray(value))
        tensors, mask = self.tensors, self.mask
        shape, d = tensors.shape[:-2], tensors.ndim - 2
        if tensors.ndim not in (4, 5) or tensors.shape[-2:] != (len(shape),) * 2:
            raise ValueError(
                f"{where}tensors: got shape {tensors.shape}; expected (nx, ny, 2, 2) or (nx, ny, nz, 3, 3)"
            )
        for name, value in (("spacing", self.spacing), ("origin", self.origin)):
            object.__setattr__(self, name, per_axis(f"{where}{name}", value, d))
        if min(self.spacing) <= 0:
            raise ValueError(f"{where}spacing: got {self.spacing}; expected positive numbers")
        if mask is not None and not (isinstance(mask, np.ndarray) and mask.shape == shape and mask.dtype == bool):
            got, remedy = describe_array(mask), ". `read_mask` reads a file" * isinstance(mask, str | os.PathLike)
            raise ValueError(f"{where}mask: got {got}; expected a bool array of shape {shape}{remedy}")
        if (affine := self.affine) is not None:
            require_affine(self.source, affine)
        for name, unit, known in (("length_unit", self.length_unit, "mm"), ("unit", self.unit, "mm²/s")):
            if unit not in ("", known):
                raise ValueError(f"{where}{name}: got {unit!r}; expected {known!r} or nothing. Convert the numbers")
        if self.slice_axis not in ((None,) if d == 3 else (None, 0, 1, 2)):
            raise ValueError(f"{where}slice_axis: got {self.slice_axis} for {d} axes; expected 0, 1 or 2 for a slice")
        by_affine = None if affine is None else spacing_of(affine, d, self.slice_axis)
        if by_affine is not None and not np.allclose(self.spacing, by_affine, rtol=_SAME_SPACING, atol=0):
            raise ValueError(
                f"{where}spacing: got {self.spacing}, but the affine's voxels have the size {by_affine}; expected the "
                "same. Leave out the wrong one (an npz without spacing has that of its affine), or correct it"
            )
        covariance, modes, m = self.covariance, self.modes, d * (d + 1) // 2
        if covariance is not None and covariance.shape != (*shape, m, m):
            raise ValueError(f"{where}covariance: got shape {covariance.shape}; expected {(*shape, m, m)}")
        if modes is not None and (modes.ndim != d + 2 or (*modes.shape[:-2], modes.shape[-1]) != (*shape, m)):
            raise ValueError(f"{where}modes: got shape {modes.shape}; expected {(*shape, 'n', m)}")

    def __repr__(self) -> str:
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
        """The mask, or True everywhere if there is no mask."""
        return np.ones(self.shape, bool) if self.mask is None else self.mask

    def grid(self, components: Literal["raise", "largest", "all"] = "raise") -> Grid:
        """Return the grid of voxel centres with the mask. See `hks_jax.Grid` for `components`."""
        return Grid(self.shape, self.spacing, self.origin, self.mask, components)

    def with_mask(self, mask: Bool[np.ndarray, "*shape"] | None) -> "TensorVolume":
        """Return the same volume with another mask."""
        return replace(self, mask=mask)

    def slice(self, axis: int | str, index: int) -> "TensorVolume":
        """Return the slice at an index along an axis (0, 1, 2 or ``"x"``, ``"y"``, ``"z"``) as a volume with d = 2.

        The slice has the in-plane 2×2 block of each tensor. The in-plane block B of a diffusion tensor D describes
        diffusion in the slice with the measured in-plane diffusivities, and gives the metric B⁻¹. The in-plane block of
        D⁻¹ would instead be the metric induced on the slice as a surface in the volume. The metric B⁻¹ differs from the
        induced metric if a principal axis of D is oblique to the slice.

        Raises:
            ValueError: the volume is a slice, the axis or index is out of range, or the mask is empty in this slice.
        """
        if self.dimension != 3:
            raise ValueError("slice: got a slice; expected a volume with three axes")
        a = AXES.find(axis) if isinstance(axis, str) and len(axis) == 1 else axis
        if a not in (0, 1, 2):
            raise ValueError(f'axis: got {axis!r}; expected 0, 1, 2 or "x", "y", "z"')
        if not 0 <= index < self.shape[a]:
            raise ValueError(f"index: got {AXES[a]} = {index}; expected 0 … {self.shape[a] - 1}")
        keep, (rows, columns) = [b for b in range(3) if b != a], np.tril_indices(3)
        within = np.flatnonzero((rows != a) & (columns != a))
        cut: dict[str, Any] = {"tensors": np.take(self.tensors, index, axis=a)[..., keep, :][..., keep]}
        if self.mask is not None:
            cut["mask"] = np.take(self.mask, index, axis=a)
            if not cut["mask"].any():
                filled = np.flatnonzero(self.mask.any(axis=tuple(keep)))
                where = f"{AXES[a]} = {filled[0]} … {filled[-1]}" if filled.size else "no slice at all"
                raise ValueError(f"mask: got no voxels in slice {AXES[a]} = {index}; the mask has voxels at {where}")
        if self.covariance is not None:
            cut["covariance"] = np.take(self.covariance, index, axis=a)[..., within, :][..., within]
        if self.modes is not None:
            cut["modes"] = np.take(self.modes, index, axis=a)[..., within]
        if self.affine is not None:
            cut["affine"] = self.affine.copy()
            cut["affine"][:3, 3] += index * self.affine[:3, a]
        for name in ("spacing", "origin"):
            cut[name] = tuple(getattr(self, name)[b] for b in keep)
        note = f"slice {AXES[a]} = {index}: its tensors are the in-plane blocks"
        return replace(self, **cut, slice_axis=a, notes=(*self.notes, note))

    def noise(self, grid: Grid) -> TensorNoise:
        """Return the noise of the tensors that `fit_dwi` estimated, from `modes` if they are known, else `covariance`.

        Raises:
            ValueError: the fit did not estimate the noise.
        """
        if self.modes is not None:
            return TensorNoise.from_modes(self.modes, grid, unknowns=7)  # six components and the unweighted signal
        if self.covariance is None:
            raise ValueError(
                "noise: got a volume without an estimate of its noise; fit the tensors by `fit_dwi` with noise=, or "
                "give the noise by `TensorNoise.relative`"
            )
        return TensorNoise(self.covariance, grid)

    @property
    def volume_affine(self) -> Float[np.ndarray, "4 4"]:
        """The affine; if it is None, the affine with the volume's spacing and origin."""
        if self.affine is not None:
            return self.affine
        affine = np.eye(4)
        axes = [b for b in range(3) if b != self.thin_axis] if self.dimension == 2 else [0, 1, 2]
        affine[axes, axes] = self.spacing
        affine[axes, 3] = self.origin
        return affine

    @property
    def volume_shape(self) -> tuple[int, ...]:
        """The shape as a volume, in which a slice is one voxel thick."""
        return self.shape if self.dimension == 3 else tuple(np.insert(self.shape, self.thin_axis, 1).tolist())

    @property
    def thin_axis(self) -> int:
        """The axis along which a slice is one voxel thick when it is written as a volume; z by default."""
        return 2 if self.slice_axis is None else self.slice_axis


def require_affine(source: str, affine: Float[np.ndarray, "..."]) -> None:
    """Raise ValueError unless an affine is an invertible matrix of shape (4, 4)."""
    if affine.shape != (4, 4) or not np.isfinite(affine).all() or np.linalg.det(affine[:3, :3]) == 0:
        where = f"{source}: " * bool(source)
        raise ValueError(f"{where}affine: got {affine.tolist()}; expected an invertible matrix of shape (4, 4)")


def spacing_of(affine: Float[np.ndarray, "4 4"], d: int, slice_axis: int | None) -> tuple[float, ...]:
    """Return the voxel sizes of an affine along the d axes of a volume, or of a slice perpendicular to `slice_axis`."""
    sizes = np.linalg.norm(affine[:3, :3], axis=0)
    if d == 2:
        sizes = np.delete(sizes, 2 if slice_axis is None else slice_axis)
    return tuple(sizes.tolist())


def placed(name: str, found: Matrices, frame: str, affine: Float[np.ndarray, "4 4"], **known: Any) -> TensorVolume:
    """Return a volume at the position `affine`, with tensors transformed from the axes of `frame` to the voxel axes."""
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not (np.isfinite(affine).all() and spacing.min() > 0):
        raise ValueError(f"{name}: got an affine that is singular or not finite; expected an invertible affine")
    return TensorVolume(
        np.ascontiguousarray(to_voxel_axes(found.tensors, frame, affine)),
        tuple(spacing.tolist()),
        (0.0, 0.0, 0.0),
        affine=affine,
        order=found.order,
        frame=frame,
        notes=(*shear_notes(affine[:3, :3]), found.note(frame)),
        source=name,
        invalid_by_order=found.invalid,
        **{"length_unit": "mm", **known},
    )


def mask_in_file(name: str, values: np.ndarray) -> Bool[np.ndarray, "*shape"]:
    """Return the mask of zeros and one other number, such as 255, in a file; warn unless it is 1.

    Raises:
        ValueError: there are other values, or a fraction, which may be a probability.
    """
    values = np.asarray(values)
    if values.dtype != bool and values.size and values.dtype.kind in "fiu":
        high = values.max()
        if high > _ROUNDED_ONE and high != 1 and np.isin(values, (0, high)).all():
            warn_of_accuracy(f"{name}: the values are 0 and {high:g}; {high:g} is read as inside the mask", UserWarning)
            return values == high
    return as_mask(name, values)


def corners(shape: tuple[int, ...]) -> Int[np.ndarray, "8 4"]:
    """Return the homogeneous indices (i, j, k, 1) of the voxels at the corners of an image in 2D or 3D."""
    ends = ((0, n - 1) for n in (*shape, 1)[:3])
    return np.stack(np.meshgrid(*ends, [1], indexing="ij"), -1).reshape(-1, 4)


def require_position(name: str, affine: Any, expected: Any, shape: tuple[int, ...], of: str = "the tensors") -> None:
    """Raise ValueError if the affine of an image displaces its voxels from `expected`; an affine None is unknown."""
    if affine is None or expected is None:
        return
    shift = np.linalg.norm(corners(shape) @ (affine - expected).T, axis=1).max()
    if shift > 0.5 * np.linalg.norm(expected[:3, :3], axis=0).min():
        raise ValueError(
            f"{name}: the affine displaces this image by up to {shift:.3g} from {of}; expected the same position. "
            f"Resample the image to the voxels of {of}"
        )


def images_of(array: np.ndarray, volume: TensorVolume) -> np.ndarray:
    """Return scalars (*shape,) or (n_times, *shape) as image files store them: slices one voxel thick, times last."""
    n = array.ndim - volume.dimension
    if volume.dimension == 2:
        array = np.expand_dims(array, n + volume.thin_axis)
    return np.moveaxis(array, 0, -1) if n else array


def digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def describe(volume: TensorVolume | None, more: Mapping[str, Any] | None) -> str:
    """Return a line of JSON with the origin of data: the version, the tensors' file, the volume's notes, and `more`."""
    record: dict[str, Any] = {"software": f"hks-jax {__version__}"}
    if volume is not None:
        record |= {"source": volume.source, "sha256": volume.digest, "order": volume.order, "frame": volume.frame}
        record |= {"notes": list(volume.notes)}
    return json.dumps(plain({**record, **(more or {})}), default=str)  # in ASCII, which NRRD's header requires


def describe_tensors(volume: TensorVolume, order: str, frame: str, more: Mapping[str, Any] | None) -> str:
    """Return a line of JSON with the origin of tensors, and their order, frame, axes and units in the new file."""
    stored = {"order": order, "frame": frame, "source_order": volume.order, "source_frame": volume.frame}
    stored |= {"axes": volume.volume_affine[:3, :3].tolist(), "length_unit": volume.length_unit, "unit": volume.unit}
    return describe(volume, {**stored, **(more or {})})


def own_record(text: str | bytes) -> dict[str, Any]:
    """Parse a text that `describe_tensors` wrote; return an empty dictionary for any other text."""
    try:
        record = json.loads(text.rstrip(b"\0") if isinstance(text, bytes) else text)
    except ValueError:
        return {}
    ours = isinstance(record, dict) and str(record.get("software", "")).startswith("hks-jax ")
    return record if ours and "source_frame" in record else {}
