"""The table of a signature's regions, which ``hks-jax stats`` writes for one result and ``hks-jax batch`` for many."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax import __version__
from hks_jax.cli.explore import About, Place
from hks_jax.cli.plot import read_saved
from hks_jax.cli.progress import Progress
from hks_jax.io.masks import names_beside, read_labels, read_names
from hks_jax.io.volume import digest
from hks_jax.npz import load_npz
from hks_jax.signatures.regions import region_statistics

COLUMNS = ("index", "region", "voxels", "coverage", "volume", "t", "mean", "std", "median")

_SOME = ("lambda1_t", "error")
"""Columns that only some tables have."""
_SCALES = {
    "raw": "the heat kernel signature, per (metric length)^d",
    "heat-trace": "the heat kernel signature divided by the heat trace",
    "volume": "the heat kernel signature times the domain's volume in the metric",
    "flat": "(4πt)^(d/2) times the heat kernel signature: 1 where space is flat",
}


def region_table(
    source: Path, atlas: Path, names: Path | None, progress: Progress
) -> tuple[tuple[str, ...], list[tuple[Any, ...]], dict[str, Any]]:
    """Return the columns and rows of a result's table, a row for each region and time, and what its sidecar says.

    Raises:
        FileNotFoundError: no such result, labels or names.
        ValueError: a result that is on no grid, or labels that do not fit it.
    """
    arrays = load_npz(source)
    if "vertices" in arrays:
        raise ValueError(f"{source}: is on a mesh; expected a grid of voxels, as a label map has them")
    saved = read_saved(source, "hks")
    if saved.times is None:
        raise ValueError(f"{source}: has no times; expected a signature over t, as 'hks-jax hks' writes it")
    values, grid = saved.values, saved.grid
    place, about = Place.of(arrays, grid.dimension), About.of(arrays)
    if place.affine is None:
        progress.warn(f"{source.name} has no place in space: the labels are taken voxel by voxel, and not checked")
    labels = read_labels(atlas, grid.shape, place.affine, place.slice_axis)
    names = names if names is not None else _beside(atlas)
    called = {} if names is None else read_names(names)
    # A slice of a volume is one voxel thick.
    of_one = math.prod(grid.spacing) if place.affine is None else abs(np.linalg.det(place.affine[:3, :3]))
    regions = region_statistics(values, labels, float(of_one))
    if not regions.nodes.any():
        raise ValueError(f"{atlas}: none of its {regions.labels.size} regions has a voxel in the domain of {source}")
    columns: tuple[str, ...] = COLUMNS
    times: list[tuple[float, ...]] = [(t,) for t in saved.times.tolist()]
    if "scaled_times" in arrays:  # of a study whose times are λ₁t
        columns = (*COLUMNS[:5], "lambda1_t", *COLUMNS[5:])
        times = [(float(scaled), *t) for scaled, t in zip(arrays["scaled_times"], times, strict=True)]
    errors: list[np.ndarray] = []
    if "noise_maps" in arrays:  # the means of draws of noise have the variance of the mean's
        columns = (*columns, "error")
        draws = [region_statistics(one, labels).mean for one in arrays["noise_maps"]]
        errors = [np.sqrt(np.mean(np.square(draws), axis=0))]
    rows = [
        (int(label), called.get(int(label), f"label {label}"), int(n), float(part), float(volume), *t, *statistics)
        for r, (label, n, part, volume) in enumerate(
            zip(regions.labels, regions.nodes, regions.coverage, regions.volume, strict=True)
        )
        for t, *statistics in zip(
            times,
            regions.mean[:, r].tolist(),
            regions.deviation[:, r].tolist(),
            regions.median[:, r].tolist(),
            *(error[:, r].tolist() for error in errors),
            strict=True,
        )
    ]
    described = _about(about, atlas, names, flat=grid.dimension == 2 and place.affine is None)
    return columns, rows, {name: what for name, what in described.items() if name in columns or name not in _SOME}


def _beside(atlas: Path) -> Path | None:
    beside = names_beside(atlas)
    return None if beside is None else Path(beside)


def _about(about: About, atlas: Path, names: Path | None, flat: bool) -> dict[str, Any]:
    """Return the sidecar: what the columns are, and where they came from."""
    settings = about.settings
    values = _SCALES.get(settings.get("normalisation", "raw"), "the heat kernel signature")
    unit = {"Units": about.unit} if about.unit else {}
    return {
        "index": {"Description": "number of the region in the label map"},
        "region": {"Description": "name of the region"},
        "voxels": {"Description": "voxels of the region that are in the domain of the signature"},
        "coverage": {"Description": "their share of all of the region's voxels"},
        "volume": {
            "Description": f"{'area' if flat else 'volume'} of the voxels counted, in the lengths of the image "
            "(NIfTI: mm); a slice is one voxel thick"
        },
        "lambda1_t": {"Description": "t times the first positive eigenvalue: the same numbers for all subjects"},
        "t": {"Description": "time of diffusion, (metric length)²: s for the metric D⁻¹ of mm²/s on mm", **unit},
        "mean": {"Description": f"mean over these voxels of {values}"},
        "std": {"Description": "standard deviation over these voxels (the root of the mean square deviation)"},
        "median": {"Description": "median over these voxels"},
        "error": {"Description": "standard deviation of the mean that the noise of the tensors gives it"},
        "GeneratedBy": {"Name": "hks-jax", "Version": __version__},
        "LabelMap": {"File": atlas.name, "SHA256": digest(atlas)},
        "Names": None if names is None else {"File": names.name, "SHA256": digest(names)},
        "Settings": {name: settings.get(name) for name in ("metric", "boundary", "normalisation", "k")},
    }
