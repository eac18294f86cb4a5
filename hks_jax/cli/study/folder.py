"""The folder of a study, a BIDS derivative: file names, sidecars, logs, and the state of subjects."""

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
from hks_jax.io.json_files import plain, read_json, write_json
from hks_jax.io.masks import names_beside
from hks_jax.io.nifti import SCALAR
from hks_jax.io.result import Result
from hks_jax.io.volume import digest
from hks_jax.storage import atomic_folder, atomic_path, existing

MAP = "_model-tensor_param-hks_dwimap"
REGIONS = "_model-tensor_param-hks_regions"
PAIRS = "_model-tensor_param-hks_pairs.npz"
"""The suffixes of file names: a subject's signature, the table of its regions, and its saved eigenpairs."""
DONE, FAILED, UNFINISHED = "done", "failed: ", "unfinished"
"""The last line of a subject's log, if the reason follows `FAILED`; a log without it is that of a killed process."""
ABSENT = "not computed"
DESCRIPTIONS = ("study.json", "dataset_description.json", ".bidsignore", "participants.tsv")
"""The names of the files that describe a study."""
IGNORED = "study.json\nlogs\nfigures\n*_dwimap.*\n*_regions.*\n*_pairs.npz\ngroup_*\n"
"""The files that BIDS's validator ignores. It knows no ``dwimap``, which is of a draft (BIDS Extension Proposal 16)."""
GENERATED_BY = {"Name": "hks-jax", "Version": __version__}
_TEMPORARY = re.compile(r"\.[0-9a-f]{12}\..+")
"""The names of temporary files that an interrupted process may leave (see `hks_jax.atomic_path`)."""


