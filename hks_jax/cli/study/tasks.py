"""Run the computations of a study that are not done yet."""

import io
import sys
import time
import traceback
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from hks_jax.cli.computation import INPUT_ERRORS, ComputationError, Solved, compute_pairs, domain_of_volume
from hks_jax.cli.noise import noise_of, signature_of
from hks_jax.cli.outputs import PictureError, draw_picture
from hks_jax.cli.pairs import are_of, read_pairs, write_pairs
from hks_jax.cli.parsing import Times
from hks_jax.cli.progress import StudyProgress
from hks_jax.cli.reading import Reading, read_volume
from hks_jax.cli.stats import region_table
from hks_jax.cli.study.folder import MAP, PAIRS, REGIONS, Study
from hks_jax.cli.study.subjects import Subject
from hks_jax.io.formats import format_of
from hks_jax.io.result import Result
from hks_jax.io.tables import write_table
from hks_jax.plot import signature_panels
from hks_jax.signatures.times import positive_range
from hks_jax.storage import claim

FORGETFUL = 8
"""The number of subjects after which compiled programs are deleted; each domain needs 70 MiB of new programs."""

PICTURE = "picture"

PATIENCE = 0.5
"""The seconds between two checks of subjects that other processes compute."""


class Outcome(NamedTuple):
    """The error messages of failed subjects by name, and the names of subjects without a picture."""

    problems: dict[str, str]
    undrawn: list[str]


def run_all(study: Study, subjects: list[Subject], progress: StudyProgress, debug: bool) -> Outcome:
    """Compute all subjects that are not done.

    Several processes may work on the same study; the first process that starts a subject computes it. If another
    process restarts the study with other settings, this function raises ValueError.
    """
    problems, undrawn = dict[str, str](), list[str]()

    def failed(subject: Subject, error: Exception) -> None:
        if debug:
            traceback.print_exception(error, file=sys.stderr)
        known = isinstance(error, (*INPUT_ERRORS, ComputationError, np.linalg.LinAlgError))
        problems[subject.name] = " ".join(f"{'' if known else f'{type(error).__name__}: '}{error}".split())
        progress.end(f"{subject.name} failed: {problems[subject.name]}")

    plan = []
    for subject in subjects:
        try:
            fingerprint = study.fingerprint(subject)
            regions = "" if subject.args.atlas is None else study.regions_fingerprint(subject, fingerprint)
            plan.append(_Task(study, subject, fingerprint, regions))
        except Exception as error:
            failed(subject, error)
    pending = [task for task in plan if task.missing]
    # A subject whose computation killed an earlier process, perhaps by lack of memory, may kill this one: it is last.
    pending.sort(key=lambda task: task.attempt.exists())
    if len(pending) < len(plan):
        progress.end(f"{len(plan) - len(pending)} of {len(subjects)} subjects are already done")
    progress.total, number, waiting = len(pending), 0, False
    while pending:
        elsewhere = []
        for task in pending:
            study.require_settings()
            try:
                with claim(task.attempt) as ours:
                    if not ours:
                        elsewhere.append(task)
                    elif not task.missing:  # another process has done the task
                        progress.total -= 1
                    else:
                        if number and number % FORGETFUL == 0:
                            jax.clear_caches()
                        number += 1
                        with progress.subject(task.subject.name):
                            task.run(progress)
            except PictureError as error:
                undrawn.append(task.subject.name)
                progress.end(f"{task.subject.name}: {error}")
            except Exception as error:
                failed(task.subject, error)
        if len(elsewhere) == len(pending):
            if not waiting:
                progress.end(f"waiting for other processes that compute {len(elsewhere)} of the subjects")
            waiting = True
            time.sleep(PATIENCE)
        pending = elsewhere
    progress.end(f"{len(subjects) - len(problems)} of {len(subjects)} subjects are done")
    return Outcome(problems, undrawn)


