"""What the command line says of itself, `--help` for `--help`."""

import argparse
import os
from functools import cache


@cache
def parsers() -> dict[str, argparse.ArgumentParser]:
    """Return the parser of every command."""
    os.environ["COLUMNS"] = "90"  # argparse wraps its help to it
    from hks_jax.cli import build_parser

    (subparsers,) = (a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return dict(subparsers.choices)


def reference(_: str) -> str:
    """Return a section for every command."""
    return "\n\n".join(f"## hks-jax {name}\n\n```text\n{parser.format_help()}```" for name, parser in parsers().items())
