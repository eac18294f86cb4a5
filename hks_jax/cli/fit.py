"""Find the metric that has a given signature.

Find the metric that has a given heat kernel signature. TARGET is an npz that 'hks-jax hks' wrote with the
normalisation flat, the default, or raw. TARGET contains 'hks' (n_times, *shape), 'times', 'spacing', 'origin', and
optionally 'mask' and 'affine'.

The command writes to the folder OUT: tensors.npz (the metric), fit.npz (its signature, and the loss at each step),
fit.png (in two dimensions) and report.json. Ctrl-C ends the fit and writes the best metric found until then.

example:
  hks-jax fit out/hks.npz -o fitted --parametrisation conformal --noise 0.01 --h1 1e-4 --checkpoint fit.part.npz
"""

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax import Grid, TensorField
from hks_jax.cli import options
from hks_jax.cli.combinations import refuse, require_one_metric
from hks_jax.cli.computation import ComputationError, use_dtype
from hks_jax.cli.outputs import REPORT, Done, writing
from hks_jax.cli.parsing import boundary_conditions, weight
from hks_jax.cli.progress import Progress
from hks_jax.domain import spd
from hks_jax.io import read_tensors, save, save_tensors
from hks_jax.io.formats import format_of
from hks_jax.io.json_files import tuples
from hks_jax.io.plausibility import reviewed
from hks_jax.io.repair import describe_invalid, invalid_in
from hks_jax.io.result import Result
from hks_jax.io.volume import TensorVolume, digest, require_position

USAGE = "TARGET -o OUT"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "target", type=Path, metavar="TARGET", help="the signature, an .npz file or the folder of a signature"
    )
    options.add_output(parser)
    parser.add_argument(
        "--init", type=Path, metavar="FILE", help=f"the initial tensors: {options.FORMATS} (default: identity)"
    )
    parser.add_argument(
        "--metric",
        choices=("tensor", "inverse", "adjugate"),
        help="the metric of the tensors D in --init: inverse is D⁻¹, tensor is D itself, adjugate is |D|D⁻¹. This "
        "option is required except for NumPy's files without a unit of length, whose tensors are the metric by "
        "default, and for --operator fick",
    )
    parser.add_argument(
        "--operator",
        choices=("laplace-beltrami", "fick"),
        help="the operator of the target, as for 'hks-jax hks' (default: the operator in TARGET, otherwise "
        "laplace-beltrami). With fick, tensors.npz contains the diffusivity D",
    )
    options.add_conventions(
        parser.add_argument_group("meaning of the numbers in --init", "needed only if the file does not declare it.")
    )
    options.add_interpolation(parser, None, "the interpolation in TARGET, otherwise linear")
    parser.add_argument(
        "--parametrisation",
        choices=("log-euclidean", "cholesky", "conformal", "eigenvalues", "rotation"),
        default="log-euclidean",
        help="the unknowns of the fit: the whole tensor, as log-euclidean (default) or cholesky; or only a conformal "
        "factor, the eigenvalues, or the rotation of the tensors in --init",
    )
    parser.add_argument(
        "--boundary",
        type=boundary_conditions,
        metavar="CONDITION",
        help="the boundary condition of the target, as for 'hks-jax hks' (default: the condition in TARGET, otherwise "
        "neumann)",
    )
    parser.add_argument(
        "-k",
        type=int,
        metavar="K",
        help="number of eigenpairs (default: enough for all but 1e-6 of the heat trace at the smallest time)",
    )
    parser.add_argument(
        "--noise",
        type=float,
        metavar="SIGMA",
        help="standard deviation of the logarithm of the target (0.01 for 1 %%); the fit stops at this misfit",
    )
    parser.add_argument(
        "--smoothness",
        type=float,
        metavar="LENGTH",
        help="smoothing length of the steps, in coordinate units (default a tenth of the domain, or 0 for conformal "
        "without --noise)",
    )
    parser.add_argument(
        "--h1", type=weight, metavar="WEIGHT", help="penalise slopes of the unknowns p by ½ · WEIGHT · mean |∇p|²"
    )
    parser.add_argument(
        "--tv", type=weight, metavar="WEIGHT", help="penalise the total variation, which keeps edges sharp"
    )
    parser.add_argument(
        "--max-steps", type=int, default=50, metavar="N", help="largest number of steps per stage (default 50)"
    )
    parser.add_argument(
        "--continuation",
        type=int,
        default=1,
        metavar="N",
        help="number of stages; each stage adds smaller times (default 1)",
    )
    parser.add_argument(
        "--starts",
        type=int,
        default=1,
        metavar="N",
        help="number of starts; all but the first begin at random perturbations of --init (default 1)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the random perturbations (default 0)")
    parser.add_argument(
        "--optimiser",
        choices=("gauss-newton", "lbfgs", "bfgs"),
        default="gauss-newton",
        help="optimisation method (default gauss-newton)",
    )
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="FILE",
        help="file that is written after each step; if the file exists, the fit continues from it",
    )
    options.add_dtype(parser)
    options.add_view(parser)


