"""Refuse options that do not fit each other, or do not fit the kind of the file."""

import argparse
from collections.abc import Iterable
from typing import Any, Literal

from hks_jax.checks import require_count
from hks_jax.cli.options import (
    add_meshes,
    add_metric,
    add_noise,
    add_reading,
    add_signature,
    add_solving,
    add_view,
    defaults,
    flag,
)
from hks_jax.fem.problems import MESH_BOUNDARIES
from hks_jax.io import TensorVolume
from hks_jax.uncertainty.propagate import LEAST

Kind = Literal["mesh", "pairs", "tensors"]
"""The kinds of files with a domain: meshes, saved eigenpairs, and tensors or the images to which they are fitted."""

_USUAL = defaults(add_metric, add_reading, add_solving, add_meshes, add_signature, add_noise, add_view)
_NO_NOISE = "this option needs tensors; saved eigenpairs and meshes with the Euclidean metric have none. Leave it out"


def refuse(args: Any, names: Iterable[str], why: str) -> None:
    """Raise ValueError with the reason `why` if one of the named options is given; `args` may lack some of them."""
    for name in names:
        usual = _USUAL.get(name)
        if (value := getattr(args, name, usual)) != usual and value is not False:
            raise ValueError(f"{flag(name)}: {why}")


def require_fitting(args: argparse.Namespace, kind: Kind) -> None:
    """Raise ValueError for options that do not fit a file of this kind, from which eigenpairs are computed or read."""
    if kind == "mesh":
        if args.others:
            raise ValueError(f"FILE: got {1 + len(args.others)} files; expected one mesh")
        if not (args.array or args.tensors):
            why = "this option needs tensors, but without --array and --tensors a mesh has the Euclidean metric"
            why += ". Pass --array or --tensors, or leave this option out"
            refuse(args, ("metric", "operator", "order", "interpolation"), why)
            refuse(args, ("noise",), _NO_NOISE)
        elif args.metric is None and args.operator != "fick":
            raise ValueError(
                "--metric: the tensors of the mesh need a metric. Choose inverse, tensor or adjugate, or pass "
                "--operator fick"
            )
        require_one_metric(args.metric, args.operator)
        require_mesh_options(args)
    else:
        require_grid_options(args)
        refuse(args, ("tensors",), "this option is for a mesh inside a volume; leave it out for the volume itself")
    if kind == "pairs":
        refuse(args, ("noise",), _NO_NOISE)
        why = f"the eigenpairs in {args.file} determine this setting; leave the option out"
        refuse(args, (*defaults(add_metric, add_reading, add_solving), "save_pairs"), why)
    require_noise_options(args)


def require_mesh_options(args: argparse.Namespace) -> None:
    """Raise ValueError for options that no mesh has, and for a boundary condition that meshes lack."""
    of_grids = ["slice", "through", "view", "save_pairs", "components", "method"]
    if not args.tensors:  # with --tensors, the options for reading refer to the volume
        of_grids += [name for name in defaults(add_reading) if name not in ("order", "array")]
    elif args.array:
        raise ValueError("--tensors, --array: got both; expected tensors either in a volume or in the mesh's file")
    refuse(args, of_grids, "this option is for tensors on a grid; leave it out for a mesh")
    if args.boundary not in (None, *MESH_BOUNDARIES):
        raise ValueError(f"--boundary: got {args.boundary!r}; expected {', '.join(MESH_BOUNDARIES)} for a mesh")


def require_grid_options(args: argparse.Namespace) -> None:
    """Raise ValueError for options that only meshes have."""
    refuse(args, ("clean", "inside"), "this option is for meshes; for tensors on a grid, see --repair and --mask")


def require_reading_options(args: Any) -> None:
    """Raise ValueError for options of tensors beside diffusion-weighted images, and for options of images without."""
    if args.bval is None and args.bvec is None:
        refuse(args, ("b_max",), "this option is for diffusion-weighted images; pass --bval and --bvec too")
        refuse(args, ("bvec_frame",), "this option is for diffusion-weighted images; for tensors pass --frame")
        return
    if args.others:
        raise ValueError(f"FILE: got {1 + len(args.others)} files; expected one file of all images for --bval, --bvec")
    if args.bval is None or args.bvec is None:
        raise ValueError("--bval, --bvec: got one option; expected both for diffusion-weighted images")
    refuse(args, ("frame",), "this option is for files of tensors; pass --bvec-frame")
    refuse(args, ("order", "array", "spacing"), "this option is for files of tensors; leave it out with --bval")


def require_metric(reading: Any, volume: TensorVolume | None = None) -> None:
    """Raise ValueError if the file has diffusion tensors and neither metric nor Fick's operator is chosen, or both.

    Of NumPy's files, only those with lengths in mm have diffusion tensors, which `volume` shows after the file is read.
    """
    require_one_metric(reading.metric, reading.operator)
    if reading.operator == "fick" or reading.metric is not None:
        return
    if reading.image if volume is None else volume.length_unit:
        raise ValueError(
            "--metric: choose the metric of the diffusion tensors D: inverse (D⁻¹, in which points are near if "
            "diffusion is fast), tensor (D itself) or adjugate (|D|D⁻¹); or pass --operator fick (diffusion by Fick's "
            "law)"
        )


def require_one_metric(metric: str | None, operator: str) -> None:
    """Raise ValueError for a metric beside Fick's operator."""
    if operator == "fick" and metric is not None:
        raise ValueError(
            f"--metric: got {metric} with --operator fick, whose metric is D⁻¹. Leave out --metric, or use "
            "--operator laplace-beltrami"
        )


def require_noise_options(args: argparse.Namespace) -> None:
    """Raise ValueError for error bars by a method other than ``"spectral"`` or with too few draws, and a checkpoint."""
    if getattr(args, "noise", None) is None:
        refuse(args, ("checkpoint",), "this option is for error bars; add --noise or leave it out")
        return
    require_count("--draws", args.draws, LEAST)
    if args.method != "spectral":
        raise ValueError(f"--noise: got --method {args.method}; expected spectral. Leave one of the options out")
