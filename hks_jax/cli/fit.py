"""``hks-jax fit TARGET -o OUT``: the metric that has a given heat kernel signature."""

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hks_jax.cli.arguments import NATURAL, parse_boundary, parse_weight, recorded_boundary, unreached_sides
from hks_jax.cli.inputs import add_command, add_interpolation_argument, add_json_argument, add_view_argument
from hks_jax.cli.job import ComputationError, use_dtype
from hks_jax.cli.outputs import check_folder, show_files, writing
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import FILES, image_suffix
from hks_jax.cli.saved import About, read_saved
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.io import ORDERS, TensorVolume, read_tensors, save, save_tensors
from hks_jax.io.volume import as_mask, digest

if TYPE_CHECKING:
    from hks_jax.inverse.metric_fit import MetricFit

DESCRIPTION = """\
Find the metric that has a given heat kernel signature. TARGET is an npz as 'hks-jax hks' writes it without
normalisation: 'hks' (n_times, *shape), 'times', 'spacing', 'origin' and, optional, 'mask', 'affine'.

Writes to the folder OUT: tensors.npz (the metric), fit.npz (its signature, and the loss at each step), fit.png (in two
dimensions) and report.json. Ctrl-C ends the fit, and writes the best metric so far.
"""

EPILOG = """\
example:
  hks-jax fit out/hks.npz -o fitted --parametrisation conformal --noise 0.01 --h1 1e-4 --checkpoint fit.part.npz
"""

PARAMETRISATIONS = ("log-euclidean", "cholesky", "conformal", "eigenvalues", "rotation")
OPTIMISERS = ("gauss-newton", "lbfgs", "bfgs")
"""As in `hks_jax.inverse`, which is slow to import: a test keeps them the same."""