_NO_METRIC = "--metric: choose inverse, tensor or adjugate, because --init has diffusion tensors and not a metric"
_OF_SEARCH = ("optimiser", "smoothness", "max_steps", "continuation", "starts", "seed")
"""Options that are arguments of `Search` with the same name."""


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    checkpoint = [] if args.checkpoint is None else [args.checkpoint]
    return [*(args.output / name for name in ("tensors.npz", "fit.npz", "fit.png", REPORT)), *checkpoint]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    if args.init is None:
        of_init = ("metric", "order", "frame", "unit")
        refuse(args, of_init, "this option describes the tensors in --init, which is missing; pass both")
    from hks_jax import fit_metric
    from hks_jax.inverse import H1, Data, Search, TotalVariation
    from hks_jax.inverse.metric_fit import RESULTS

    use_dtype(args.dtype)
    with progress.stage("reading", str(args.target)):
        target = Result.read(args.target, "hks", over_times=True)
        if target.normalisation not in ("raw", "flat"):
            raise ValueError(
                f"TARGET: got {target.source} with the normalisation {target.normalisation}; expected raw or flat. "
                "Compute it by 'hks-jax hks' without --normalisation"
            )
        args.operator = args.operator or target.settings.get("operator", "laplace-beltrami")
        args.interpolation = args.interpolation or target.settings.get("interpolation", "linear")
        require_one_metric(args.metric, args.operator)
        if target.normalisation == "flat":
            target = replace(target, values=target.values / target.to_flat)
        # The mask is the domain of the computed signature, so all of its components belong to the domain.
        grid = target.grid
        init = _initial(args, target.volume, grid, progress)
        if args.boundary is None:
            recorded = tuples(target.settings.get("boundary"))
            args.boundary = recorded or "neumann"
            origin = "recorded in the target" if recorded else "the default, because the target has none"
            progress.note(f"boundary {json.dumps(args.boundary)} ({origin})")
    weights = ((H1, args.h1), (TotalVariation, args.tv))
    with progress.stage("fitting", f"{args.parametrisation}, {int(grid.inside.sum())} nodes"):
        fit = fit_metric(
            init,
            target.values,
            target.times,
            args.parametrisation,
            data=Data(noise=args.noise),
            k=args.k,
            boundary=args.boundary,
            search=Search(**{name: getattr(args, name) for name in _OF_SEARCH}),
            regularisers=[kind(weight) for kind, weight in weights if weight is not None],
            progress=lambda step: progress.update(str(step)),
            checkpoint=args.checkpoint,
        )
    if not math.isfinite(fit.loss):
        raise ComputationError(f"the fit failed: {RESULTS['not finite']}. Check --init and -k")
    if not fit.converged:
        progress.warn(f"the fit ended early, {fit.result}: {RESULTS[fit.result]}; writing the best metric found")
    names = (
        "init",
        "metric",
        "operator",
        "interpolation",
        "h1",
        "tv",
        "dtype",
        "checkpoint",
        "noise",
        "boundary",
        *_OF_SEARCH,
    )
    report = {
        "target": {
            "source": target.source,
            "shape": grid.shape,
            "spacing": grid.spacing,
            "nodes_inside": int(grid.inside.sum()),
            "times": target.times.tolist(),
        },
        **{name: getattr(fit, name) for name in ("result", "loss", "misfit", "steps", "truncation_misfit")},
        "explanation": RESULTS[fit.result],
        "losses_of_starts": list(fit.losses),
        "k": fit.problem.k,
        "parametrisation": args.parametrisation,
        "settings": {name: getattr(args, name) for name in names},
    }
    return _write(args, fit, target, report, progress)


