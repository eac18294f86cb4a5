"""Command line of the stress runs."""

import argparse
import json
import sys
import warnings
from importlib import import_module
from pathlib import Path

import jax

from benchmarks.machine import write

from .harness import Tally, run, seeds

KINDS = (
    "eigenproblems",
    "matrices",
    "reference",
    "precision",
    "gradients",
    "counts",
    "estimates",
    "statistics",
    "geometry",
    "fits",
    "files",
    "spaces",
    "dirty",
    "modes",
    "hang",
)


def main() -> int:
    """Run the kinds that are named; return 1 if anything failed."""
    program = "PYTHONPATH=tests python -m stress"
    parser = argparse.ArgumentParser(prog=program, description=sys.modules[__package__].__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)} (default: all)")
    parser.add_argument("--seed", type=int, help="one seed alone: the reproducer of a failure")
    parser.add_argument("--first", type=int, default=0, help="the seed to begin with")
    parser.add_argument("--number", type=int, help="how many seeds of each kind (default: as time allows)")
    parser.add_argument("--minutes", type=float, default=4.5, help="time for each kind")
    parser.add_argument("--json", type=Path, help="file to keep the counts in")
    arguments = parser.parse_args()
    if unknown := set(arguments.kinds) - set(KINDS):
        parser.error(f"unknown kinds: {', '.join(sorted(unknown))}")
    jax.config.update("jax_enable_x64", True)
    # What was compiled for some seeds serves others.
    jax.config.update("jax_compilation_cache_dir", str(Path.cwd() / ".pytest_cache" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    warnings.simplefilter("always")
    tallies = {}
    for kind in arguments.kinds or KINDS:
        check = import_module(f".{kind}", __package__).check
        chosen = iter([arguments.seed]) if arguments.seed is not None else seeds(arguments.first, arguments.number)
        tally = run(kind, check, chosen, 60 * arguments.minutes, lambda text: print(text, flush=True))
        print(f"{kind}: {tally.outcomes.total()} checks, {dict(tally.outcomes)}, {tally.seconds:.0f} s", flush=True)
        tallies[kind] = tally
    if arguments.json:
        keep(arguments.json, tallies)
    return any(tally.failures for tally in tallies.values())


def keep(path: Path, tallies: dict[str, Tally]) -> None:
    """Write counts and failures of a run, beside what the file has of other kinds."""
    before = json.loads(path.read_text()) if path.exists() else {"rows": [], "failures": []}
    rows = [row for row in before["rows"] if row["kind"] not in tallies]
    failures = [text for text in before["failures"] if text.split()[0] not in tallies]
    rows += [tally.row(kind) for kind, tally in tallies.items()]
    failures += [text for tally in tallies.values() for text in tally.failures]
    write(path, sorted(rows, key=lambda row: KINDS.index(row["kind"])), failures=failures)


if __name__ == "__main__":
    sys.exit(main())
