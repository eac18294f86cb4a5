"""``hks-jax stats OUT --atlas LABELS``: the statistics of a signature over the regions of a label map."""

import argparse
from pathlib import Path
from typing import Any

from hks_jax.cli.inputs import add_command, add_json_argument
from hks_jax.cli.outputs import check_folder, show_summary, signature_file
from hks_jax.cli.progress import Progress
from hks_jax.cli.regions import region_table
from hks_jax.io.tables import write_table

DESCRIPTION = """\
Write a table of regions: for each label of an image, and each t of the signature that 'hks-jax hks' has left in the
folder OUT, the mean, the standard deviation and the median over the region's voxels; with the region's volume, and the
share of it that is in the domain. The labels are in the image's own space: where their affine places them on other
voxels they are refused.
"""

EPILOG = """\
examples:
  hks-jax stats out --atlas sub-01_dseg.nii.gz
  hks-jax stats out --atlas aparc+aseg.nii.gz --names FreeSurferColorLUT.txt -o regions.tsv

Of many subjects, 'hks-jax batch --atlas' writes all tables and joins them.
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser = add_command(
        subparsers, "stats", "write a table of regions' means over the labels of an atlas", DESCRIPTION, EPILOG
    )
    add = parser.add_argument
    add("result", metavar="OUT", type=Path, help="the folder that 'hks-jax hks' wrote, or an .npz from there")
    add("-o", "--output", metavar="TABLE", type=Path, help="the table (default: regions.tsv in OUT)")
    add_atlas_arguments(parser, required=True)
    add_json_argument(parser)
    return parser


def add_atlas_arguments(parser: argparse.ArgumentParser, required: bool) -> None:
    """Add the arguments that say which regions there are."""
    add = parser.add_argument
    add(
        "--atlas",
        metavar="FILE",
        type=Path,
        required=required,
        help="labels on the voxels of the image, whole numbers, 0 for none: NIfTI, or .npy of the image's shape",
    )
    add(
        "--names",
        metavar="FILE",
        type=Path,
        help="names of the labels: a table with the columns index and name, or lines of a number and a name, such as "
        "FreeSurfer's (default: the .tsv of the same name beside the labels, if it is there)",
    )


def run(args: argparse.Namespace) -> None:
    """Run the subcommand.

    Raises:
        FileNotFoundError: no such result, labels or names.
        ValueError: a result that has no regions, or labels that do not fit it.
    """

    source = signature_file(args.result)
    table = source.with_name("regions.tsv") if args.output is None else args.output
    if table.suffix.lower() != ".tsv":
        raise ValueError(f"--output: got {table}; expected a name that ends in .tsv")
    check_folder(table.parent)
    progress = Progress(args.quiet)
    with progress.catching_warnings(), progress.stage("regions", f"{args.atlas} on {source}"):
        columns, rows, about = region_table(source, args.atlas, args.names, progress)
        files = write_table(table, columns, rows, about)
    show_summary(args, files, {"source": str(source), "regions": list(dict.fromkeys(row[1] for row in rows))})
