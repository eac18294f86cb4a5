"""The settings of a study: those that it keeps, omitted options, and times that suit all subjects."""

import argparse
import io
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hks_jax.cli import options
from hks_jax.cli.computation import Settings
from hks_jax.cli.info import describe
from hks_jax.cli.options import FILES, defaults, flag
from hks_jax.cli.parsing import Times
from hks_jax.cli.progress import StudyProgress
from hks_jax.cli.reading import Reading, read_volume
from hks_jax.cli.study.folder import DESCRIPTIONS, Study, reading_options
from hks_jax.cli.study.subjects import Subject
from hks_jax.io import TensorVolume
from hks_jax.io.bids import are_entities
from hks_jax.io.json_files import read_json, tuples
from hks_jax.io.volume import digest
from hks_jax.signatures.spans import SHORTEST
from hks_jax.signatures.times import LAST

ENTITIES = ("select", "mask", "atlas")
"""Options that may select files by BIDS entities, and which a study keeps beside its settings."""
_STYLE = ("view", "show_rim")
"""The options of pictures."""
OUTPUT = (*_STYLE, "save_pairs")
"""Options that a study keeps, and that change no signature."""


def add_kept(parser: argparse.ArgumentParser) -> None:
    """Add the options that a study keeps."""
    options.add_metric(parser)
    options.add_reading(parser)
    options.add_solving(parser)
    options.add_signature(parser)
    options.add_noise(parser)
    parser.add_argument(
        "--time-unit",
        choices=("scanner", "lambda1"),
        default="scanner",
        help="unit of --times: scanner, for the same t for all subjects, in seconds for D in mm²/s with the metric "
        "D⁻¹ or Fick's operator (default); or lambda1, for the same product λ₁t, so that the given numbers are "
        "divided by each subject's first positive eigenvalue λ₁. Automatic times are log-spaced over the range that "
        "suits all subjects, and the study keeps them",
    )
    options.add_view(parser)
    options.add_rim(parser)
    parser.add_argument(
        "--save-pairs",
        action="store_true",
        help="save the eigenpairs of each subject, which other --times, --normalisation or --method then reuse",
    )


DEFAULTS = dict.fromkeys(name for name in defaults(add_kept) if name not in FILES)
"""The options that a study keeps, with the default None, by which omitted options are recognised."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that commands on several subjects share."""
    add_kept(parser)
    parser.set_defaults(**DEFAULTS)
    options.add_atlas(parser)
    options.add_names(parser)


def complete(args: argparse.Namespace) -> str:
    """Replace omitted options by options of the study in the folder or by defaults; return a note about them."""
    args.strict_unit = True  # subjects with different units cannot be compared
    before = {} if args.replace else read_json(args.output / "study.json")
    kept, taken = _options(before), []
    if args.operator == "fick":  # a given operator replaces the study's metric, and a given metric its operator
        kept.pop("metric", None)
    elif args.metric is not None:
        kept.pop("operator", None)
    for name, path in before.get("files", {}).items():
        if getattr(args, name, "") is None:
            setattr(args, name, Path(path))
            taken.append(f"{flag(name)} {path}")
    # Comparable subjects need the same boundary condition, with or without a mask.
    usual = {**defaults(add_kept), "boundary": "mean"}
    for name in DEFAULTS:
        if getattr(args, name) is None:
            value = kept.get(name, usual[name])
            setattr(args, name, [_spelled(name, value)] if name == "times" and value else value)
            if value != usual[name] or (name == "boundary" and not before):
                taken.append(flag(name) if value is True else f"{flag(name)} {_spelled(name, value)}")
    origin = f"of the study in {args.output}" if before else "for all subjects"
    return f"options {origin}: {', '.join(taken) or 'as given, or the defaults'}"


