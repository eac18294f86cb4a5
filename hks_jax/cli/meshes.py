"""Read a mesh, with the metric that tensors give it, from the options of meshes, and compute its eigenpairs."""

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool

from hks_jax import Eigenpairs, SurfaceMesh, TetMesh, assemble
from hks_jax.cli.computation import Settings, solve, use_dtype
from hks_jax.cli.info import listed
from hks_jax.cli.options import add_reading, defaults, refuse
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import read, require_one
from hks_jax.domain.tensor_checks import Interpolation, MetricChoice, OperatorChoice
from hks_jax.fem.assembly import MESH_BOUNDARIES
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.io import TensorVolume, read_mask, read_mesh, sample_tensors
from hks_jax.io.cortex import MAPS, structure_of
from hks_jax.io.mesh import WRITTEN, arrays_by_place, is_surface
from hks_jax.io.repair import require_valid
from hks_jax.io.sampling import OutsideMaskError
from hks_jax.io.tensor_order import Order, matrices
from hks_jax.optional import optional

Mesh: TypeAlias = SurfaceMesh | TetMesh

OF_TENSORS = ("metric", "operator", "order", "interpolation")
"""Options that refer to tensors of a mesh."""
NO_NOISE = "this option needs tensors; saved eigenpairs and meshes with the Euclidean metric have none. Leave it out"


class Domain(NamedTuple):
    """A mesh with a metric, the tensors behind the metric, and the function from such tensors to the mesh."""

    mesh: Mesh
    tensors: np.ndarray | None  # at the vertices or cells of the mesh, or at the voxels of the volume
    volume: TensorVolume | None
    of_tensors: Callable[[Any], Mesh] | None


def domain_of(args: argparse.Namespace, progress: Progress) -> Domain:
    """Read the mesh, and the tensors that give it a metric, from the options; raise ValueError for other options."""
    _check_options(args)
    return domain_in(args.file, args.metric, args, progress)


def domain_in(file: Path, metric: MetricChoice | None, args: argparse.Namespace, progress: Progress) -> Domain:
    """Read a mesh, and the tensors that give it the chosen metric, from the options."""
    with progress.stage("reading", str(file)):
        return _read_domain(
            file,
            _volume_around(args, progress),
            progress,
            dtype=args.dtype,
            clean=args.clean,
            inside=args.inside,
            array=args.array,
            order=args.order,
            metric=metric,
            operator=args.operator,
            interpolation=args.interpolation,
        )


def _volume_around(args: argparse.Namespace, progress: Progress) -> TensorVolume | None:
    """Read the volume of ``--tensors``, if this option is given."""
    if not args.tensors:
        return None
    if args.array:
        raise ValueError("--tensors, --array: got both; expected tensors either in a volume or in the mesh's file")
    volume = read(argparse.Namespace(**vars(args) | {"file": args.tensors, "others": []}), progress)
    require_valid(volume, "--repair")
    return volume


def solve_mesh(mesh: Mesh, settings: Settings, progress: Progress) -> tuple[Eigenpairs, Settings]:
    """Compute the eigenpairs of a mesh; return them, and the settings with the boundary condition."""
    settings = replace(settings, boundary=settings.boundary or "neumann")
    assert settings.boundary is not None
    with progress.stage("assembly", f"{len(mesh.vertices)} vertices"):
        pencil = assemble(mesh, settings.boundary)
    return solve(pencil, settings, progress), settings


