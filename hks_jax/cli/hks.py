"""Compute the signature of a tensor field in a file.

Compute the heat kernel signature of a field of diffusion tensors. FILE contains one of

  tensors                    of a volume; --metric is required, and --slice restricts the computation to a slice
  diffusion-weighted images  with --bval and --bvec, to which tensors are fitted
  a mesh                     of triangles or tetrahedra, with the Euclidean metric, or of tensors at its vertices or
                             cells (--array), or of tensors in a volume (--tensors)
  eigenpairs                 written by --save-pairs, for other times, or another normalisation or method

The command writes to the folder OUT: hks.npz, an image or a mesh in FILE's format, hks.png and report.json. Times are
along the fourth axis of the image.

examples:
  hks-jax hks tensor.nii.gz -o out --metric inverse
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse -k 100 --times auto:8
  hks-jax hks out/pairs.npz -o later --times auto:24
  hks-jax hks heart.vtu -o out --array D --metric inverse -k 50
  hks-jax hks lh.white --tensors dti.nii.gz -o out --metric inverse
  hks-jax hks dwi.nii.gz --bval dwi.bval --bvec dwi.bvec -o out --slice z=10 --metric inverse --components largest
"""

import argparse
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from hks_jax import SurfaceMesh, TensorNoise, TetMesh, assemble
from hks_jax.cli import pairs as saved_pairs
from hks_jax.cli.computation import Settings, compute_pairs, result_of, solve, use_dtype
from hks_jax.cli.info import describe_mesh, listed
from hks_jax.cli.noise import Noisy, check_noise, noise_of_volume, signature_of, with_error_bars
from hks_jax.cli.options import READING, SOLVING, options_in, refuse
from hks_jax.cli.outputs import PAIRS, REPORT, Done, of_earlier, write_outputs
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import read, read_volume, require_metric, require_one
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.fem.assembly import MESH_BOUNDARIES
from hks_jax.io import read_mask, read_mesh, sample_tensors
from hks_jax.io.formats import format_of
from hks_jax.io.mesh import WRITTEN, arrays_by_place, is_mesh
from hks_jax.io.repair import require_valid
from hks_jax.io.result import Result
from hks_jax.io.tensor_order import matrices
from hks_jax.optional import optional

OF_MESHES = """\
@clean
--tensors FILE
    tensors of a volume that contains the mesh (a cortical surface, for example). The tensors are interpolated at the
    vertices in scanner coordinates (FreeSurfer's surfaces are moved by c_ras, GIFTI's by their transformation). The
    options on voxels and on the meaning of numbers refer to this file
--inside FILE
    vertices of a mesh that form the domain, such as a cortical surface without its medial wall: FreeSurfer's .label, or
    zeros and ones in .npy or in the array 'mask' of an .npz"""
"""The options of meshes."""

OPTIONS = f"""
@file @metric {READING} @output {SOLVING}
--through I,J,K
    voxel through which the slices in the picture of a volume pass, or else the nearest voxel in the domain (default: a
    voxel in the middle)
{OF_MESHES}
@signature @noise @view @rim
--save-pairs  write the eigenpairs to OUT/pairs.npz; 'hks-jax hks OUT/pairs.npz --times …' reuses them
"""

_OF_TENSORS = ("metric", "operator", "order", "interpolation")
"""Options that refer to tensors of a mesh."""
_NO_NOISE = "this option needs tensors; saved eigenpairs and meshes with the Euclidean metric have none. Leave it out"


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [args.output / name for name in ("hks.*", REPORT, *[PAIRS] * args.save_pairs)]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    check_noise(args)
    if is_mesh(args.file):
        return _on_mesh(args, Settings.of(args, metric=args.metric), progress)
    refuse(args, ("clean", "inside"), "this option is for meshes; for tensors on a grid, see --repair and --mask")
    refuse(args, ("tensors",), "this option is for a mesh inside a volume; leave it out for the volume itself")
    if saved := not args.others and saved_pairs.is_saved_pairs(args.file):
        refuse(args, ("noise",), _NO_NOISE)
        settled = [option.name for option in options_in(f"@metric {READING} {SOLVING}")]
        why = f"the eigenpairs in {args.file} determine this setting; leave the option out"
        refuse(args, (*settled, "save_pairs"), why)
    else:
        require_metric(args)
    from hks_jax.plot import signature_panels

    settings = Settings.of(args)
    if saved:
        solved, image = saved_pairs.read_pairs(args.file, settings, progress)
        volume = solved.volume
    else:
        volume, image = read_volume(args, progress), format_of(args.file).image
    if volume.dimension == 2:
        refuse(args, ("through",), "this option is for a volume; leave it out for a slice")
    noise = None
    if not saved:
        if args.noise is not None:  # the noise is read first, because reading it may fail
            use_dtype(args.dtype)
            noise = noise_of_volume(args, volume, volume.grid(args.components), progress)
        solved = compute_pairs(volume, settings, progress)
    if args.save_pairs:  # the eigenpairs are written first, because later steps may fail
        with progress.stage("writing", str(args.output / PAIRS)):
            for file in of_earlier(args.output, np.asarray(solved.pairs.eigenvalues), progress):
                file.unlink(missing_ok=True)
            saved_pairs.write_pairs(args.output / PAIRS, solved, image, progress.warnings)
    result = signature_of(args, solved, noise, progress)
    style = {"view": args.view, "through": args.through, "show_rim": args.show_rim}
    drawing = partial(signature_panels, result, **style)
    done = write_outputs(args.output, result, progress, drawing, image)
    return done._replace(files=[*done.files, *[args.output / PAIRS] * args.save_pairs])