class Target(NamedTuple):
    """What is to be fitted.

    Attributes:
        values: (n_times, *shape).
        times: (n_times,).
        volume: the identity on the grid of the values: the flat metric, and where it lies in space.
        boundary: what the signature was computed with, where the file says it.
    """

    values: Float[np.ndarray, "n_times *shape"]
    times: Float[np.ndarray, " n_times"]
    volume: TensorVolume
    boundary: BoundarySpec | None


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser = add_command(subparsers, "fit", "find the metric that has a given signature", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add("target", metavar="TARGET", type=Path, help="the signature: .npz")
    add("-o", "--output", metavar="OUT", type=Path, required=True, help="folder for the results")
    add("--init", type=Path, metavar="FILE", help=f"tensors to start from: {FILES} (default: identity)")
    add(
        "--metric",
        choices=("tensor", "inverse", "adjugate"),
        help="the metric of the tensors D of --init: inverse is D⁻¹, tensor is D itself, adjugate is |D|D⁻¹; "
        "must be chosen but for NumPy's files, which hold the metric itself unless you choose",
    )
    add("--order", choices=tuple(ORDERS), help="order of the components of --init, where the file does not declare it")
    add_interpolation_argument(parser)
    add(
        "--parametrisation",
        choices=PARAMETRISATIONS,
        default="log-euclidean",
        help="what varies: the whole tensor as log-euclidean (default) or cholesky; or of --init a conformal factor, "
        "the eigenvalues, or the rotation",
    )
    add(
        "--boundary",
        type=parse_boundary,
        metavar="B",
        help="the target's, written as for 'hks-jax hks' (default what TARGET says of itself, else neumann)",
    )
    add(
        "-k",
        type=int,
        help="number of eigenpairs (default: so many that 1e-6 of the heat trace at the smallest time is left out)",
    )
    add(
        "--noise",
        type=float,
        metavar="SIGMA",
        help="standard deviation of the logarithm of the target (0.01 for 1 %%): stop where the misfit reaches it",
    )
    add(
        "--smoothness",
        type=float,
        metavar="LENGTH",
        help="length, in units of the spacing, below which steps are smooth (default a tenth of the domain, and 0 for "
        "conformal without --noise)",
    )
    add("--h1", type=parse_weight, metavar="WEIGHT", help="penalise slopes: ½ WEIGHT · mean |∇p|² of the parameters p")
    add("--tv", type=parse_weight, metavar="WEIGHT", help="penalise total variation, which keeps edges sharp")
    add("--max-steps", type=int, default=50, metavar="N", help="steps per stage (default 50)")
    add("--continuation", type=int, default=1, metavar="N", help="stages, large times first (default 1)")
    add("--starts", type=int, default=1, metavar="N", help="starts, from random changes of --init (default 1)")
    add("--seed", type=int, default=0, help="of the starts after the first (default 0)")
    add("--optimiser", choices=OPTIMISERS, default="gauss-newton", help="default gauss-newton")
    add("--checkpoint", type=Path, metavar="FILE", help="written after each step; if it is there, go on from it")
    add("--dtype", choices=("float32", "float64"), default="float64", help="precision (default float64)")
    add_view_argument(parser)
    add_json_argument(parser)
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand.

    Raises:
        ValueError: a target, a start or settings that cannot be fitted with.
        ComputationError: a signature of the start that is NaN or infinite.
    """
    if args.init is None and (args.metric or args.order):
        raise ValueError(f"--{'metric' if args.metric else 'order'}: is about the tensors of --init; give both or none")
    if args.init is not None and args.metric is None and image_suffix(args.init):
        raise ValueError(
            "--metric: choose inverse, tensor or adjugate; --init has diffusion tensors D, which are no metric"
        )

    from hks_jax.inverse.fit import fit_metric
    from hks_jax.inverse.metric_fit import RESULTS
    from hks_jax.inverse.regulariser import H1, Regulariser, TotalVariation

    check_folder(args.output)
    use_dtype(args.dtype)
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        with progress.stage("reading", str(args.target)):
            target = read_target(args.target)
            # The mask is the domain of a signature that was computed: its pieces were wanted.
            grid = target.volume.grid(components="all")
            init = _initial(args, target, grid, progress)
            if args.boundary is None:
                args.boundary = NATURAL if target.boundary is None else target.boundary
                origin = "the target says none" if target.boundary is None else "the target's"
                progress.note(f"boundary {json.dumps(args.boundary)} ({origin})")
        for message in unreached_sides(grid.inside, args.boundary):
            progress.warn(message)
        regularisers: list[Regulariser] = []
        if args.h1 is not None:
            regularisers.append(H1(args.h1))
        if args.tv is not None:
            regularisers.append(TotalVariation(args.tv))
        with progress.stage("fitting", f"{args.parametrisation}, {int(grid.inside.sum())} nodes"):
            fit = fit_metric(
                target.values,
                target.times,
                init,
                args.parametrisation,
                regularisers=regularisers,
                noise=args.noise,
                k=args.k,
                boundary=args.boundary,
                optimiser=args.optimiser,
                smoothness=args.smoothness,
                max_steps=args.max_steps,
                continuation=args.continuation,
                starts=args.starts,
                seed=args.seed,
                progress=lambda step: progress.update(str(step)),
                checkpoint=args.checkpoint,
            )
        if not math.isfinite(fit.loss):
            raise ComputationError(f"no fit: {RESULTS['not finite']}. Check --init and -k")
        if not fit.converged:
            progress.warn(f"the fit ended early, {fit.result}: {RESULTS[fit.result]}; what was best is written")
        files = _write(args, fit, target, progress)
    show_files(files, args.quiet, args.json)


def read_target(path: Path) -> Target:
    """Read a signature as ``hks-jax hks`` writes it.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no npz; arrays that are missing, not real numbers, or of shapes that disagree.
    """
    saved = read_saved(path, "hks", over_times=True)
    assert saved.times is not None
    arrays, d = saved.arrays, saved.grid.dimension
    volume = TensorVolume(
        np.broadcast_to(np.eye(d), (*saved.grid.shape, d, d)),
        saved.grid.spacing,
        saved.grid.origin,
        as_mask("mask", arrays["mask"]) if "mask" in arrays else None,
        None if saved.place.affine is None else saved.place.affine.astype(np.float64),
        int(arrays["slice_axis"]) if "slice_axis" in arrays else None,
        source=str(path),
        digest=digest(path),
    )
    return Target(saved.values, saved.times, volume, recorded_boundary(About.of(arrays).settings))


def _initial(args: argparse.Namespace, target: Target, grid: Grid, progress: Progress) -> TensorField:
    """Return the field to start from, on the target's grid."""

    if args.init is None:
        return TensorField(grid, target.volume.tensors.astype(args.dtype), args.interpolation)
    volume = read_tensors(args.init, args.order)
    if volume.dimension > grid.dimension:
        raise ValueError(
            f"--init: got a volume of shape {volume.shape}; expected the target's shape {grid.shape}. Cut the slice "
            f"out first: hks-jax convert {args.init} slice.npz --slice z=14, and --init slice.npz"
        )
    if volume.shape != grid.shape:
        raise ValueError(
            f"--init: got tensors of shape {volume.shape}; expected the target's shape {grid.shape}. "
            "Give one tensor for each node of the target"
        )
    if not np.allclose(volume.spacing, grid.spacing, rtol=1e-4):
        progress.warn(f"--init: its spacing {volume.spacing} is not the target's, {grid.spacing}, which is used")
    if volume.mask is not None and (grid.inside & ~volume.mask).any():
        raise ValueError(
            f"--init: got a mask without {int((grid.inside & ~volume.mask).sum())} of the target's "
            f"{int(grid.inside.sum())} nodes; expected tensors at all of them. Cut the target's mask to it"
        )
    tensors = volume.tensors.astype(args.dtype)
    return TensorField.from_diffusion(
        grid, tensors, args.metric or "tensor", interpolation=args.interpolation, name="--init"
    )


def _write(args: argparse.Namespace, fit: "MetricFit", target: Target, progress: Progress) -> list[Path]:
    """Write tensors.npz, fit.npz, fit.png (in 2D) and report.json; return their paths."""
    from hks_jax.cli.picture import placed
    from hks_jax.plot import fit_panels, save_figure

    volume = replace(target.volume, tensors=np.asarray(fit.field.domain_tensors))
    history = {
        "losses": [step.loss for step in fit.history],
        "misfits": [step.misfit for step in fit.history],
        "stages": [step.stage for step in fit.history],
        "starts": [step.start for step in fit.history],
    }
    report, stale = _report(args, fit, target), [args.output / "fit.png"]
    with writing(args.output, report, progress, lambda: stale) as (folder, files):
        origin = {"command": sys.argv, "settings": report["settings"]}
        save_tensors(folder / "tensors.npz", volume, provenance=origin)
        extra = {"times": target.times, **{name: np.asarray(array) for name, array in history.items()}}
        save(folder / "fit.npz", np.asarray(fit.hks), volume, name="hks", extra=extra, provenance=origin)
        if volume.dimension == 2:
            orientation = placed(volume, [slice(0, n) for n in volume.shape], args.view)
            save_figure(fit_panels(fit, target.values, target.times, orientation=orientation), folder / "fit.png")
    return files


def _report(args: argparse.Namespace, fit: "MetricFit", target: Target) -> dict[str, Any]:
    from hks_jax.inverse.metric_fit import RESULTS

    chosen = ("init", "metric", "interpolation", "boundary", "noise", "smoothness", "h1", "tv", "max_steps")
    more = ("continuation", "starts", "seed", "optimiser", "checkpoint", "dtype")
    settings = {name: getattr(args, name) for name in (*chosen, *more)}
    return {
        "target": {
            "source": target.volume.source,
            "shape": target.volume.shape,
            "spacing": target.volume.spacing,
            "nodes_inside": int(fit.field.grid.inside.sum()),
            "times": target.times.tolist(),
        },
        "result": fit.result,
        "explanation": RESULTS[fit.result],
        "loss": fit.loss,
        "misfit": fit.misfit,
        "steps": fit.steps,
        "losses_of_starts": list(fit.losses),
        "k": fit.problem.k,
        "truncation_misfit": fit.truncation_misfit,
        "parametrisation": args.parametrisation,
        "settings": {name: str(value) if isinstance(value, Path) else value for name, value in settings.items()},
    }
