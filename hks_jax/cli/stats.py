"""Write a table of means over the regions of an atlas.

Write a table of the mean, the standard deviation and the median of the signature over each labelled region, at each t.
The signature is the one that 'hks-jax hks' has written to the folder OUT. The table also has the volume of each region
in the domain, and the share of its voxels in the domain. The labels must be on the voxels of the image; labels with
another affine raise an error.

examples:
  hks-jax stats out --atlas sub-01_dseg.nii.gz
  hks-jax stats out --atlas aparc+aseg.nii.gz --names FreeSurferColorLUT.txt -o regions.tsv

For many subjects, 'hks-jax batch --atlas' writes all tables and joins them.
"""

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax import __version__
from hks_jax.cli import options
from hks_jax.cli.computation import HALF
from hks_jax.cli.outputs import Done
from hks_jax.cli.parsing import file_in_folder
from hks_jax.cli.progress import Progress
from hks_jax.io.masks import names_beside, read_labels, read_names
from hks_jax.io.result import Result, signature_file
from hks_jax.io.tables import write_table
from hks_jax.io.units import MEDIAN
from hks_jax.io.volume import digest
from hks_jax.signatures.regions import region_statistics
from hks_jax.signatures.times import FREE

USAGE = "RESULT --atlas FILE"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "result", type=Path, metavar="RESULT", help="the folder OUT that 'hks-jax hks' wrote, or an .npz from there"
    )
    parser.add_argument(
        "-o", "--output", type=file_in_folder, metavar="TABLE", help="the table (default: regions.tsv in OUT)"
    )
    parser.add_argument(
        "--atlas",
        type=Path,
        required=True,
        metavar="FILE",
        help="integer labels on the image's voxels, with 0 for unlabelled (NIfTI, MRtrix, NRRD or .npy)",
    )
    options.add_names(parser)


_SCALES = {
    "raw": "the heat kernel signature, per (metric length)^d, or per length^d for Fick's operator",
    "heat-trace": "the heat kernel signature divided by the heat trace",
    "volume": "the heat kernel signature times the domain's volume in the metric, or in space for Fick's operator",
    "flat": "(4πt)^(d/2) times the heat kernel signature, times √|D| for Fick's operator, which is 1 for flat space",
}


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    table = _table(args)
    return [table, table.with_suffix(".json")]


def _table(args: argparse.Namespace) -> Path:
    return args.output or signature_file(args.result).with_name("regions.tsv")


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    source, table = signature_file(args.result), _table(args)
    if table.suffix.lower() != ".tsv":
        raise ValueError(f"--output: got {table}; expected a name that ends in .tsv")
    with progress.stage("regions", f"{args.atlas} on {source}"):
        columns, rows, about = region_table(source, args.atlas, args.names, progress)
        files = write_table(table, columns, rows, about)
    return Done(files, {"source": str(source), "regions": list(dict.fromkeys(row[1] for row in rows))})


def names_of(labels: Path, names: Path | None) -> tuple[Path | None, dict[int, str]]:
    """Return the file with the names of labels (`names`, or the table beside the labels), and the names."""
    beside = names or names_beside(labels)
    return (None, {}) if beside is None else (Path(beside), read_names(beside))


