"""Compute the signatures of many subjects, and tables of their regions.

Compute the signatures of many subjects at the same times, and tables of their regions. SUBJECTS is a table (.tsv or
.csv) with a row for each subject and the columns

  participant_id   sub-01 or 01
  session_id       ses-1 or 1, optional
  file             tensors, or diffusion-weighted images; or one of six images of components
  {files}
                   more files of the subject, optional; paths are relative to the table's folder
  {columns}
                   options that differ between subjects, optional; paths of noise are relative to the table's folder

Other columns, such as age and group, are copied to participants.tsv. The values in a row replace the values of the
command's options.

DIR becomes a BIDS derivative. For each subject, DIR contains an image with its sidecar, an .npz for hks-jax explore,
plot and stats, a picture, and with --atlas a table of regions. The tables group_summary.tsv and group_regions.tsv
contain all subjects.

If the mean diffusivity of a subject, in mm2/s, is outside the range of living tissue, the subject fails until --unit or
a column named unit gives the unit, because subjects with different units cannot be compared.

If a subject fails, the others are still computed. If the command is repeated, it computes only the signatures and
tables that are missing, or whose input files have changed. A repeated command takes omitted options from the study.

examples:
  hks-jax batch subjects.tsv -o study --metric inverse --atlas atlas.nii.gz
  hks-jax batch subjects.tsv -o study --metric inverse --times 8e5 1.6e6 3.2e6 --only sub-07 sub-08
"""

import argparse
import io
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hks_jax.cli import options
from hks_jax.cli.computation import ComputationError, Settings
from hks_jax.cli.info import describe
from hks_jax.cli.inputs import require_inputs_kept
from hks_jax.cli.noise import check_noise
from hks_jax.cli.options import FILES, defaults, flag, refuse
from hks_jax.cli.outputs import Done, show
from hks_jax.cli.parsing import Times, folder
from hks_jax.cli.progress import Progress, StudyProgress
from hks_jax.cli.reading import Reading, is_file, read_volume, require_metric
from hks_jax.cli.study.folder import DESCRIPTIONS, MAP, PAIRS, REGIONS, Study, reading_options
from hks_jax.cli.study.subjects import Subject, read_subjects
from hks_jax.io import TensorVolume
from hks_jax.io.result import tuples
from hks_jax.io.tables import read_json
from hks_jax.io.units import LIVING_TISSUE
from hks_jax.signatures.spans import SHORTEST
from hks_jax.signatures.times import LAST

USAGE = "SUBJECTS -o DIR"


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


DEFAULTS = dict.fromkeys(name for name in defaults(add_kept) if name not in FILES)
"""The options that a study keeps, with the default None, by which omitted options are recognised."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("subjects", type=Path, metavar="SUBJECTS", help="the table of subjects")
    parser.add_argument("-o", "--output", type=folder, required=True, metavar="DIR", help="the study's folder")
    add_kept(parser)
    parser.set_defaults(**DEFAULTS)
    options.add_atlas(parser)
    options.add_names(parser)
    options.add_view(parser)
    options.add_rim(parser)
    parser.add_argument(
        "--save-pairs",
        action="store_true",
        help="save the eigenpairs of each subject, which other --times, --normalisation or --method then reuse",
    )
    parser.add_argument(
        "--replace", action="store_true", help="replace a study in DIR that has other settings or times"
    )
    parser.add_argument(
        "--only", nargs="+", metavar="SUBJECT", help="compute only these subjects, such as sub-07 or sub-07_ses-2"
    )


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [args.output / name for name in (*DESCRIPTIONS, "group_*", f"**/*{MAP}*", f"**/*{REGIONS}*", f"**/*{PAIRS}")]


def run(args: argparse.Namespace, begun: Progress) -> None:
    """Run the command; if some subjects fail, raise ComputationError after computing the others."""
    from hks_jax.cli.study.tasks import run_all

    if is_file(args.noise):
        why = "for all subjects; expected a number, residuals or roughness"
        raise ValueError(f"--noise: got {args.noise} {why}. Put second scans into a column named noise of the table")
    args.strict_unit = True
    note = _complete(args)
    subjects = read_subjects(args.subjects, args)
    chosen = _only(subjects, args.only)
    for subject in chosen:
        if subject.arguments is not None:
            require_inputs_kept(subject.arguments)
            require_metric(Reading.of(subject.arguments))
            check_noise(subject.arguments)
    if not any(s.arguments is not None and s.arguments.atlas is not None for s in subjects):
        refuse(args, ("names",), "this option names labels, which are missing; pass --atlas, or a column named atlas")
    progress = StudyProgress(len(chosen), args.quiet)
    progress.start = begun.start
    progress.end(note)
    with progress.catching_warnings():
        study = _open(args, subjects, progress)
        problems = {subject.name: "" for subject in subjects if subject not in chosen}
        outcome = run_all(study, chosen, progress, args.debug)
        problems |= outcome.problems
        if args.only:  # other processes may have finished other subjects
            there = {s.name for s in subjects if problems.get(s.name) == "" and _is_there(study, s)}
            problems = {name: why for name, why in problems.items() if name not in there}
        problems |= _other_units(study, [subject for subject in subjects if subject.name not in problems])
        files = study.write_group(subjects, problems)
    failed = [subject.name for subject in chosen if problems.get(subject.name)]
    tables = "\n".join(str(file) for file in files if file.suffix == ".tsv")
    show(args, Done(files, {"failed": failed}, tables))
    if failed:
        raise ComputationError(
            f"{len(failed)} of {len(chosen)} subjects failed ({', '.join(failed[:5])}{', …' * (len(failed) > 5)}); "
            f"{args.output / 'group_summary.tsv'} contains the reasons. The other subjects are done. Repeat the "
            "command to compute the failed subjects again"
        )
    if outcome.undrawn:
        raise ComputationError(
            f"the results are complete, but {len(outcome.undrawn)} of {len(chosen)} pictures cannot be drawn "
            f"({', '.join(outcome.undrawn[:5])}{', …' * (len(outcome.undrawn) > 5)}). Repeat the command to draw them"
        )


def _is_there(study: Study, subject: Subject) -> bool:
    with suppress(Exception):
        return study.has(subject, MAP, study.fingerprint(subject))
    return False


def _other_units(study: Study, done: list[Subject]) -> dict[str, str]:
    """Return error messages for subjects whose diffusivity suggests another unit than for the other subjects."""
    if study.settings.metric == "tensor":  # the tensors need not describe diffusion
        return {}
    inputs = {subject.name: read_json(study.path(subject, f"{MAP}.json")).get("Input", {}) for subject in done}
    medians = {name: value for name, about in inputs.items() if (value := about.get("median_mean_diffusivity"))}
    middle = math.exp(np.median(np.log(list(medians.values())))) if medians else 1.0
    span = LIVING_TISSUE[1] / LIVING_TISSUE[0]
    return {
        name: f"--unit: got a median mean diffusivity of {value:.3g}, but the median of the study is {middle:.3g}; "
        "expected the same unit for all subjects. Give the units by --unit or by a column named unit"
        for name, value in medians.items()
        if not 1 / span <= value / middle <= span
    }


def _complete(args: argparse.Namespace) -> str:
    """Replace omitted options by options of the study in the folder or by defaults; return a note about them."""
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
                taken.append(f"{flag(name)} {_spelled(name, value)}")
    origin = f"of the study in {args.output}" if before else "for all subjects"
    return f"options {origin}: {', '.join(taken) or 'as given, or the defaults'}"


def _options(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options in the record of a study, with names as in Python and tuples in place of lists."""
    if not record:
        return {}
    times = record["times"] if record["chosen"] == "explicit" else record["chosen"]
    options = {"times": times, "time_unit": record["time-unit"], "operator": "laplace-beltrami"}
    options |= {**record["settings"], **record["reading"]}
    return {name.replace("-", "_"): tuples(value) for name, value in options.items()}


