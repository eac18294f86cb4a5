"""Run the computations of a study that are not done yet."""

import argparse
import io
import sys
import traceback
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from hks_jax.cli.combinations import require_metric, require_noise_options
from hks_jax.cli.computation import INPUT_ERRORS, ComputationError, Solved, compute_pairs
from hks_jax.cli.inputs import require_inputs_kept
from hks_jax.cli.noise import noise_of, signature_of
from hks_jax.cli.outputs import Done, PictureError, draw_picture, show
from hks_jax.cli.pairs import are_of, read_pairs, write_pairs
from hks_jax.cli.parsing import Times
from hks_jax.cli.progress import Progress, StudyProgress
from hks_jax.cli.reading import Reading, is_file, read_grid, read_volume
from hks_jax.cli.stats import region_table
from hks_jax.cli.study.folder import ABSENT, DONE, FAILED, MAP, PAIRS, REGIONS, UNFINISHED, Study
from hks_jax.cli.study.group import other_units, write_group
from hks_jax.cli.study.settings import open_study
from hks_jax.cli.study.subjects import Subject
from hks_jax.io.json_files import write_json
from hks_jax.io.result import Result
from hks_jax.io.tables import write_table
from hks_jax.io.volume import digest
from hks_jax.plot import signature_panels
from hks_jax.signatures.times import positive_range

FORGETFUL = 8
"""The number of subjects after which compiled programs are deleted; each domain needs 70 MiB of new programs."""

PICTURE = "picture"


class Outcome(NamedTuple):
    """The error messages of failed subjects by name, and the names of subjects without a picture."""

    problems: dict[str, str]
    undrawn: list[str]


def run_study(
    args: argparse.Namespace,
    chosen: list[Subject],
    every: Callable[[], list[Subject]],
    begun: Progress,
    note: str,
    collects: bool,
) -> None:
    """Compute the chosen subjects that are not done; if some fail, raise ComputationError after the others.

    `collects` means that the chosen subjects are all, and that the tables of the group are written. The function
    `every` returns all subjects.
    """
    study, progress = _begin(args, chosen, every, begun, note)
    files = []
    with progress.catching_warnings():
        problems, undrawn = run_all(study, chosen, progress, args.debug)
        if collects:
            problems |= other_units(study, [subject for subject in chosen if subject.name not in problems])
            files = write_group(study, chosen, problems)
    done = [subject for subject in chosen if subject.name not in problems]
    failed = [subject.name for subject in chosen if subject.name in problems]
    files += [study.path(subject, f"{MAP}{Reading.of(subject.args).image or '.npz'}") for subject in done]
    shown = [str(file) for file in files if not collects or file.suffix == ".tsv"]
    show(args, Done(files, {"failed": failed}, "\n".join(shown)))
    if failed:
        raise ComputationError(
            f"{len(failed)} of {len(chosen)} subjects failed ({_listed(failed)}), the first because: "
            f"{problems[failed[0]].removeprefix(FAILED)}. The logs in {study.folder / 'logs'} have all reasons. Repeat "
            "the command to compute the failed subjects again"
        )
    if undrawn:
        raise ComputationError(
            f"the results are complete, but {len(undrawn)} of {len(chosen)} pictures cannot be drawn "
            f"({_listed(undrawn)}). Repeat the command to draw them"
        )


def prepare(args: argparse.Namespace, subjects: list[Subject], begun: Progress, note: str) -> None:
    """Choose the settings and times that suit the subjects, and store them in the study's folder."""
    study, _ = _begin(args, subjects, lambda: subjects, begun, note)
    show(args, Done([study.folder / "study.json"], study.record))


def collect(args: argparse.Namespace, subjects: list[Subject], begun: Progress, note: str) -> None:
    """Write the tables of the group from the results that there are; raise ValueError if there are none."""
    if not (args.output / "study.json").is_file():
        raise ValueError(f"OUT: there are no results in {args.output}. Compute the participants first")
    study, progress = _begin(args, subjects, lambda: subjects, begun, note)
    with progress.catching_warnings():
        problems = {subject.name: problem for subject in subjects if (problem := _problem(study, subject))}
        problems |= other_units(study, [subject for subject in subjects if subject.name not in problems])
        for name, problem in problems.items():
            progress.warn(f"{name}: {problem}")
        if len(problems) == len(subjects):
            first = f"{subjects[0].name}: {problems[subjects[0].name]}"
            raise ValueError(f"OUT: {study.folder} has none of the {len(subjects)} results. {first}")
        files = write_group(study, subjects, problems)
    without = list(problems)
    show(args, Done(files, {"without": without}, "\n".join(str(file) for file in files if file.suffix == ".tsv")))


