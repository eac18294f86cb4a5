"""``hks-jax hks FILE -o OUT``: the heat kernel signature of a tensor field in a file."""

import argparse
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli import saved_pairs
from hks_jax.cli.arguments import Times, parse_times, parse_voxel
from hks_jax.cli.inputs import (
    add_clean_argument,
    add_command,
    add_eigenpair_arguments,
    add_json_argument,
    add_tensor_arguments,
    add_view_argument,
    read_volume,
    require_metric,
    require_spectral,
)
from hks_jax.cli.job import Settings, compute_on_mesh, compute_pairs, signature_of
from hks_jax.cli.noise import error_bars, noise_of, with_error_bars
from hks_jax.cli.outputs import PAIRS, check_folder, of_earlier, show_files, write_outputs
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import image_suffix
from hks_jax.domain.tensor_checks import MetricChoice
from hks_jax.io import TensorVolume
from hks_jax.io.mesh import is_mesh

DESCRIPTION = """\
Compute the heat kernel signature of a field of diffusion tensors. FILE holds one of

  tensors                    of a volume, which is computed whole unless --slice cuts it; pass --metric
  diffusion-weighted images  with --bval and --bvec: tensors are fitted to them
  a mesh                     of triangles or tetrahedra, with the metric of space, or with that of the tensors at its
                             vertices that --array names, or of the volume --tensors in which it lies
  eigenpairs                 which --save-pairs has kept: for other times, or another normalisation or method

The folder OUT gets hks.npz, an image or a mesh in FILE's format (times along the fourth axis), hks.png and report.json.
"""

EPILOG = """\
examples:
  hks-jax hks tensor.nii.gz -o out --metric inverse
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse -k 100 --times auto:8
  hks-jax hks out/pairs.npz -o later --times auto:24 --normalisation flat
  hks-jax hks heart.vtu -o out --array D --metric inverse -k 50
  hks-jax hks lh.white --tensors dti.nii.gz -o out --metric inverse
  hks-jax hks dwi.nii.gz --bval dwi.bval --bvec dwi.bvec -o out --slice z=10 --metric inverse --components largest
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser = add_command(
        subparsers, "hks", "compute the signature of a tensor field in a file", DESCRIPTION, EPILOG, "FILE -o OUT"
    )
    add = parser.add_argument
    add_tensor_arguments(parser)
    add_eigenpair_arguments(parser, "mean where the domain has a mask, else neumann; of a mesh neumann")
    add(
        "--through",
        type=parse_voxel,
        metavar="I,J,K",
        help="the voxel that the slices in the picture of a volume run through (default: one in the middle)",
    )
    add_clean_argument(parser)
    add(
        "--tensors",
        type=Path,
        metavar="FILE",
        help="of a mesh that lies in a volume, such as a cortex: the tensors, sampled at its vertices in the "
        "coordinates of the scanner (FreeSurfer's surfaces are moved by c_ras, GIFTI's by their transformation); "
        "options on voxels and numbers are about this file",
    )
    add_signature_arguments(parser)
    add_noise_arguments(parser)
    add_view_argument(parser)
    add(
        "--save-pairs",
        action="store_true",
        help="keep the eigenpairs, in OUT as pairs.npz: 'hks-jax hks OUT/pairs.npz --times …' solves nothing again",
    )
    add_json_argument(parser)
    return parser


def add_signature_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say which signature is computed of the eigenpairs."""
    add = parser.add_argument_group("the signature").add_argument
    add(
        "--times",
        nargs="+",
        metavar="T",
        help="positive numbers, in s for --metric inverse, or auto, or auto:N for N times that suit the eigenvalues "
        "(default auto:6); 'hks-jax info FILE' says which suit a file",
    )
    add(
        "--normalisation",
        choices=("raw", "heat-trace", "volume", "flat"),
        default="raw",
        help="of the signature (default raw)",
    )
    add(
        "--method",
        choices=("spectral", "spectrum-free", "auto"),
        default="spectral",
        help="sum over eigenpairs (default), do without them, or choose by t, k and the spacing: auto reports which "
        "times came from where and how the two agree",
    )


