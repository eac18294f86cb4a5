"""``hks-jax plot RESULT -o PICTURE``: pictures of results that are in files."""

import argparse
import re
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli.arguments import RESOLVED, parse_numbers, parse_slice, parse_times
from hks_jax.cli.inputs import add_command, add_json_argument, add_view_argument
from hks_jax.cli.outputs import check_folder, show_summary
from hks_jax.cli.progress import Progress
from hks_jax.cli.saved import NAMES, Saved
from hks_jax.cli.saved import read_saved as read_saved
from hks_jax.domain.grid import Grid

DESCRIPTION = """\
Draw a result that 'hks-jax hks', 'fit' or 'curvature' has written as npz: an image for each time, or with --points a
curve over the times for each point.
"""

EPILOG = """\
examples:
  hks-jax plot out/hks.npz -o panels.png --times auto:4 --quantiles 0.02,0.9 --unit s
  hks-jax plot out/hks.npz -o curves.pdf --points -22,5 24,5 --unit s --scaled
"""

MANY = 12
"""Images at most, unless times are chosen."""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser = add_command(subparsers, "plot", "draw a result that is in a file", DESCRIPTION, EPILOG)
    # What begins with a minus and a digit is a point, such as -20,35, and no option.
    parser._negative_number_matcher = re.compile(r"-[\d.]")
    add = parser.add_argument
    add("result", metavar="RESULT", type=Path, help="the result: .npz")
    add("-o", "--output", metavar="PICTURE", type=Path, required=True, help="the picture: .png, .pdf, .svg, …")
    add("--array", metavar="NAME", help=f"which array of the file (default: {' or '.join(NAMES)})")
    add(
        "--times",
        nargs="+",
        metavar="T",
        help="some of the saved times, or auto:N for N of them, evenly spaced (default: all, or 12 of more)",
    )
    add("--slice", type=parse_slice, metavar="AXIS=N", help="of a volume, such as z=14 (default: the middle along z)")
    add(
        "--points",
        nargs="+",
        type=_point,
        metavar="X,Y",
        help="curves at these coordinates, as the images show them, not images",
    )
    add(
        "--range",
        default="own",
        metavar="R",
        help="of the colours: own for each image (default) or shared by all, 1 %% of the values at least; or two "
        "numbers LOW,HIGH (write --range=LOW,HIGH where LOW is negative)",
    )
    add("--quantiles", type=_pair, default=(0.0, 1.0), metavar="Q,Q", help="that own and shared ranges span (0,1)")
    add("--cmap", default="viridis", metavar="NAME", help="a colour map of matplotlib (default viridis)")
    add("--scaled", action="store_true", help="curves of (4πt)^(d/2)·HKS, which is 1 for flat space")
    add("--unit", default="", help="the unit of t")
    add("--title", default="", help="a title for the whole picture")
    add("--dpi", type=float, default=150, help="pixels per inch (default 150)")
    add_view_argument(parser)
    add_json_argument(parser)
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand.

    Raises:
        ValueError: a file without a result to draw, or options that do not suit it.
    """
    from matplotlib import colormaps

    from hks_jax.plot import new_figure, save_figure

    limits = _limits(args.range)
    if args.cmap not in colormaps:
        raise ValueError(
            f"--cmap: got {args.cmap!r}; expected a name that matplotlib knows, such as viridis or cividis"
        )
    formats = new_figure(1, 1).canvas.get_supported_filetypes()
    if args.output.suffix.lstrip(".").lower() not in formats:
        raise ValueError(
            f"--output: got {args.output}; expected a name that ends in one of {', '.join(sorted(formats))}"
        )
    check_folder(args.output.parent)
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        saved = read_saved(args.result, args.array)
        chosen = _choose_times(saved, args)
        saved = saved._replace(values=saved.values[chosen], times=None if saved.times is None else saved.times[chosen])
        figure = _panels(saved, args, limits) if args.points is None else _curves(saved, args)
        save_figure(figure, args.output, dpi=args.dpi)
    finite = saved.values[np.isfinite(saved.values)]
    values = {"least": float(finite.min()), "greatest": float(finite.max())}
    times = [] if saved.times is None else saved.times.tolist()
    show_summary(args, [args.output], {"source": str(args.result), "times": times, "values": values})


def _choose_times(saved: Saved, args: argparse.Namespace) -> np.ndarray:
    """Return the indices of the times to draw."""
    if saved.times is None:
        if args.times is not None or args.points is not None:
            raise ValueError(f"--{'times' if args.times else 'points'}: {args.result} has no times; leave this out")
        return np.arange(1)
    if args.times is None:
        count = saved.times.size if args.points is not None else MANY
    else:
        wanted = parse_times(args.times)
        if wanted.explicit:
            apart = np.abs(np.log(saved.times) - np.log(wanted.explicit)[:, None])
            nearest = np.argmin(apart, axis=1)
            far = apart.min(axis=1) > 0.05
            if far.any():
                raise ValueError(
                    f"--times: got {wanted.explicit[int(np.argmax(far))]:g}; expected some of the saved times, "
                    f"{', '.join(f'{t:.4g}' for t in saved.times)}"
                )
            return np.unique(nearest)
        count = wanted.automatic
    return np.unique(np.linspace(0, saved.times.size - 1, min(count, saved.times.size)).round().astype(int))


def _panels(saved: Saved, args: argparse.Namespace, limits: tuple[float, float] | None) -> Any:
    from hks_jax.cli.picture import LEAST_RANGE, cropped, orientation_of
    from hks_jax.plot import hks_panels, middle_node

    values, grid, title, thin = saved.values, saved.grid, args.title, saved.place.slice_axis
    if grid.dimension == 3:
        axis, index = args.slice or ("z", middle_node(grid.inside)[2])
        a = thin = "xyz".index(axis)
        if index >= grid.shape[a]:
            raise ValueError(f"--slice: got {axis}={index}; expected {axis}=0 … {axis}={grid.shape[a] - 1}")
        values, inside = values.take(index, 1 + a), grid.inside.take(index, a)
        keep = [b for b in range(3) if b != a]
        title = f"{title}, slice {axis} = {index}".lstrip(", ")
    elif args.slice is not None:
        raise ValueError(f"--slice: {args.result} is a slice already (two axes); leave this out")
    else:
        inside, keep = grid.inside, [0, 1]
    drawn = inside & np.isfinite(values).all(axis=0)
    if not drawn.any():
        raise ValueError(f"--slice: no value of {args.result} is finite there; choose another")
    plane = Grid(drawn.shape, [grid.spacing[b] for b in keep], [grid.origin[b] for b in keep])
    plane, box = cropped(plane, drawn)
    vmin, vmax = limits or (None, None)
    return hks_panels(
        np.where(drawn, values, np.nan)[:, *box],
        [0.0] if saved.times is None else saved.times,
        plane,
        titles=[args.array or args.result.stem] if saved.times is None else None,
        unit=args.unit,
        shared_range=args.range == "shared",
        cmap=args.cmap,
        vmin=vmin,
        vmax=vmax,
        quantiles=args.quantiles,
        least_range=LEAST_RANGE,
        suptitle=title,
        orientation=None if saved.place.affine is None else orientation_of(saved.place.affine, thin, box, args.view),
    )


def _curves(saved: Saved, args: argparse.Namespace) -> Any:
    from hks_jax.plot import Orientation, hks_curves, new_figure

    assert saved.times is not None
    values, grid = saved.values, saved.grid
    if saved.place.affine is not None:  # points have the coordinates that the images show
        orientation = Orientation.of(saved.place.affine, saved.place.slice_axis)
        values, grid = orientation.array(values), orientation.grid(grid)
    d, limit = grid.dimension, None
    if any(len(point) != d for point in args.points):
        raise ValueError(f"--points: got {args.points}; expected {d} coordinates each")
    if "eigenvalues" in saved.arrays:
        limit = RESOLVED[d] / float(saved.arrays["eigenvalues"][-1])
    figure = new_figure(5.4, 4.0)
    hks_curves(
        figure.subplots(),
        values,
        saved.times,
        grid,
        args.points,
        limit=limit,
        scaled=args.scaled,
        cmap=args.cmap,
        unit=args.unit,
    )
    if args.title:
        figure.suptitle(args.title)
    return figure


def _point(text: str) -> tuple[float, ...]:
    """Read ``1.5,2`` or ``1.5,2,3``."""
    if len(numbers := parse_numbers(text)) not in (2, 3):
        raise argparse.ArgumentTypeError(f"got {text!r}; expected coordinates, such as 1.5,2")
    return numbers


def _pair(text: str) -> tuple[float, float]:
    """Read ``0.01,0.99``."""
    if len(numbers := parse_numbers(text)) != 2 or not 0 <= numbers[0] < numbers[1] <= 1:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected two numbers from 0 to 1, such as 0.01,0.99")
    return numbers[0], numbers[1]


def _limits(text: str) -> tuple[float, float] | None:
    """Read ``own`` or ``shared`` (None) or ``LOW,HIGH``."""
    if text in ("own", "shared"):
        return None
    if len(numbers := parse_numbers(text)) != 2 or not numbers[0] < numbers[1]:
        raise ValueError(f"--range: got {text!r}; expected own, shared, or two ascending numbers LOW,HIGH")
    return numbers[0], numbers[1]