def _begin(
    args: argparse.Namespace, chosen: list[Subject], every: Callable[[], list[Subject]], begun: Progress, note: str
) -> tuple[Study, StudyProgress]:
    """Check the arguments of the chosen subjects, and open the study."""
    if is_file(args.noise):
        why = "for all subjects; expected a number, residuals or roughness"
        raise ValueError(f"--noise: got {args.noise} {why}. Put second scans into a column named noise of the table")
    for subject in chosen:
        if subject.arguments is not None:
            require_inputs_kept(subject.arguments)
            require_metric(Reading.of(subject.arguments))
            require_noise_options(subject.arguments)
    progress = StudyProgress(len(chosen), args.quiet)
    progress.start = begun.start
    progress.end(note)
    with progress.catching_warnings():
        return open_study(args, every, progress), progress


def _problem(study: Study, subject: Subject) -> str:
    """Return why a subject has no result, with `FAILED` before it if the computation failed; empty if it has one."""
    try:
        task = _Task.of(study, subject)
    except Exception as error:
        return FAILED + _reason(error)
    lacking = {kind: why for kind, why in task.lacking().items() if kind not in (PICTURE, PAIRS)}
    last = study.outcome(subject)
    return last if lacking and last.startswith(FAILED) else next(iter(lacking.values()), "")


def _reason(error: Exception) -> str:
    """Return an error's message in one line, with its type if it is not an error of the input."""
    known = isinstance(error, (*INPUT_ERRORS, ComputationError, np.linalg.LinAlgError))
    return " ".join(f"{'' if known else f'{type(error).__name__}: '}{error}".split())


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:5])}{', …' * (len(names) > 5)}"


def run_all(study: Study, subjects: list[Subject], progress: StudyProgress, debug: bool) -> Outcome:
    """Compute all subjects that are not done; another process must not compute the same subjects.

    If another process restarts the study with other settings, this function raises ValueError.
    """
    problems, undrawn = dict[str, str](), list[str]()

    def failed(subject: Subject, error: Exception) -> None:
        if debug:
            traceback.print_exception(error, file=sys.stderr)
        problems[subject.name] = FAILED + _reason(error)
        study.log_end(subject, problems[subject.name])
        progress.end(f"{subject.name} {problems[subject.name]}")

    pending = []
    for subject in subjects:
        try:
            task = _Task.of(study, subject)
            if not task.regions:
                study.forget_regions(subject)
            lacking = task.lacking()
        except Exception as error:
            failed(subject, error)
            continue
        if lacking:
            pending.append((task, lacking))
        for why in dict.fromkeys(lacking.values()):
            if why != ABSENT:
                progress.end(f"{subject.name} is computed again: {why}")
    if done := len(subjects) - len(problems) - len(pending):
        progress.end(f"{done} of {len(subjects)} subjects are already done")
    # A subject whose computation killed an earlier process, perhaps by lack of memory, may kill this one: it is last.
    pending.sort(key=lambda entry: study.outcome(entry[0].subject) == UNFINISHED)
    progress.total = len(pending)
    for number, (task, lacking) in enumerate(pending):
        study.require_settings()
        if number and number % FORGETFUL == 0:
            jax.clear_caches()
        try:
            with progress.subject(task.subject.name, study.log(task.subject)):
                task.run(lacking, progress)
        except PictureError as error:
            undrawn.append(task.subject.name)
            study.log_end(task.subject, DONE)
            progress.end(f"{task.subject.name}: {error}")
        except Exception as error:
            failed(task.subject, error)
        else:
            study.log_end(task.subject, DONE)
    progress.end(f"{len(subjects) - len(problems)} of {len(subjects)} subjects are done")
    return Outcome(problems, undrawn)


