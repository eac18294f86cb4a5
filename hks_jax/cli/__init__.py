"""Heat kernel signatures of tensor fields.

examples:
  hks-jax demo
  hks-jax info tensor.nii.gz
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse
  hks-jax modes tensor.nii.gz -o out --operator fick --map bold.nii.gz
  hks-jax batch subjects.tsv -o study --metric inverse --atlas atlas.nii.gz
  hks-jax bids derivatives/qsirecon out participant --participant-label 01 --metric inverse
  hks-jax hks --help
"""

# The command line reports an error as one line on stderr and as an exit code.

import _thread
import argparse
import io
import os
import re
import sys
import threading
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NoReturn

import jax
import numpy as np

from hks_jax import __version__
from hks_jax.cache import keep_compiled
from hks_jax.cli import convert, curvature, demo, explore, fit, hks, info, modes, plot, smooth, spectrum, stats
from hks_jax.cli.computation import INPUT_ERRORS
from hks_jax.cli.inputs import require_inputs_kept
from hks_jax.cli.options import COLUMNS, FILES, add_common, of_arguments
from hks_jax.cli.outputs import show
from hks_jax.cli.progress import Progress
from hks_jax.cli.study import batch, bids
from hks_jax.io.formats import WRITTEN
from hks_jax.io.mesh import READ as MESHES
from hks_jax.naming import named_as_options, with_option

COMMANDS = (hks, modes, smooth, spectrum, curvature, fit, batch, bids, stats, plot, explore, info, convert, demo)
"""A module for each command: its docstring is the help text, `add_options` adds its options, and `run` runs it.

`USAGE` has the required arguments. The function `writes` of commands with input files returns the files that the
command may write.
"""
_LISTS = {"meshes": MESHES, "written": WRITTEN, "files": FILES, "columns": COLUMNS}
"""Lists that a module's docstring may name in braces."""

BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130


class Parser(argparse.ArgumentParser):
    """An argument parser that reports an error in one line."""

    def error(self, message: str) -> NoReturn:
        """Print the error and end with the exit code for bad input."""
        self.exit(BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    raw = argparse.RawDescriptionHelpFormatter
    description, _, examples = (__doc__ or "").partition("\n\n")
    parser = Parser(prog="hks-jax", description=description, epilog=examples, formatter_class=raw)
    parser.add_argument("--version", action="version", version=f"hks-jax {__version__}")
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for command in COMMANDS:
        _add_command(subparsers, command)
    return parser


def _add_command(subparsers: Any, command: ModuleType) -> None:
    """Add the parser of a command."""
    lists = {name: ", ".join(words) for name, words in _LISTS.items()}
    summary, _, text = (command.__doc__ or "").format(**lists).partition("\n\n")
    description, *examples = re.split(r"\n(?=examples?:)", text)
    parser: argparse.ArgumentParser = subparsers.add_parser(
        command.__name__.rpartition(".")[2],
        help=summary[:1].lower() + summary[1:].rstrip("."),
        usage=" ".join(filter(None, ("%(prog)s", command.USAGE, "[options]"))),
        description=description,
        epilog="".join(examples),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    # A word that begins with a minus and a digit is a point, such as -20,35, and not an option.
    parser._negative_number_matcher = re.compile(r"-[\d.]")
    command.add_options(parser)
    add_common(parser)
    parser.set_defaults(run=command.run, command=command, prog=parser.prog)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code: 0 success, 1 failed computation, 2 bad input, 130 interrupt.

    Results are written atomically and together at the end, so a failed command writes no file, except for the files of
    `batch` and `bids`, the checkpoints of `fit` and `hks`, and the eigenpairs of `hks`. Pictures are drawn after the
    results are written. No command replaces its input.
    """
    argv, parser = sys.argv[1:] if argv is None else argv, build_parser()
    if not argv:
        parser.print_help(sys.stderr)
        return BAD_INPUT
    try:
        args, unknown = parser.parse_known_args(argv)
        if unknown:
            Parser(prog=args.prog).error(f"unrecognized arguments: {' '.join(unknown)}")
    except SystemExit as stop:  # argparse has printed the message
        return int(stop.code or 0)
    with named_as_options(of_arguments(args)):
        return _run(args)


def _run(args: argparse.Namespace) -> int:
    progress = Progress(args.quiet)
    try:
        if args.no_cache:
            jax.config.update("jax_enable_compilation_cache", False)
        else:
            keep_compiled()
        require_inputs_kept(args)
        with progress.catching_warnings():
            done = args.run(args, progress)
        if done is not None:
            show(args, done)
    except KeyboardInterrupt:
        return _fail(args, "interrupted", INTERRUPTED)
    except np.linalg.LinAlgError as error:
        return _fail(args, str(error), FAILED, error)
    except INPUT_ERRORS as error:
        return _fail(args, with_option(str(error)), BAD_INPUT, error)
    except Exception as error:
        return _fail(args, f"{type(error).__name__}: {error}", FAILED, error)
    return 0


def run_and_exit() -> NoReturn:
    """Run the command line as a program.

    JAX's threads continue after an interrupt, and Python would crash while stopping them, so the process ends at once.
    """
    sys.unraisablehook = _interrupt_again
    if isinstance(sys.stdout, io.TextIOWrapper):  # its encoding, such as Windows' for files, may lack λ or …
        sys.stdout.reconfigure(errors="backslashreplace")
    code = main()
    if code == INTERRUPTED:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _interrupt_again(unraisable: Any) -> None:
    # Python discards an interrupt (Ctrl-C) within a finaliser or a callback of the garbage collector, such as JAX's.
    # The timer raises the interrupt again after the callback has ended.
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        threading.Timer(0.05, _thread.interrupt_main).start()
    else:
        sys.__unraisablehook__(unraisable)


def _fail(args: argparse.Namespace, message: str, code: int, error: Exception | None = None) -> int:
    if args.debug and error is not None:
        raise error
    print(f"{args.prog}: error: {' '.join(message.split())}", file=sys.stderr)
    return code
