"""The folder of a study, a BIDS derivative: file names, sidecars, state of subjects, and tables of the group."""

import argparse
import hashlib
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from hks_jax import __version__
from hks_jax.cli.computation import Settings
from hks_jax.cli.options import COLUMNS
from hks_jax.cli.parsing import Times
from hks_jax.cli.reading import Reading, is_file
from hks_jax.cli.study.subjects import Subject
from hks_jax.io.formats import format_of
from hks_jax.io.masks import names_beside
from hks_jax.io.result import Result, plain
from hks_jax.io.tables import read_json, read_table, write_json, write_table
from hks_jax.io.volume import digest
from hks_jax.storage import atomic_folder, atomic_path, existing

MAP = "_model-tensor_param-hks_dwimap"
REGIONS = "_model-tensor_param-hks_regions"
PAIRS = "_model-tensor_param-hks_pairs.npz"
"""The suffixes of file names: a subject's signature, the table of its regions, and its saved eigenpairs."""
DESCRIPTIONS = ("study.json", "dataset_description.json", ".bidsignore", "participants.tsv")
"""The names of the files that describe a study."""
_SUFFIXES = {MAP: ".npz", REGIONS: ".tsv"}
GENERATED_BY = {"Name": "hks-jax", "Version": __version__}
_TEMPORARY = re.compile(r"\.[0-9a-f]{12}\..+")
"""The names of temporary files that an interrupted process may leave (see `hks_jax.atomic_path`)."""
SUMMARY = {
    "status": "done, failed, or pending if the run did not include the subject",
    "voxels": "number of voxels in the domain",
    "k": "number of eigenpairs",
    "lambda1": "first positive eigenvalue in 1/(metric length)²; in 1/s for D in mm²/s with D⁻¹ or Fick's operator",
    "truncation": "largest share of the signature, over t, from omitted eigenpairs (estimate)",
    "free_of_rim": "share of voxels, at the last t, at which the boundary contributes less than 10 % of the signature",
    "resolution": "largest relative error, over t, due to the size of the voxels (estimate)",
    "warnings": "number of warnings, which the subject's sidecar contains",
    "problem": "reason why the subject failed",
}
"""The columns of the group's summary after the identifiers, with descriptions."""