def _initial(args: argparse.Namespace, target: TensorVolume, grid: Grid, progress: Progress) -> TensorField:
    if args.init is None:
        unit = np.eye(grid.dimension, dtype=args.dtype)
        tensors = np.broadcast_to(unit, (*grid.shape, *unit.shape))
        return TensorField(grid, tensors, args.interpolation, operator=args.operator)
    fick = args.operator == "fick"
    if args.metric is None and not fick and format_of(args.init).image:
        raise ValueError(_NO_METRIC)
    volume = read_tensors(args.init, args.order, frame=args.frame, unit=args.unit)
    if args.metric is None and not fick and volume.length_unit:  # of NumPy's files, as in `require_metric`
        raise ValueError(_NO_METRIC)
    if volume.shape != grid.shape:
        remedy = "Give one tensor for each node of the target"
        if volume.dimension > grid.dimension:
            remedy = f"Write it by 'hks-jax convert {args.init} slice.npz --slice AXIS=INDEX', and pass that file"
        raise ValueError(
            f"--init: got tensors of shape {volume.shape}; expected the target's shape {grid.shape}. {remedy}"
        )
    require_position("--init", volume.affine, target.affine, target.volume_shape, of="the target")
    if not np.allclose(volume.spacing, grid.spacing, rtol=1e-4):
        progress.warn(f"--init: got the spacing {volume.spacing}; using the spacing of the target, {grid.spacing}")
    if lacking := int((grid.inside & ~volume.inside).sum()):
        raise ValueError(
            f"--init: got no tensors at {lacking} of the target's {int(grid.inside.sum())} nodes; expected tensors at "
            "all nodes of the target. Restrict the target to the mask of --init"
        )
    volume = volume.with_mask(grid.mask)
    for question in reviewed(volume)[1]:
        progress.warn(f"--init: {question}")
    found = invalid_in(volume)
    if count := int(found.bad.sum()):
        raise ValueError(
            f"--init: {count} of {int(grid.inside.sum())} tensors are {describe_invalid(volume, found)}. Write "
            f"repaired tensors by 'hks-jax convert {args.init} repaired.npz --repair nearest', and pass that file"
        )
    metric: Any = args.metric or (None if fick else "tensor")
    of: Any = {"operator": args.operator, "interpolation": args.interpolation, "name": "--init"}
    return TensorField.from_diffusion(grid, volume.tensors.astype(args.dtype), metric, **of)


def _write(args: argparse.Namespace, fit: Any, target: Result, report: dict[str, Any], progress: Progress) -> Done:
    from hks_jax.plot import fit_panels, save_figure
    from hks_jax.plot.signature import placed

    tensors, density = np.asarray(fit.field.domain_tensors), {}
    if args.operator == "fick":
        tensors = spd.inverse(tensors)  # D, in place of the metric D⁻¹
        density["density"] = np.sqrt(spd.determinant(tensors))
    volume = replace(target.volume, tensors=tensors, order="matrix", frame="voxel")
    volume = replace(volume, source=target.source, digest=digest(target.source), notes=(), unit="")
    history = {"losses": "loss", "misfits": "misfit", "stages": "stage", "starts": "start"}
    columns = {name: np.array([getattr(step, of) for step in fit.history]) for name, of in history.items()}

    def draw(path: Path) -> None:
        save_figure(fit_panels(fit, target.values, target.times, orientation=placed(volume, None, args.view)), path)

    pictures = {"fit.png": draw} if volume.dimension == 2 else {}
    with writing(args.output, report, progress, lambda: [args.output / "fit.png"], pictures) as (folder, done):
        origin = {"command": sys.argv, "settings": report["settings"]}
        extra = {"times": target.times, **density, **columns}
        metric = replace(volume, length_unit="")  # otherwise, the tensors count as diffusion tensors when they are read
        save_tensors(folder / "tensors.npz", metric, provenance=origin)
        save(folder / "fit.npz", np.asarray(fit.hks), volume, name="hks", extra=extra, provenance=origin)
    return done
