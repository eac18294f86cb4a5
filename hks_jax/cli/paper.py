"""``hks-jax paper``: the tables and figures of Zobel, Reininghaus and Hotz, reproduced."""

import argparse
import json
from pathlib import Path
from typing import Any

from hks_jax.cli.inputs import add_command, add_json_argument
from hks_jax.cli.job import use_dtype
from hks_jax.cli.outputs import check_folder, plain, versions
from hks_jax.cli.progress import Progress

EPILOG = """\
examples:
  hks-jax paper
  hks-jax paper --full --only table1 figure3 -o paper-full
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser = add_command(
        subparsers,
        "paper",
        "reproduce the paper's table and figures",
        "Reproduce Table 1 and Figures 1 to 6 of Zobel, Reininghaus and Hotz, and count the triangles of a "
        "remark: tables and PNG pictures.",
        EPILOG,
    )
    add = parser.add_argument
    add("-o", "--output", metavar="OUT", type=Path, default=Path("paper"), help="folder for the results (paper)")
    add("--full", action="store_true", help="the paper's own sizes: minutes instead of seconds")
    add("--only", nargs="+", metavar="NAME", help="only these, such as: table1 figure3")
    add_json_argument(parser)
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand."""

    check_folder(args.output)
    use_dtype("float64")
    from hks_jax import paper

    progress = Progress(args.quiet)
    with progress.catching_warnings():
        files = paper.run(args.output, args.full, args.only, progress.note)
    if args.json:
        print(json.dumps(plain({"full": args.full, "versions": versions(), "files": [str(file) for file in files]})))
    elif not args.quiet:
        print(args.output)
