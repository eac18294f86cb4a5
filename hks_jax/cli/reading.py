"""What commands that read tensors have in common: their options, and the volume that these describe."""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hks_jax.cli.arguments import parse_positive, parse_repair, parse_slice
from hks_jax.cli.progress import READING, Progress, as_options
from hks_jax.io import (
    ORDERS,
    UNITS,
    TensorVolume,
    erode,
    fit_dwi,
    positive_tensors,
    read_mask,
    read_tensors,
    repair_tensors,
)
from hks_jax.io.formats import SUFFIXES, format_of
from hks_jax.io.questions import reviewed
from hks_jax.io.repair import find_background, without_background
from hks_jax.io.units import unit_question

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
    add = parser.add_argument_group("which voxels").add_argument
    add("--slice", type=parse_slice, metavar="AXIS=N", help="only one slice, such as z=14")
    add("--mask", type=Path, metavar="FILE", help="zeros and ones: NIfTI, MRtrix, NRRD, .npy, or .npz with 'mask'")
    add(
        "--background",
        choices=("outside", "inside"),
        help="without a mask: whether voxels that a program filled with one isotropic tensor, or near zero, "
        "are outside the domain or inside (default: inside, with a warning; exact zeros are outside)",
    )
    add("--erode", type=int, default=0, metavar="N", help="peel N voxels off the mask's rim")
    add = parser.add_argument_group(
        "what the numbers mean", "needed only where the file does not say it; a wrong axis mirrors the tensors"
    ).add_argument
    add("--order", choices=tuple(ORDERS), help="order of the components")
    add(
        "--frame",
        choices=("voxel", "fsl", "world", "measurement"),
        help="axes of the components: the image's own (voxel), those of FSL's b-vectors (fsl: DIPY's and FSL's "
        "tensors), the scanner's (world: MRtrix's), or NRRD's measurement frame",
    )
    add(
        "--unit",
        choices=tuple(UNITS),
        help="of the tensors; they are converted to mm2/s. Water in living tissue has about 7e-4 mm2/s, which is 0.7 "
        "um2/ms, 700 um2/s (TORTOISE) or 7e-10 m2/s. With --bval: the reciprocal of the b-values' unit",
    )
    add("--array", metavar="NAME", help="the array of tensors in an npz or VTK file that has several")
    add("--spacing", type=float, nargs="+", metavar="H", help="distance between nodes, for .npy and .npz without one")
    add("--confidence", type=float, default=0.5, metavar="C", help="NRRD's masked tensors are inside above it (0.5)")
    add = parser.add_argument_group(
        "tensors that are not positive definite", "without one of these they are refused"
    ).add_argument
    add(
        "--repair",
        type=parse_repair,
        metavar="HOW[:FLOOR]",
        help="a few of them: clip raises their eigenvalues to FLOOR (a hundredth of the median mean eigenvalue), mask "
        "leaves them out, nearest takes the nearest valid one; those with an eigenvalue below FLOOR, if given, are "
        "treated alike",
    )
    add(
        "--positive",
        type=parse_positive,
        metavar="HOW:NUMBER",
        help="tensors that are indefinite by nature, such as stress: a metric is made of every one, exp:S takes "
        "exp(T/S), shift:C takes T + C·I; go on with --metric tensor",
    )
    dwi = parser.add_argument_group(
        "diffusion-weighted images", "Tensors are fitted by DIPY; without --mask inside what its median_otsu finds."
    )
    dwi.add_argument("--bval", type=Path, metavar="FILE", help="b-values, in s/mm2 unless --unit says otherwise")
    dwi.add_argument(
        "--bvec",
        type=Path,
        metavar="FILE",
        help="gradient directions of length 1, three rows or three columns, as dcm2niix writes them (see --bvec-frame)",
    )
    dwi.add_argument(
        "--bvec-frame",
        choices=("fsl", "voxel", "world"),
        help="axes of the directions: the image's, the first reversed where the affine's determinant is positive (fsl, "
        "the default: FSL, dcm2niix, BIDS), the image's as they are (voxel), or the scanner's (world: MRtrix)",
    )
    dwi.add_argument(
        "--b-max", type=float, metavar="B", help="leave out images with larger b, in s/mm2; tensors suit b ≲ 1500"
    )


def defaults(*adding: Callable[[argparse.ArgumentParser], None]) -> dict[str, Any]:
    """Return what the options are that functions add, here `add_options`, unless they are given."""
    parser = argparse.ArgumentParser(add_help=False)
    for add in adding or (add_options,):
        add(parser)
    return vars(parser.parse_args([]))


