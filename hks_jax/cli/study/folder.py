"""The folder of a study, a BIDS derivative: names, sidecars, what is done already, and the tables of the group."""

import argparse
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hks_jax import __version__
from hks_jax.atomic import atomic_folder, atomic_path
from hks_jax.cli.job import Settings
from hks_jax.cli.noise import second_scan
from hks_jax.cli.options import COLUMNS, Times
from hks_jax.cli.reading import image_suffix
from hks_jax.cli.result import Result, plain
from hks_jax.cli.study.subjects import Subject
from hks_jax.io.components import is_one_of_six, siblings
from hks_jax.io.masks import names_beside
from hks_jax.io.nifti import is_nifti, sidecar_of
from hks_jax.io.tables import read_json, read_table, write_json, write_table
from hks_jax.io.volume import digest
from hks_jax.reading import existing

BIDS_VERSION = "1.10.0"
MAP = "_model-tensor_param-hks_dwimap"
REGIONS = "_model-tensor_param-hks_regions"
PAIRS = "_model-tensor_param-hks_pairs.npz"
"""How the names of a subject's files end: the signature, the table of its regions, and its eigenpairs if kept."""
GENERATED_BY = {"Name": "hks-jax", "Version": __version__}
_TEMPORARY = re.compile(r"\.[0-9a-f]{12}\..+")
"""What an interrupted write leaves behind (see `hks_jax.atomic_path`)."""


