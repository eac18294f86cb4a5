"""Read a mesh, with the metric that tensors give it, from the options of meshes."""

import argparse
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy.spatial import cKDTree

from hks_jax.cli.computation import Domain, Mesh, OfMesh, Settings, describe_input, use_dtype
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, read
from hks_jax.domain.simplices import WORDS, signed_measure
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io import TensorVolume, read_mask, sample_tensors
from hks_jax.io.mesh import load_mesh
from hks_jax.io.repair import require_valid
from hks_jax.io.sampling import OutsideMaskError
from hks_jax.io.tensor_order import Order, matrices
from hks_jax.io.volume import digest
from hks_jax.optional import optional
from hks_jax.signatures.times import suitable_times

_TENSORS = ("source", "sha256", "array", "order", "frame")
"""The facts about tensors that the record of each result has."""


class MeshFile(NamedTuple):
    """The file of a mesh and how to read it, with the names of the options; `around` has the tensors of a volume."""

    file: Path
    clean: bool
    inside: Path | None
    array: str | None
    order: Order | None
    around: Reading | None

    @classmethod
    def of(cls, args: argparse.Namespace, file: Path) -> "MeshFile":
        """Return the options in `args`."""
        around = Reading.of(args, file=args.tensors, others=()) if args.tensors else None
        return cls(file, args.clean, args.inside, args.array, args.order, around)


def read_domain(mesh_file: MeshFile, settings: Settings, progress: Progress) -> OfMesh:
    """Read a mesh in the chosen precision, with the metric of tensors in a volume or in an array of its file, if any.

    Without tensors, the mesh has the Euclidean metric.
    """
    volume = None if mesh_file.around is None else read(mesh_file.around, progress)
    if volume is not None:
        require_valid(volume, "--repair")
    with progress.stage("reading", str(mesh_file.file)):
        use_dtype(settings.dtype)
        return _with_metric(mesh_file, volume, settings, progress)


def _with_metric(mesh_file: MeshFile, volume: TensorVolume | None, settings: Settings, progress: Progress) -> OfMesh:
    file, dtype = mesh_file.file, settings.dtype
    inside = None if mesh_file.inside is None else partial(_inside, mesh_file.inside)
    try:
        found = load_mesh(file, mesh_file.clean, volume is not None, inside)
    except ValueError as error:
        if inside is None or not str(error).startswith("mask: "):
            raise
        raise ValueError(f"--inside: {str(error).removeprefix('mask: ')}") from error
    mesh, cells, mask = found.mesh, found.cells, found.mask
    vertices = np.asarray(mesh.vertices).astype(dtype)
    kind: Any = type(mesh)

    def of_tensors(tensors: Any, at: str = "vertices") -> Mesh:
        how: Any = {"at": at, "operator": settings.operator, "interpolation": settings.interpolation, "mask": mask}
        with_metric: Mesh = kind.from_tensors(vertices, cells, tensors, settings.metric, **how)
        return with_metric

    def made(mesh: Mesh, *tensors: Any, **origin: Any) -> OfMesh:
        about, record = {"source": str(file), **describe_mesh(file, mesh)}, dict(found.origin)
        if origin:
            about["tensors"] = origin
            record |= {f"tensors_{name}": str(value) for name, value in origin.items() if name in _TENSORS}
        return Domain(mesh, mesh, about, found.written, record, *tensors)

    if volume is not None:
        at = np.flatnonzero(mesh.triangulation.used)

        def sampled(values: Any) -> Mesh:
            tensors = np.zeros((len(vertices), 3, 3), dtype)
            around = replace(volume, tensors=np.asarray(values))
            try:
                tensors[at] = sample_tensors(around, np.asarray(mesh.vertices)[at])
            except OutsideMaskError as error:
                remedy = (
                    "Pass a larger --mask, or pass --inside with the vertices inside the mask, to leave the others out"
                )
                raise ValueError(f"{error.fact}. {remedy}") from error
            return of_tensors(tensors)

        return made(sampled(volume.tensors), volume.tensors, sampled, volume, **describe_input(volume))
    if mesh_file.array is None:
        _tell_of_tensors(found.arrays, progress)
        return made(kind(vertices, cells, mask=mask))
    tensors, place = _tensors_in(found.arrays, mesh_file.array, mesh_file.order, progress)
    origin: dict[str, Any] = {"array": mesh_file.array, "at": place, "order": mesh_file.order or "matrix"}
    tensors = tensors.astype(dtype)
    return made(of_tensors(tensors, place), tensors, partial(of_tensors, at=place), **origin)