def _options(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options in the record of a study, with names as in Python and tuples in place of lists."""
    if not record:
        return {}
    times = record["times"] if record["chosen"] == "explicit" else record["chosen"]
    options = {"times": times, "time_unit": record["time-unit"], "operator": "laplace-beltrami"}
    options |= {**record["settings"], **record["reading"], **record.get("output", {})}
    return {name.replace("-", "_"): tuples(value) for name, value in options.items()}


def _spelled(name: str, value: Any) -> str:
    """Return the value of an option as on the command line."""
    if not isinstance(value, tuple):
        return "unset" if value is None else str(value)
    parts = [":".join(each) if isinstance(each, tuple) else str(each) for each in value if each is not None]
    return {"slice": "=", "repair": ":", "positive": ":"}.get(name, ",").join(parts)


def open_study(args: argparse.Namespace, subjects: Callable[[], list[Subject]], progress: StudyProgress) -> Study:
    """Return the study with explicit times and write its description; raise ValueError if there is another study.

    The function `subjects` returns all subjects, which a new study with automatic times reads.
    """
    there = [name for name in DESCRIPTIONS if (args.output / name).exists()]
    if there and "study.json" not in there:
        raise ValueError(
            f"--output: got {args.output}, where another program wrote {', '.join(there)}; expected a new folder or a "
            f"study. Choose a folder such as {args.output / 'derivatives' / 'hks-jax'}"
        )
    given = {name: path for name in ("select", *FILES) if (path := getattr(args, name, None)) is not None}
    files = {
        n: str(path if n in ENTITIES and are_entities(str(path)) else path.absolute()) for n, path in given.items()
    }
    output = {name: getattr(args, name) for name in OUTPUT}
    study = Study(args.output, Settings.of(args), args.time_unit, reading_options(args, True), output, files)
    times = study.settings.times
    before, chosen = read_json(args.output / "study.json"), "explicit" if times.explicit else f"auto:{times.automatic}"
    now, then = _options({**study.record, "chosen": chosen}), _options(before)
    if before:  # an older version may have kept fewer options
        then = {**defaults(add_kept), **then} | ({"times": tuples(before["times"])} if times.explicit else {})
    changed = [name for name, value in now.items() if then.get(name) != value]
    style, changed = set(changed).intersection(_STYLE), [name for name in changed if name not in OUTPUT]
    earlier = before.get("files", {})
    names = dict.fromkeys(("mask", *earlier))
    other = [name for name in names if before and _is_other(name, earlier.get(name), files.get(name))]
    if before and (changed or other) and not args.replace:
        kept = "; ".join(
            [f"{flag(n)} {_spelled(n, then.get(n))}, not {_spelled(n, now[n])}" for n in changed]
            + [f"{flag(n)} {earlier.get(n, 'unset')}, not {files.get(n, 'unset')}" for n in other]
        )
        raise ValueError(
            f"--output: the study in {args.output} has {kept}. Leave these options out to continue the study, choose "
            "another folder, or pass --replace to compute the subjects of that study again"
        )
    if times.automatic:
        explicit = _suitable(args, times.automatic, subjects(), progress) if changed else tuple(before["times"])
        study = replace(study, settings=replace(study.settings, times=Times(explicit, 0)))
    if before and style:
        study.forget_pictures()
        progress.end(f"the pictures are drawn again for {' and '.join(sorted(map(flag, style)))}")
    study.write_description(chosen)
    return study


def _is_other(name: str, before: str | None, now: str | None) -> bool:
    """Return whether a file for all subjects is another than before; a file that was moved is not."""
    if name not in FILES or before == now:
        return False
    if before is None or now is None or are_entities(before) or are_entities(now):
        return True
    return Path(before).is_file() and Path(now).is_file() and digest(before) != digest(now)


def _suitable(
    args: argparse.Namespace, count: int, subjects: list[Subject], progress: StudyProgress
) -> tuple[float, ...]:
    """Read all subjects, and return times that suit them; ignore subjects that cannot be read."""
    if args.metric == "adjugate":
        raise ValueError("--times: automatic times in a study need inverse, tensor or --operator fick. Choose times")
    ranges: dict[str, Range] = {}
    first = ""
    silent = StudyProgress(1, True, io.StringIO())  # warnings are shown when the subject is computed
    for number, subject in enumerate(subjects, 1):
        progress.update(f"choosing times: {subject.name}, {number} of {len(subjects)}")
        try:
            ranges[subject.name] = suitable_range(read_volume(Reading.of(subject.args), silent), subject.args)
        except Exception as error:  # reported when the subject is computed
            first = first or f"{subject.name}: {error}"
    if not ranges:
        raise ValueError(f"--times: no subject can be read, so no times can be chosen. The first error: {first}")
    times = common_times(ranges, count, args.time_unit)
    progress.end(f"times that suit all subjects ({len(ranges)}): {', '.join(f'{t:g}' for t in times)}")
    return times


class Range(NamedTuple):
    """The times that suit a subject.

    Attributes:
        least: the least time by the voxel size and the number of eigenpairs.
        free: the time at which half of the voxels are free of the boundary.
        largest: the largest time by the domain's size, at which λ₁t is `LAST`.
    """

    least: float
    free: float
    largest: float


def suitable_range(volume: TensorVolume, args: argparse.Namespace) -> Range:
    """Estimate the range of times that suits a subject from its metric and its size, without eigenpairs."""
    metric = "inverse" if args.operator == "fick" else args.metric or "tensor"
    of: dict[str, Any] = describe(args.file, volume, args.boundary)["suits"][metric]
    by_pairs = of["least_time_of_k"] * (1.0 if args.k is None else of["k"] / args.k) ** (2 / volume.dimension)
    return Range(max(of["least_time"], by_pairs), of["largest_time"], of["time_by_size"])


def common_times(ranges: Mapping[str, Range], n: int, unit: str) -> tuple[float, ...]:
    """Return n log-spaced times, rounded to three digits, from the first time that is resolved for all subjects.

    The last time is the least time at which half of a subject's voxels are free of the boundary, but at least twice the
    first time. For the unit ``"lambda1"``, the function returns products λ₁t.
    """
    if unit == "lambda1":
        ranges = {name: Range(*(LAST * t / one.largest for t in one)) for name, one in ranges.items()}
    late, small = max(ranges, key=lambda s: ranges[s].least), min(ranges, key=lambda s: ranges[s].largest)
    least, largest = ranges[late].least, ranges[small].largest
    if least >= largest:
        raise ValueError(
            f"--times: no time suits all subjects: {late} resolves only t ≥ {least:.3g}, and the size of {small} "
            f"allows only t ≤ {largest:.3g}. Choose times, or more eigenpairs (-k). See 'hks-jax info' for {late}: "
            "tensors with eigenvalues near zero need many eigenpairs (--repair nearest:1e-4)"
        )
    end = min(largest, max(min(one.free for one in ranges.values()), SHORTEST * least))
    return tuple(float(f"{t:.3g}") for t in np.geomspace(least, end, n))
