"""The computations of a study: what is to be done of each subject, and doing it."""

import io
import os
import sys
import time
import traceback
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from hks_jax.atomic import claim
from hks_jax.cli import INPUT_ERRORS
from hks_jax.cli.job import ComputationError, compute_pairs, signature_of
from hks_jax.cli.noise import error_bars, noise_of, with_error_bars
from hks_jax.cli.options import Times
from hks_jax.cli.pairs import are_of, read_pairs, write_pairs
from hks_jax.cli.picture import draw, draw_volume
from hks_jax.cli.progress import StudyProgress, duration
from hks_jax.cli.reading import image_suffix, read_volume
from hks_jax.cli.stats import region_table
from hks_jax.cli.study.folder import MAP, PAIRS, Study
from hks_jax.cli.study.subjects import Subject
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.io import TensorVolume
from hks_jax.signatures.times import positive_range

FORGETFUL = 8
"""After so many subjects what was compiled is forgotten: domains differ, and each leaves 70 MiB that no other uses."""

PATIENCE = 0.5
"""Seconds between two looks at what other processes compute."""


def run_all(study: Study, subjects: list[Subject], progress: StudyProgress, debug: bool) -> dict[str, str]:
    """Compute what is not there yet; return why some subjects failed, by their names.

    Other processes with the same study share the work: each subject is computed by the one that comes to it first.

    Raises:
        ValueError: another process has begun the study anew, with other settings.
    """
    problems: dict[str, str] = {}
    plan = []
    for subject in subjects:
        try:
            task = _Task.of(study, subject)
        except Exception as error:
            problems[subject.name] = _said(error, debug)
            progress.end(f"{subject.name} failed: {problems[subject.name]}")
        else:
            plan.append(task)
    pending = [task for task in plan if task.signature or task.regions]
    # What ended a process before, for want of memory perhaps, may do so again: the others come first.
    pending.sort(key=lambda task: study.attempt(task.subject).exists())
    if len(pending) < len(plan):
        progress.end(f"{len(plan) - len(pending)} of {len(subjects)} subjects are done already")
    progress.total, number, waiting = len(pending), 0, False
    while pending:
        elsewhere = []
        for task in pending:
            name = task.subject.name
            study.require_settings()
            try:
                with claim(study.attempt(task.subject)) as ours:
                    if not ours:
                        elsewhere.append(task)
                    elif (left := task.left(study)) is None:
                        progress.total -= 1
                    else:
                        if number and number % FORGETFUL == 0:
                            jax.clear_caches()
                        number += 1
                        with progress.subject(name):
                            left.run(study, progress)
            except Exception as error:
                problems[name] = _said(error, debug)
                progress.end(f"{name} failed: {problems[name]}")
        if len(elsewhere) == len(pending):
            if not waiting:
                progress.end(f"waiting for other processes, which compute {len(elsewhere)} of the subjects")
            waiting = True
            time.sleep(PATIENCE)
        pending = elsewhere
    done = len(subjects) - len(problems)
    progress.end(f"{progress.line()}: {done} of {len(subjects)} subjects are done, in {duration(progress.elapsed)}")
    return problems


class _Task(NamedTuple):
    """What is to be done of a subject."""

    subject: Subject
    fingerprint: str
    signature: bool
    regions: str
    """The fingerprint of the table of regions, if it is to be written; else nothing."""

    @classmethod
    def of(cls, study: Study, subject: Subject) -> "_Task":
        """Return what is to be done: what is not there, or was of other files or settings."""
        fingerprint = study.fingerprint(subject)
        missing, regions = not study.is_done(subject, fingerprint), ""
        if subject.args.atlas is not None:
            regions = study.regions_fingerprint(subject, fingerprint)
            regions = "" if not missing and study.has_regions(subject, regions) else regions
        return cls(subject, fingerprint, missing, regions)

    def left(self, study: Study) -> "_Task | None":
        """Return what another process has not done meanwhile."""
        missing = self.signature and not study.is_done(self.subject, self.fingerprint)
        known = not missing and study.has_regions(self.subject, self.regions)
        left = self._replace(signature=missing, regions="" if known else self.regions)
        return left if left.signature or left.regions else None

    def run(self, study: Study, progress: StudyProgress) -> None:
        """Do it."""
        args = self.subject.args
        if self.signature:
            _compute(study, self.subject, self.fingerprint, progress)
        if self.regions:
            study.forget_regions(self.subject)
            with progress.stage("regions"):
                table = region_table(study.path(self.subject, f"{MAP}.npz"), args.atlas, args.names, progress)
            study.write_regions(self.subject, self.regions, *table)


def _compute(study: Study, subject: Subject, fingerprint: str, progress: StudyProgress) -> None:
    """Compute and write the signature of a subject."""
    study.forget(subject)
    settings, args = study.settings, subject.args
    volume, field, pairs = _pairs(study, subject, progress)
    if study.time_unit == "lambda1":
        own = np.array(settings.times.explicit) / float(positive_range(pairs)[0])
        settings = replace(settings, times=Times(tuple(own.tolist()), 0))
    if args.noise is not None:
        if args.noise == "residuals" and volume.covariance is None:  # pairs that were kept do not have it
            volume = read_volume(args, StudyProgress(1, quiet=True, stream=io.StringIO()))
        noise = noise_of(args, volume, field.grid, progress)
        bars, settings = error_bars(volume, noise, pairs, settings, args.draws, progress)
    result = signature_of(volume, field, pairs, settings, progress)
    if args.noise is not None:
        result = with_error_bars(result, bars, os.path.basename(args.noise))
    if study.time_unit == "lambda1":
        scaled = {"scaled_times": np.array(study.settings.times.explicit)}
        result = replace(result, arrays={**result.arrays, **scaled})
    drawn = partial(draw if volume.dimension == 2 else draw_volume, result, view=args.view)
    with progress.stage("writing"):
        study.write_signature(subject, fingerprint, result, progress.warnings, drawn)


def _pairs(study: Study, subject: Subject, progress: StudyProgress) -> tuple[TensorVolume, TensorField, Eigenpairs]:
    """Return the volume, its metric and its eigenpairs: those that were kept, or computed, and kept if asked to."""
    kept, fingerprint = study.path(subject, PAIRS), study.pairs_fingerprint(subject)
    if are_of(kept, fingerprint):
        return read_pairs(kept, study.settings, progress)[:3]
    kept.unlink(missing_ok=True)
    volume = read_volume(subject.args, progress)
    field, pairs, _ = compute_pairs(volume, study.settings, progress)
    if study.save_pairs:
        domain, image = volume.with_mask(field.grid.mask), image_suffix(subject.args.file)
        with progress.stage("writing"):
            write_pairs(kept, domain, pairs, study.settings, image, progress.warnings, fingerprint)
    return volume, field, pairs


def _said(error: Exception, debug: bool) -> str:
    """Return an error as one line."""
    if debug:
        traceback.print_exception(error, file=sys.stderr)
    plain = isinstance(error, (*INPUT_ERRORS, ComputationError, np.linalg.LinAlgError))
    return " ".join((str(error) if plain else f"{type(error).__name__}: {error}").split())