@dataclass(frozen=True)
class Study:
    """The folder of a study, and the settings that all subjects share.

    Attributes:
        folder: the folder of the study.
        settings: the settings of the computation, including the times for all subjects.
        time_unit: ``"scanner"``, or ``"lambda1"`` if the times are products λ₁t.
        reading: the options for reading, which rows of the table may replace.
        output: the orientation and the hatching of pictures, and whether eigenpairs are saved, as options.
        files: the paths of files for all subjects, by name of the option, which a repeated command takes.
    """

    folder: Path
    settings: Settings
    time_unit: str
    reading: Mapping[str, Any]
    output: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)

    def path(self, subject: Subject, ending: str) -> Path:
        """Return the path of a subject's file."""
        return self.folder / subject.folder / "dwi" / f"{subject.name}{ending}"

    def log(self, subject: Subject) -> Path:
        """Return the path of the log of a subject's last computation."""
        return self.folder / "logs" / f"{subject.name}.log"

    def outcome(self, subject: Subject) -> str:
        """Return the last line of a subject's log: `DONE`, or `FAILED` and the reason, or `UNFINISHED`; or empty."""
        if not self.log(subject).is_file():
            return ""
        last = ["", *self.log(subject).read_text(encoding="utf-8", errors="replace").splitlines()][-1]
        return last if last == DONE or last.startswith(FAILED) else UNFINISHED

    def log_end(self, subject: Subject, line: str) -> None:
        """Add the last line to a subject's log."""
        self.log(subject).parent.mkdir(parents=True, exist_ok=True)
        with open(self.log(subject), "a", encoding="utf-8", errors="backslashreplace") as stream:
            print(line, file=stream)

    def picture(self, subject: Subject) -> Path:
        """Return the path of the picture of a subject's signature."""
        return self.folder / subject.participant / "figures" / f"{subject.name}{MAP}.png"

    def forget_pictures(self) -> None:
        """Remove all pictures of signatures, which the next commands draw again."""
        for picture in self.folder.glob(f"*/figures/*{MAP}.png"):
            picture.unlink(missing_ok=True)

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

    def lacks(self, subject: Subject, kind: str, fingerprint: str) -> str:
        """Return why the signature or the table of regions is not complete with this fingerprint; empty if it is."""
        about = read_json(self.path(subject, f"{kind}.json"))
        if not about:
            return ABSENT
        if about.get("Fingerprint") != fingerprint or "SHA256" not in about:
            return "computed from other files, with other settings or by another version"
        for name, stored in about["SHA256"].items():
            file = self.path(subject, "").with_name(name)
            if not file.is_file() or digest(file) != stored:
                return f"{file} is damaged: its SHA-256 is not that of the sidecar"
        return ""

    def write_signature(self, subject: Subject, fingerprint: str, result: Result, warnings: list[str]) -> None:
        """Write a subject's signature and, last, the sidecar that marks completion, all without dates."""
        self.forget(subject)
        args, report, scaled = subject.args, result.report, result.arrays.get("scaled_times")
        target = self.path(subject, MAP)
        with atomic_folder(target.parent) as temporary:
            result.save(temporary / target.name, format_of(args.file).image)
            checksums = {file.name: digest(file) for file in sorted(temporary.iterdir()) if file.suffix != ".json"}
        sidecar = {
            "Description": "Heat kernel signature of the field of diffusion tensors; times along the last axis",
            "OrientationEncoding": SCALAR,
            "Model": {"Description": "Diffusion tensor", "Parameters": report["settings"]},
            "Times": result.times.tolist(),
            "TimesByFirstEigenvalue": None if scaled is None else scaled.tolist(),
            "TimesDescription": times_text(self.time_unit),
            **({"Units": result.unit_of_values} if result.unit_of_values else {}),
            "UnitsOfTimes": report["units"],
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
            "SHA256": checksums,
        }
        write_json(self.path(subject, f"{MAP}.json"), sidecar)

    def forget(self, subject: Subject) -> None:
        """Remove files of a subject from an interrupted run or from a run with other settings."""
        sidecar, picture = self.path(subject, f"{MAP}.json"), self.picture(subject)
        sidecar.unlink(missing_ok=True)  # first, because a sidecar means that the other files are complete
        ours = [file for kind in (MAP, REGIONS) for file in sidecar.parent.glob(f"{subject.name}{kind}.*")]
        for path in [*ours, picture, sidecar.with_name("explore.html")]:
            path.unlink(missing_ok=True)
        for folder in (sidecar.parent, picture.parent):
            for left in folder.glob(".*") if folder.is_dir() else ():
                if _TEMPORARY.fullmatch(left.name):
                    shutil.rmtree(left) if left.is_dir() else left.unlink()

    def forget_regions(self, subject: Subject) -> None:
        """Remove the table of a subject's regions."""
        for suffix in (".json", ".tsv"):  # the sidecar first, because it marks completion
            self.path(subject, f"{REGIONS}{suffix}").unlink(missing_ok=True)

    @property
    def record(self) -> dict[str, Any]:
        """The settings that all subjects share, as stored in study.json."""
        settings = asdict(self.settings)
        times = {"times": settings.pop("times")[0], "time-unit": self.time_unit}
        record: dict[str, Any] = plain({**times, "settings": settings, "reading": self.reading, "output": self.output})
        return record

    def require_settings(self) -> None:
        """Raise ValueError if another process has restarted the study with other settings or times."""
        now = read_json(self.folder / "study.json")
        if any(now.get(name) != value for name, value in self.record.items()):
            raise ValueError(
                f"--output: another process has meanwhile changed the settings or times of the study {self.folder}. "
                "Choose another folder for one of the studies"
            )

    def write_description(self, chosen: str) -> None:
        """Write the files that describe the study: the description of a BIDS derivative, and study.json with times."""
        description = {
            "Name": "Heat kernel signatures of diffusion tensor fields",
            "BIDSVersion": "1.10.0",
            "DatasetType": "derivative",
            "GeneratedBy": [GENERATED_BY],
        }
        write_json(self.folder / "dataset_description.json", description)
        with atomic_path(self.folder / ".bidsignore") as temporary:
            temporary.write_text(IGNORED)
        about = {**self.record, "chosen": chosen, "files": self.files, "description": times_text(self.time_unit)}
        write_json(self.folder / "study.json", about)


def written_in(folder: Path) -> list[Path]:
    """Return the files that a study may write."""
    names = (*DESCRIPTIONS, "logs/*", "group_*", f"**/*{MAP}*", f"**/*{REGIONS}*", f"**/*{PAIRS}")
    return [folder / name for name in names]


def reading_options(args: argparse.Namespace, every: bool = False) -> dict[str, Any]:
    """Return the options for reading and noise; "file" replaces the path of a second scan, because files may move.

    Without noise, its options are left out, unless ``every`` is set: subjects may have noise in a column of the table.
    """
    names = [option for option in COLUMNS if every or args.noise is not None or option not in ("noise", "draws")]
    reading = {option: getattr(args, option.replace("-", "_")) for option in names}
    return {**reading, "noise": "file"} if is_file(args.noise) else reading


def times_text(unit: str) -> str:
    """Return a description of the times of a study."""
    if unit == "lambda1":
        return "the times of each subject are the given numbers divided by its first positive eigenvalue λ₁"
    return "all subjects have the same times, in (metric length)²; in s for D in mm²/s with D⁻¹ or Fick's operator"


def _without_folder(about: Mapping[str, Any]) -> dict[str, Any]:
    return {**about, "source": os.path.basename(str(about["source"]))}


def _digest(content: Any) -> str:
    text = json.dumps(plain({"version": __version__, **content}), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