class _Task(NamedTuple):
    """The work on a subject: its signature, and the table of its regions unless the fingerprint `regions` is empty."""

    study: Study
    subject: Subject
    fingerprint: str
    regions: str

    @property
    def attempt(self) -> Path:
        """The file that a process locks while it computes a subject; it remains if the process is killed."""
        return self.study.folder / self.subject.folder / ".attempt"

    @property
    def missing(self) -> list[str]:
        """The results, `MAP` or `REGIONS`, that do not exist or have another fingerprint, and a missing `PICTURE`."""
        wanted = {MAP: self.fingerprint} | ({REGIONS: self.regions} if self.regions else {})
        lacking = [kind for kind, fingerprint in wanted.items() if not self.study.has(self.subject, kind, fingerprint)]
        return lacking if self.study.picture(self.subject).is_file() else [*lacking, PICTURE]

    def run(self, progress: StudyProgress) -> None:
        """Compute what is missing; draw the picture last, so that a failure leaves the results."""
        study, subject, result = self.study, self.subject, None
        if MAP in self.missing:
            result = _compute(study, subject, self.fingerprint, progress)  # removes the picture and table of regions
        if REGIONS in self.missing:
            table = study.path(subject, f"{REGIONS}.tsv")
            for old in (table.with_suffix(".json"), table):  # the sidecar first, because it marks completion
                old.unlink(missing_ok=True)
            with progress.stage("regions"):
                source, args = study.path(subject, f"{MAP}.npz"), subject.args
                columns, rows, about = region_table(source, args.atlas, args.names, progress)
                write_table(table, columns, rows, {**about, "Fingerprint": self.regions})
        if PICTURE in self.missing:
            npz = study.path(subject, f"{MAP}.npz")
            result = Result.read(npz, "hks", over_times=True) if result is None else result
            with progress.stage("drawing"):
                style = {"view": subject.args.view, "show_rim": subject.args.show_rim}
                draw_picture(study.picture(subject), partial(signature_panels, result, **style), [npz])


def _compute(study: Study, subject: Subject, fingerprint: str, progress: StudyProgress) -> Result:
    study.forget(subject)
    args, reading, solved = subject.args, Reading.of(subject.args), _pairs(study, subject, progress)
    scaled: dict[str, np.ndarray] = {}
    if study.time_unit == "lambda1":
        scaled["scaled_times"] = np.array(study.settings.times.explicit)
        own = scaled["scaled_times"] / float(positive_range(solved.pairs)[0])
        solved = solved._replace(settings=replace(solved.settings, times=Times(tuple(own.tolist()), 0)))
    domain, volume = solved.domain, solved.domain.volume
    if args.noise == "residuals" and volume is not None and volume.covariance is None:  # not saved with eigenpairs
        again = read_volume(reading, StudyProgress(1, quiet=True, stream=io.StringIO()))
        domain = replace(domain, volume=again.with_mask(volume.mask))
    noise = noise_of(domain, reading, args.draws, progress)
    result = signature_of(solved, noise, progress)
    result = replace(result, arrays={**scaled, **result.arrays})
    with progress.stage("writing"):
        study.write_signature(subject, fingerprint, result, progress.warnings)
    return result


def _pairs(study: Study, subject: Subject, progress: StudyProgress) -> Solved:
    """Return saved eigenpairs, or compute eigenpairs and save them if the study saves eigenpairs."""
    kept, fingerprint = study.path(subject, PAIRS), study.pairs_fingerprint(subject)
    if are_of(kept, fingerprint):
        return read_pairs(kept, study.settings, progress)
    kept.unlink(missing_ok=True)
    volume = read_volume(Reading.of(subject.args), progress)
    domain = domain_of_volume(volume, study.settings, format_of(subject.args.file).image)
    solved = compute_pairs(domain, study.settings, progress)
    if study.save_pairs:
        with progress.stage("writing"):
            write_pairs(kept, solved, progress.warnings, fingerprint)
    return solved