class _Task(NamedTuple):
    """The work on a subject: its signature, and the table of its regions unless the fingerprint `regions` is empty."""

    study: Study
    subject: Subject
    fingerprint: str
    regions: str

    @classmethod
    def of(cls, study: Study, subject: Subject) -> "_Task":
        """Return the work on a subject; raise an error if its arguments are invalid or a file is missing."""
        fingerprint = study.fingerprint(subject)
        regions = "" if subject.args.atlas is None else study.regions_fingerprint(subject, fingerprint)
        return cls(study, subject, fingerprint, regions)

    def lacking(self) -> dict[str, str]:
        """Return why results, `MAP`, `REGIONS`, `PAIRS` or `PICTURE`, are to be computed."""
        wanted = {MAP: self.fingerprint} | ({REGIONS: self.regions} if self.regions else {})
        found = {kind: self.study.lacks(self.subject, kind, fingerprint) for kind, fingerprint in wanted.items()}
        found[PICTURE] = "" if self.study.picture(self.subject).is_file() else ABSENT
        if self.study.output.get("save_pairs"):
            kept = self.study.path(self.subject, PAIRS), self.study.pairs_fingerprint(self.subject)
            found[PAIRS] = "" if are_of(*kept) else ABSENT
        return {kind: why for kind, why in found.items() if why}

    def run(self, lacking: Iterable[str], progress: StudyProgress) -> None:
        """Compute the lacking results; draw the picture last, so that results remain if drawing fails."""
        study, subject, result = self.study, self.subject, None
        if MAP in lacking or PAIRS in lacking:
            result = _compute(study, subject, self.fingerprint, progress)  # removes the picture and table of regions
            lacking = (REGIONS, PICTURE)
        if REGIONS in lacking and self.regions:
            study.forget_regions(subject)
            with progress.stage("regions"):
                table, source = study.path(subject, f"{REGIONS}.tsv"), study.path(subject, f"{MAP}.npz")
                args = subject.args
                columns, rows, about = region_table(source, args.atlas, args.names, progress)
                write_table(table, columns, rows)
                checked = {"Fingerprint": self.regions, "SHA256": {table.name: digest(table)}}
                write_json(table.with_suffix(".json"), {**about, **checked})
        if PICTURE in lacking:
            npz = study.path(subject, f"{MAP}.npz")
            result = Result.read(npz, "hks", over_times=True) if result is None else result
            with progress.stage("drawing"):
                style = {"view": subject.args.view, "show_rim": subject.args.show_rim}
                draw_picture(study.picture(subject), partial(signature_panels, result, **style), [npz])


def _compute(study: Study, subject: Subject, fingerprint: str, progress: StudyProgress) -> Result:
    study.forget(subject)
    args, reading, solved = subject.args, Reading.of(subject.args), _pairs(study, subject, progress)
    scaled = None
    if study.time_unit == "lambda1":
        scaled = np.array(study.settings.times.explicit)
        own = scaled / float(positive_range(solved.pairs)[0])
        solved = solved._replace(settings=replace(solved.settings, times=Times(tuple(own.tolist()), 0)))
    domain, volume = solved.domain, solved.domain.volume
    if args.noise == "residuals" and volume is not None and volume.covariance is None:  # not saved with eigenpairs
        again = read_volume(reading, StudyProgress(1, quiet=True, stream=io.StringIO()))
        domain = replace(domain, volume=again.with_mask(volume.mask))
    noise = noise_of(domain, reading, args.draws, progress)
    result = signature_of(solved, noise, progress, scaled=scaled)
    if scaled is not None:
        result = replace(result, arrays={"scaled_times": scaled, **result.arrays})
    with progress.stage("writing"):
        study.write_signature(subject, fingerprint, result, progress.warnings)
    return result


def _pairs(study: Study, subject: Subject, progress: StudyProgress) -> Solved:
    """Return saved eigenpairs, or compute eigenpairs and save them if the study saves eigenpairs."""
    kept, fingerprint = study.path(subject, PAIRS), study.pairs_fingerprint(subject)
    if are_of(kept, fingerprint):
        return read_pairs(kept, study.settings, progress)
    kept.unlink(missing_ok=True)
    domain = read_grid(Reading.of(subject.args), study.settings, progress)
    solved = compute_pairs(domain, study.settings, progress)
    if study.output.get("save_pairs"):
        with progress.stage("writing"):
            write_pairs(kept, solved, progress.warnings, fingerprint)
    return solved
