"""Read the domain, or the saved eigenpairs, of commands that need eigenpairs."""

import argparse
from pathlib import Path
from typing import NamedTuple

from hks_jax.cli.combinations import Kind, require_fitting
from hks_jax.cli.computation import OfMesh, OfVolume, Settings, Solved
from hks_jax.cli.meshes import MeshFile, read_domain
from hks_jax.cli.pairs import is_saved_pairs, read_pairs
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, read_grid
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.io.mesh import is_mesh


class Source(NamedTuple):
    """A domain, the settings, and the eigenpairs if the file has them."""

    domain: OfVolume | OfMesh
    settings: Settings
    saved: Solved | None = None


def read_source(args: argparse.Namespace, progress: Progress, boundary: BoundarySpec | None = None) -> Source:
    """Read a mesh, the tensors of a volume, or saved eigenpairs; raise ValueError for options that do not fit.

    Without the option ``--boundary``, the condition is `boundary`.
    """
    if args.boundary is not None:
        boundary = args.boundary
    kind = _kind_of(args.file, args.others)
    require_fitting(args, kind)
    if kind == "mesh":
        settings = Settings.of(args, metric=args.metric, boundary=boundary)
        return Source(read_domain(MeshFile.of(args, args.file), settings, progress), settings)
    settings = Settings.of(args, boundary=boundary)
    if kind == "pairs":
        saved = read_pairs(args.file, settings, progress)
        return Source(saved.domain, saved.settings, saved)
    return Source(read_grid(Reading.of(args), settings, progress), settings)


def _kind_of(file: Path, others: list[Path]) -> Kind:
    if is_mesh(file):
        return "mesh"
    return "pairs" if not others and is_saved_pairs(file) else "tensors"
