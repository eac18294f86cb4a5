"""Read the tensors of a volume or slice, or saved eigenpairs, from the options of commands that need eigenpairs."""

import argparse
from typing import NamedTuple

from hks_jax.cli import pairs as saved_pairs
from hks_jax.cli.computation import Settings, Solved
from hks_jax.cli.meshes import NO_NOISE
from hks_jax.cli.options import add_metric, add_reading, add_solving, defaults, refuse
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, read_volume
from hks_jax.io import TensorVolume
from hks_jax.io.formats import format_of


class Tensors(NamedTuple):
    """The tensors of a volume or slice, the suffix of image files, and their eigenpairs if the file has them."""

    volume: TensorVolume
    image: str
    saved: Solved | None


def tensors_of(args: argparse.Namespace, settings: Settings, progress: Progress) -> Tensors:
    """Read tensors, or saved eigenpairs; raise ValueError for options that do not concern them."""
    refuse(args, ("clean", "inside"), "this option is for meshes; for tensors on a grid, see --repair and --mask")
    refuse(args, ("tensors",), "this option is for a mesh inside a volume; leave it out for the volume itself")
    if args.others or not saved_pairs.is_saved_pairs(args.file):
        return Tensors(read_volume(Reading.of(args), progress), format_of(args.file).image, None)
    refuse(args, ("noise",), NO_NOISE)
    why = f"the eigenpairs in {args.file} determine this setting; leave the option out"
    refuse(args, (*defaults(add_metric, add_reading, add_solving), "save_pairs"), why)
    solved, image = saved_pairs.read_pairs(args.file, settings, progress)
    return Tensors(solved.volume, image, solved)