def add_noise_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that ask for error bars."""
    add = parser.add_argument_group("error bars").add_argument
    add(
        "--noise",
        metavar="N",
        help="of the tensors, for error bars: a number, relative to the mean diffusivity, such as 0.1; residuals, what "
        "the fit to diffusion-weighted images leaves; a second FILE of tensors, from another scan of the subject; or "
        "roughness, what neighbours differ by. Adds deviation and bias to the .npz, signal to noise at each t to the "
        "report, the column error to tables of regions, and fades in the picture what noise could make; automatic "
        "times of one subject begin where signal is",
    )
    add("--draws", type=int, default=16, metavar="N", help="noisy maps that error bars are made of (default 16)")


def settings_of(args: argparse.Namespace, times: Times, metric: MetricChoice | None) -> Settings:
    """Return what the arguments ask for."""

    given = {field.name: getattr(args, field.name) for field in fields(Settings) if field.name in args}
    return Settings(**given | {"metric": metric, "times": times})


def run(args: argparse.Namespace) -> None:
    """Run the subcommand."""
    times = parse_times(args.times)

    on_mesh, saved = is_mesh(args.file), saved_pairs.is_saved_pairs(args.file)
    if args.clean and not on_mesh:
        raise ValueError("--clean: it is for meshes; leave it out for tensors on a grid, and see --repair")
    if args.noise is not None and (on_mesh or saved):
        raise ValueError("--noise: it is for tensors on a grid; leave it out for meshes and for eigenpairs")
    if args.tensors and not on_mesh:
        raise ValueError("--tensors: it is for a mesh that lies in a volume; leave it out for the volume itself")
    require_spectral(args)
    if not (on_mesh or saved):
        require_metric(args)
    from hks_jax.cli import mesh as meshes
    from hks_jax.cli.picture import draw, draw_volume

    if on_mesh:
        meshes.check_options(args)
    if saved:
        saved_pairs.check_options(args)
    check_folder(args.output)
    settings = settings_of(args, times, args.metric if on_mesh else args.metric or "tensor")
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        draw_to: Callable[[Path], None]
        if on_mesh:
            with progress.stage("reading", str(args.file)):
                mesh = meshes.read_domain(args, progress)
            result = compute_on_mesh(mesh, meshes.describe_mesh(args.file, mesh), settings, progress)
            image, draw_to = meshes.mesh_suffix(args.file, mesh), partial(meshes.draw, result)
        else:
            if saved:
                volume, field, pairs, settings, image = saved_pairs.read_pairs(args.file, settings, progress)
            else:
                with progress.stage("reading", str(args.file)):
                    volume, image = read_volume(args, progress), image_suffix(args.file)
            if args.through is not None:
                _check_voxel(args.through, volume)
            if not saved:
                field, pairs, settings = compute_pairs(volume, settings, progress)
            if args.save_pairs:  # at once: what comes after may fail, or be interrupted
                with progress.stage("writing", str(args.output / PAIRS)):
                    for file in of_earlier(args.output, np.asarray(pairs.eigenvalues), progress):
                        file.unlink(missing_ok=True)
                    domain = volume.with_mask(field.grid.mask)
                    saved_pairs.write_pairs(args.output / PAIRS, domain, pairs, settings, image, progress.warnings)
            if args.noise is not None:
                noise = noise_of(args, volume, field.grid, progress)
                bars, settings = error_bars(volume, noise, pairs, settings, args.draws, progress)
            result = signature_of(volume, field, pairs, settings, progress)
            if args.noise is not None:
                result = with_error_bars(result, bars, args.noise)
            flat = volume.dimension == 2
            draw_to = partial(draw if flat else partial(draw_volume, through=args.through), result, view=args.view)
        files = write_outputs(args.output, result, progress, draw=draw_to, image=image)
    show_files(files, args.quiet, args.json)


def _check_voxel(voxel: tuple[int, int, int], volume: TensorVolume) -> None:
    """Raise ValueError, before the long computation, for a voxel through which no slices can be drawn."""
    text = ",".join(map(str, voxel))
    if volume.dimension != 3:
        raise ValueError(f"--through: got {text}; only the picture of a volume has slices, not that of one slice")
    if not all(i < n for i, n in zip(voxel, volume.shape, strict=True)):
        raise ValueError(f"--through: got {text}; expected a voxel of the volume, whose shape is {volume.shape}")
    if volume.mask is not None and not volume.mask[voxel]:
        middle = ",".join(map(str, np.argwhere(volume.mask)[volume.mask.sum() // 2]))
        raise ValueError(f"--through: voxel {text} is outside the mask; {middle}, for one, is inside")
