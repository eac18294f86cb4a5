"""Results: signatures and other scalar fields, which are saved, read back, drawn, explored, tabulated or fitted."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax import Grid, SurfaceMesh, TetMesh
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.io.arrays import volume_of
from hks_jax.io.files import save
from hks_jax.io.volume import TensorVolume
from hks_jax.storage import load_npz

NAMES = ("hks", "curvature")


@dataclass(frozen=True, eq=False)
class Result:
    """A signature, or another scalar field, on a volume or slice whose mask is the domain, or on a mesh.

    Attributes:
        place: the volume or slice, or the mesh. Where a file has no tensors they are the identity.
        values: (n_times, *shape).
        times: (n_times,), or (0,) for a result without.
        eigenvalues: (k,), or (0,) where they are not known.
        report: facts about the computation; ``settings`` are those of the computation.
        arrays: more arrays by name, which are saved with it: ``deviation``, ``bias`` and ``noise_maps`` (n_draws,
            n_times, *shape) of error bars; ``scaled_times`` λ₁t; ``input_tensors``, where they are known.
        name: ``"hks"`` or ``"curvature"``.
        source: the file that it was read from.
    """

    place: TensorVolume | SimplicialMesh
    values: Float[np.ndarray, "n_times *shape"]
    times: Float[np.ndarray, " n_known"]
    eigenvalues: Float[np.ndarray, " k"]
    report: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    name: str = "hks"
    source: str = ""

    @classmethod
    def read(cls, path: str | os.PathLike[str], name: str | None = None, over_times: bool = False) -> "Result":
        """Read a result that `save` or the command line wrote as npz.

        Args:
            path: the file, or the folder of a signature.
            name: the array; None: ``hks``, else ``curvature``.
            over_times: whether it must be a signature over times.

        Raises:
            FileNotFoundError: no such file.
            ValueError: no npz; arrays that are missing or of shapes that disagree.
        """
        path = signature_file(Path(path))
        arrays = load_npz(path)
        name = name or next((n for n in NAMES if n in arrays), " or ".join(NAMES))
        on_mesh = "vertices" in arrays and ("faces" in arrays or "cells" in arrays)
        needed = (name, *["times"] * over_times, *(() if on_mesh else ("spacing", "origin")))
        if lacking := [n for n in needed if n not in arrays]:
            raise ValueError(
                f"{path}: got the arrays {', '.join(sorted(arrays)) or 'none'}; expected {', '.join(needed)}, as "
                f"'hks-jax hks' and 'hks-jax curvature' write them. Add {', '.join(lacking)}"
            )
        values, d = np.asarray(arrays[name]), 1 if on_mesh else np.size(arrays["spacing"])
        over_times = over_times or values.ndim > d
        times = arrays.get("times", np.arange(len(values))).astype(np.float64) if over_times else np.zeros(0)
        numbers = values.dtype.kind in "fiu" and (on_mesh or d in (2, 3)) and values.ndim - d == over_times
        if not numbers or (over_times and times.shape != values.shape[:1]):
            raise ValueError(
                f"{path}: got {name} of shape {values.shape}, dtype {values.dtype}, times of shape {times.shape} for "
                f"{d} axes; expected real numbers, one per node, or (n_times, *shape) with (n_times,)"
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
            about["slice_axis"] = int(arrays["slice_axis"]) if "slice_axis" in arrays else None
            place = volume_of(str(path), arrays, tensors, **about)
        elif "cells" in arrays:
            place = TetMesh(arrays["vertices"], arrays["cells"])
        else:
            place = SurfaceMesh(arrays["vertices"], arrays["faces"])
        eigenvalues, report = arrays.get("eigenvalues", np.zeros(0)), {"settings": record.get("settings") or {}}
        more = {n: a for n, a in arrays.items() if n in ("deviation", "noise_maps", "scaled_times", "input_tensors")}
        return cls(place, values, times, eigenvalues, report, more, name, str(path))

    def save(self, stem: Path, image: str, origin: Mapping[str, Any] | None = None) -> None:
        """Write it as `stem` with ``.npz`` after it and, unless that is empty, with the suffix of an image or a mesh.

        The npz also has the times, the eigenvalues, the tensors, and all other arrays. Where the tensors
        are of single precision the values are, too: more digits mean nothing and take room.

        Args:
            stem: the files' path without a suffix.
            image: the suffix; see `hks_jax.io.save`.
            origin: more entries of the files' provenance, beside the settings and the times.
        """
        single = isinstance(self.place, TensorVolume) and self.place.tensors.dtype == np.float32
        values = self.values.astype(np.float32) if single else self.values
        times = {"times": self.times} if self.times.size else {}
        extra = {**times, **({"eigenvalues": self.eigenvalues} if self.eigenvalues.size else {}), **self.arrays}
        record = {**(origin or {}), "settings": plain(self.settings), **times}
        for suffix in filter(None, (".npz", image)):
            given: dict[str, Any] = times if suffix.startswith(".nii") else extra
            if suffix == ".npz" and isinstance(self.place, TensorVolume):
                given = {**extra, "input_tensors": self.place.tensors.astype(np.float32)}
            path, shown = stem.with_name(stem.name + suffix), values if self.times.size else values[0]
            save(path, shown, self.place, name=self.name, extra=given, provenance=record)

    @property
    def volume(self) -> TensorVolume:
        """The volume or slice that it is on; raises ValueError where it is on a mesh."""
        if not isinstance(self.place, TensorVolume):
            raise ValueError(f"{self.source}: is on a mesh; expected a grid of voxels")
        return self.place

    @property
    def grid(self) -> Grid:
        """The grid, whose mask is the domain."""
        return self.volume.grid("all")

    @property
    def settings(self) -> Mapping[str, Any]:
        """The settings of the computation; empty where the file does not say them."""
        settings: Mapping[str, Any] = self.report["settings"]
        return settings

    @property
    def z(self) -> Float[np.ndarray, "n_times *shape"] | None:
        """By how many standard deviations the signature differs from that of flat space, or from its median."""
        if "deviation" not in self.arrays:
            return None
        ones, normalisation = (-1, *[1] * (self.values.ndim - 1)), self.settings["normalisation"]
        if normalisation in ("raw", "flat"):
            reference = (4 * np.pi * self.times) ** (0 if normalisation == "flat" else -(self.values.ndim - 1) / 2)
        else:
            reference = np.nanmedian(self.values.reshape(len(self.values), -1), axis=1)
        return (self.values - reference.reshape(ones)) / self.arrays["deviation"]

    @property
    def unit(self) -> str:
        """The unit of t: fitted tensors are in mm²/s, and their grids in mm. Else it is not known."""
        fitted = isinstance(self.place, TensorVolume) and self.place.order == "fit"
        return "s" if fitted and self.settings.get("metric") == "inverse" else ""


def signature_file(result: Path) -> Path:
    """Return the file of the signature in a folder that ``hks-jax hks`` has written; a file is its own."""
    return result / "hks.npz" if result.is_dir() else result


def recorded_boundary(settings: Mapping[str, Any]) -> BoundarySpec | None:
    """Return the boundary that settings read from JSON name, if they do: its lists are tuples."""

    def tuples(value: Any) -> Any:
        return tuple(map(tuples, value)) if isinstance(value, list) else value

    boundary: BoundarySpec | None = tuples(settings.get("boundary"))
    return boundary


def plain(value: Any) -> Any:
    """Return what JSON can hold: no NaN or infinity, no tuples, paths or NumPy scalars."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
