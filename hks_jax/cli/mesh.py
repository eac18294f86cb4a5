"""``hks-jax hks`` on a mesh: what of the options applies, the domain, and the picture."""

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.cli.job import use_dtype
from hks_jax.cli.options import READING, options_in, refuse
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import read
from hks_jax.cli.result import Result
from hks_jax.domain.simplices import WORDS
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.surface_mesh import SurfaceMesh
from hks_jax.domain.tet_mesh import TetMesh
from hks_jax.fem.assembly import MESH_BOUNDARIES
from hks_jax.io import read_mesh, read_mesh_arrays, sample_tensors
from hks_jax.io.mesh import WRITTEN
from hks_jax.io.repair import require_valid
from hks_jax.io.tensor_order import unpack
from hks_jax.io.volume import digest
from hks_jax.plot import new_figure, number_text, save_figure, surface

_OF_TENSORS = ("metric", "order", "interpolation")
"""Options that are about the tensors at a mesh's vertices."""


def check_options(args: argparse.Namespace) -> None:
    """Raise ValueError for options that are for grids alone, and for tensors of which the metric is open."""
    if args.tensors and args.array:
        raise ValueError("--tensors, --array: got both; tensors come from a volume, or from the mesh's own vertices")
    of_grids = ["slice", "through", "view", "save_pairs", "components", "method"]
    if not args.tensors:  # they are about the volume in which the mesh lies
        options = options_in(READING)
        of_grids += [option.name for option in options if option.name not in (*_OF_TENSORS, "array")]
    refuse(args, of_grids, "it is for tensors on a grid; leave it out for a mesh")
    if args.boundary not in (None, *MESH_BOUNDARIES):
        raise ValueError(f"--boundary: got {args.boundary!r}; a mesh takes one of {', '.join(MESH_BOUNDARIES)}")
    if not (args.array or args.tensors):
        why = (
            "a mesh has the metric of space unless --array names tensors at its vertices, or --tensors a volume of them"
        )
        refuse(args, _OF_TENSORS, f"{why}; pass both, or neither")
    elif args.metric is None:
        raise ValueError("--metric: choose what the tensors at the vertices stand for: inverse, tensor or adjugate")


def read_domain(args: argparse.Namespace, progress: Progress) -> SurfaceMesh | TetMesh:
    """Read the mesh, with the metric of the tensors at its vertices if they are asked for, in the precision asked for.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that is no mesh, or whose tensors make no metric.
    """
    use_dtype(args.dtype)
    mesh = read_mesh(args.file, clean=args.clean, in_space=bool(args.tensors))
    vertices, cells = np.asarray(mesh.vertices).astype(args.dtype), mesh.triangulation.cells
    kind: Any = type(mesh)
    if args.tensors:
        volume = read(argparse.Namespace(**vars(args) | {"file": args.tensors}), progress)
        require_valid(volume, "--repair")
        tensors = sample_tensors(volume, mesh.vertices).astype(args.dtype)
    elif args.array:
        tensors = _tensors(args).astype(args.dtype)
    else:
        return kind(vertices, cells)
    return kind.from_tensors(vertices, cells, tensors, args.metric, at="vertices", interpolation=args.interpolation)


def _tensors(args: argparse.Namespace) -> Float[np.ndarray, "V 3 3"]:
    arrays = read_mesh_arrays(args.file, clean=args.clean)
    if args.array not in arrays:
        there = ", ".join(arrays) or "none"
        raise ValueError(f"--array: got {args.array!r}; the arrays at the vertices are {there}")
    values = arrays[args.array].reshape(len(arrays[args.array]), -1)
    if values.shape[1] == 6 and args.order is not None:
        return unpack(values, args.order)
    if values.shape[1] != 9 or args.order is not None:
        raise ValueError(
            f"--array: {args.array!r} has {values.shape[1]} components; expected nine, or six with their --order"
        )
    return values.reshape(-1, 3, 3)


def describe_mesh(path: Path, mesh: SimplicialMesh) -> dict[str, Any]:
    """Return what a report says of a mesh."""
    triangulation = mesh.triangulation
    return {
        "source": str(path),
        "sha256": digest(path),
        "vertices": triangulation.n_vertices,
        WORDS[triangulation.dimension].simplices: len(triangulation.cells),
        "boundary_vertices": int(triangulation.boundary_vertices.sum()),
        "components": triangulation.labels[1],
    }


def mesh_suffix(path: Path, mesh: SimplicialMesh) -> str:
    """Return the format for values at the vertices: the file's own, if it has room for them."""
    suffix = path.suffix.lower()
    return suffix if suffix in WRITTEN and not (suffix == ".ply" and isinstance(mesh, TetMesh)) else ".vtu"


def draw(result: Result, path: Path) -> None:
    """Draw the signature on the surface, or on the solid's boundary, once for each time with its own colours."""
    mesh, times = result.place, result.times
    assert isinstance(mesh, SurfaceMesh | TetMesh)
    columns = min(len(times), 4)
    rows = math.ceil(len(times) / columns)
    figure = new_figure(3.4 * columns, 3.0 * rows)
    for i, (time, values) in enumerate(zip(times, result.values, strict=True)):
        ax = figure.add_subplot(rows, columns, i + 1, projection="3d")
        mappable = surface(ax, mesh, values)
        ax.set_title(f"t = {number_text(float(time))}", fontsize="medium")
        figure.colorbar(mappable, ax=ax, shrink=0.6)
    save_figure(figure, path)