def images_of_mesh(file: Path, mesh: Mesh, clean: bool) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the suffixes of results on a mesh, and entries for their provenance.

    The suffixes are that of the mesh's file, or .vtu if its format has no values at vertices; and for a GIFTI or a
    FreeSurfer surface also that of GIFTI's maps, unless the vertices may have been renumbered by cleaning.
    """
    suffix = file.suffix.lower()
    own = ".vtu" if suffix not in WRITTEN or (suffix == ".ply" and isinstance(mesh, TetMesh)) else suffix
    return ((own, MAPS), structure_of(file)) if is_surface(file) and not clean else ((own,), {})


def _check_options(args: argparse.Namespace) -> None:
    """Raise ValueError for options that only grids have, and for tensors without --metric."""
    if args.others:
        raise ValueError(f"FILE: got {1 + len(args.others)} files; expected one mesh")
    of_grids = ["slice", "through", "view", "save_pairs", "components", "method"]
    if not args.tensors:  # with --tensors, the options for reading refer to the volume
        of_grids += [name for name in defaults(add_reading) if name not in (*OF_TENSORS, "array")]
    refuse(args, of_grids, "this option is for tensors on a grid; leave it out for a mesh")
    check_boundary(args.boundary)
    if not (args.array or args.tensors):
        why = "this option needs tensors, but without --array and --tensors a mesh has the Euclidean metric"
        refuse(args, OF_TENSORS, f"{why}. Pass --array or --tensors, or leave this option out")
        refuse(args, ("noise",), NO_NOISE)
    elif args.metric is None and args.operator != "fick":
        raise ValueError(
            "--metric: the tensors of the mesh need a metric. Choose inverse, tensor or adjugate, or pass "
            "--operator fick"
        )
    require_one(args)


def check_boundary(boundary: BoundarySpec | None) -> None:
    """Raise ValueError for a boundary condition that meshes do not have."""
    if boundary not in (None, *MESH_BOUNDARIES):
        raise ValueError(f"--boundary: got {boundary!r}; expected {', '.join(MESH_BOUNDARIES)} for a mesh")


def _read_domain(
    file: Path,
    volume: TensorVolume | None,
    progress: Progress,
    *,
    dtype: Literal["float32", "float64"],
    clean: bool,
    inside: Path | None,
    array: str | None,
    order: Order | None,
    metric: MetricChoice | None,
    operator: OperatorChoice,
    interpolation: Interpolation,
) -> Domain:
    """Read a mesh in the chosen precision, with the metric of tensors in a volume or in an array of its file, if any.

    Without tensors, the mesh has the Euclidean metric. The arguments have the names of the options, except for the
    volume of ``--tensors``.
    """
    use_dtype(dtype)
    mesh = read_mesh(file, clean=clean, in_space=volume is not None)
    vertices, cells = np.asarray(mesh.vertices).astype(dtype), mesh.triangulation.cells
    kind: Any = type(mesh)
    mask = None if inside is None else _inside(inside, len(vertices))
    if mask is not None:
        try:
            kind(vertices, cells, mask=mask)
        except ValueError as error:
            raise ValueError(f"--inside: {str(error).removeprefix('mask: ')}") from error

    def domain(tensors: Any, at: str = "vertices") -> Mesh:
        settings: Any = {"at": at, "interpolation": interpolation, "mask": mask}
        made: Mesh = kind.from_tensors(vertices, cells, tensors, metric, operator=operator, **settings)
        return made

    if volume is not None:
        at = np.arange(len(vertices)) if mask is None else np.flatnonzero(mask)

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
            return domain(tensors)

        return Domain(sampled(volume.tensors), volume.tensors, volume, sampled)
    arrays = arrays_by_place(file, clean)
    if not array:
        for each in (each for each in listed(arrays) if each["components"] in (6, 9)):
            progress.note(
                f"the {each['components']} components of {each['name']} at the {each['at']} are not used, and the mesh "
                f"has the Euclidean metric. To use them, pass --array {each['name']}"
                + " and --order"
                * (each["components"] == 6)
            )
        return Domain(kind(vertices, cells, mask=mask), None, None, None)
    places = [at for at, there in arrays.items() if array in there]
    if not places:
        there = "; ".join(f"at the {at}: {', '.join(named) or 'none'}" for at, named in arrays.items())
        raise ValueError(f"--array: got {array!r}; expected one of the arrays {there}")
    if len(places) > 1:
        progress.note(f"--array: {array} is at the {' and at the '.join(places)}; the {places[0]} are used")
    values = arrays[places[0]][array]
    values = values.reshape(len(values), -1)
    if values.shape[1] != (9 if order is None else 6):
        n = values.shape[1]
        raise ValueError(f"--array: got {array!r} with {n} components; expected 9, or 6 with --order")
    tensors = matrices(array, values, order).tensors.astype(dtype)
    of_tensors = partial(domain, at=places[0])
    return Domain(of_tensors(tensors), tensors, None, of_tensors)


def _inside(path: Path, n_vertices: int) -> Bool[np.ndarray, " V"]:
    if path.suffix != ".label":
        return read_mask(path)
    numbers = optional("nibabel.freesurfer").read_label(path)
    if numbers.size == 0 or numbers.min() < 0 or numbers.max() >= n_vertices:
        raise ValueError(f"--inside: got {numbers.size} vertices in {path}; expected indices 0 … {n_vertices - 1}")
    return np.isin(np.arange(n_vertices), numbers)
