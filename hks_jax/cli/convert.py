"""Write the tensors of a file in another format.

Read tensors from FILE, or fit them to diffusion-weighted images, and write them to OUT. The suffix of OUT determines
the format: {written}. OUT declares the order and the frame of its components, so reading it
needs neither --order nor --frame. With --unit, numbers are converted from that unit to mm2/s.

examples:
  hks-jax convert dti.nrrd tensor.nii.gz
  hks-jax convert dti_tensor.nii.gz tensor.vti --order fsl --mask mask.nii.gz --repair nearest
  hks-jax convert dwi.nii.gz tensor.nii.gz --bval dwi.bval --bvec dwi.bvec --b-max 1000
"""

import argparse
import sys
from pathlib import Path

from hks_jax.cli import options
from hks_jax.cli.computation import describe_input
from hks_jax.cli.outputs import Done
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, read
from hks_jax.io import save_tensors
from hks_jax.io.formats import WRITTEN
from hks_jax.io.repair import describe_invalid, invalid_in

USAGE = "FILE OUT"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_file(parser)
    options.add_reading(parser)
    parser.add_argument("output", type=Path, metavar="OUT", help="the file to write; an existing file is replaced")


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [args.output]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    if not args.output.name.lower().endswith(WRITTEN):
        raise ValueError(f"OUT: got {args.output}; expected a name that ends in {', '.join(WRITTEN)}")
    if args.output.is_dir():
        raise IsADirectoryError(f"OUT: got the folder {args.output}; expected a file")
    volume = read(Reading.of(args), progress)
    found = invalid_in(volume)
    if count := int(found.bad.sum()):
        progress.warn(f"{count} tensors are {describe_invalid(volume, found)}; written unchanged, see --repair")
    with progress.stage("writing", str(args.output)):
        save_tensors(args.output, volume, provenance={"command": sys.argv, "repair": dict(volume.repair) or None})
    return Done([args.output], {**describe_input(volume), "not_positive_definite": count})
