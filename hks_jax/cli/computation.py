"""Compute the heat kernel signature of a tensor volume or a mesh, and the facts for the report."""

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import Any, Generic, Literal, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj
from hks_jax.cli.options import add_metric, add_signature, add_solving, defaults
from hks_jax.cli.parsing import Times, parse_times
from hks_jax.cli.progress import Progress
from hks_jax.domain.tensor_checks import Interpolation, MetricChoice, OperatorChoice
from hks_jax.eigen.automatic import choose_for_command, choose_solvers
from hks_jax.eigen.weyl import weyl
from hks_jax.fem.boundary import BoundarySpec, default_boundary
from hks_jax.io import TensorVolume
from hks_jax.io.result import Result
from hks_jax.io.units import median_mean_diffusivity, unit_of_times
from hks_jax.signatures.hks import Normalisation
from hks_jax.signatures.rim import estimate_of, free_share, influence_of, is_estimated, is_known, rim_of
from hks_jax.signatures.spans import SHORTEST, resolved_span
from hks_jax.signatures.times import FREE, RESOLVED, default_k, times_of
from hks_jax.signatures.truncation import truncated_share

EARLY = 0.02
"""The truncated share of the signature above which the boundary's influence is estimated without eigenpairs."""
# Residuals are orthogonal to all m vectors of the filter, so that the error δᵢ of φᵢ is too, and ‖δᵢ‖ is at most the
# residual divided by λₘ₊₁ − λᵢ. To first order, errors change Σ f(λᵢ)φᵢ² by 2 Σ f(λᵢ)φᵢδᵢ, where f(λᵢ) is small for the
# pairs with the largest ‖δᵢ‖. Errors of the eigenvalues are of second order.
_TOLERANCE = 1e-4
"""The largest relative residual of the Chebyshev filter. On a brain of 85 000 voxels (k = 75), residuals up to 7e-4
changed the signature by at most 2.4e-4 of its value at any node, and residuals up to 4e-5 by 1.1e-5, for t ≥ 4/λ_k."""
HALF = 0.45
"""The share of nodes free of the boundary below which a time is warned of; automatic times aim at one half."""


INPUT_ERRORS = (ValueError, FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError, ImportError)
"""Errors that a user can correct: wrong values, missing files, missing extras. Others are failed computations."""


class ComputationError(RuntimeError):
    """The error for a computation that failed."""


@dataclass(frozen=True)
class Settings:
    """The settings of a computation, with the names of the options.

    The metric is None for Fick's operator, and for a mesh with the Euclidean metric. For the boundary, None means
    `default_boundary` for volumes, neumann for meshes.
    """

    metric: MetricChoice | None
    operator: OperatorChoice
    interpolation: Interpolation
    k: int | None
    boundary: BoundarySpec | None
    times: Times
    components: Literal["raise", "largest", "all"]
    solver: str
    normalisation: Normalisation
    method: Literal["spectral", "auto"]
    dtype: Literal["float32", "float64"]

    @classmethod
    def of(cls, args: argparse.Namespace | None = None, **given: Any) -> "Settings":
        """Return the settings in `args`, or else the default settings; settings in `given` replace some of them."""
        chosen = defaults(add_metric, add_solving, add_signature) | (vars(args) if args else {})
        metric = chosen["metric"] or (None if chosen["operator"] == "fick" else "tensor")
        given = {"metric": metric, "times": parse_times(chosen["times"]), **given}
        return cls(**{field.name: chosen[field.name] for field in fields(cls)} | given)

    @property
    def of_pairs(self) -> dict[str, Any]:
        """The settings, except k, that determine eigenpairs."""
        names = ("metric", "operator", "interpolation", "boundary", "components", "solver", "dtype")
        return {name: getattr(self, name) for name in names}

    def field(self, grid: hj.Grid, tensors: Any) -> hj.TensorField:
        """Return the field of diffusion tensors with the metric or the operator of these settings."""
        of: Any = {"operator": self.operator, "interpolation": self.interpolation, "name": "tensors"}
        return hj.TensorField.from_diffusion(grid, tensors, self.metric, **of)


Place = TypeVar("Place")
Field = TypeVar("Field")