def region_table(
    source: Path, atlas: Path, names: Path | None, progress: Progress
) -> tuple[tuple[str, ...], list[tuple[Any, ...]], dict[str, Any]]:
    """Return the columns, the rows (one for each region and time) and the sidecar of a result's table."""
    result = Result.read(source, "hks")
    volume, values = result.volume, result.values
    if not result.times.size:
        raise ValueError(f"{source}: got a result without times; expected a signature that 'hks-jax hks' wrote")
    if volume.affine is None:
        progress.warn(f"{source.name} has no affine, so the positions of the labels are not checked")
    labels = read_labels(atlas, volume)
    names, called = names_of(atlas, names)
    # A slice with an affine counts as one voxel thick.
    of_one = math.prod(volume.spacing) if volume.affine is None else abs(np.linalg.det(volume.affine[:3, :3]))
    regions = region_statistics(values, labels, float(of_one))
    if not regions.nodes.any():
        raise ValueError(f"{atlas}: none of the {regions.labels.size} regions has a voxel in the domain of {source}")
    n_times, n_regions = regions.mean.shape
    by_time = {"t": result.times, "lambda1_t": result.arrays.get("scaled_times")}  # present for --time-unit lambda1
    by_region = {
        "index": regions.labels,
        "voxels": regions.nodes,
        "coverage": regions.coverage,
        "volume": regions.volume,
    }
    by_region["region"] = np.array([called.get(int(label), f"label {label}") for label in regions.labels], object)
    cells = {name: np.tile(of, n_regions) for name, of in by_time.items() if of is not None}
    cells |= {name: np.repeat(of, n_times) for name, of in by_region.items()}
    cells |= {"mean": regions.mean.T.ravel(), "std": regions.deviation.T.ravel(), "median": regions.median.T.ravel()}
    if (
        near := result.near_rim
    ) is not None:  # the labels' nodes with and without influence of the boundary, at each time
        share = region_statistics(np.where(np.isfinite(values), ~near, np.nan), labels).mean
        cells["free_of_rim"] = share.T.ravel()
        if late := int((share < HALF).any(axis=0).sum()):
            progress.warn(
                f"in {late} of {n_regions} regions, the boundary contributes over {100 * FREE:.0f} % of the signature "
                "at most voxels at some t (column free_of_rim); the mean then shows the shape of the domain"
            )
    if result.lengths is not None:
        cells["length"] = np.tile(result.lengths, n_regions)
    if "noise_maps" in result.arrays:  # a regional mean's error is the root mean square of the noisy maps' means
        draws = [region_statistics(one, labels).mean for one in result.arrays["noise_maps"]]
        cells["error"] = np.sqrt(np.mean(np.square(draws), axis=0)).T.ravel()
    about = {name: of for name, of in _about(result, atlas, names).items() if name in cells or name[0].isupper()}
    columns = tuple(name for name in about if name in cells)
    rows = list(zip(*(cells[name].tolist() for name in columns), strict=True))
    return columns, rows, about


def _about(result: Result, atlas: Path, names: Path | None) -> dict[str, Any]:
    """Return the sidecar: descriptions of the table's columns in order, and (capitalised) the origin of the table."""
    settings = result.settings
    flat = result.volume.dimension == 2 and result.volume.affine is None
    values = _SCALES.get(result.normalisation, "the heat kernel signature")
    unit = {"Units": result.unit} if result.unit else {}
    return {
        "index": {"Description": "number of the region in the label map"},
        "region": {"Description": "name of the region"},
        "voxels": {"Description": "voxels of the region that are in the domain of the signature"},
        "coverage": {"Description": "share of the region's voxels that are in the domain of the signature"},
        "volume": {
            "Description": f"{'area' if flat else 'volume'} of the region's voxels in the domain, in the unit of the "
            "image (NIfTI: mm); a slice is one voxel thick"
        },
        "lambda1_t": {"Description": "t times the first positive eigenvalue, equal for all subjects"},
        "t": {
            "Description": "time in (metric length)², in s for D in mm²/s with the metric D⁻¹ or Fick's operator",
            **unit,
        },
        "length": {
            "Description": f"√(Dt), where D is {MEDIAN}",
            **({"Units": result.length_unit} if result.length_unit else {}),
        },
        "free_of_rim": {
            "Description": "share of these voxels at which the boundary contributes less than "
            f"{100 * FREE:.0f} % of the signature"
        },
        "mean": {"Description": f"mean over the region's voxels in the domain: {values}"},
        "std": {"Description": "standard deviation over the same voxels (the root of the mean square deviation)"},
        "median": {"Description": "median over the same voxels"},
        "error": {"Description": "standard deviation of the mean due to the noise of the tensors"},
        "GeneratedBy": {"Name": "hks-jax", "Version": __version__},
        "LabelMap": {"File": atlas.name, "SHA256": digest(atlas)},
        "Names": None if names is None else {"File": names.name, "SHA256": digest(names)},
        "Settings": {name: settings.get(name) for name in ("metric", "operator", "boundary", "normalisation", "k")},
    }