def _spelled(name: str, value: Any) -> str:
    """Return the value of an option as on the command line."""
    if not isinstance(value, tuple):
        return "unset" if value is None else str(value)
    parts = [":".join(each) if isinstance(each, tuple) else str(each) for each in value if each is not None]
    return {"slice": "=", "repair": ":", "positive": ":"}.get(name, ",").join(parts)


def _open(args: argparse.Namespace, subjects: list[Subject], progress: StudyProgress) -> Study:
    """Return the study with explicit times and write its description; raise ValueError if there is another study."""
    there = [name for name in DESCRIPTIONS if (args.output / name).exists()]
    if there and "study.json" not in there:
        raise ValueError(
            f"--output: got {args.output}, where another program wrote {', '.join(there)}; expected a new folder or a "
            f"study. Choose a folder such as {args.output / 'derivatives' / 'hks-jax'}"
        )
    files = {name: str(getattr(args, name).absolute()) for name in FILES if getattr(args, name) is not None}
    study = Study(args.output, Settings.of(args), args.time_unit, reading_options(args), args.save_pairs, files)
    times = study.settings.times
    before, chosen = read_json(args.output / "study.json"), "explicit" if times.explicit else f"auto:{times.automatic}"
    now, then = _options({**study.record, "chosen": chosen}), _options(before)
    if before and times.explicit:
        then["times"] = tuples(before["times"])
    changed = [name for name, value in now.items() if then.get(name) != value]
    if before and changed and not args.replace:
        kept = "; ".join(f"{flag(n)} {_spelled(n, then.get(n))}, not {_spelled(n, now[n])}" for n in changed)
        raise ValueError(
            f"--output: the study in {args.output} has {kept}. Leave these options out to continue the study, choose "
            "another folder, or pass --replace to compute the subjects of that study again"
        )
    if times.automatic:
        explicit = _suitable(args, times.automatic, subjects, progress) if changed else tuple(before["times"])
        study = replace(study, settings=replace(study.settings, times=Times(explicit, 0)))
    study.write_description(subjects, chosen)
    return study


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


def _only(subjects: list[Subject], names: list[str] | None) -> list[Subject]:
    if names is None:
        return subjects
    wanted = {name if name.startswith("sub-") else f"sub-{name}" for name in names}
    chosen = [subject for subject in subjects if {subject.name, subject.participant} & wanted]
    missing = wanted - {name for subject in chosen for name in (subject.name, subject.participant)}
    if missing:
        raise ValueError(f"--only: got {', '.join(sorted(missing))}; expected names of subjects in the table")
    return chosen