@dataclass(frozen=True)
class Domain(Generic[Place, Field]):
    """A volume or slice, or a mesh, with a metric.

    Attributes:
        place: the volume, whose mask is the domain, or the mesh.
        field: the field of the volume's tensors, or the mesh.
        about: the entries of a report about the input.
        images: the suffixes of images or meshes with results.
        origin: entries of their provenance.
        tensors: the tensors behind the metric; None for a mesh with the Euclidean metric.
        of_tensors: the function from such tensors to such a field.
        volume: the volume of the tensors, which may contain a mesh; None for tensors in a mesh's file.
    """

    place: Place
    field: Field
    about: dict[str, Any]
    images: tuple[str, ...]
    origin: Mapping[str, str]
    tensors: np.ndarray | None = None
    of_tensors: Callable[[Any], Any] | None = None
    volume: TensorVolume | None = None


OfVolume: TypeAlias = Domain[TensorVolume, hj.TensorField]
Mesh: TypeAlias = hj.SurfaceMesh | hj.TetMesh
OfMesh: TypeAlias = Domain[Mesh, Mesh]


class Solved(NamedTuple):
    """The eigenpairs of a domain, and settings whose boundary is not None."""

    domain: OfVolume | OfMesh
    pairs: hj.Eigenpairs
    settings: Settings


def use_dtype(dtype: str) -> None:
    """Enable float64 in JAX if `dtype` is ``"float64"``; call it before arrays are created."""
    if dtype == "float64":
        jax.config.update("jax_enable_x64", True)


def result_of(solved: Solved, progress: Progress) -> Result:
    """Compute the signature of a domain from its eigenpairs."""
    domain, pairs, settings = solved
    with progress.stage("signature"):
        times = settings.times.explicit or automatic_times(pairs, settings.times.automatic)
        values, origin = _signature(pairs, times, settings)
        influence = _influence(pairs, times)
        free = None if influence is None else np.asarray(free_share(influence, pairs.space))
    report = {"input": domain.about, **_report(settings, pairs, times), **origin}
    arrays = {} if influence is None or not np.nanmax(influence) else {"influence": influence.astype(np.float32)}
    if pairs.pencil.density is not None:
        arrays["density"] = np.asarray(pairs.pencil.density)
    result = Result(domain.place, values, np.asarray(times), np.asarray(pairs.eigenvalues), report, arrays)
    rows = report["times"]
    for row in rows:  # values without eigenpairs lack no eigenpair
        if "method" in origin and row["t"] not in origin["method"]["eigenpairs"]:
            row |= {"truncation": None, "truncation_worst_node": None}
    for name, column in (("length", result.lengths), ("free_of_rim", free)):
        for row, value in zip(rows, [None] * len(rows) if column is None else column.tolist(), strict=True):
            row[name] = value
    report |= {"units": result.units, "rim": _rim_report(pairs, influence)}
    _tell_of_times(result, free, pairs, progress)
    return result


def _influence(pairs: hj.Eigenpairs, times: tuple[float, ...]) -> np.ndarray | None:
    """Return the influence of the boundary (n_times, *shape), or None if it is not known."""
    if not is_known(pairs):
        return None
    t = times_of(pairs, times)
    found, early = np.array(influence_of(pairs, t)), np.asarray(truncated_share(pairs, t)[0]) > EARLY
    if early.any():  # the eigenpairs do not resolve the signatures of the two problems
        found[early] = np.asarray(estimate_of(pairs, t[early]))
    return found


def _rim_report(pairs: hj.Eigenpairs, influence: np.ndarray | None) -> dict[str, Any]:
    """Return the entry of the report about the boundary's influence: the limit, and how it was computed."""
    if influence is None:
        return {"limit": FREE, "influence": "not known"}
    if not rim_of(pairs.pencil).any():
        return {"limit": FREE, "influence": "none, because the domain has no boundary"}
    exact = "from the eigenpairs of both boundary problems"
    return {"limit": FREE, "influence": "estimated from first passage times" if is_estimated(pairs) else exact}


def _tell_of_times(result: Result, free: np.ndarray | None, pairs: hj.Eigenpairs, progress: Progress) -> None:
    """Print the times, and warn of times at which most nodes feel the boundary, or at which heat fills the domain."""
    progress.note(f"t = {', '.join(times_in_words(result.times, result.lengths, result.unit, result.length_unit))}")
    if free is None or not rim_of(pairs.pencil).any():
        _warn_of_late(result.times, pairs, progress)
        return
    share = ", ".join(f"{100 * one:.0f}" for one in free)
    how = " (estimated)" * is_estimated(pairs)
    progress.note(f"nodes with less than {100 * FREE:.0f} % influence of the boundary{how}: {share} %")
    late = free < HALF
    if late.any():
        shown = ", ".join(f"{t:.4g}" for t in result.times[late])
        remedy = "Choose smaller times"
        if result.times[late][0] <= SHORTEST * result.smallest_time:
            remedy += ", which need more eigenpairs (-k) or --method auto"
        progress.warn(
            f"at {late.sum()} of {late.size} times, most nodes feel the boundary: at t = {shown}, it contributes over "
            f"{100 * FREE:.0f} % of the signature at {', '.join(f'{100 * (1 - one):.0f}' for one in free[late])} % of "
            f"the nodes, which pictures hatch. There, the shape of the domain shows, and not curvature. {remedy}"
        )


