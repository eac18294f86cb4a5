"""Smooth maps along the tissue.

Smooth a map, or a series of maps (4D), by the diffusion of a substance in the tissue, div(D∇u) with the diffusion
tensors D: more along fibres than across them, and only within the mask. The diffusion's time is that in which the
mean full width at half maximum is --fwhm, in mm. The integral of the map is kept, except with dirichlet.

FILE has the maps: on the voxels of the tensors (NIfTI, MRtrix, NRRD or .npy), or with --mesh at the vertices of a
surface or of tetrahedra (GIFTI, FreeSurfer's maps such as lh.thickness, .npy, or a mesh with arrays). On a surface,
maps are smoothed within it by the tangential parts of the tensors, and without tensors equally in all its directions.
The options on voxels and on the meaning of numbers refer to the tensors.

The command writes to the folder OUT: smoothed.npz, an image in the tensors' format (smoothed.nii.gz, .nrrd or .vti) or
a mesh (smoothed.vtu; for a GIFTI or FreeSurfer surface also smoothed.func.gii), report.json, and smoothed.png, which
compares the first map with isotropic smoothing of the same width.

examples:
  hks-jax smooth bold.nii.gz --tensors dti.nii.gz --fwhm 6 -o out --mask mask.nii.gz
  hks-jax smooth fa.nii.gz --tensors dti.nii.gz --fwhm 4 -o out --mask mask.nii.gz --slice z=14
  hks-jax smooth lh.thickness --mesh lh.white --inside lh.cortex.label --fwhm 10 -o out
  hks-jax smooth lh.thickness --mesh lh.white --tensors dti.nii.gz --fwhm 10 -o out
"""

import argparse
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax import SurfaceMesh, TensorField, gaussian_scale_space
from hks_jax.cli import options
from hks_jax.cli.combinations import require_grid_options, require_mesh_options
from hks_jax.cli.computation import OfMesh, OfVolume, Settings
from hks_jax.cli.meshes import MeshFile, read_domain
from hks_jax.cli.outputs import REPORT, Done, writing
from hks_jax.cli.parsing import boundary_conditions
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, read_grid
from hks_jax.io import read_maps, save
from hks_jax.io.cortex import MAPS
from hks_jax.io.formats import WRITTEN
from hks_jax.io.mesh import WRITTEN as MESHES_WRITTEN
from hks_jax.io.nifti import repetition_time
from hks_jax.spectrum_free.smoothing import smooth

USAGE = "FILE --fwhm LENGTH -o OUT"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("file", action=options.FirstAndOthers, nargs="+", type=Path, metavar="FILE", help="the maps")
    parser.add_argument(
        "--fwhm",
        type=float,
        required=True,
        metavar="LENGTH",
        help="mean full width at half maximum of the smoothing, in mm, at least the voxel size, or the median edge of "
        "a mesh",
    )
    parser.add_argument(
        "--tensors", type=Path, metavar="FILE", help="the diffusion tensors; required unless --mesh is given"
    )
    parser.add_argument(
        "--mesh",
        type=Path,
        metavar="FILE",
        help="the mesh at whose vertices the maps are. With --tensors, the tensors of this volume are interpolated at "
        "the vertices in scanner coordinates, as in 'hks-jax hks'; with --array, the mesh's file has them",
    )
    options.add_vertices(parser)
    options.add_reading(parser)
    options.add_components(parser)
    options.add_dtype(parser)
    options.add_interpolation(parser)
    options.add_output(parser)
    parser.add_argument(
        "--operator",
        choices=("fick", "laplace-beltrami"),
        default="fick",
        help="fick: the diffusion of a substance by Fick's law (default), whose density becomes uniform in space. "
        "laplace-beltrami: the heat flow of the metric D⁻¹, which keeps the integral with the volume of this metric",
    )
    parser.add_argument(
        "--boundary",
        type=boundary_conditions,
        default="neumann",
        metavar="CONDITION",
        help="condition at the boundary of the domain: neumann (nothing flows through it, the default); dirichlet "
        "(the map is 0 at the sides of the image, or at the boundary of a mesh); dirichlet-rim (also at the boundary "
        "of a mask); or periodic. Give one condition for all axes, or one per axis",
    )
    options.add_view(parser)


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [args.output / name for name in ("smoothed.*", REPORT)]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    if args.others:
        raise ValueError(f"FILE: got {1 + len(args.others)} files; expected one file of maps")
    domain = _on_grid(args, progress) if args.mesh is None else _on_mesh(args, progress)
    place, field = domain.place, domain.field
    inside = field.grid.inside if isinstance(field, TensorField) else field.triangulation.used
    with progress.stage("reading", str(args.file)):
        maps = read_maps(args.file, place)
    where = "voxels" if args.mesh is None else "vertices"
    if unknown := int((~np.isfinite(maps[:, inside])).any(axis=0).sum()):
        remedy = "a --mask" if args.mesh is None else "an --inside"
        raise ValueError(
            f"{args.file}: got NaN or infinite values at {unknown} {where} inside the mask; expected finite values. "
            f"Pass {remedy} without these {where}"
        )
    with progress.stage("smoothing", f"{len(maps)} maps at {int(inside.sum())} {where}"):
        smoothed = np.asarray(smooth(field, maps, args.fwhm, args.boundary, progress=progress.update))
    chosen = ("fwhm", "operator", "interpolation", "boundary", "dtype", "components")
    report = {
        "input": {**domain.about, "maps": {"source": str(args.file), "number": len(maps)}},
        "settings": {name: getattr(args, name) for name in chosen},
    }
    stale = [args.output / f"smoothed{suffix}" for suffix in (MAPS, *WRITTEN, *MESHES_WRITTEN)]
    draw: Any = _draw if args.mesh is None else _draw_mesh
    pictures = {"smoothed.png": partial(draw, domain, args, maps[0], smoothed[0])}
    record, step = {**report["settings"], **domain.origin}, repetition_time(args.file) if len(maps) > 1 else {}
    with writing(args.output, report, progress, lambda: stale, pictures) as (folder, done):
        values = smoothed if len(smoothed) > 1 else smoothed[0]
        for suffix in filter(None, (".npz", *domain.images)):
            stored = values if suffix == ".npz" else values.astype(np.float32)
            save(folder / f"smoothed{suffix}", stored, place, name="smoothed", extra=step, provenance=record)
    return done


