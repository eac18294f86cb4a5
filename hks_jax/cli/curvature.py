"""``hks-jax curvature FILE -o OUT``: the Gaussian curvature of a two-dimensional tensor field in a file."""

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from hks_jax.cli.inputs import (
    add_command,
    add_json_argument,
    add_tensor_arguments,
    add_view_argument,
    read_volume,
    require_metric,
)
from hks_jax.cli.job import describe_input, field_of
from hks_jax.cli.outputs import check_folder, show_files, writing
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import image_suffix
from hks_jax.curvature import gaussian_curvature
from hks_jax.io import TensorVolume, save
from hks_jax.io.formats import WRITTEN

if TYPE_CHECKING:
    from hks_jax.plot.orientation import View

DESCRIPTION = """\
Compute the Gaussian curvature of a two-dimensional field of diffusion tensors, or of a slice. FILE is read as by
'hks-jax hks'.

Writes to the folder OUT: curvature.npz, curvature.nii.gz (or .nrrd, .vti, as FILE is), curvature.png and report.json.
"""

EPILOG = """\
examples:
  hks-jax curvature tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse
  hks-jax curvature torus.npz -o out --periodic xy --json
"""

COLOURED = 0.98
"""The part of the values that the colours span: differences of noisy tensors have a few wild ones."""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser = add_command(
        subparsers, "curvature", "compute the Gaussian curvature of a 2D field", DESCRIPTION, EPILOG, "FILE -o OUT"
    )
    add_tensor_arguments(parser)
    parser.add_argument(
        "--periodic", choices=("x", "y", "xy"), default="", help="axes of which node n is node 0 (default none)"
    )
    add_view_argument(parser)
    add_json_argument(parser)
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand.

    Raises:
        ValueError: tensors that have no Gaussian curvature that could be computed.
    """
    require_metric(args)
    from hks_jax.plot import save_figure

    check_folder(args.output)
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        with progress.stage("reading", str(args.file)):
            volume = read_volume(args, progress)
            if volume.dimension != 2:
                raise ValueError(
                    f"--slice: the tensors are on a volume of shape {volume.shape}, and Gaussian curvature belongs to "
                    "two dimensions; choose a slice, such as --slice z=14"
                )
            field = field_of(volume, volume.grid(args.components), args.metric or "tensor", args.dtype)
        with progress.stage("curvature", f"{int(field.grid.inside.sum())} nodes"):
            curvature = np.asarray(gaussian_curvature(field, ["x" in args.periodic, "y" in args.periodic]))
        known = np.isfinite(curvature)
        lacking = int((field.grid.inside & ~known).sum())
        if not known.any():
            raise ValueError("tensors: no grid line inside the mask has the 8 nodes that the differences need")
        if lacking:
            progress.note(f"{lacking} nodes are too near the mask's rim for the differences: NaN there")
        density = np.sqrt(np.linalg.det(np.asarray(field.domain_tensors, np.float64)))[known]
        values = curvature[known].astype(np.float64)
        report = {
            "input": describe_input(volume, field.grid.mask),
            "settings": {"metric": args.metric or "tensor", "periodic": args.periodic, "dtype": args.dtype},
            "curvature": {
                "nodes": int(known.sum()),
                "lacking": lacking,
                "least": float(values.min()),
                "median": float(np.median(values)),
                "greatest": float(values.max()),
                "total": float(values @ density * np.prod(field.grid.spacing)),
            },
        }
        volume = volume.with_mask(field.grid.mask)
        stale = [args.output / f"curvature{suffix}" for suffix in WRITTEN]
        with writing(args.output, report, progress, lambda: stale) as (folder, files):
            save(folder / "curvature.npz", curvature, volume, name="curvature")
            if image := image_suffix(args.file):
                save(folder / f"curvature{image}", curvature, volume, name="curvature")
            save_figure(draw(curvature, volume, args.view), folder / "curvature.png")
    show_files(files, args.quiet, args.json)


def draw(curvature: Float[np.ndarray, "nx ny"], volume: TensorVolume, view: "View") -> Any:
    """Return the picture: colours on either side of zero, as many as the values reach but for a few."""
    from hks_jax.cli.picture import cropped, placed, proportion
    from hks_jax.plot import new_figure, scalar_image

    grid, box = cropped(volume, np.isfinite(curvature))
    limit = float(np.nanquantile(np.abs(curvature), COLOURED)) or 1.0
    orientation = placed(volume, box, view)
    figure = new_figure(4.8, 3.6 * proportion(grid, orientation) + 0.6)
    ax = figure.subplots()
    colours: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "label": "in 1/length² of the metric"}
    scalar_image(ax, curvature[box], grid, orientation=orientation, **colours)
    ax.set_title("Gaussian curvature", fontsize="medium")
    return figure