@dataclass(frozen=True)
class Study:
    """The folder of a study, and the settings that all subjects share.

    Attributes:
        folder: the folder of the study.
        settings: the settings of the computation, including the times for all subjects.
        time_unit: ``"scanner"``, or ``"lambda1"`` if the times are products λ₁t.
        reading: the options for reading, which rows of the table may replace.
        save_pairs: whether the eigenpairs are saved.
        files: the paths of files for all subjects, by name of the option, which a repeated command takes.
    """

    folder: Path
    settings: Settings
    time_unit: str
    reading: Mapping[str, Any]
    save_pairs: bool = False
    files: Mapping[str, str] = field(default_factory=dict)

    def path(self, subject: Subject, ending: str, folder: str = "dwi") -> Path:
        """Return the path of a subject's file."""
        return self.folder / subject.folder / folder / f"{subject.name}{ending}"

    def picture(self, subject: Subject) -> Path:
        """Return the path of the picture of a subject's signature."""
        return self.path(subject, f"{MAP}.png", "figures")

    def fingerprint(self, subject: Subject) -> str:
        """Return a digest of all inputs of a subject's signature; raise FileNotFoundError if a file is missing."""
        reading, inputs = reading_options(subject.args), Reading.of(subject.args).files
        files = {role: [digest(existing(path)) for path in paths] for role, paths in inputs.items()}
        return _digest({"settings": asdict(self.settings), "unit": self.time_unit, "reading": reading, "files": files})

    def pairs_fingerprint(self, subject: Subject) -> str:
        """Return a digest of all inputs of a subject's eigenpairs, without times, normalisation, method and noise."""
        alike = replace(self.settings, times=Times((), 0), normalisation="raw", method="spectral")
        args = argparse.Namespace(**{**vars(subject.args), "noise": None})
        return replace(self, settings=alike, time_unit="").fingerprint(replace(subject, arguments=args))

    def regions_fingerprint(self, subject: Subject, fingerprint: str) -> str:
        """Return a digest of all inputs of the table of a subject's regions."""
        atlas, names = subject.args.atlas, subject.args.names
        paths = (atlas, names_beside(atlas) if names is None else names)
        files = [None if path is None else digest(existing(path)) for path in paths]
        return _digest({"signature": fingerprint, "files": files})

    def has(self, subject: Subject, kind: str, fingerprint: str) -> bool:
        """Return whether the signature or the table of regions exists and has this fingerprint."""
        made_of = read_json(self.path(subject, f"{kind}.json")).get("Fingerprint")
        return made_of == fingerprint and self.path(subject, kind + _SUFFIXES[kind]).is_file()

    def write_signature(self, subject: Subject, fingerprint: str, result: Result, warnings: list[str]) -> None:
        """Write a subject's signature and, last, the sidecar that marks completion, all without dates."""
        self.forget(subject)
        args, report, scaled = subject.args, result.report, result.arrays.get("scaled_times")
        target = self.path(subject, MAP)
        with atomic_folder(target.parent) as temporary:
            result.save(temporary / target.name, format_of(args.file).image)
        sidecar = {
            "Description": "Heat kernel signature of the field of diffusion tensors; times along the last axis",
            "Model": {"Description": "Diffusion tensor", "Parameters": report["settings"]},
            "Times": result.times.tolist(),
            "TimesByFirstEigenvalue": None if scaled is None else scaled.tolist(),
            "TimesDescription": times_text(self.time_unit),
            "Units": report["units"],
            "Rim": report["rim"],
            "Sources": [os.path.basename(path) for paths in Reading.of(args).files.values() for path in paths],
            "Input": _without_folder(report["input"]),
            "Eigenpairs": report["eigenpairs"],
            "Truncation": report["times"],
            **({"Method": report["method"]} if "method" in report else {}),
            **({"Noise": _without_folder(report["noise"])} if "noise" in report else {}),
            "Warnings": warnings,
            "GeneratedBy": GENERATED_BY,
            "Fingerprint": fingerprint,
        }
        write_json(self.path(subject, f"{MAP}.json"), plain(sidecar))

    def forget(self, subject: Subject) -> None:
        """Remove files of a subject from an interrupted run or from a run with other settings."""
        sidecar, picture = self.path(subject, f"{MAP}.json"), self.picture(subject)
        sidecar.unlink(missing_ok=True)  # first, because a sidecar means that the other files are complete
        ours = [file for kind in _SUFFIXES for file in sidecar.parent.glob(f"{subject.name}{kind}.*")]
        for path in [*ours, picture, sidecar.with_name("explore.html")]:
            path.unlink(missing_ok=True)
        for folder in (sidecar.parent.parent, sidecar.parent, picture.parent):
            for left in folder.glob(".*") if folder.is_dir() else ():
                if _TEMPORARY.fullmatch(left.name):
                    shutil.rmtree(left) if left.is_dir() else left.unlink()

    @property
    def record(self) -> dict[str, Any]:
        """The settings that all subjects share, as stored in study.json."""
        settings = asdict(self.settings)
        times = {"times": settings.pop("times")[0], "time-unit": self.time_unit}
        record: dict[str, Any] = plain({**times, "settings": settings, "reading": self.reading})
        return record

    def require_settings(self) -> None:
        """Raise ValueError if another process has restarted the study with other settings or times."""
        now = read_json(self.folder / "study.json")
        if any(now.get(name) != value for name, value in self.record.items()):
            raise ValueError(
                f"--output: another process has meanwhile changed the settings or times of the study {self.folder}. "
                "Choose another folder for one of the studies"
            )

    def write_description(self, subjects: list[Subject], chosen: str) -> None:
        """Write the files that describe the study: the description of a BIDS derivative, and study.json with times."""
        description = {
            "Name": "Heat kernel signatures of diffusion tensor fields",
            "BIDSVersion": "1.10.0",
            "DatasetType": "derivative",
            "GeneratedBy": [GENERATED_BY],
        }
        write_json(self.folder / "dataset_description.json", description)
        with atomic_path(self.folder / ".bidsignore") as temporary:
            temporary.write_text("study.json\ngroup_*\n*.npz\n*_regions.*\n")
        about = {**self.record, "chosen": chosen, "files": self.files, "description": times_text(self.time_unit)}
        write_json(self.folder / "study.json", about)
        covariates = list(dict.fromkeys(name for subject in subjects for name in subject.covariates))
        first = {subject.participant: subject.covariates for subject in reversed(subjects)}  # of the first session
        rows = [(who, *map(first[who].get, covariates)) for who in dict.fromkeys(s.participant for s in subjects)]
        write_table(self.folder / "participants.tsv", ("participant_id", *covariates), rows)

    def write_group(self, subjects: list[Subject], problems: Mapping[str, str]) -> list[Path]:
        """Write the tables of all subjects and all regions; `problems` maps names of failed subjects to reasons.

        The regions are those of all subjects that have a table of regions, which belongs to their signature.
        """
        n = 1 + any(subject.session for subject in subjects)
        head, ids = ("participant_id", "session_id")[:n], {s.name: (s.participant, s.session)[:n] for s in subjects}
        summary = [(*ids[s.name], *_summary(self.path(s, f"{MAP}.json"), problems.get(s.name))) for s in subjects]
        about = {name: {"Description": text} for name, text in SUMMARY.items()}
        files = write_table(self.folder / "group_summary.tsv", (*head, *SUMMARY), summary, about)
        done = [s for s in subjects if s.name not in problems and self.path(s, f"{REGIONS}.json").is_file()]
        joint = self.folder / "group_regions.tsv"
        if not done:
            for old in (joint.with_suffix(".json"), joint):
                old.unlink(missing_ok=True)
        else:
            tables = [(ids[subject.name], read_table(self.path(subject, f"{REGIONS}.tsv"))) for subject in done]
            columns = list(dict.fromkeys(name for _, rows in tables for row in rows for name in row))
            joined = [(*who, *map(row.get, columns)) for who, rows in tables for row in rows]
            about = read_json(self.path(done[0], f"{REGIONS}.json"))
            described = {name: about[name] for name in (*columns, "Settings") if name in about}
            files += write_table(joint, (*head, *columns), joined, described)
        return files


