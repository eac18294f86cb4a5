"""Draw a result in a file.

Draw a result that 'hks-jax hks', 'fit' or 'curvature' has written as npz. The picture has an image for each time, or
with --points a curve over the times for each point.

examples:
  hks-jax plot out/hks.npz -o panels.png --times auto:4 --quantiles 0.02,0.9
  hks-jax plot out/hks.npz -o volume.png --through 60,70,14 --range shared
  hks-jax plot out/hks.npz -o curves.pdf --points -22,5 24,5
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli import options
from hks_jax.cli.combinations import refuse
from hks_jax.cli.outputs import Done
from hks_jax.cli.parsing import axis_and_index, colour_range, file_in_folder, parse_times, point, quantiles, voxel
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import sliced
from hks_jax.io.result import Result

USAGE = "RESULT -o PICTURE"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "result", type=Path, metavar="RESULT", help="the result, as an .npz or the folder of a signature"
    )
    parser.add_argument(
        "-o", "--output", type=file_in_folder, required=True, metavar="PICTURE", help="the picture: .png, .pdf, .svg, …"
    )
    parser.add_argument("--array", metavar="NAME", help="name of the array in the file (default: hks or curvature)")
    parser.add_argument(
        "--times",
        nargs="+",
        metavar="T",
        help="some of the saved times, or auto:N for N evenly spaced ones (default: all times, at most 12)",
    )
    parser.add_argument(
        "--slice",
        type=axis_and_index,
        metavar="AXIS=N",
        help="slice of a volume, such as z=14 (default: the middle along z)",
    )
    parser.add_argument(
        "--through",
        nargs="?",
        const=(),
        type=voxel,
        metavar="I,J,K",
        help="three orthogonal slices of a volume through this voxel, or the nearest one with a value, instead of one "
        "slice (without I,J,K: a voxel in the middle)",
    )
    parser.add_argument(
        "--points",
        nargs="+",
        type=point,
        metavar="X,Y",
        help="draw curves at these coordinates, as the images show them, instead of images",
    )
    parser.add_argument(
        "--range",
        type=colour_range,
        default="own",
        metavar="R",
        help="range of the colours: own for each image (default) or shared by all images, at least 1 %% of the "
        "values; or two numbers LOW,HIGH (write --range=LOW,HIGH if LOW is negative)",
    )
    parser.add_argument(
        "--quantiles",
        type=quantiles,
        metavar="Q,Q",
        help="quantiles of the values at the two ends of an own or shared range of colours (default: 0.002,0.998 of a "
        "signature's values free of the boundary, as 'hks-jax hks' draws them; 0,1 of other arrays)",
    )
    parser.add_argument(
        "--cmap",
        metavar="NAME",
        help="colour map of matplotlib (default: viridis, or colours that diverge from 1 if 1 means flat space)",
    )
    parser.add_argument(
        "--scaled",
        action="store_true",
        help="draw (4πt)^(d/2)·HKS, which is 1 for flat space (with --normalisation flat, this is always drawn)",
    )
    parser.add_argument(
        "--unit-of-t", metavar="TEXT", help="unit of t, if the result does not have it (default: that of the result)"
    )
    parser.add_argument("--title", metavar="TEXT", help="title of the picture")
    parser.add_argument("--dpi", type=float, default=150.0, metavar="DPI", help="pixels per inch (default 150)")
    options.add_view(parser)
    options.add_rim(parser)


MANY = 12
"""The largest number of images, unless times are chosen."""


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [args.output]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    from matplotlib import colormaps

    from hks_jax.plot import new_figure, save_figure

    if args.cmap not in (None, *colormaps):
        raise ValueError(f"--cmap: got {args.cmap!r}; expected a colour map of matplotlib, such as viridis")
    formats = sorted(new_figure(1, 1).canvas.get_supported_filetypes())
    if args.output.suffix.lstrip(".").lower() not in formats:
        raise ValueError(f"--output: got {args.output}; expected a name that ends in one of {', '.join(formats)}")
    result = Result.read(args.result, args.array)
    if args.scaled and not (result.times.size and result.normalisation in ("raw", "flat")):
        raise ValueError(
            f"--scaled: got {args.result} with the normalisation {result.normalisation}; expected a result with "
            "times and the normalisation raw or flat. Leave this option out"
        )
    chosen = _choose_times(result, args)
    at_times = {n: a[chosen] for n, a in result.arrays.items() if n in ("influence", "z", "deviation", "bias")}
    arrays = {**result.arrays, **at_times}
    result = replace(
        result, values=result.values[chosen], times=result.times[chosen[: result.times.size]], arrays=arrays
    )
    if args.scaled and result.normalisation == "raw":
        settings = {**result.settings, "normalisation": "flat"}
        result = replace(result, values=result.values * result.to_flat, report={"settings": settings})
    save_figure(_panels(result, args) if args.points is None else _curves(result, args), args.output, dpi=args.dpi)
    ends = {"least": float(np.nanmin(result.values)), "greatest": float(np.nanmax(result.values))}
    summary = {"source": str(args.result), "times": result.times.tolist(), "values": ends}
    return Done([args.output], summary)


def _choose_times(result: Result, args: argparse.Namespace) -> np.ndarray:
    """Return the indices of the times to draw."""
    times = result.times
    if not times.size:
        refuse(args, ("times", "points"), f"{args.result} has no times; leave this option out")
        return np.arange(1)
    wanted, count = parse_times(args.times) if args.times else ((), times.size if args.points else MANY)
    if wanted:
        apart = np.abs(np.log(times) - np.log(wanted)[:, None])
        far = apart.min(axis=1) > 0.05
        if far.any():
            raise ValueError(
                f"--times: got {wanted[int(np.argmax(far))]:g}; expected some of the saved times, "
                f"{', '.join(f'{t:.4g}' for t in times)}"
            )
        return np.unique(np.argmin(apart, axis=1))
    return np.unique(np.linspace(0, times.size - 1, min(count, times.size)).round().astype(int))


def _panels(result: Result, args: argparse.Namespace) -> Any:
    from hks_jax.plot import hks_panels, middle_node, volume_panels
    from hks_jax.plot.signature import (
        LEAST_RANGE,
        anatomy,
        caption,
        cropped,
        free_colours,
        legend,
        placed,
        quantity,
        range_notes,
        titles_of,
    )

    signature = result.name == "hks"
    values, volume, title = result.values, result.volume, args.title or (caption(result) if signature else "")
    near, z = (result.near_rim, result.z) if signature else (None, None)
    beside = anatomy(result) if signature else {}
    place = ""
    if volume.dimension == 2:
        refuse(args, ("slice", "through"), f"{args.result} is a slice, with two axes; leave this option out")
    elif args.through is not None:
        refuse(args, ("slice",), "--through draws three slices; leave one of the options out")
    else:
        axis, index = args.slice or ("z", middle_node(result.grid.inside)[2])
        volume = sliced(volume, axis, index)
        across = "xyz".index(axis)
        values = values.take(index, 1 + across)
        near, z = (None if each is None else each.take(index, 1 + across) for each in (near, z))
        beside = {name: scalar.take(index, across) for name, scalar in beside.items()}
        place = f"slice {axis} = {index}"
    drawn = volume.inside & np.isfinite(values).all(axis=0)
    if not drawn.any():
        raise ValueError(f"--slice: no value of {args.result} in this slice is finite; choose another slice")
    plane, box = cropped(volume, drawn)
    values, hatched = np.where(drawn, values, np.nan), None if args.show_rim else near
    style: dict[str, Any] = {"cmap": args.cmap, "label": quantity(result) if signature else ""}
    notes, centre = legend(result, hatched) if signature else [], result.centre if args.cmap is None else None
    if signature and isinstance(args.range, str) and args.quantiles is None:  # as the command hks draws it
        colours = free_colours(values, near, drawn, centre, args.range == "shared")
        style |= {"limits": [each[:2] for each in colours], "cmap": args.cmap or colours[0].cmap}
        notes += range_notes(result, values, colours)
    else:
        style |= dict(zip(("vmin", "vmax"), (None, None) if isinstance(args.range, str) else args.range, strict=True))
        style |= {"centre": centre if style["vmin"] is None else None, "shared_range": args.range == "shared"}
        style |= {"quantiles": args.quantiles or (0.0, 1.0), "least_range": LEAST_RANGE}
    titles = titles_of(result, args.unit_of_t) if signature else None
    if args.through:
        style["node"] = [index - part.start for index, part in zip(args.through, box, strict=True)]
    panels: Any = hks_panels if volume.dimension == 2 else volume_panels
    return panels(
        values[:, *box],
        result.times if result.times.size else [0.0],
        plane,
        titles=titles if result.times.size else [args.array or args.result.stem],
        length_unit=volume.length_unit,
        beside={name: np.where(drawn, scalar, np.nan)[box] for name, scalar in beside.items()},
        suptitle="\n".join([": ".join(filter(None, (place, title))), *([] if args.title else notes)]).strip(),
        hatched=None if hatched is None else hatched[:, *box],
        z=None if z is None else z[:, *box],
        orientation=placed(volume, box, args.view),
        **style,
    )


def _curves(result: Result, args: argparse.Namespace) -> Any:
    from hks_jax.plot import hks_curves, new_figure
    from hks_jax.plot.signature import placed, quantity

    refuse(args, ("slice", "through", "quantiles"), "--points draws curves; leave this option out")
    grid, d, flat = result.grid, result.dimension, result.normalisation == "flat"
    values = result.values / result.flat_scale if flat else result.values  # hks_curves multiplies by this scale
    orientation = placed(result.volume, None, "neurological")
    near = None if args.show_rim else result.near_rim
    if orientation is not None:  # points are in the coordinates of the images' axes
        values, grid = orientation.array(values), orientation.grid(grid)
        near = None if near is None else orientation.array(near)
    if any(len(point) != d for point in args.points):
        raise ValueError(f"--points: got {args.points}; expected {d} coordinates per point")
    style: dict[str, Any] = {"scaled": flat, "cmap": args.cmap or "viridis", "unit": args.unit_of_t or result.unit}
    style["near_rim"] = near
    if result.smallest_time:
        style["limit"] = result.smallest_time
    figure = new_figure(5.4, 4.0)
    axes = figure.subplots()
    hks_curves(axes, values, result.times, grid, args.points, **style)
    axes.set_ylabel(quantity(result))
    if args.title:
        figure.suptitle(args.title)
    return figure
