"""What commands that read tensors have in common: their options, and the volume that these describe."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli.arguments import parse_positive, parse_repair, parse_slice
from hks_jax.cli.progress import Progress
from hks_jax.cli.spelling import READING, as_options
from hks_jax.io import ORDERS, TensorVolume, erode, fit_dwi, positive_tensors, read_mask, read_tensors, repair_tensors
from hks_jax.io.mrtrix import is_mrtrix
from hks_jax.io.nifti import is_nifti
from hks_jax.io.nrrd import is_nrrd
from hks_jax.io.read import SUFFIXES
from hks_jax.io.repair import without_background
from hks_jax.io.vtk_image import is_vtk_image

FILES = ", ".join(SUFFIXES)


class _FirstAndOthers(argparse.Action):
    """Keeps the first of several files apart from the others."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, *_option: Any
    ) -> None:
        namespace.file, namespace.others = values[0], values[1:]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add FILE, and the options that say what of it to read, and how."""
    add_file_argument(parser)
    add_options(parser)


def add_file_argument(parser: argparse.ArgumentParser) -> None:
    """Add FILE."""
    parser.add_argument(
        "file",
        metavar="FILE",
        type=Path,
        nargs="+",
        action=_FirstAndOthers,
        help=f"tensors: {FILES}; or the six images of one component each (…txx… to …tzz…), or one of them; or "
        "diffusion-weighted images with --bval, --bvec",
    )
    parser.set_defaults(others=[])


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what of FILE to read, and how."""
    add = parser.add_argument
    add("--slice", type=parse_slice, metavar="AXIS=N", help="only one slice, such as z=14")
    add("--mask", type=Path, metavar="FILE", help="zeros and ones: NIfTI, MRtrix, NRRD, .npy, or .npz with 'mask'")
    add("--erode", type=int, default=0, metavar="N", help="peel N voxels off the mask's rim")
    add(
        "--repair",
        type=parse_repair,
        metavar="HOW[:FLOOR]",
        help="tensors that are not positive definite: clip raises their eigenvalues to FLOOR (a hundredth of the "
        "median mean eigenvalue), mask leaves them out, nearest takes the nearest valid one; those with an eigenvalue "
        "below FLOOR, if given, are treated alike; without this option they are refused",
    )
    add(
        "--positive",
        type=parse_positive,
        metavar="HOW:NUMBER",
        help="tensors that are indefinite by nature, such as stress: a metric is made of every one, exp:S takes "
        "exp(T/S), shift:C takes T + C·I; go on with --metric tensor",
    )
    add("--order", choices=tuple(ORDERS), help="order of the components, where the file does not declare it")
    add("--frame", choices=("voxel", "fsl", "world", "measurement"), help="axes of the components, likewise")
    add("--array", metavar="NAME", help="the array of tensors in an npz or VTK file that has several")
    add("--spacing", type=float, nargs="+", metavar="H", help="distance between nodes, for .npy and .npz without one")
    add("--confidence", type=float, default=0.5, metavar="C", help="NRRD's masked tensors are inside above it (0.5)")
    dwi = parser.add_argument_group(
        "diffusion-weighted images", "Tensors are fitted by DIPY; without --mask inside what its median_otsu finds."
    )
    dwi.add_argument("--bval", type=Path, metavar="FILE", help="b-values, s/mm²")
    dwi.add_argument("--bvec", type=Path, metavar="FILE", help="gradient directions")
    dwi.add_argument("--b-max", type=float, metavar="B", help="leave out images with larger b; tensors suit b ≲ 1500")


def defaults() -> dict[str, Any]:
    """Return what the options are unless given."""
    parser = argparse.ArgumentParser(add_help=False)
    add_options(parser)
    return vars(parser.parse_args([]))


def read(args: argparse.Namespace, progress: Progress) -> TensorVolume:
    """Read or fit the tensors, cut the slice, settle the mask, and repair if asked to."""
    volume, mask = _load(args)
    if mask is not None and mask.shape == volume.shape:
        volume, mask = volume.with_mask(mask), None
    if args.slice is not None:
        try:
            volume = volume.slice(*args.slice)
        except ValueError as error:
            raise ValueError(f"--slice: {error}") from error
    if mask is not None:  # it may be one of the slice alone
        if mask.shape != volume.shape:
            raise ValueError(f"--mask: got shape {mask.shape}; expected the shape of the tensors, {volume.shape}")
        volume = volume.with_mask(mask)
    volume = without_background(volume)
    if args.erode:
        volume = volume.with_mask(erode(volume.inside, args.erode))
    if args.positive is not None:
        if args.repair is not None:
            raise ValueError("--positive, --repair: got both; --positive leaves nothing to repair")
        try:
            volume = positive_tensors(volume, *args.positive)
        except ValueError as error:
            raise ValueError(f"--positive: {str(error).removeprefix('number: ')}") from error
    if args.repair is not None:
        volume = repair_tensors(volume, *args.repair)
        volume = volume if volume.repair["voxels"] else replace(volume, notes=(*volume.notes, "repair: not needed"))
    for note in volume.notes:
        progress.note(as_options(note, READING))
    if args.bval is not None and (clipped := _count_clipped(volume)):
        progress.warn(
            f"{clipped} tensors inside have an eigenvalue near zero: DIPY clips fits that are not positive definite. "
            "Distances in D⁻¹ are enormous there; --erode 1 takes the rim off, --repair nearest:1e-4 replaces them"
        )
    return volume


def _count_clipped(volume: TensorVolume) -> int:
    """Count the fitted tensors inside with an eigenvalue below a hundredth of the median mean eigenvalue."""
    values = np.linalg.eigvalsh(volume.tensors[volume.inside])
    return int((values[:, 0] < 0.01 * np.median(values.mean(axis=-1))).sum())


def image_suffix(path: Path) -> str:
    """Return the suffix of images in the format of a file; of NumPy's files none."""
    known = ((is_nifti, ".nii.gz"), (is_mrtrix, ".nii.gz"), (is_nrrd, ".nrrd"), (is_vtk_image, ".vti"))
    return next((suffix for test, suffix in known if test(path)), "")


def _load(args: argparse.Namespace) -> tuple[TensorVolume, np.ndarray | None]:
    """Return the volume, and the mask where that is still to be laid over it."""
    if args.bval is None and args.bvec is None:
        if args.b_max is not None:
            raise ValueError("--b-max: it is for diffusion-weighted images; pass --bval and --bvec too")
        spacing = args.spacing[0] if args.spacing is not None and len(args.spacing) == 1 else args.spacing
        volume = read_tensors(
            [args.file, *args.others] if args.others else args.file,
            args.order,
            frame=args.frame,
            array=args.array,
            spacing=spacing,
            confidence=args.confidence,
        )
        return volume, None if args.mask is None else read_mask(args.mask, volume.affine)
    if args.others:
        raise ValueError(f"FILE: got {1 + len(args.others)} files; --bval and --bvec belong to one file of all images")
    if args.bval is None or args.bvec is None:
        raise ValueError("--bval, --bvec: got one of them; diffusion-weighted images need both")
    for option in ("order", "frame", "array", "spacing"):
        if getattr(args, option) is not None:
            raise ValueError(f"--{option}: it is for files of tensors; leave it out with --bval and --bvec")
    return fit_dwi(args.file, args.bval, args.bvec, args.mask, args.b_max), None