def reading_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options for reading and noise; "file" replaces the path of a second scan, because files may move."""
    names = [option for option in COLUMNS if args.noise is not None or option not in ("noise", "draws")]
    reading = {option: getattr(args, option.replace("-", "_")) for option in names}
    return {**reading, "noise": "file"} if is_file(args.noise) else reading


def times_text(unit: str) -> str:
    """Return a description of the times of a study."""
    if unit == "lambda1":
        return "the times of each subject are the given numbers divided by its first positive eigenvalue λ₁"
    return "all subjects have the same times, in (metric length)²; in s for D in mm²/s with D⁻¹ or Fick's operator"


def _without_folder(about: Mapping[str, Any]) -> dict[str, Any]:
    return {**about, "source": os.path.basename(str(about["source"]))}


def _summary(sidecar: Path, problem: str | None) -> tuple[Any, ...]:
    report = {} if problem is not None else read_json(sidecar)
    if not report:
        return ("failed" if problem else "pending", *(None,) * 7, problem or None)
    pairs, times = report["Eigenpairs"], report["Truncation"]
    worst = [max((t[name] or 0.0 for t in times), default=0.0) for name in ("truncation", "resolution_bias")]
    inside, warnings = report["Input"]["voxels_inside"], len(report["Warnings"])
    free = times[-1].get("free_of_rim") if times else None
    return ("done", inside, pairs["k"], pairs["first_positive"], worst[0], free, worst[1], warnings, None)


def _digest(content: Any) -> str:
    text = json.dumps(plain({"version": __version__, **content}), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