@dataclass(frozen=True)
class Study:
    """Where the results of a study are, and what all of its subjects have in common.

    Attributes:
        folder: the study's.
        settings: of the computation; its times are those of all subjects.
        time_unit: ``"scanner"``, or ``"lambda1"`` where the times are λ₁t.
        reading: the options of reading that hold for all subjects whose rows do not say otherwise.
        save_pairs: whether the eigenpairs are kept.
    """

    folder: Path
    settings: Settings
    time_unit: str
    reading: Mapping[str, Any]
    save_pairs: bool = False

    def path(self, subject: Subject, ending: str) -> Path:
        """Return the path of a subject's file."""
        return self.folder / subject.folder / "dwi" / f"{subject.name}{ending}"

    def picture(self, subject: Subject) -> Path:
        """Return the path of a subject's picture."""
        return self.folder / subject.folder / "figures" / f"{subject.name}{MAP}.png"

    def fingerprint(self, subject: Subject) -> str:
        """Return a digest of all that a subject's signature depends on.

        Raises:
            FileNotFoundError: a file is missing.
        """
        args = subject.args
        reading = reading_options(args)
        files = {role: [digest(existing(path)) for path in paths] for role, paths in _inputs(args).items()}
        return _digest({"settings": asdict(self.settings), "unit": self.time_unit, "reading": reading, "files": files})

    def pairs_fingerprint(self, subject: Subject) -> str:
        """Return a digest of all that a subject's eigenpairs depend on: neither times, normalisation nor noise.

        Raises:
            FileNotFoundError: a file is missing.
        """
        alike = replace(self.settings, times=Times((), 0), normalisation="raw", method="spectral")
        args = argparse.Namespace(**{**vars(subject.args), "noise": None})
        return replace(self, settings=alike, time_unit="").fingerprint(replace(subject, arguments=args))

    def regions_fingerprint(self, subject: Subject, fingerprint: str) -> str:
        """Return a digest of all that the table of a subject's regions depends on.

        Raises:
            FileNotFoundError: a file is missing.
        """
        args = subject.args
        names = names_beside(args.atlas) if args.names is None else args.names
        files = [None if path is None else digest(existing(path)) for path in (args.atlas, names)]
        return _digest({"signature": fingerprint, "files": files})

    def is_done(self, subject: Subject, fingerprint: str) -> bool:
        """Tell whether the signature of a subject is there, of the same files and settings."""
        return _is_done(self.path(subject, f"{MAP}.json"), fingerprint, self.path(subject, f"{MAP}.npz"))

    def has_regions(self, subject: Subject, fingerprint: str) -> bool:
        """Tell whether the table of a subject's regions is there, of the same signature and labels."""
        return _is_done(self.path(subject, f"{REGIONS}.json"), fingerprint, self.path(subject, f"{REGIONS}.tsv"))

    def attempt(self, subject: Subject) -> Path:
        """Return the path of the file that a process holds while it computes a subject, and leaves if it dies."""
        return self.folder / subject.folder / ".attempt"

    def write_signature(
        self,
        subject: Subject,
        fingerprint: str,
        result: Result,
        warnings: list[str],
        draw: Callable[[Path], Any],
    ) -> None:
        """Write a subject's signature, its picture and, last, the sidecar that says it is done.

        Nothing in the files depends on when or where they were computed.
        """
        self.forget(subject)
        args, report, scaled = subject.args, result.report, result.arrays.get("scaled_times")
        target = self.path(subject, MAP)
        with atomic_folder(target.parent) as temporary:
            result.save(temporary / target.name, image_suffix(args.file))
        with atomic_path(self.picture(subject)) as picture:
            draw(picture)
        write_json(
            self.path(subject, f"{MAP}.json"),
            plain(
                {
                    "Description": "Heat kernel signature of the field of diffusion tensors; times along the last axis",
                    "Model": {"Description": "Diffusion tensor", "Parameters": report["settings"]},
                    "Times": result.times.tolist(),
                    "TimesByFirstEigenvalue": None if scaled is None else scaled.tolist(),
                    "TimesDescription": times_text(self.time_unit),
                    "Sources": [os.path.basename(path) for paths in _inputs(args).values() for path in paths],
                    "Input": {**report["input"], "source": os.path.basename(str(report["input"]["source"]))},
                    "Eigenpairs": report["eigenpairs"],
                    "Truncation": report["times"],
                    **{name.capitalize(): report[name] for name in ("method", "noise") if name in report},
                    "Warnings": warnings,
                    "GeneratedBy": GENERATED_BY,
                    "Fingerprint": fingerprint,
                }
            ),
        )

    def write_regions(
        self, subject: Subject, fingerprint: str, columns: Sequence[str], rows: list[Any], about: Mapping[str, Any]
    ) -> None:
        """Write the table of a subject's regions and, last, its sidecar."""
        table = self.path(subject, f"{REGIONS}.tsv")
        write_table(table, columns, rows, {**about, "Fingerprint": fingerprint})

    def forget(self, subject: Subject) -> None:
        """Remove what an earlier run with other settings, or an interrupted one, has left of a subject."""
        sidecar = self.path(subject, f"{MAP}.json")
        sidecar.unlink(missing_ok=True)  # first: what it stands for is complete as long as it is there
        ours = [*sidecar.parent.glob(f"{subject.name}{MAP}.*"), *sidecar.parent.glob(f"{subject.name}{REGIONS}.*")]
        for path in [*ours, self.picture(subject), sidecar.with_name("explore.html")]:
            path.unlink(missing_ok=True)
        for folder in (sidecar.parent.parent, sidecar.parent, self.picture(subject).parent):
            for left in folder.glob(".*") if folder.is_dir() else ():
                if _TEMPORARY.fullmatch(left.name):
                    shutil.rmtree(left) if left.is_dir() else left.unlink()

    def forget_regions(self, subject: Subject) -> None:
        """Remove the table of a subject's regions, its sidecar first."""
        for suffix in (".json", ".tsv"):
            self.path(subject, REGIONS + suffix).unlink(missing_ok=True)

    @property
    def record(self) -> dict[str, Any]:
        """What all subjects have in common, as study.json has it."""
        settings = {name: value for name, value in asdict(self.settings).items() if name != "times"}
        times: dict[str, Any] = plain({"times": self.settings.times.explicit, "time-unit": self.time_unit})
        return {**times, "settings": plain(settings), "reading": plain(dict(self.reading))}

    def require_settings(self) -> None:
        """Raise ValueError where another process has begun the study anew."""
        now = read_json(self.folder / "study.json")
        if any(now.get(name) != value for name, value in self.record.items()):
            raise ValueError(
                f"--output: another process has given the study {self.folder} other settings or times meanwhile; "
                "choose another folder for one of them"
            )

    def write_description(self, subjects: list[Subject], chosen: str) -> None:
        """Write what the study is: the files of a BIDS derivative, and the times."""
        description = {
            "Name": "Heat kernel signatures of diffusion tensor fields",
            "BIDSVersion": BIDS_VERSION,
            "DatasetType": "derivative",
            "GeneratedBy": [GENERATED_BY],
        }
        write_json(self.folder / "dataset_description.json", description)
        with atomic_path(self.folder / ".bidsignore") as temporary:
            temporary.write_text("study.json\ngroup_*\n*.npz\n*_regions.*\n")
        about = {**self.record, "chosen": chosen, "description": times_text(self.time_unit)}
        write_json(self.folder / "study.json", about)
        covariates = list(dict.fromkeys(name for subject in subjects for name in subject.covariates))
        people = {s.participant: [s.covariates.get(name) for name in covariates] for s in reversed(subjects)}
        rows = [(participant, *people[participant]) for participant in dict.fromkeys(s.participant for s in subjects)]
        write_table(self.folder / "participants.tsv", ("participant_id", *covariates), rows)

    def write_group(self, subjects: list[Subject], problems: Mapping[str, str], with_regions: bool) -> list[Path]:
        """Write the table of all subjects and, of those that are done, that of all regions; return their paths.

        Args:
            subjects: in the order of the table.
            problems: by the names of those that are not done, why.
            with_regions: whether there are regions.
        """
        sessions = any(subject.session for subject in subjects)
        head = ("participant_id", "session_id") if sessions else ("participant_id",)

        def ids(subject: Subject) -> tuple[str, ...]:
            return (subject.participant, subject.session)[: len(head)]

        summary = [(*ids(s), *_summary(self.path(s, f"{MAP}.json"), problems.get(s.name))) for s in subjects]
        files = write_table(self.folder / "group_summary.tsv", (*head, *SUMMARY), summary, SUMMARY)
        done = [s for s in subjects if s.name not in problems and self.path(s, f"{REGIONS}.json").is_file()]
        if with_regions and done:
            tables = [(ids(subject), read_table(self.path(subject, f"{REGIONS}.tsv"))) for subject in done]
            columns = list(dict.fromkeys(name for _, rows in tables for row in rows for name in row))
            joined = [(*who, *(row.get(name) for name in columns)) for who, rows in tables for row in rows]
            about = read_json(self.path(done[0], f"{REGIONS}.json"))
            described = {name: about[name] for name in columns if name in about}
            files += write_table(self.folder / "group_regions.tsv", (*head, *columns), joined, described)
        return files


