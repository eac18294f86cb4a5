"""Compute the Gaussian curvature of a 2D field.

Compute the Gaussian curvature of a two-dimensional field of diffusion tensors, or of a slice. FILE is read as in
'hks-jax hks'.

The command writes curvature.npz, curvature.png, report.json and an image in the format of FILE (curvature.nii.gz, .nrrd
or .vti) to the folder OUT. The report has the integral over the domain, if the curvature is known at all its nodes.

examples:
  hks-jax curvature tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse
  hks-jax curvature torus.npz -o out --periodic xy --json
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.cli import options
from hks_jax.cli.combinations import refuse
from hks_jax.cli.computation import Settings, domain_of_volume
from hks_jax.cli.outputs import REPORT, Done, writing
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, read_volume
from hks_jax.curvature import gaussian_curvature
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.assembly import assemble
from hks_jax.fem.pencil import Pencil
from hks_jax.io import Result
from hks_jax.io.formats import WRITTEN, format_of

USAGE = "FILE -o OUT"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_file(parser)
    options.add_metric(parser)
    options.add_reading(parser)
    options.add_components(parser)
    options.add_dtype(parser)
    options.add_output(parser)
    parser.add_argument(
        "--periodic",
        choices=("x", "y", "xy"),
        help="periodic axes, along which the first node follows the last (default none)",
    )
    options.add_view(parser)


def _total(field: TensorField, curvature: Float[np.ndarray, "nx ny"], periodic: str) -> dict[str, float]:
    """Return the integral of the curvature over the domain; nothing if the curvature is not known everywhere."""
    conditions = tuple("periodic" if axis in periodic else "neumann" for axis in "xy")
    pencil = assemble(field, conditions, "lumped")
    assert isinstance(pencil, Pencil)
    areas = np.asarray(pencil.space.extend(pencil.mass.diagonal(), outside=0.0), np.float64)
    values, inside = curvature.astype(np.float64), areas > 0
    return {"total": float(areas[inside] @ values[inside])} if np.isfinite(values[inside]).all() else {}


COLOURED = 0.98
"""The quantile of absolute values at the ends of the colour scale; the curvature of noisy tensors has outliers."""


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [args.output / name for name in ("curvature.*", REPORT)]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    from hks_jax.plot import hks_panels
    from hks_jax.plot.signature import cropped, placed

    volume, settings, periodic = read_volume(Reading.of(args), progress), Settings.of(args), args.periodic or ""
    refuse(args, ("operator",), "the curvature is that of a metric; pass --metric inverse for that of D⁻¹")
    if volume.dimension != 2:
        raise ValueError(
            f"--slice: got tensors on a volume of shape {volume.shape}; expected two dimensions for the Gaussian "
            "curvature. Choose a slice, such as --slice z=14"
        )
    domain = domain_of_volume(volume, settings)
    volume, field = domain.place, domain.field
    inside = field.grid.inside
    with progress.stage("curvature", f"{int(inside.sum())} nodes"):
        curvature = np.asarray(gaussian_curvature(field, ["x" in periodic, "y" in periodic]))
    known = np.isfinite(curvature)
    if not known.any():
        raise ValueError("tensors: finite differences need a grid line with 7 nodes inside the mask; got none")
    if lacking := int((inside & ~known).sum()):
        progress.note(f"the curvature is NaN at {lacking} nodes that are too near the mask's boundary")
    values = curvature[known].astype(np.float64)
    report = {
        "input": domain.about,
        "settings": {"metric": settings.metric, "periodic": periodic, "dtype": settings.dtype},
        "curvature": {
            "nodes": int(known.sum()),
            "lacking": lacking,
            "least": float(values.min()),
            "median": float(np.median(values)),
            "greatest": float(values.max()),
            **_total(field, curvature, periodic),
        },
    }
    stale = [args.output / f"curvature{suffix}" for suffix in WRITTEN]

    def draw(path: Path) -> None:
        grid, box = cropped(volume, known)
        limit = float(np.quantile(np.abs(values), COLOURED)) or 1.0
        style: dict[str, Any] = {"cmap": "RdBu_r", "limits": [(-limit, limit)], "label": "in 1/length² of the metric"}
        style |= {"orientation": placed(volume, box, args.view), "path": path, "length_unit": volume.length_unit}
        hks_panels(curvature[None, *box], [0.0], grid, titles=["Gaussian curvature"], **style)

    with writing(args.output, report, progress, lambda: stale, {"curvature.png": draw}) as (folder, done):
        result = Result(volume, curvature[None], np.zeros(0), report=report, name="curvature")
        result.save(folder / "curvature", format_of(args.file).image)
    return done