def times_in_words(times: Any, lengths: Any, unit: str, length_unit: str) -> list[str]:
    """Return each time with its unit and, if known, with the length √(Dt)."""
    words = [f"{t:.4g} {unit}".rstrip() for t in times]
    if lengths is None:
        return words
    return [f"{w} (√(Dt) = {length:.3g} {length_unit}".rstrip() + ")" for w, length in zip(words, lengths, strict=True)]


def _warn_of_late(t: np.ndarray, pairs: hj.Eigenpairs, progress: Progress) -> None:
    """Warn of times at which heat fills the domain: for a box, √t then exceeds about 0.6 times its sides."""
    d, volume, problems = pairs.space.dimension, pairs.pencil.volume, len(pairs.pencil.parts)
    if volume is None or d is None:
        return
    heat = np.exp(-np.outer(t, pairs.eigenvalues)).sum(axis=1) / float(volume)  # the mean of the signature
    late = t[heat * (4 * np.pi * t) ** (d / 2) > 1.5 * 2**d / min(problems, 2)]
    if late.size:
        shown = ", ".join(f"{s:.4g}" for s in late)
        progress.warn(
            f"{late.size} of {len(t)} times are too large for the domain: at t = {shown}, √t is more than half "
            "of its size or thickness, which the signature then mainly shows. Choose smaller times"
        )


def automatic_times(pairs: hj.Eigenpairs, n: int) -> tuple[float, ...]:
    """Return n default times, from the first that the eigenpairs resolve (`resolved_span`)."""
    return tuple(np.asarray(resolved_span(pairs, n), np.float64).tolist())


def domain_of_volume(volume: TensorVolume, settings: Settings, image: str = "") -> OfVolume:
    """Return the domain of a volume or slice in the chosen precision; `image` is the suffix of images with results."""
    use_dtype(settings.dtype)
    grid = volume.grid(settings.components)
    field = settings.field(grid, volume.tensors.astype(settings.dtype))
    volume, of_tensors = volume.with_mask(grid.mask), partial(settings.field, grid)
    return Domain(volume, field, describe_input(volume), (image,), {}, volume.tensors, of_tensors, volume)


def solver_of(
    settings: Settings, pencil: hj.Pencil | hj.MirrorPencil, k: int, keep_spare: bool = False
) -> str | hj.Eigensolver:
    """Return the solver, or its name, because the two problems of "mean" may get different solvers by name.

    A Chebyshev filter has the tolerance of the command line. With ``keep_spare`` it keeps what later computations start
    from.
    """
    automatic = settings.solver == "auto"
    solver = choose_for_command(pencil, k) if automatic else choose_solvers(settings.solver, pencil, k)[0][0]
    if isinstance(solver, hj.ChebyshevFilter):
        return replace(solver, tolerance=_TOLERANCE, keep_spare=keep_spare)
    return solver if isinstance(solver, hj.ShiftInvert) else settings.solver


def compute_pairs(
    domain: OfVolume | OfMesh, settings: Settings, progress: Progress, keep_spare: bool = False
) -> Solved:
    """Compute the eigenpairs of a domain; raise ComputationError unless all converge."""
    boundary, field = settings.boundary, domain.field
    if isinstance(field, hj.TensorField):
        inside, nodes = field.grid.inside, f"{int(field.grid.inside.sum())} of {field.grid.size} nodes"
        if boundary is None:
            boundary, why = default_boundary(inside)
            progress.note(f"boundary {boundary} ({why})")
    else:
        boundary, nodes = boundary or "neumann", f"{len(field.vertices)} vertices"
    with progress.stage("assembly", nodes):
        pencil = hj.assemble(field, boundary)
    unknowns, dimension = sum(part.space.n_dof for part in pencil.parts), pencil.space.dimension
    assert dimension is not None
    k = default_k(dimension, unknowns) if settings.k is None else settings.k
    _tell_of_resolution(k, pencil, domain, settings, progress)
    solver = solver_of(settings, pencil, k, keep_spare)
    with progress.stage("eigenpairs", f"{k} of {unknowns} by {choose_solvers(solver, pencil, k)[0][0].name}"):
        pairs = hj.eigenpairs(pencil, k, solver=solver, progress=progress.update)
        jax.block_until_ready(pairs.eigenvalues)
    if not np.asarray(pairs.converged).all():
        raise ComputationError(pairs.messages()[0])
    return Solved(domain, pairs, replace(settings, boundary=boundary))


