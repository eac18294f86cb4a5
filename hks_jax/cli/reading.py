"""Read the volume of tensors that the options for reading describe."""

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool

from hks_jax.cli.options import refuse
from hks_jax.cli.progress import Progress
from hks_jax.domain.components import label_nodes
from hks_jax.io import TensorVolume, erode, fit_dwi, positive_tensors, read_mask, read_tensors, repair_tensors
from hks_jax.io.formats import format_of
from hks_jax.io.plausibility import reviewed
from hks_jax.io.repair import find_background, require_valid, without_background
from hks_jax.io.units import unit_question
from hks_jax.naming import with_option


def require_metric(args: argparse.Namespace, volume: TensorVolume | None = None) -> None:
    """Raise ValueError if the file has diffusion tensors and neither metric nor Fick's operator is chosen, or both.

    Of NumPy's files, only those with lengths in mm have diffusion tensors, which `volume` shows after the file is read.
    """
    if args.operator == "fick":
        require_one(args)
    elif args.metric is None and (format_of(args.file).image if volume is None else volume.length_unit):
        raise ValueError(
            "--metric: choose the metric of the diffusion tensors D: inverse (D⁻¹, in which points are near if "
            "diffusion is fast), tensor (D itself) or adjugate (|D|D⁻¹); or pass --operator fick (diffusion by Fick's "
            "law)"
        )


def require_one(args: argparse.Namespace) -> None:
    """Raise ValueError for a metric beside Fick's operator."""
    if args.operator == "fick" and args.metric is not None:
        raise ValueError(
            f"--metric: got {args.metric} with --operator fick, whose metric is D⁻¹. Leave out --metric, or use "
            "--operator laplace-beltrami"
        )


def read_volume(args: argparse.Namespace, progress: Progress) -> TensorVolume:
    """Read the tensors by `read`, and raise ValueError if they do not define a metric."""
    require_metric(args)
    volume = read(args, progress)
    require_metric(args, volume)
    if 1 in volume.shape:
        raise ValueError(f"--slice: the volume is one voxel thick. Pass --slice {'xyz'[volume.shape.index(1)]}=0")
    if lost := int(without_element(volume).sum()):
        progress.note(outside_note(lost))
    require_valid(volume.with_mask(volume.grid(args.components).mask), "--repair")
    return volume


def without_element(volume: TensorVolume) -> Bool[np.ndarray, "*shape"]:
    """Mark the voxels of the mask that belong to no element, which the computation leaves out."""
    return volume.inside & (label_nodes(volume.inside, (False,) * volume.dimension)[0] == 0)


def outside_note(count: int) -> str:
    """Return a note about voxels of the mask that belong to no element."""
    return (
        f"{count} voxels of the mask are left out, because they belong to no element; an element is a cube (in a slice "
        "a square) of adjacent voxels of the mask"
    )


def read(args: argparse.Namespace, progress: Progress, ask: Callable[[str], None] | None = None) -> TensorVolume:
    """Read or fit the tensors, and apply the options for the slice, the mask and the repair.

    Questions about the frame or unit go to `ask` or become warnings. With ``args.strict_unit``, an implausible mean
    diffusivity without ``--unit`` raises ValueError.
    """
    with progress.stage("reading", str(args.file)):
        volume, mask = _load(args)
        if mask is not None and mask.shape == volume.shape:
            volume, mask = volume.with_mask(mask), None
        if mask is None:  # the background would distort the checks of units and frames
            volume = _without_filling(volume, args, progress)
        volume = _reviewed(volume, args, progress.warn if ask is None else ask)
        if args.slice is not None:
            volume = sliced(volume, *args.slice)
        if mask is not None:  # the mask may have the shape of the slice
            if mask.shape != volume.shape:
                raise ValueError(f"--mask: got shape {mask.shape}; expected the shape of the tensors, {volume.shape}")
            volume = volume.with_mask(mask)
        if args.erode:
            volume = volume.with_mask(erode(volume.inside, args.erode))
        volume = _repaired(volume, args)
    for note in volume.notes:
        progress.note(with_option(note))
    return volume


