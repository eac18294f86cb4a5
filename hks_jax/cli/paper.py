"""``hks-jax paper``: the tables and figures of Zobel, Reininghaus and Hotz, reproduced."""

import argparse
from pathlib import Path
from typing import Any

from hks_jax.cli.progress import Progress


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "paper",
        help="reproduce the paper's table and figures",
        description="Reproduce Table 1 and Figures 1 to 6 of Zobel, Reininghaus and Hotz: a CSV and PNG pictures.",
    )
    add = parser.add_argument
    add("-o", "--output", metavar="OUT", type=Path, default=Path("paper"), help="folder for the results (paper)")
    add("--full", action="store_true", help="the paper's own sizes: minutes instead of seconds")
    add("--only", nargs="+", metavar="NAME", help="only these, such as: table1 figure3")
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand."""
    from hks_jax.cli.job import use_dtype
    from hks_jax.cli.outputs import check_folder

    check_folder(args.output)
    use_dtype("float64")
    from hks_jax import paper

    progress = Progress(args.quiet)
    with progress.catching_warnings():
        paper.run(args.output, args.full, args.only, progress.note)
    if not args.quiet:
        print(args.output)