SUMMARY = {
    "status": {"Description": "done, failed, or pending where a run was for others alone"},
    "voxels": {"Description": "voxels in the domain"},
    "k": {"Description": "number of eigenpairs"},
    "lambda1": {"Description": "first positive eigenvalue, 1/(metric length)²: per s for the metric D⁻¹ of mm²/s"},
    "truncation": {"Description": "largest share of the signature, over t, that lies beyond the eigenpairs (estimate)"},
    "resolution": {"Description": "largest relative error, over t, by the size of the voxels (estimate)"},
    "warnings": {"Description": "number of warnings; the subject's sidecar has them"},
    "problem": {"Description": "why it is not done"},
}
"""The columns of the group's summary after the identifiers."""


def reading_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return by name the options of reading and, where error bars are asked for, of noise.

    A second scan is one of the files, and said to be one alone: its path may change.
    """
    reading = {option: getattr(args, option.replace("-", "_")) for option in COLUMNS}
    if args.noise is None:
        return {option: value for option, value in reading.items() if option not in ("noise", "draws")}
    return {**reading, "noise": args.noise if second_scan(args) is None else "file"}


def times_text(unit: str) -> str:
    """Say what the times of a study are."""
    if unit == "lambda1":
        return "times of each subject are the given numbers over its own first positive eigenvalue λ₁"
    return "the same times for all subjects, in (metric length)²: s for the metric D⁻¹ of mm²/s on mm"


def _summary(sidecar: Path, problem: str | None) -> tuple[Any, ...]:
    report = {} if problem is not None else read_json(sidecar)
    if not report:
        return ("failed" if problem else "pending", *(None,) * 6, problem or None)
    pairs, times = report["Eigenpairs"], report["Truncation"]
    worst = [max((t[name] or 0.0 for t in times), default=0.0) for name in ("truncation", "resolution_bias")]
    inside, warnings = report["Input"]["voxels_inside"], len(report["Warnings"])
    return ("done", inside, pairs["k"], pairs["first_positive"], *worst, warnings, None)


def _inputs(args: argparse.Namespace) -> dict[str, list[str]]:
    """Return the files that a subject's signature is computed from, by their part in it."""
    images = [args.file, *args.others]
    if not args.others and args.bval is None and is_nifti(args.file) and is_one_of_six(args.file):
        images = siblings(args.file)
    sidecars = [sidecar_of(path) for path in images[:1] if args.bval is None and is_nifti(path)]
    given = {"file": images, "sidecar": sidecars, "mask": [args.mask], "bval": [args.bval], "bvec": [args.bvec]}
    inputs = {role: [str(path) for path in paths if path is not None] for role, paths in given.items()}
    second = second_scan(args)
    return inputs if second is None else {**inputs, "noise": [*_inputs(second)["file"], *_inputs(second)["sidecar"]]}


def _is_done(sidecar: Path, fingerprint: str, file: Path) -> bool:
    return read_json(sidecar).get("Fingerprint") == fingerprint and file.is_file()


def _digest(content: Any) -> str:
    text = json.dumps(plain({"version": __version__, **content}), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
