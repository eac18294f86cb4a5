"""What the commands that compute with tensors have in common: their arguments, and the volume these describe."""

import argparse
from pathlib import Path
from typing import Any

from hks_jax.cli.arguments import parse_boundary
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import add_file_argument, add_options, image_suffix, read
from hks_jax.eigen.automatic import SOLVERS
from hks_jax.io import TensorVolume
from hks_jax.io.repair import require_valid


def add_command(
    subparsers: Any, name: str, summary: str, description: str, examples: str, usage: str = ""
) -> argparse.ArgumentParser:
    """Add a subcommand's parser, whose help keeps the lines of its texts.

    Args:
        subparsers: what it is added to.
        name: of the subcommand.
        summary: what it does, in one line.
        description: what it does, reads and writes.
        examples: what ends the help.
        usage: the arguments that a line of usage names before the options; empty for a line of all options.
    """
    parser: argparse.ArgumentParser = subparsers.add_parser(
        name,
        help=summary,
        usage=f"%(prog)s {usage} [options]" if usage else None,
        description=description,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    return parser


def add_tensor_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that say which tensors are read, and where the results go."""
    add_file_argument(parser)
    add_tensor_options(parser)
    parser.add_argument("-o", "--output", metavar="OUT", type=Path, required=True, help="folder for the results")


def add_tensor_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how tensors are read, and what metric they make."""
    parser.add_argument_group("the metric").add_argument(
        "--metric",
        choices=("tensor", "inverse", "adjugate"),
        help="how distances are made of diffusion tensors D. inverse: D⁻¹, in which places are near if water gets "
        "quickly from one to the other, as along a fibre; t is then the time of diffusion, in s for D in mm2/s and "
        "voxels in mm; take it for diffusion MRI unless you know better. tensor: D itself taken for a metric, near is "
        "where water is slow. adjugate: |D|D⁻¹, D⁻¹ with other areas. Must be chosen but for NumPy's files, which "
        "hold the metric itself unless you choose",
    )
    add_options(parser)
    add = parser.add_argument
    add(
        "--components",
        choices=("raise", "largest", "all"),
        default="raise",
        help="where the mask falls apart: stop (default), keep the largest piece, or keep all",
    )
    add("--dtype", choices=("float32", "float64"), default="float64", help="precision (default float64)")


def add_interpolation_argument(parser: argparse._ActionsContainer) -> None:
    """Add the argument that says what lies between the nodes."""
    parser.add_argument(
        "--interpolation",
        choices=("linear", "log-euclidean"),
        default="linear",
        help="of the metric between the nodes: its components (default), or those of its logarithm, which keeps the "
        "volume where tensors turn",
    )


def add_eigenpair_arguments(parser: argparse.ArgumentParser, unless_given: str, boundary: str | None = None) -> None:
    """Add the arguments that say which eigenpairs are computed.

    Args:
        parser: what they are added to.
        unless_given: which boundary there is without ``--boundary``, and why, for the help.
        boundary: the same, where it is known before the domain is.
    """
    group = parser.add_argument_group("the eigenpairs")
    add_interpolation_argument(group)
    add = group.add_argument
    add(
        "--boundary",
        type=parse_boundary,
        default=boundary,
        metavar="B",
        help="neumann; mean, of Neumann and Dirichlet, under which the rim of a mask hardly shows; dirichlet, "
        "dirichlet-rim (the rim of a mask, too), periodic or mirror; one for all axes, or one per axis as in "
        "neumann,periodic, and then one for the rim of a mask; low:high for the two sides, as in "
        f"neumann:dirichlet,neumann (default {unless_given})",
    )
    add(
        "-k",
        type=int,
        help="number of eigenpairs, under the mean of both problems together (default 200, for a volume 100, or a "
        "quarter of the unknowns if that is less)",
    )
    add("--solver", choices=("auto", *SOLVERS), default="auto", help="eigensolver (default auto)")


def add_clean_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument that asks for a mesh to be put right."""
    parser.add_argument(
        "--clean",
        action="store_true",
        help="of a mesh: merge vertices at the same place, and drop what is NaN, without area, there twice, or unused; "
        "says what was done",
    )


def add_view_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument that says which side of a picture is left."""
    parser.add_argument(
        "--view",
        choices=("neurological", "radiological"),
        default="neurological",
        help="of pictures of a volume that lies in space: neurological, left on the left (default), or radiological, "
        "left on the right. Front and head are on top or on the right, however the voxels are stored",
    )


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument that asks for a machine-readable summary."""
    parser.add_argument("--json", action="store_true", help="print a summary as JSON, not the names of the files")


def require_metric(args: argparse.Namespace) -> None:
    """Raise ValueError where diffusion tensors are not yet a metric."""
    if args.metric is None and image_suffix(args.file):
        raise ValueError(
            "--metric: choose one; diffusion tensors D become a metric as inverse (D⁻¹, Brownian motion with "
            "diffusivity D), tensor (D itself) or adjugate (|D|D⁻¹)"
        )


def require_spectral(args: argparse.Namespace) -> None:
    """Raise ValueError where error bars are asked for of a method that has none."""
    if args.noise is not None and args.method != "spectral":
        raise ValueError(f"--noise: with --method {args.method} there are no error bars; leave one of them out")


def second_scan(args: argparse.Namespace) -> argparse.Namespace | None:
    """Return the arguments that read the second scan that ``--noise`` names; None where it names a number or a word."""
    if args.noise in (None, "residuals", "roughness"):
        return None
    try:
        float(args.noise)
    except ValueError:
        return argparse.Namespace(**{**vars(args), "file": Path(args.noise), "others": [], "noise": None})
    return None


def read_volume(args: argparse.Namespace, progress: Progress) -> TensorVolume:
    """Read the file, cut the slice, settle the mask, and refuse tensors that make no metric.

    Raises:
        FileNotFoundError: no such file.
        ValueError: what cannot be read as tensors, or a slice or a mask that does not fit them.
    """
    volume = read(args, progress)
    if 1 in volume.shape:
        raise ValueError(f"--slice: the volume is one voxel thick; pass --slice {'xyz'[volume.shape.index(1)]}=0")
    require_valid(volume.with_mask(volume.grid(args.components).mask), "--repair")
    return volume
