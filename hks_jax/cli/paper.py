"""Reproduce the paper's table and figures.

Reproduce Table 1 and Figures 1 to 6 of Zobel, Reininghaus and Hotz as tables and PNG pictures, and count the triangles
that a remark in the paper mentions.

examples:
  hks-jax paper
  hks-jax paper --full --only table1 figure3 -o paper-full
"""

import argparse

from hks_jax.cli.computation import use_dtype
from hks_jax.cli.outputs import Done, versions
from hks_jax.cli.progress import Progress

OPTIONS = """
-o,--output OUT = paper  folder for the results
--full  use the sizes of the paper, which takes minutes instead of seconds
--only NAME...  reproduce only these, such as: table1 figure3
"""


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    use_dtype("float64")
    from hks_jax import paper

    files = paper.run(args.output, args.full, args.only, progress.note)
    return Done(files, {"full": args.full, "versions": versions()}, str(args.output))