def _on_mesh(args: argparse.Namespace, settings: Settings, progress: Progress) -> Done:
    check_mesh_options(args)
    with progress.stage("reading", str(args.file)):
        mesh, noisy = read_domain(args, progress)
    boundary = settings.boundary or "neumann"
    settings = replace(settings, boundary=boundary)
    with progress.stage("assembly", f"{len(mesh.vertices)} vertices"):
        pencil = assemble(mesh, boundary)
    pairs = solve(pencil, settings, progress)
    described = {"source": str(args.file), **describe_mesh(args.file, mesh)}
    of_pairs = partial(result_of, mesh, described, pairs)
    if noisy is None:
        result = of_pairs(settings, progress)
    else:
        result = with_error_bars(args, of_pairs, noisy, pairs, settings, progress)
    drawing = partial(_draw_mesh, result, args.show_rim)
    return write_outputs(args.output, result, progress, drawing, image_of_mesh(args.file, mesh))


def image_of_mesh(file: Path, mesh: SimplicialMesh) -> str:
    """Return the suffix of results on a mesh: that of its file, or .vtu if its format has no values at vertices."""
    suffix = file.suffix.lower()
    return ".vtu" if suffix not in WRITTEN or (suffix == ".ply" and isinstance(mesh, TetMesh)) else suffix


def check_mesh_options(args: argparse.Namespace) -> None:
    """Raise ValueError for options that only grids have, and for tensors without --metric."""
    if args.others:
        raise ValueError(f"FILE: got {1 + len(args.others)} files; expected one mesh")
    if args.tensors and args.array:
        raise ValueError("--tensors, --array: got both; expected tensors either in a volume or in the mesh's file")
    of_grids = ["slice", "through", "view", "save_pairs", "components", "method"]
    if not args.tensors:  # with --tensors, the options for reading refer to the volume
        of_grids += [o.name for o in options_in(READING) if o.name not in (*_OF_TENSORS, "array")]
    refuse(args, of_grids, "this option is for tensors on a grid; leave it out for a mesh")
    if args.boundary not in (None, *MESH_BOUNDARIES):
        raise ValueError(f"--boundary: got {args.boundary!r}; expected {', '.join(MESH_BOUNDARIES)} for a mesh")
    if not (args.array or args.tensors):
        why = "this option needs tensors, but without --array and --tensors a mesh has the Euclidean metric"
        refuse(args, _OF_TENSORS, f"{why}. Pass --array or --tensors, or leave this option out")
        refuse(args, ("noise",), _NO_NOISE)
    elif args.metric is None and args.operator != "fick":
        raise ValueError(
            "--metric: the tensors of the mesh need a metric. Choose inverse, tensor or adjugate, or pass "
            "--operator fick"
        )
    require_one(args)


