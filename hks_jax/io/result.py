"""The class of results (signatures and other scalar fields), which commands save, read, draw, tabulate and fit."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hks_jax import Grid, SurfaceMesh, TetMesh
from hks_jax.arrays import describe_array
from hks_jax.checks import require_real
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io.arrays import volume_of
from hks_jax.io.files import save
from hks_jax.io.units import MEDIAN, median_mean_diffusivity, unit_of_times
from hks_jax.io.volume import TensorVolume
from hks_jax.signatures.times import FREE, RESOLVED
from hks_jax.storage import load_npz

NAMES = ("hks", "curvature")
KEPT = ("deviation", "bias", "z", "noise_maps", "scaled_times", "density", "input_tensors", "influence")
"""The arrays of a file that a result keeps, beside its values, times and eigenvalues."""
_ROUNDED = 1e-9
"""The share by which a time may be below the smallest resolved one, at which automatic times begin."""


@dataclass(frozen=True, eq=False)
class Result:
    """A signature or another scalar field on a mesh, or on a volume or slice whose mask is the domain.

    Attributes:
        place: the volume, slice or mesh. If the result's file has no tensors, the volume has identity matrices.
        values: (n_times, *shape).
        times: (n_times,), or (0,) for a result without times.
        eigenvalues: (k,), or (0,) if they are unknown.
        report: facts about the computation; the entry ``settings`` contains its settings.
        arrays: more named arrays, saved with the result: ``deviation``, ``bias``, ``z`` and ``noise_maps`` (n_draws,
            n_times, *shape) for error bars, ``scaled_times`` (t times the first positive eigenvalue), ``density``
            (√|D| of the diffusivity D, for Fick's operator), ``input_tensors``, and ``influence`` (n_times, *shape),
            the influence of the boundary (`hks_jax.boundary_influence`).
        name: ``"hks"`` or ``"curvature"``.
        source: the file from which the result was read.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), field.grid.spacing, field.grid.origin)
        >>> path = hj.io.save(folder / "hks.npz", np.ones((1, 9, 9)), volume, name="hks", extra={"times": [0.5]})
        >>> hj.io.Result.read(path).grid == field.grid
        True
    """

    place: TensorVolume | SimplicialMesh
    values: Float[np.ndarray, "n_times *shape"]
    times: Float[np.ndarray, " n_known"]
    eigenvalues: Float[np.ndarray, " k"] = field(default_factory=lambda: np.zeros(0))
    report: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    name: str = "hks"
    source: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.place, TensorVolume | SimplicialMesh):
            raise TypeError(f"place: got {type(self.place).__name__}; expected a TensorVolume or a mesh")
        for name in ("values", "times", "eigenvalues"):
            require_real(name, getattr(self, name))
            object.__setattr__(self, name, np.asarray(getattr(self, name)))
        shape = self.place.shape if isinstance(self.place, TensorVolume) else (len(self.place.vertices),)
        if self.values.shape[1:] != shape or self.times.shape not in ((0,), self.values.shape[:1]):
            raise ValueError(
                f"values: got shape {self.values.shape} and times of shape {self.times.shape}; expected "
                f"{('n_times', *shape)} and (n_times,), or one field and no times"
            )

    def __repr__(self) -> str:
        """Return a summary in one line, without the arrays."""
        times = f", {self.times.size} times {self.times.min():.4g} … {self.times.max():.4g}" * bool(self.times.size)
        unit = f" {self.unit}" * bool(times and self.unit)
        return f"Result({self.name}: {describe_array(self.values)}{times}{unit}, source={self.source!r})"

    @classmethod
    def read(cls, path: str | os.PathLike[str], name: str | None = None, over_times: bool = False) -> "Result":
        """Read a result from an npz that `save` or the command line wrote.

        Args:
            path: the npz, or a folder that ``hks-jax hks`` wrote.
            name: the name of the array. None means ``hks`` or, if the file has no such array, ``curvature``.
            over_times: whether the result must have an axis of times.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is not an npz, arrays are missing, or their shapes disagree.
        """
        path = signature_file(Path(path))
        arrays = load_npz(path)
        name = name or next((n for n in NAMES if n in arrays), " or ".join(NAMES))
        on_mesh = "vertices" in arrays and ("faces" in arrays or "cells" in arrays)
        needed = (name, *["times"] * over_times, *(() if on_mesh else ("spacing", "origin")))
        if lacking := [n for n in needed if n not in arrays]:
            raise ValueError(
                f"{path}: got the arrays {', '.join(sorted(arrays)) or 'none'}; expected {', '.join(needed)}, as in "
                f"files of 'hks-jax hks' and 'hks-jax curvature'. Add {', '.join(lacking)}"
            )
        values, d = np.asarray(arrays[name]), 1 if on_mesh else np.size(arrays["spacing"])
        over_times = over_times or values.ndim > d
        times = arrays.get("times", np.arange(len(values))).astype(np.float64) if over_times else np.zeros(0)
        numbers = values.dtype.kind in "fiu" and (on_mesh or d in (2, 3)) and values.ndim - d == over_times
        if not numbers or (over_times and times.shape != values.shape[:1]):
            raise ValueError(
                f"{path}: got {name} of shape {values.shape} and dtype {values.dtype}, times of shape {times.shape}; "
                f"expected real numbers (*shape,) or (n_times, *shape), where *shape has {d} axes, and times (n_times,)"
            )
        record = json.loads(str(arrays["provenance"])) if "provenance" in arrays else {}
        values = values.reshape(-1, *values.shape[values.ndim - d :]).astype(np.float64)
        place: TensorVolume | SimplicialMesh
        if not on_mesh:
            shape = (*values.shape[1:], d, d)
            tensors = arrays.get("input_tensors", np.broadcast_to(np.eye(d), shape))
            if tensors.shape != shape:
                raise ValueError(f"{path}: got input_tensors of shape {tensors.shape}; expected {shape}")
            about: dict[str, Any] = {"order": record.get("order", "matrix"), "frame": record.get("frame", "voxel")}
            about |= {"source": record.get("source") or "", "digest": record.get("sha256") or ""}
            about |= {"notes": tuple(record.get("notes", ()))}
            place = volume_of(str(path), arrays, tensors, **about)
        else:
            kind, cells = (TetMesh, arrays["cells"]) if "cells" in arrays else (SurfaceMesh, arrays["faces"])
            # Only a mesh with a mask may have vertices that belong to no cell, which are outside the domain.
            place = kind(arrays["vertices"], cells, mask=np.ones(cells.shape[:1], bool))
        eigenvalues, report = arrays.get("eigenvalues", np.zeros(0)), {"settings": record.get("settings") or {}}
        more = {n: a for n, a in arrays.items() if n in KEPT}
        return cls(place, values, times, eigenvalues, report, more, name, str(path))

    def save(self, stem: Path, *images: str, origin: Mapping[str, Any] | None = None) -> None:
        """Write the result as an npz and also as images or meshes.

        The npz contains the times, the eigenvalues, the tensors and all other arrays. If the tensors are in single
        precision, so are the written values, because further digits are not significant.

        Args:
            stem: the path of the files without suffix.
            *images: the suffixes of the images or meshes; see `hks_jax.io.save`. Empty suffixes are ignored.
            origin: more entries of the files' provenance, in addition to the settings and the times.
        """
        single = isinstance(self.place, TensorVolume) and self.place.tensors.dtype == np.float32
        values = self.values.astype(np.float32) if single else self.values
        times = {"times": self.times} if self.times.size else {}
        extra = {**times, **({"eigenvalues": self.eigenvalues} if self.eigenvalues.size else {}), **self.arrays}
        record = {**(origin or {}), "settings": self.settings, **times}
        if self.times.size:
            lengths = None if self.lengths is None else self.lengths.tolist()
            record |= {"units": self.units, "lengths": lengths}
        for suffix in filter(None, (".npz", *images)):
            # Headers of NIfTI and NRRD have no room for arrays of the volume's size.
            given: dict[str, Any] = times if suffix.startswith((".nii", ".nrrd")) else extra
            if suffix == ".npz" and isinstance(self.place, TensorVolume):
                given = {**extra, "input_tensors": self.place.tensors.astype(np.float32)}
            path, shown = stem.with_name(stem.name + suffix), values if self.times.size else values[0]
            save(path, shown, self.place, name=self.name, extra=given, provenance=record)

    @property
    def volume(self) -> TensorVolume:
        """The volume or slice of the result; raises ValueError for a mesh."""
        if not isinstance(self.place, TensorVolume):
            raise ValueError(f"{self.source}: got a result on a mesh; expected a result on a grid of voxels")
        return self.place

    @property
    def dimension(self) -> int:
        """The dimension of the volume, slice or mesh."""
        place = self.place if isinstance(self.place, TensorVolume) else self.place.triangulation
        return place.dimension

    @property
    def grid(self) -> Grid:
        """The grid of the result, whose mask is the domain."""
        return self.volume.grid("all")

    @property
    def settings(self) -> Mapping[str, Any]:
        """The settings of the computation; empty if they are not known."""
        return dict(self.report.get("settings", {}))

    @property
    def normalisation(self) -> str:
        """The normalisation of a signature, ``"raw"`` if it is not known."""
        return str(self.settings.get("normalisation", "raw"))

    @property
    def centre(self) -> float | None:
        """The value of a flat metric, 1 with the normalisation ``"flat"``; None with the others."""
        return 1.0 if self.name == "hks" and self.normalisation == "flat" else None

    @property
    def tensors(self) -> Float[np.ndarray, "*shape d d"] | None:
        """The tensors of a volume or slice; None for a mesh, and if the file of the result has none."""
        known = isinstance(self.place, TensorVolume) and not (self.source and "input_tensors" not in self.arrays)
        return self.volume.tensors if known else None

    @property
    def diffusivity(self) -> float | None:
        """The D of √(Dt), the median of the tensors' mean eigenvalues in the domain; None if t is no time."""
        if self.tensors is None or not self.in_time:
            return None
        return median_mean_diffusivity(self.volume.with_mask(np.isfinite(self.values[0]))) or None

    @property
    def lengths(self) -> Float[np.ndarray, " n_times"] | None:
        """(n_times,) the distances √(Dt) for the `diffusivity` D; None if D is not known."""
        return None if self.diffusivity is None else np.sqrt(self.diffusivity * self.times)

    @property
    def near_rim(self) -> Bool[np.ndarray, "n_times *shape"] | None:
        """(n_times, *shape) the nodes at which the boundary contributes over a tenth; None if this is not known."""
        influence = self.arrays.get("influence")
        return None if influence is None else influence >= FREE

    @property
    def z(self) -> Float[np.ndarray, "n_times *shape"] | None:
        """The distance of the values from those of constant tensors (`hks_jax.Uncertainty.z`), if known."""
        return self.arrays.get("z")

    @property
    def smallest_time(self) -> float:
        """The time below which more than 1 % of the signature lies beyond its eigenpairs; 0 if this is not known.

        It is infinite if no eigenvalue is positive.
        """
        if not self.eigenvalues.size or self.settings.get("method", "spectral") != "spectral":
            return 0.0
        last = float(self.eigenvalues[-1])
        return RESOLVED[self.dimension] / last * (1 - _ROUNDED) if last > 0 else math.inf

    @property
    def flat_scale(self) -> Float[np.ndarray, "n_times ..."]:
        """(n_times, 1, …), the factor (4πt)^(d/2) of the normalisation ``"flat"`` in d dimensions."""
        return (4 * np.pi * self.times.reshape(-1, *[1] * (self.values.ndim - 1))) ** (self.dimension / 2)

    @property
    def to_flat(self) -> Float[np.ndarray, "n_times ..."]:
        """The factor of the normalisation ``"flat"``, which is `flat_scale`, times √|D| for Fick's operator."""
        if self.settings.get("operator") != "fick":
            return self.flat_scale
        if "density" not in self.arrays:
            raise ValueError(
                f"{self.source}: the signature of Fick's operator lacks its density √|D|; compute it again"
            )
        return self.flat_scale * self.arrays["density"]

    @property
    def in_time(self) -> bool:
        """Whether t is a time, as for the metric D⁻¹ and for Fick's operator."""
        return self.settings.get("metric") == "inverse" or self.settings.get("operator") == "fick"

    @property
    def unit(self) -> str:
        """The unit of t (`hks_jax.io.units.unit_of_times`); empty if it is not known."""
        if self.tensors is None or not isinstance(self.place, TensorVolume):
            return ""
        return unit_of_times(self.place, "inverse" if self.in_time else self.settings.get("metric"))

    @property
    def unit_of_values(self) -> str:
        """The unit of a signature, ``"1"`` if it has none; empty if it is not known."""
        if self.normalisation in ("flat", "volume"):
            return "1"
        if self.settings.get("operator") == "fick":
            return f"{self.length_unit}^-{self.dimension}" if self.length_unit else ""
        return f"s^-{self.dimension / 2:g}" if self.unit == "s" else ""

    @property
    def units(self) -> dict[str, Any]:
        """Facts for reports: the units of t and of √(Dt), and the diffusivity D with its definition."""
        return {
            "t": self.unit or "(metric length)²",
            "length": self.length_unit or None,
            "D": self.diffusivity,
            "D_is": None if self.diffusivity is None else MEDIAN,
        }

    @property
    def length_unit(self) -> str:
        """The unit of lengths: the volume's unit, or empty for a mesh."""
        return getattr(self.place, "length_unit", "")


def require_result(result: Any) -> None:
    """Raise TypeError for anything that is not a result."""
    if not isinstance(result, Result):
        raise TypeError(f"result: got {type(result).__name__}; expected hks_jax.io.Result, as Result.read returns it")


def signature_file(result: Path) -> Path:
    """Return the path of the signature in a folder of ``hks-jax hks`` or of a study's subject, or else the path."""
    if not result.is_dir():
        return result
    of_subject = [file for folder in ("", "*/") for file in result.glob(f"{folder}dwi/*_param-hks_dwimap.npz")]
    return of_subject[0] if len(of_subject) == 1 else result / "hks.npz"
