"""``hks-jax hks FILE -o OUT``: the heat kernel signature of a tensor field in a file."""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli.arguments import parse_times, parse_voxel
from hks_jax.cli.inputs import (
    add_eigenpair_arguments,
    add_json_argument,
    add_tensor_arguments,
    read_volume,
    require_metric,
)
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import image_suffix
from hks_jax.io import TensorVolume
from hks_jax.io.mesh import is_mesh

DESCRIPTION = """\
Compute the heat kernel signature of a field of diffusion tensors. FILE holds tensors: NIfTI, NRRD, VTK image data, npz
with 'tensors' (*shape, d, d) and, optional, 'spacing', 'origin', 'mask', 'affine', or npy; or diffusion-weighted
images, with --bval and --bvec.

A volume is computed whole, in three dimensions, unless --slice cuts it.

FILE may also be a mesh of triangles or tetrahedra (see hks-jax info), with the metric of space, or with that of the
tensors at its vertices that --array names.

Writes to the folder OUT: hks.npz, hks.nii.gz (or .nrrd, .vti, as FILE is; times along the fourth axis; of a mesh .vtu,
.vtk, .msh or .ply), hks.png (of a volume, three orthogonal slices for each time; of a mesh, its surface) and
report.json.
"""

EPILOG = """\
examples:
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse -k 100 --times auto:8
  hks-jax hks heart.vtu -o out --array D --metric inverse -k 50
  hks-jax hks dwi.nii.gz --bval dwi.bval --bvec dwi.bvec -o out --slice z=10 --metric inverse --components largest
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "hks",
        help="compute the signature of a tensor field in a file",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add_tensor_arguments(parser)
    add_eigenpair_arguments(parser)
    add(
        "--through",
        type=parse_voxel,
        metavar="I,J,K",
        help="the voxel that the slices in the picture of a volume run through (default: one in the middle)",
    )
    add(
        "--times",
        nargs="+",
        metavar="T",
        help="positive numbers, or auto, or auto:N for N times that suit the eigenvalues (default auto:6)",
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
    add_json_argument(parser)
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand."""
    times = parse_times(args.times)
    on_mesh = is_mesh(args.file)
    if not on_mesh:
        require_metric(args)
    from hks_jax.cli import mesh as meshes
    from hks_jax.cli.job import Settings, compute, compute_on_mesh
    from hks_jax.cli.outputs import check_folder, show_files, write_outputs
    from hks_jax.cli.picture import draw, draw_volume

    if on_mesh:
        meshes.check_options(args)
    check_folder(args.output)
    settings = Settings(
        metric=args.metric if on_mesh else args.metric or "tensor",
        interpolation=args.interpolation,
        k=args.k,
        boundary=args.boundary,
        times=times,
        components=args.components,
        solver=args.solver,
        normalisation=args.normalisation,
        method=args.method,
        dtype=args.dtype,
    )
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        draw_to: Callable[[Path], None]
        if on_mesh:
            with progress.stage("reading", str(args.file)):
                mesh = meshes.read_domain(args)
            result = compute_on_mesh(mesh, meshes.describe_mesh(args.file, mesh), settings, progress)
            image, draw_to = meshes.mesh_suffix(args.file, mesh), partial(meshes.draw, result)
        else:
            with progress.stage("reading", str(args.file)):
                volume = read_volume(args, progress)
                if args.through is not None:
                    _check_voxel(args.through, volume)
            result = compute(volume, settings, progress)
            image = image_suffix(args.file)
            flat = volume.dimension == 2
            draw_to = partial(draw, result) if flat else partial(draw_volume, result, through=args.through)
        files = write_outputs(args.output, result, progress, draw=draw_to, image=image, command=sys.argv)
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
