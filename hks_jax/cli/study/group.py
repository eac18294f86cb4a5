"""Collect the results of a study's subjects in tables of the group."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.cli.study.folder import FAILED, MAP, REGIONS, Study
from hks_jax.cli.study.subjects import Subject
from hks_jax.io.json_files import read_json
from hks_jax.io.tables import read_table, write_table
from hks_jax.io.units import LIVING_TISSUE

_COLUMNS = {"sub": "participant_id", "ses": "session_id"}
"""The columns of BIDS for entities; other entities name their own columns."""
SUMMARY = {
    "status": "done, failed, or pending if there is no result of the study's settings and the present input files",
    "voxels": "number of voxels in the domain",
    "k": "number of eigenpairs",
    "lambda1": "first positive eigenvalue in 1/(metric length)²; in 1/s for D in mm²/s with D⁻¹ or Fick's operator",
    "truncation": "largest share of the signature, over t, from omitted eigenpairs (estimate)",
    "free_of_rim": "share of voxels, at the last t, at which the boundary contributes less than 10 % of the signature",
    "resolution": "largest relative error, over t, due to the size of the voxels (estimate)",
    "warnings": "number of warnings, which the subject's sidecar contains",
    "problem": "reason why there is no result",
}
"""The columns of the group's summary after the identifiers, with descriptions."""


def write_group(study: Study, subjects: list[Subject], problems: Mapping[str, str]) -> list[Path]:
    """Write the tables of all participants, all subjects and all regions, and return their paths.

    `problems` maps the names of subjects without a result to the reason, which begins with `FAILED` if the computation
    failed. The regions are those of all subjects with an atlas and a table of regions, which belongs to the signature.
    """
    entities = list(dict.fromkeys(entity for subject in subjects for entity in subject.entities))
    head, ids = [_COLUMNS.get(entity, entity) for entity in entities], {}
    for subject in subjects:
        labels = {e: f"{e}-{label}" if e in _COLUMNS else label for e, label in subject.entities.items()}
        ids[subject.name] = [labels.get(entity) for entity in entities]
    files = _write_participants(study, subjects)
    summary = [(*ids[s.name], *_summary(study.path(s, f"{MAP}.json"), problems.get(s.name))) for s in subjects]
    about = {name: {"Description": text} for name, text in SUMMARY.items()}
    files += write_table(study.folder / "group_summary.tsv", (*head, *SUMMARY), summary, about)
    done = [s for s in subjects if s.name not in problems and s.args.atlas is not None]
    done = [s for s in done if study.path(s, f"{REGIONS}.json").is_file()]
    joint = study.folder / "group_regions.tsv"
    if not done:
        for old in (joint.with_suffix(".json"), joint):
            old.unlink(missing_ok=True)
        return files
    tables = [(ids[subject.name], read_table(study.path(subject, f"{REGIONS}.tsv"))) for subject in done]
    columns = list(dict.fromkeys(name for _, rows in tables for row in rows for name in row))
    joined = [(*who, *map(row.get, columns)) for who, rows in tables for row in rows]
    about = {key: value for s in reversed(done) for key, value in read_json(study.path(s, f"{REGIONS}.json")).items()}
    described = {name: about[name] for name in (*columns, "Settings") if name in about}
    return files + write_table(joint, (*head, *columns), joined, described)


def other_units(study: Study, done: list[Subject]) -> dict[str, str]:
    """Return error messages for subjects whose diffusivity suggests another unit than for the other subjects."""
    if study.settings.metric == "tensor":  # the tensors need not describe diffusion
        return {}
    inputs = {subject.name: read_json(study.path(subject, f"{MAP}.json")).get("Input", {}) for subject in done}
    medians = {name: value for name, about in inputs.items() if (value := about.get("median_mean_diffusivity"))}
    middle = math.exp(np.median(np.log(list(medians.values())))) if medians else 1.0
    span = LIVING_TISSUE[1] / LIVING_TISSUE[0]
    return {
        name: f"{FAILED}--unit: got a median mean diffusivity of {value:.3g}, but the median of the study is "
        f"{middle:.3g}; expected the same unit for all subjects. Give the units by --unit, by a column named unit "
        "or, for bids, by Units in the sidecars"
        for name, value in medians.items()
        if not 1 / span <= value / middle <= span
    }


def _write_participants(study: Study, subjects: list[Subject]) -> list[Path]:
    """Write participants.tsv with the covariates; rows of other participants remain if their folders do."""
    file = study.folder / "participants.tsv"
    before = read_table(file) if file.is_file() else []
    rows = {who: row for row in before if (study.folder / (who := row.pop("participant_id"))).is_dir()}
    own, differing = dict[str, dict[str, str]](), dict[str, list[str]]()
    for subject in subjects:
        first = own.setdefault(subject.participant, {})
        for name, value in subject.covariates.items():
            if first.setdefault(name, value) != value:
                differing.setdefault(name, []).append(subject.participant)
    for name, whose in differing.items():
        warn_of_accuracy(
            f"{name} differs between sessions of {', '.join(dict.fromkeys(whose))}, and participants.tsv has the first "
            "value. Join the values of sessions from your own table",
            UserWarning,
        )
    rows |= own
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))
    return write_table(
        file, ("participant_id", *columns), [(who, *map(rows[who].get, columns)) for who in sorted(rows)]
    )


def _summary(sidecar: Path, problem: str | None) -> tuple[Any, ...]:
    if problem is not None:
        return ("failed" if problem.startswith(FAILED) else "pending", *(None,) * 7, problem.removeprefix(FAILED))
    report = read_json(sidecar)
    pairs, times = report["Eigenpairs"], report["Truncation"]
    worst = [max((t[name] or 0.0 for t in times), default=0.0) for name in ("truncation", "resolution_bias")]
    inside, warnings = report["Input"]["voxels_inside"], len(report["Warnings"])
    free = times[-1].get("free_of_rim") if times else None
    return ("done", inside, pairs["k"], pairs["first_positive"], worst[0], free, worst[1], warnings, None)
