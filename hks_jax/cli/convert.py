"""``hks-jax convert FILE OUT``: tensors from any format that is read to any that is written."""

import argparse
import sys
from pathlib import Path
from typing import Any

from hks_jax.cli.inputs import add_command, add_json_argument
from hks_jax.cli.job import describe_input
from hks_jax.cli.outputs import show_summary
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import add_arguments, read
from hks_jax.io import find_invalid, save_tensors
from hks_jax.io.formats import WRITTEN

DESCRIPTION = f"""\
Read tensors from FILE, or fit them to diffusion-weighted images, and write them to OUT in the format of its suffix:
{", ".join(WRITTEN)}. Components are turned to the axes that the format has them in, which OUT says itself:
it needs neither --order nor --frame. Numbers are converted only from the unit that --unit says, to mm2/s.
"""

EPILOG = """\
examples:
  hks-jax convert dti.nrrd tensor.nii.gz
  hks-jax convert dti_tensor.nii.gz tensor.vti --order fsl --mask mask.nii.gz --repair nearest
  hks-jax convert dwi.nii.gz tensor.nii.gz --bval dwi.bval --bvec dwi.bvec --b-max 1000
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser = add_command(
        subparsers, "convert", "write the tensors of a file in another format", DESCRIPTION, EPILOG, "FILE OUT"
    )
    add_arguments(parser)
    parser.add_argument("output", metavar="OUT", type=Path, help="the file to write; an existing one is replaced")
    add_json_argument(parser)
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand."""
    if not args.output.name.lower().endswith(WRITTEN):
        raise ValueError(f"OUT: got {args.output}; expected a name that ends in {', '.join(WRITTEN)}")
    if args.output.is_dir():
        raise IsADirectoryError(f"OUT: {args.output} is a folder; expected a file")
    if args.output.exists() and args.output.samefile(args.file):
        raise ValueError(f"OUT: {args.output} is FILE itself; choose another name")
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        with progress.stage("reading", str(args.file)):
            volume = read(args, progress)
        invalid = int(find_invalid(volume).sum())
        if invalid:
            progress.warn(f"{invalid} tensors are not positive definite and are written as they are; see --repair")
        with progress.stage("writing", str(args.output)):
            save_tensors(args.output, volume, provenance={"command": sys.argv, "repair": dict(volume.repair) or None})

    show_summary(args, [args.output], {**describe_input(volume, volume.mask), "not_positive_definite": invalid})
