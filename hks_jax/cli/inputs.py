"""Refuse outputs of a command that would replace its input files."""

import argparse
from collections.abc import Iterator
from contextlib import suppress
from fnmatch import fnmatchcase
from pathlib import Path

from hks_jax.cli.options import flag
from hks_jax.cli.reading import Reading
from hks_jax.io.masks import names_beside
from hks_jax.io.result import signature_file

INPUTS = (
    *("file", "result", "subjects", "target", "bval", "bvec", "mask", "tensors", "mesh", "inside", "map", "init"),
    *("anatomy", "labels", "atlas", "names", "checkpoint"),
)
"""The options whose values are input files."""


def _inputs(args: argparse.Namespace) -> Iterator[tuple[str, Path]]:
    """Yield the options and the paths of the existing input files of a command."""
    given = vars(args)
    for name in INPUTS:
        path = given.get(name)
        if path is not None:
            yield flag(name), signature_file(path)
    implied = [*given.get("others", ())]
    implied += [names_beside(given[name]) for name in ("atlas", "labels") if given.get(name) is not None]
    with suppress(Exception):  # reading reports missing and damaged files
        implied += [path for paths in Reading.of(args).files.values() for path in paths]
    yield from (("FILE", Path(path)) for path in implied if path is not None)


def require_inputs_kept(args: argparse.Namespace) -> None:
    """Raise ValueError if a command would replace one of its input files.

    The function `writes` of the command's module returns the paths that the command may write. Their last parts may be
    patterns, and the part ``**`` means all folders below.
    """
    written: list[Path] = args.command.writes(args) if hasattr(args.command, "writes") else []
    for option, path in _inputs(args):
        for output in written:
            if not (option == "--checkpoint" and output == path) and _replaces(output, path):
                raise ValueError(
                    f"{path}: this input file would be replaced by the output {output}. Choose another output"
                )


def _replaces(output: Path, path: Path) -> bool:
    if not path.exists():
        return False
    if output.exists() and output.samefile(path):
        return True
    below = output.parent.name == "**"
    folder = (output.parent.parent if below else output.parent).resolve()
    for place in (path.parent.resolve() / path.name, path.resolve()):
        inside = place.is_relative_to(folder) if below else place.parent == folder
        if inside and (place.name == output.name or fnmatchcase(place.name, output.name)):
            return True
    return False
