"""Smooth maps along the tissue.

Smooth a map, or a series of maps (4D), by the diffusion of a substance in the tissue, div(D∇u) with the diffusion
tensors D: more along fibres than across them, and only within the mask. The diffusion's time is that in which the
mean full width at half maximum is --fwhm, in mm. The integral of the map is kept. FILE has the maps on the voxels of
the tensors: NIfTI, MRtrix, NRRD or .npy. The options on voxels and on the meaning of numbers refer to the tensors.

The command writes to the folder OUT: smoothed.npz, an image in the tensors' format (smoothed.nii.gz, .nrrd or .vti),
report.json, and smoothed.png, which compares the first map with isotropic smoothing of the same width.

examples:
  hks-jax smooth bold.nii.gz --tensors dti.nii.gz --fwhm 6 -o out --mask mask.nii.gz
  hks-jax smooth fa.nii.gz --tensors dti.nii.gz --fwhm 4 -o out --mask mask.nii.gz --slice z=14
"""

import argparse
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax import TensorField, gaussian_scale_space
from hks_jax.cli.computation import Settings, describe_input, field_of
from hks_jax.cli.options import READING
from hks_jax.cli.outputs import REPORT, Done, writing
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import read_volume
from hks_jax.io import TensorVolume, read_maps, save
from hks_jax.io.formats import WRITTEN, format_of
from hks_jax.spectrum_free.smoothing import smooth

OPTIONS = f"""
file FILE...  the maps
--tensors FILE!  the diffusion tensors
--fwhm LENGTH!  mean full width at half maximum of the smoothing, in mm, at least the voxel size
{READING} @domain @dtype @output
--operator fick|laplace-beltrami = fick
    fick: the diffusion of a substance by Fick's law (default), whose density becomes uniform in space.
    laplace-beltrami: the heat flow of the metric D⁻¹, which keeps the integral with the volume of this metric
@view
"""


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [args.output / name for name in ("smoothed.*", REPORT)]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    if args.others:
        raise ValueError(f"FILE: got {1 + len(args.others)} files; expected one file of maps")
    metric = None if args.operator == "fick" else "inverse"
    of_tensors = argparse.Namespace(**vars(args) | {"file": args.tensors, "metric": metric})
    volume = read_volume(of_tensors, progress)
    settings = Settings.of(of_tensors, metric=metric)
    field = field_of(volume, volume.grid(args.components), settings)
    volume = volume.with_mask(field.grid.mask)
    with progress.stage("reading", str(args.file)):
        maps = read_maps(args.file, volume)
    if unknown := int((~np.isfinite(maps[:, field.grid.inside])).any(axis=0).sum()):
        raise ValueError(
            f"{args.file}: got NaN or infinite values at {unknown} voxels inside the mask; expected finite values. "
            "Pass a --mask without these voxels"
        )
    with progress.stage("smoothing", f"{len(maps)} maps at {int(field.grid.inside.sum())} voxels"):
        smoothed = np.asarray(smooth(field, maps, args.fwhm))
    report = {
        "input": {**describe_input(volume), "maps": {"source": str(args.file), "number": len(maps)}},
        "settings": {"fwhm": args.fwhm, "operator": args.operator, "dtype": args.dtype, "components": args.components},
    }
    stale = [args.output / f"smoothed{suffix}" for suffix in WRITTEN]
    draw = partial(_draw, args, volume, maps[0], smoothed[0])
    with writing(args.output, report, progress, lambda: stale, {"smoothed.png": draw}) as (folder, done):
        values = smoothed if len(smoothed) > 1 else smoothed[0]
        for suffix in filter(None, (".npz", format_of(args.tensors).image)):
            stored = values if suffix == ".npz" else values.astype(np.float32)
            save(folder / f"smoothed{suffix}", stored, volume, name="smoothed", provenance=report["settings"])
    return done


def _draw(args: argparse.Namespace, volume: TensorVolume, before: np.ndarray, after: np.ndarray, path: Path) -> None:
    """Draw the map, the smoothed map, and the map after isotropic smoothing of the same width, in a middle slice."""
    from hks_jax.plot import hks_panels
    from hks_jax.plot.signature import cropped, placed

    field = TensorField(volume.grid("all"), np.broadcast_to(np.eye(volume.dimension), volume.tensors.shape))
    time = args.fwhm**2 / (16 * math.log(2.0))
    inside = field.grid.inside
    isotropic = gaussian_scale_space(field, [time], np.where(inside, before, 0))[0]
    values = np.stack([np.where(inside, before, np.nan), after, isotropic])
    if volume.dimension == 3:
        index = int(np.median(np.flatnonzero(inside.any(axis=(0, 1)))))
        volume, values = volume.slice("z", index), values[..., index]
    grid, box = cropped(volume, np.isfinite(values[1]))
    low, high = (float(x) for x in np.nanquantile(values[1:], [0.02, 0.98]))
    style: dict[str, Any] = {"limits": [(low, high if high > low else low + 1)] * 3, "label": ""}
    style |= {"orientation": placed(volume, box, args.view), "path": path}
    titles = ["map", f"along the tissue, {args.fwhm:g} mm", f"isotropic, {args.fwhm:g} mm"]
    hks_panels(values[:, *box], [0.0] * 3, grid, titles=titles, **style)
