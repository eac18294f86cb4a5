"""``hks-jax hks FILE -o OUT``: the heat kernel signature of a tensor field in a file."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli.arguments import parse_boundary, parse_slice, parse_times
from hks_jax.cli.progress import Progress
from hks_jax.eigen.solve import SOLVERS
from hks_jax.io import ORDERS, TensorVolume, erode, read_mask, read_tensors
from hks_jax.io.nifti import is_nifti

DESCRIPTION = """\
Compute the heat kernel signature of a field of diffusion tensors. FILE is a NIfTI image of six components per voxel,
or an npz with 'tensors' (*shape, d, d) and, optional, 'spacing', 'origin', 'mask', 'affine'.

Writes to the folder OUT: hks.npz, hks.nii.gz (where FILE is NIfTI), hks.png and report.json.
"""

EPILOG = """\
example:
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse -k 100 --times auto:8
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
    add("file", metavar="FILE", type=Path, help="tensors: .nii, .nii.gz or .npz")
    add("-o", "--output", metavar="OUT", type=Path, required=True, help="folder for the results")
    add(
        "--metric",
        choices=("tensor", "inverse", "adjugate"),
        help="the metric of diffusion tensors D: inverse is D⁻¹ (t is time), tensor is D itself, adjugate is |D|D⁻¹; "
        "must be chosen for NIfTI; an npz holds the metric itself unless you choose",
    )
    add("--slice", type=parse_slice, metavar="AXIS=N", help="compute on one slice, such as z=14")
    add("--mask", type=Path, metavar="FILE", help="zeros and ones: .nii, .nii.gz, .npy, or .npz with 'mask'")
    add("--erode", type=int, default=0, metavar="N", help="peel N voxels off the mask's rim")
    add(
        "--components",
        choices=("raise", "largest", "all"),
        default="raise",
        help="where the mask falls apart: stop (default), keep the largest piece, or keep all",
    )
    add(
        "--boundary",
        type=parse_boundary,
        default="neumann",
        metavar="B",
        help="neumann (default), dirichlet, periodic or mirror; one for all axes, or one per axis as in "
        "neumann,periodic; low:high for the two sides, as in neumann:dirichlet,neumann",
    )
    add(
        "--times",
        nargs="+",
        metavar="T",
        help="positive numbers, or auto, or auto:N for N times that suit the eigenvalues (default auto:6)",
    )
    add("-k", type=int, help="number of eigenpairs (default 200, or a quarter of the unknowns if that is less)")
    add("--order", choices=tuple(ORDERS), help="order of the six components, where a NIfTI file does not declare it")
    add("--solver", choices=("auto", *SOLVERS), default="auto", help="eigensolver (default auto)")
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
    add("--dtype", choices=("float32", "float64"), default="float64", help="precision (default float64)")
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand."""
    times = parse_times(args.times)
    if args.metric is None and is_nifti(args.file):
        raise ValueError(
            "--metric: choose one; diffusion tensors D become a metric as inverse (D⁻¹, Brownian motion with "
            "diffusivity D), tensor (D itself) or adjugate (|D|D⁻¹)"
        )
    from hks_jax.cli.job import Settings, compute
    from hks_jax.cli.outputs import check_folder, write_outputs
    from hks_jax.cli.picture import draw

    check_folder(args.output)
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        with progress.stage("reading", str(args.file)):
            volume = _read(args, progress)
        settings = Settings(
            metric=args.metric or "tensor",
            k=args.k,
            boundary=args.boundary,
            times=times,
            components=args.components,
            solver=args.solver,
            normalisation=args.normalisation,
            method=args.method,
            dtype=args.dtype,
        )
        result = compute(volume, settings, progress)
        files = write_outputs(
            args.output,
            result,
            progress,
            draw=lambda path: draw(result, path),
            nifti=is_nifti(args.file),
            command=sys.argv,
        )
    if not args.quiet:
        print("\n".join(map(str, files)))


def _read(args: argparse.Namespace, progress: Progress) -> TensorVolume:
    """Read the file, cut the slice, and settle the mask."""
    volume = read_tensors(args.file, args.order)
    mask = None if args.mask is None else read_mask(args.mask, volume.affine)
    if mask is not None and mask.shape == volume.shape:
        volume, mask = volume.with_mask(mask), None
    if args.slice is not None:
        volume = volume.slice(*args.slice)
    elif 1 in volume.shape:
        raise ValueError(f"--slice: the volume is one voxel thick; pass --slice {'xyz'[volume.shape.index(1)]}=0")
    if mask is not None:  # it may be one of the slice alone
        if mask.shape != volume.shape:
            raise ValueError(f"--mask: got shape {mask.shape}; expected the shape of the tensors, {volume.shape}")
        volume = volume.with_mask(mask)
    if volume.mask is None:
        volume = _without_background(volume, progress)
    if args.erode:
        inside = np.ones(volume.shape, bool) if volume.mask is None else volume.mask
        volume = volume.with_mask(erode(inside, args.erode))
    return volume


def _without_background(volume: TensorVolume, progress: Progress) -> TensorVolume:
    """Take voxels whose tensor is exactly zero, which is how programs write the background, as outside."""
    inside = np.any(volume.tensors != 0, axis=(-2, -1))
    if inside.all() or not inside.any():
        return volume
    note = f"no mask: the {int((~inside).sum())} voxels whose tensor is zero count as outside"
    progress.note(note)
    return replace(volume, mask=inside, notes=(*volume.notes, note))