def read(args: argparse.Namespace, progress: Progress, ask: Callable[[str], None] | None = None) -> TensorVolume:
    """Read or fit the tensors, cut the slice, settle the mask, and repair if asked to.

    Args:
        args: the command's arguments. With ``strict_unit``, tensors of an implausible unit are refused unless
            ``--unit`` says that they have it.
        progress: what says notes, and what is to be doubted.
        ask: what says the latter instead.
    """
    volume, mask = _load(args)
    if mask is not None and mask.shape == volume.shape:
        volume, mask = volume.with_mask(mask), None
    if mask is None:  # what a program filled in says nothing of units and axes
        volume = _without_filling(without_background(volume), args.background, progress)
    volume = _reviewed(volume, args, progress.warn if ask is None else ask)
    if args.slice is not None:
        try:
            volume = volume.slice(*args.slice)
        except ValueError as error:
            raise ValueError(f"--slice: {error}") from error
    if mask is not None:  # it may be one of the slice alone
        if mask.shape != volume.shape:
            raise ValueError(f"--mask: got shape {mask.shape}; expected the shape of the tensors, {volume.shape}")
        volume = without_background(volume.with_mask(mask))
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


def _reviewed(volume: TensorVolume, args: argparse.Namespace, ask: Callable[[str], None]) -> TensorVolume:
    """Ask what the tensors give reason to; return them with notes of what their fibres tell."""
    if args.positive is not None:  # of no diffusion
        return volume
    volume, asked = reviewed(volume)
    for question in asked:
        spelled = as_options(question, READING)
        if getattr(args, "strict_unit", False) and not volume.unit and question == unit_question(volume):
            raise ValueError(
                f"{args.file}: {spelled}. If the numbers are right pass --unit mm2/s: the subjects of a study must "
                "have the same unit, in the table by a column unit"
            )
        ask(spelled)
    return volume


def _without_filling(volume: TensorVolume, background: str | None, progress: Progress) -> TensorVolume:
    """Return the volume without what looks like background, if that is to be outside; warn if nothing is said of it."""
    found = None if background == "inside" else find_background(volume)
    if found is None:
        return volume
    if background is None:
        progress.warn(f"{found[1]}. Pass --mask, or --background outside, or inside if they are of the domain")
        return volume
    note = found[1].replace("count as inside", "are left out as asked")
    return replace(volume.with_mask(~found[0]), notes=(*volume.notes, note))


def _count_clipped(volume: TensorVolume) -> int:
    """Count the fitted tensors inside with an eigenvalue below a hundredth of the median mean eigenvalue."""
    values = np.linalg.eigvalsh(volume.tensors[volume.inside])
    return int((values[:, 0] < 0.01 * np.median(values.mean(axis=-1))).sum())


def image_suffix(path: Path) -> str:
    """Return the suffix of images in the format of a file; of NumPy's files none."""
    return format_of(path).image


def _load(args: argparse.Namespace) -> tuple[TensorVolume, np.ndarray | None]:
    """Return the volume, and the mask where that is still to be laid over it."""
    if args.bval is None and args.bvec is None:
        if args.b_max is not None:
            raise ValueError("--b-max: it is for diffusion-weighted images; pass --bval and --bvec too")
        if args.bvec_frame is not None:
            raise ValueError("--bvec-frame: it is for diffusion-weighted images; of tensors pass --frame")
        spacing = args.spacing[0] if args.spacing is not None and len(args.spacing) == 1 else args.spacing
        volume = read_tensors(
            [args.file, *args.others] if args.others else args.file,
            args.order,
            frame=args.frame,
            array=args.array,
            spacing=spacing,
            confidence=args.confidence,
            unit=args.unit,
        )
        return volume, None if args.mask is None else read_mask(args.mask, volume.affine)
    if args.others:
        raise ValueError(f"FILE: got {1 + len(args.others)} files; --bval and --bvec belong to one file of all images")
    if args.bval is None or args.bvec is None:
        raise ValueError("--bval, --bvec: got one of them; diffusion-weighted images need both")
    for option in ("order", "frame", "array", "spacing"):
        if getattr(args, option) is not None:
            instead = "pass --bvec-frame" if option == "frame" else "leave it out with --bval and --bvec"
            raise ValueError(f"--{option}: it is for files of tensors; {instead}")
    axes = {} if args.bvec_frame is None else {"bvec_frame": args.bvec_frame}
    noise: Literal["residuals"] | None = "residuals" if getattr(args, "noise", None) == "residuals" else None
    return fit_dwi(args.file, args.bval, args.bvec, args.mask, args.b_max, unit=args.unit, noise=noise, **axes), None