def _tell_of_resolution(
    k: int, pencil: hj.Pencil | hj.MirrorPencil, domain: OfVolume | OfMesh, settings: Settings, progress: Progress
) -> None:
    """Say which times k eigenpairs will resolve, by Weyl's law, and how many pairs half of the length takes."""
    d, place, unit, lengths = pencil.space.dimension, domain.place, "", None
    if d is None or pencil.volume is None or k < 1:  # `eigenpairs` refuses such a k
        return
    t = RESOLVED[d] / float(weyl(k, float(pencil.volume), d))
    if isinstance(place, TensorVolume):
        metric = "inverse" if settings.operator == "fick" else settings.metric
        unit = unit_of_times(place, metric)
        lengths = [math.sqrt(domain.about["median_mean_diffusivity"] * t)] if metric == "inverse" else None
    (words,) = times_in_words([t], lengths, unit, getattr(place, "length_unit", ""))
    progress.note(f"k = {k} will resolve t ≥ about {words}; half of this √t takes {2**d} times as many eigenpairs")


def _signature(pairs: hj.Eigenpairs, times: tuple[float, ...], settings: Settings) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the signature and, for the method ``"auto"``, the entry of the report about the methods used."""
    if settings.method != "auto":
        return np.asarray(hj.hks(pairs, times, settings.normalisation)), {}
    result = hj.hks_auto(pairs, times, settings.normalisation)
    origin: dict[str, Any] = {"eigenpairs": [], result.method: [], "agreement": None}
    for t, spectral in zip(times, np.asarray(result.spectral), strict=True):
        origin["eigenpairs" if spectral else result.method].append(t)
    if np.isfinite(float(result.overlap_time)):
        origin["agreement"] = {"t": float(result.overlap_time), "difference": float(result.overlap_difference)}
    return np.asarray(result.values), {"method": {name: value for name, value in origin.items() if name != "none"}}


def _report(settings: Settings, pairs: hj.Eigenpairs, times: tuple[float, ...]) -> dict[str, Any]:
    estimate = hj.truncation(pairs, jnp.asarray(times))
    by_node = np.asarray(hj.truncation_map(pairs, jnp.asarray(times))).reshape(len(times), -1)
    columns = {
        "t": times,
        "truncation": estimate.tail,
        "truncation_worst_node": np.nanmax(by_node, axis=1),
        **{name: getattr(estimate, name) for name in ("resolution_bias", "lasting_bias", "coarse_fraction")},
    }
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    origin = "automatic" if settings.times.automatic else "explicit"
    return {
        "settings": {**asdict(settings), "times": origin, "k": pairs.k},
        "eigenpairs": describe_pairs(pairs),
        "times": [dict(zip(columns, row, strict=True)) for row in rows],
    }


def describe_input(volume: TensorVolume) -> dict[str, Any]:
    """Return the entries of a report about the tensors of a volume, whose mask is the domain."""
    names = ("source", "shape", "spacing", "length_unit", "unit", "order", "frame", "notes")
    return {
        **{name: getattr(volume, name) for name in names},
        "sha256": volume.digest,
        "median_mean_diffusivity": median_mean_diffusivity(volume),
        "voxels_inside": int(volume.inside.sum()),
        "repair": dict(volume.repair) or None,
    }


def describe_pairs(pairs: hj.Eigenpairs) -> dict[str, Any]:
    """Return the entries of a report about eigenpairs."""
    values = np.asarray(pairs.eigenvalues)
    return {
        "k": pairs.k,
        "unknowns": pairs.n_unknowns,
        "solver": pairs.solver_name,
        "zero": pairs.n_null,
        "first_positive": float(values[min(pairs.n_null, pairs.k - 1)]),
        "last": float(values[-1]),
        "next": float(pairs.next_eigenvalue),
        "worst_residual": float(np.max(np.asarray(pairs.residuals))),
        "converged": int(np.sum(np.asarray(pairs.converged))),
        "cut_multiplet": int(pairs.cut_multiplet),
    }