def describe_mesh(path: Path, mesh: SimplicialMesh) -> dict[str, Any]:
    """Return facts about a mesh in space for JSON; also the times that suit it, unless it has another metric."""
    vertices, cells, d = np.asarray(mesh.vertices, np.float64), mesh.triangulation.cells, mesh.triangulation.dimension
    measure = float(np.sum(signed_measure(vertices, cells)[0])) / math.factorial(d)
    sides = [vertices[cells[:, i]] - vertices[cells[:, j]] for i, j in combinations(range(d + 1), 2)]
    edge, rim = float(np.median(np.linalg.norm(np.concatenate(sides), axis=1))), mesh.triangulation.boundary_vertices
    facts = {
        "sha256": digest(path),
        "format": path.suffix,
        "vertices": len(vertices),
        WORDS[d].simplices: len(cells),
        "boundary_vertices": int(rim.sum()),
        "components": mesh.triangulation.labels[1],
        WORDS[d].measure: measure,
        "median_edge": edge,
    }
    if mesh.metric_of_space is None:
        used = mesh.triangulation.used
        size = float(np.linalg.norm(np.ptp(vertices[used], axis=0)))
        depth = float(np.median(cKDTree(vertices[rim]).query(vertices[used])[0])) if rim.any() else math.inf
        times = suitable_times(d, measure, edge**2, size, len(vertices), depth=depth)
        facts["suits"] = {{2: "surface", 3: "solid"}[d]: times}
    return facts


def _tell_of_tensors(arrays: Mapping[str, Mapping[str, np.ndarray]], progress: Progress) -> None:
    """Print a note about arrays that may be tensors."""
    for at, named in arrays.items():
        for name, values in named.items():
            components = math.prod(values.shape[1:])
            if components in (6, 9):
                progress.note(
                    f"the {components} components of {name} at the {at} are not used, and the mesh has the Euclidean "
                    f"metric. To use them, pass --array {name}" + " and --order" * (components == 6)
                )


def _tensors_in(
    arrays: Mapping[str, Mapping[str, np.ndarray]], name: str, order: Order | None, progress: Progress
) -> tuple[np.ndarray, str]:
    """Return the tensors in an array of a mesh, and their place, vertices or cells."""
    places = [at for at, there in arrays.items() if name in there]
    if not places:
        there = "; ".join(f"at the {at}: {', '.join(named) or 'none'}" for at, named in arrays.items())
        raise ValueError(f"--array: got {name!r}; expected one of the arrays {there}")
    if len(places) > 1:
        progress.note(f"--array: {name} is at the {' and at the '.join(places)}; the {places[0]} are used")
    values = arrays[places[0]][name]
    values = values.reshape(len(values), -1)
    if values.shape[1] != (9 if order is None else 6):
        raise ValueError(f"--array: got {name!r} with {values.shape[1]} components; expected 9, or 6 with --order")
    return matrices(name, values, order).tensors, places[0]


def _inside(path: Path, n_vertices: int) -> Bool[np.ndarray, " V"]:
    if path.suffix != ".label":
        return read_mask(path)
    numbers = optional("nibabel.freesurfer").read_label(path)
    if numbers.size == 0 or numbers.min() < 0 or numbers.max() >= n_vertices:
        raise ValueError(f"--inside: got {numbers.size} vertices in {path}; expected indices 0 … {n_vertices - 1}")
    return np.isin(np.arange(n_vertices), numbers)
