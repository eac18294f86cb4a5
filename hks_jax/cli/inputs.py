"""What the commands that read tensors have in common: their arguments, and reading."""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from hks_jax.cli.arguments import parse_boundary, parse_slice
from hks_jax.cli.progress import Progress
from hks_jax.eigen.solve import SOLVERS
from hks_jax.io import ORDERS, TensorVolume, erode, read_mask, read_tensors
from hks_jax.io.nifti import is_nifti


def add_tensor_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say which tensors are read, and where the results go."""
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
    add("--order", choices=tuple(ORDERS), help="order of the six components, where a NIfTI file does not declare it")
    add("--dtype", choices=("float32", "float64"), default="float64", help="precision (default float64)")


def add_eigenpair_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say which eigenpairs are computed."""
    add = parser.add_argument
    add(
        "--boundary",
        type=parse_boundary,
        default="neumann",
        metavar="B",
        help="neumann (default), dirichlet, periodic or mirror; one for all axes, or one per axis as in "
        "neumann,periodic; low:high for the two sides, as in neumann:dirichlet,neumann",
    )
    add("-k", type=int, help="number of eigenpairs (default 200, or a quarter of the unknowns if that is less)")
    add("--solver", choices=("auto", *SOLVERS), default="auto", help="eigensolver (default auto)")


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument that asks for a machine-readable summary."""
    parser.add_argument("--json", action="store_true", help="print a summary as JSON, not the names of the files")


def require_metric(args: argparse.Namespace) -> None:
    """Raise ValueError where diffusion tensors are not yet a metric."""
    if args.metric is None and is_nifti(args.file):
        raise ValueError(
            "--metric: choose one; diffusion tensors D become a metric as inverse (D⁻¹, Brownian motion with "
            "diffusivity D), tensor (D itself) or adjugate (|D|D⁻¹)"
        )


def read_volume(args: argparse.Namespace, progress: Progress) -> TensorVolume:
    """Read the file, cut the slice, and settle the mask.

    Raises:
        FileNotFoundError: no such file.
        ValueError: what cannot be read as tensors, or a slice or a mask that does not fit them.
    """
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