def sliced(volume: TensorVolume, axis: str, index: int) -> TensorVolume:
    """Return a slice of a volume; errors begin with the option ``--slice``."""
    try:
        return volume.slice(axis, index)
    except ValueError as error:
        raise ValueError(f"--slice: {error}") from error


def _load(args: argparse.Namespace) -> tuple[TensorVolume, np.ndarray | None]:
    """Return the volume, and the mask of ``--mask`` unless the volume has this mask already."""
    if args.bval is None and args.bvec is None:
        refuse(args, ("b_max",), "this option is for diffusion-weighted images; pass --bval and --bvec too")
        refuse(args, ("bvec_frame",), "this option is for diffusion-weighted images; for tensors pass --frame")
        spacing = args.spacing[0] if args.spacing is not None and len(args.spacing) == 1 else args.spacing
        files, names = [args.file, *args.others] if args.others else args.file, ("frame", "array", "confidence", "unit")
        volume = read_tensors(files, args.order, spacing=spacing, **{name: getattr(args, name) for name in names})
        return volume, None if args.mask is None else read_mask(args.mask, volume.affine)
    if args.others:
        raise ValueError(f"FILE: got {1 + len(args.others)} files; expected one file of all images for --bval, --bvec")
    if args.bval is None or args.bvec is None:
        raise ValueError("--bval, --bvec: got one option; expected both for diffusion-weighted images")
    refuse(args, ("frame",), "this option is for files of tensors; pass --bvec-frame")
    refuse(args, ("order", "array", "spacing"), "this option is for files of tensors; leave it out with --bval")
    noise: Literal["residuals"] | None = "residuals" if getattr(args, "noise", None) == "residuals" else None
    axes: dict[str, Any] = {"bvec_frame": args.bvec_frame or "fsl"}
    files = (args.file, args.bval, args.bvec, args.mask)
    return fit_dwi(*files, args.b_max, unit=args.unit, noise=noise, **axes), None


def _without_filling(volume: TensorVolume, args: argparse.Namespace, progress: Progress) -> TensorVolume:
    """Exclude the background if ``--background outside`` is given; without the option, warn of a background.

    Zero tensors are always background, except with ``--positive``: zero is a valid stress.
    """
    if args.positive is None or args.background == "outside":
        volume = without_background(volume)
    found = None if args.background == "inside" else find_background(volume)
    if found is None:
        return volume
    if args.background is None:
        progress.warn(f"{found[1]}. Pass --mask or --background outside, or --background inside to include them")
        return volume
    note = found[1].replace("count as inside", "are left out, as asked")
    return replace(volume.with_mask(~found[0]), notes=(*volume.notes, note))


def _reviewed(volume: TensorVolume, args: argparse.Namespace, ask: Callable[[str], None]) -> TensorVolume:
    """Ask questions about a wrong frame or unit; return the volume with a note about its fibres."""
    if args.positive is not None:  # the tensors, such as stresses, are not diffusion tensors
        return volume
    volume, asked = reviewed(volume)
    for question in asked:
        if getattr(args, "strict_unit", False) and not volume.unit and question == unit_question(volume):
            raise ValueError(
                f"{args.file}: {question}. The tensors of all subjects must have the same unit. If the "
                "numbers are in mm²/s, pass --unit mm2/s, or add a column named unit to the table"
            )
        ask(question)
    return volume


def _repaired(volume: TensorVolume, args: argparse.Namespace) -> TensorVolume:
    if args.positive is not None:
        if args.repair is not None:
            raise ValueError("--positive, --repair: got both, but --positive leaves nothing to repair. Leave one out")
        try:
            return positive_tensors(volume, *args.positive)
        except ValueError as error:
            raise ValueError(f"--positive: {str(error).removeprefix('number: ')}") from error
    if args.repair is None:
        return volume
    volume = repair_tensors(volume, *args.repair)
    return volume if volume.repair["voxels"] else replace(volume, notes=(*volume.notes, "repair: none was needed"))
