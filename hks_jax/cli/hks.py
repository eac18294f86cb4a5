"""``hks-jax hks FILE -o OUT``: the heat kernel signature of a tensor field in a file."""

import argparse
import sys
from typing import Any

from hks_jax.cli.arguments import parse_times
from hks_jax.cli.inputs import add_eigenpair_arguments, add_tensor_arguments, read_volume, require_metric
from hks_jax.cli.progress import Progress
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
    add_tensor_arguments(parser)
    add_eigenpair_arguments(parser)
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
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand."""
    times = parse_times(args.times)
    require_metric(args)
    from hks_jax.cli.job import Settings, compute
    from hks_jax.cli.outputs import check_folder, write_outputs
    from hks_jax.cli.picture import draw

    check_folder(args.output)
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        with progress.stage("reading", str(args.file)):
            volume = read_volume(args, progress)
        settings = Settings(
            metric=args.metric or "tensor",
            k=args.k,
            boundary=args.boundary,
            times=times,
            components=args.components,
            solver=args.solver,
            normalisation=args.normalisation,
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