def _on_grid(args: argparse.Namespace, progress: Progress) -> OfVolume:
    if args.tensors is None:
        raise ValueError(
            "--tensors: got no file; expected the diffusion tensors of the voxels, or the mesh of the maps"
        )
    require_grid_options(args)
    metric = None if args.operator == "fick" else "inverse"
    reading = Reading.of(args, file=args.tensors, metric=metric)
    return read_grid(reading, Settings.of(args, metric=metric), progress)


def _on_mesh(args: argparse.Namespace, progress: Progress) -> OfMesh:
    metric = None if args.operator == "fick" else "inverse"
    require_mesh_options(args)
    return read_domain(MeshFile.of(args, args.mesh), Settings.of(args, metric=metric), progress)


def _draw(domain: OfVolume, args: argparse.Namespace, before: np.ndarray, after: np.ndarray, path: Path) -> None:
    """Draw the map, the smoothed map, and the map after isotropic smoothing of the same width, in a middle slice."""
    from hks_jax.plot import hks_panels
    from hks_jax.plot.signature import cropped, middle_slice, placed

    volume = domain.place
    field = TensorField(volume.grid("all"), np.broadcast_to(np.eye(volume.dimension), volume.tensors.shape))
    time = args.fwhm**2 / (16 * math.log(2.0))
    inside = field.grid.inside
    isotropic = gaussian_scale_space(field, [time], np.where(inside, before, 0))[0]
    values = np.stack([np.where(inside, before, np.nan), after, isotropic])
    volume, cut = middle_slice(volume, inside)
    values = cut(values)
    grid, box = cropped(volume, np.isfinite(values[1]))
    style: dict[str, Any] = {"limits": [_limits(values[1:])] * 3, "label": ""}
    style |= {"orientation": placed(volume, box, args.view), "path": path, "length_unit": volume.length_unit}
    hks_panels(values[:, *box], [0.0] * 3, grid, titles=_titles(args.fwhm), **style)


def _draw_mesh(domain: OfMesh, args: argparse.Namespace, before: np.ndarray, after: np.ndarray, path: Path) -> None:
    """Draw the map, the smoothed map, and if there are tensors the map after smoothing without them."""
    from hks_jax.plot.images import Colours
    from hks_jax.plot.surfaces import surface_panels

    mesh, shown, titles = domain.place, [before, after], _titles(args.fwhm)
    if domain.tensors is None:
        titles = [titles[0], f"smoothed, {args.fwhm:g} mm"]
    else:
        plain = type(mesh)(mesh.vertices, mesh.triangulation.cells, mask=np.ones(len(mesh.triangulation.cells), bool))
        shown.append(np.asarray(smooth(plain, before, args.fwhm, args.boundary)))
    nodes = mesh.triangulation.used if isinstance(mesh, SurfaceMesh) else mesh.triangulation.boundary_vertices
    colours = [Colours(*_limits(np.stack(shown[1:])[:, nodes]), "viridis")] * len(shown)
    surface_panels(mesh, shown, titles, colours, path=path)


def _limits(values: np.ndarray) -> tuple[float, float]:
    low, high = (float(x) for x in np.nanquantile(values, [0.02, 0.98]))
    return low, high if high > low else low + 1


def _titles(fwhm: float) -> list[str]:
    return ["map", f"along the tissue, {fwhm:g} mm", f"isotropic, {fwhm:g} mm"]