def read_domain(args: argparse.Namespace, progress: Progress) -> tuple[SurfaceMesh | TetMesh, Noisy | None]:
    """Read the mesh in the chosen precision, with the metric of its tensors if there are any.

    For error bars, also return the tensors and their noise, at the voxels if the tensors come from a volume.
    """
    use_dtype(args.dtype)
    mesh = read_mesh(args.file, clean=args.clean, in_space=bool(args.tensors))
    vertices, cells = np.asarray(mesh.vertices).astype(args.dtype), mesh.triangulation.cells
    kind: Any = type(mesh)
    inside = None if args.inside is None else _inside(args.inside, len(vertices))
    if inside is not None:
        try:
            kind(vertices, cells, mask=inside)
        except ValueError as error:
            raise ValueError(f"--inside: {str(error).removeprefix('mask: ')}") from error

    def domain(tensors: Any, at: str = "vertices") -> SurfaceMesh | TetMesh:
        settings: Any = {"at": at, "interpolation": args.interpolation, "mask": inside}
        return kind.from_tensors(vertices, cells, tensors, args.metric, operator=args.operator, **settings)

    if args.tensors:
        volume = read(argparse.Namespace(**vars(args) | {"file": args.tensors, "others": []}), progress)
        require_valid(volume, "--repair")
        at = np.arange(len(vertices)) if inside is None else np.flatnonzero(inside)

        def sampled(values: Any) -> SurfaceMesh | TetMesh:
            tensors = np.zeros((len(vertices), 3, 3), args.dtype)
            tensors[at] = sample_tensors(replace(volume, tensors=np.asarray(values)), np.asarray(mesh.vertices)[at])
            return domain(tensors)

        noise = noise_of_volume(args, volume, volume.grid("all"), progress)
        noisy = None if noise is None else Noisy(volume.tensors, noise, sampled, traceable=False)
        return sampled(volume.tensors), noisy
    arrays = arrays_by_place(args.file, args.clean)
    if not args.array:
        for each in (each for each in listed(arrays) if each["components"] in (6, 9)):
            progress.note(
                f"the {each['components']} components of {each['name']} at the {each['at']} are not used, and the mesh "
                f"has the Euclidean metric. To use them, pass --array {each['name']}"
                + " and --order"
                * (each["components"] == 6)
            )
        return kind(vertices, cells, mask=inside), None
    places = [at for at, there in arrays.items() if args.array in there]
    if not places:
        there = "; ".join(f"at the {at}: {', '.join(named) or 'none'}" for at, named in arrays.items())
        raise ValueError(f"--array: got {args.array!r}; expected one of the arrays {there}")
    if len(places) > 1:
        progress.note(f"--array: {args.array} is at the {' and at the '.join(places)}; the {places[0]} are used")
    domain = partial(domain, at=places[0])
    values = arrays[places[0]][args.array]
    values = values.reshape(len(values), -1)
    if values.shape[1] != (9 if args.order is None else 6):
        n = values.shape[1]
        raise ValueError(f"--array: got {args.array!r} with {n} components; expected 9, or 6 with --order")
    tensors = matrices(args.array, values, args.order).tensors.astype(args.dtype)
    if args.noise is None:
        return domain(tensors), None
    try:
        level = float(args.noise)
    except ValueError:
        raise ValueError(
            f"--noise: got {args.noise!r}; expected a number, relative to the mean diffusivity, for tensors of a mesh"
        ) from None
    return domain(tensors), Noisy(tensors, TensorNoise.relative(tensors, level), domain)


def _inside(path: Path, n_vertices: int) -> Bool[np.ndarray, " V"]:
    if path.suffix != ".label":
        return read_mask(path)
    numbers = optional("nibabel.freesurfer").read_label(path)
    if numbers.size == 0 or numbers.min() < 0 or numbers.max() >= n_vertices:
        raise ValueError(f"--inside: got {numbers.size} vertices in {path}; expected indices 0 … {n_vertices - 1}")
    return np.isin(np.arange(n_vertices), numbers)


def _draw_mesh(result: Result, show_rim: bool, path: Path) -> None:
    """Draw the signature on the surface, or on the boundary of a solid, with a separate colour scale for each time."""
    from hks_jax.plot import new_figure, save_figure, surface
    from hks_jax.plot.images import colours_of
    from hks_jax.plot.signature import LEAST_RANGE, caption, legend, nodes_for_colours, titles_of

    mesh = result.place
    assert isinstance(mesh, SurfaceMesh | TetMesh)
    cells, near = mesh.triangulation, None if show_rim else result.near_rim
    visible = cells.boundary_vertices if isinstance(mesh, TetMesh) else cells.used
    words = legend(result, near)
    if near is not None and near[:, visible].all():  # as on the boundary of a solid, where hatching would show nothing
        near, words = None, ["the boundary contributes over 10 % at all vertices"]
    columns = min(len(result.times), 4)
    rows = math.ceil(len(result.times) / columns)
    figure = new_figure(3.4 * columns, 3.0 * rows + 0.3 + 0.3 * len(words))
    figure.suptitle("\n".join([caption(result), *words]))
    centre = 1.0 if result.normalisation == "flat" else None
    shown = [values[nodes] for values, nodes in zip(result.values, nodes_for_colours(result, visible), strict=True)]
    colours = colours_of(shown, least_range=LEAST_RANGE, centre=centre)
    for i, (title, values, (low, high, cmap)) in enumerate(zip(titles_of(result), result.values, colours, strict=True)):
        ax = figure.add_subplot(rows, columns, i + 1, projection="3d")
        style: dict[str, Any] = {"vmin": low, "vmax": high, "cmap": cmap, "hatched": None if near is None else near[i]}
        figure.colorbar(surface(ax, mesh, values, **style), ax=ax, shrink=0.6)
        ax.set_title(title, fontsize="medium")
    save_figure(figure, path)
