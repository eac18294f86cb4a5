"""Read the domain, or the saved eigenpairs, of commands that need eigenpairs."""

import argparse
from typing import NamedTuple

from hks_jax.cli import pairs as saved_pairs
from hks_jax.cli.computation import OfMesh, OfVolume, Settings, Solved, domain_of_volume
from hks_jax.cli.meshes import NO_NOISE, MeshFile, read_domain, require_mesh_options
from hks_jax.cli.options import add_metric, add_reading, add_solving, defaults, refuse
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, read_volume
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.io.formats import format_of
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
    if is_mesh(args.file):
        require_mesh_options(args)
        settings = Settings.of(args, metric=args.metric, boundary=boundary)
        return Source(read_domain(MeshFile.of(args, args.file), settings, progress), settings)
    saved_before = not args.others and saved_pairs.is_saved_pairs(args.file)
    refuse(args, ("clean", "inside"), "this option is for meshes; for tensors on a grid, see --repair and --mask")
    refuse(args, ("tensors",), "this option is for a mesh inside a volume; leave it out for the volume itself")
    if saved_before:
        refuse(args, ("noise",), NO_NOISE)
        why = f"the eigenpairs in {args.file} determine this setting; leave the option out"
        refuse(args, (*defaults(add_metric, add_reading, add_solving), "save_pairs"), why)
    settings = Settings.of(args, boundary=boundary)
    if saved_before:
        saved = saved_pairs.read_pairs(args.file, settings, progress)
        return Source(saved.domain, saved.settings, saved)
    volume = read_volume(Reading.of(args), progress)
    image = format_of(args.file).image
    return Source(domain_of_volume(volume, settings, image), settings)
