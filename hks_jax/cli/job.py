"""The main job: from a tensor volume or a mesh to its heat kernel signature, and what is known about it."""

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hks_jax.cli.arguments import DEFAULT_K, DEFAULT_TIMES, LAST, NATURAL, Times, default_boundary, unreached_sides
from hks_jax.cli.progress import Progress
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_checks import Interpolation, MetricChoice
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.automatic import choose_solver
from hks_jax.eigen.driver import eigenpairs
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.assembly import assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.pencil import AnyPencil
from hks_jax.io.units import median_mean_diffusivity
from hks_jax.io.volume import TensorVolume
from hks_jax.signatures.hks import HKSMethod, Normalisation, hks, hks_auto
from hks_jax.signatures.times import default_times, positive_range
from hks_jax.signatures.truncation import truncation, truncation_map
from hks_jax.uncertainty import Uncertainty


class ComputationError(RuntimeError):
    """The computation did not give what was asked for."""


@dataclass(frozen=True)
class Settings:
    """What to compute; see ``hks-jax hks --help``.

    Only on meshes, which have one of their own, is there no metric. Without a boundary the domain has the one that
    suits it (`hks_jax.cli.arguments.default_boundary`), and a mesh the natural one.
    """

    metric: MetricChoice | None
    interpolation: Interpolation = "linear"
    k: int | None = None
    boundary: BoundarySpec | None = None
    times: Times = DEFAULT_TIMES
    components: Literal["raise", "largest", "all"] = "raise"
    solver: str = "auto"
    normalisation: Normalisation = "raw"
    method: HKSMethod = "spectral"
    dtype: Literal["float32", "float64"] = "float64"


class Bars(NamedTuple):
    """Error bars of a signature, the noise (n_draws, n_times, *shape) of which they are made, and the interior.

    The interior (n_times, *shape) is where the boundary decides little, under ``"mean"``, and empty at times that leave
    few such nodes; else it is all of the domain.
    """

    uncertainty: Uncertainty
    maps: np.ndarray
    interior: np.ndarray


@dataclass(frozen=True, eq=False)
class Result:
    """The signature on the volume whose mask is the domain, or on a mesh; its report; its error bars, if asked for."""

    volume: TensorVolume | SimplicialMesh
    times: np.ndarray
    values: np.ndarray
    eigenvalues: np.ndarray
    report: dict[str, Any]
    bars: Bars | None = None


def use_dtype(dtype: str) -> None:
    """Let JAX compute in float64 if asked to: the application's choice, made before any array is."""
    if dtype == "float64":
        import jax

        jax.config.update("jax_enable_x64", True)


def compute(volume: TensorVolume, settings: Settings, progress: Progress) -> Result:
    """Compute the signature of a volume or slice.

    Raises:
        ValueError: tensors, mask or settings that cannot be computed with.
        ComputationError: eigenpairs that did not converge.
    """
    return signature_of(volume, *compute_pairs(volume, settings, progress), progress)


def signature_of(
    volume: TensorVolume, field: TensorField, pairs: Eigenpairs, settings: Settings, progress: Progress
) -> Result:
    """Compute the signature of a volume or slice whose metric and eigenpairs are known.

    Raises:
        ValueError: settings that cannot be computed with.
    """
    mask = field.grid.mask
    return _result(volume.with_mask(mask), describe_input(volume, mask), pairs, settings, progress)


def compute_on_mesh(mesh: SimplicialMesh, described: dict[str, Any], settings: Settings, progress: Progress) -> Result:
    """Compute the signature on a mesh, whose metric it has already; `described` is what the report says of it.

    Raises:
        ValueError: settings that cannot be computed with.
        ComputationError: eigenpairs that did not converge.
    """
    boundary = NATURAL if settings.boundary is None else settings.boundary
    settings = replace(settings, boundary=boundary)
    with progress.stage("assembly", f"{len(mesh.vertices)} vertices"):
        pencil = assemble(mesh, boundary)
    pairs = _solve(pencil, settings, progress)
    return _result(mesh, described, pairs, settings, progress)


def _result(
    place: TensorVolume | SimplicialMesh,
    described: dict[str, Any],
    pairs: Eigenpairs,
    settings: Settings,
    progress: Progress,
) -> Result:
    """Return the signature, and its report."""
    with progress.stage("signature"):
        times = settings.times.explicit or automatic_times(pairs, settings.times.automatic)
        values, origin = _signature(pairs, times, settings)
    report = {"input": described, **_report(settings, pairs, times), **origin}
    return Result(place, np.asarray(times), values, np.asarray(pairs.eigenvalues), report)


def automatic_times(pairs: Eigenpairs, n: int) -> tuple[float, ...]:
    """Return n times, log-spaced from the first of `default_times` to where all but the constant is 1 %."""
    first, last = float(default_times(pairs, 1)[0]), LAST / float(positive_range(pairs)[0])
    return tuple(np.geomspace(first, max(first, last), n).tolist())


def field_of(
    volume: TensorVolume, grid: Grid, metric: MetricChoice, dtype: str, interpolation: Interpolation = "linear"
) -> TensorField:
    """Return the metric of a volume or slice on its grid, in the precision asked for.

    Raises:
        ValueError: tensors that make no metric.
    """
    use_dtype(dtype)
    tensors = volume.tensors.astype(dtype)
    return TensorField.from_diffusion(grid, tensors, metric, interpolation=interpolation, name="tensors")


def compute_pairs(
    volume: TensorVolume, settings: Settings, progress: Progress
) -> tuple[TensorField, Eigenpairs, Settings]:
    """Compute the eigenpairs of a volume or slice; return its metric, them, and the settings with their boundary.

    Raises:
        ValueError: tensors, mask or settings that cannot be computed with.
        ComputationError: eigenpairs that did not converge.
    """
    grid, boundary = volume.grid(settings.components), settings.boundary
    assert settings.metric is not None
    if boundary is None:
        boundary, why = default_boundary(grid.inside)
        progress.note(f"boundary {boundary} ({why})")
    with progress.stage("assembly", f"{int(grid.inside.sum())} of {grid.size} nodes"):
        for message in unreached_sides(grid.inside, boundary):
            progress.warn(message)
        field = field_of(volume, grid, settings.metric, settings.dtype, settings.interpolation)
        pencil = assemble(field, boundary)
    return field, _solve(pencil, settings, progress), replace(settings, boundary=boundary)


def _solve(pencil: AnyPencil, settings: Settings, progress: Progress) -> Eigenpairs:
    """Compute eigenpairs; raise ComputationError unless all of them converged."""
    unknowns = sum(part.space.n_dof for part in pencil.parts)
    k = min(DEFAULT_K[pencil.space.dimension], max(1, unknowns // 4)) if settings.k is None else settings.k
    name = choose_solver(settings.solver, pencil.parts[0], k).name
    with progress.stage("eigenpairs", f"{k} of {unknowns} by {name}"):
        pairs = eigenpairs(pencil, k, solver=settings.solver, progress=progress.update)
        jax.block_until_ready(pairs.eigenvalues)
    if not np.asarray(pairs.converged).all():
        raise ComputationError(pairs.messages()[0])
    return pairs


def _signature(pairs: Eigenpairs, times: tuple[float, ...], settings: Settings) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the signature and, where methods were chosen from, what the report says of the choice."""
    if settings.method != "auto":
        return np.asarray(hks(pairs, times, settings.normalisation, settings.method)), {}
    result = hks_auto(pairs, times, settings.normalisation)
    agreement = None
    if np.isfinite(float(result.overlap_time)):
        agreement = {"t": float(result.overlap_time), "difference": float(result.overlap_difference)}
    of_pairs = np.asarray(result.spectral)
    origin = {
        "eigenpairs": [t for t, yes in zip(times, of_pairs, strict=True) if yes],
        result.method: [t for t, yes in zip(times, of_pairs, strict=True) if not yes],
        "agreement": agreement,
    }
    return np.asarray(result.values), {"method": {name: value for name, value in origin.items() if name != "none"}}


def _report(settings: Settings, pairs: Eigenpairs, times: tuple[float, ...]) -> dict[str, Any]:
    estimate = truncation(pairs, jnp.asarray(times))
    by_node = np.asarray(truncation_map(pairs, jnp.asarray(times))).reshape(len(times), -1)
    chosen = replace(settings, times=Times(times, settings.times.automatic), k=pairs.k)
    return {
        "settings": {**asdict(chosen), "times": "automatic" if settings.times.automatic else "explicit"},
        "eigenpairs": describe_pairs(pairs),
        "times": [
            {
                "t": float(t),
                "truncation": float(tail),
                "truncation_worst_node": float(worst),
                "resolution_bias": float(bias),
                "lasting_bias": float(lasting),
                "coarse_fraction": float(coarse),
            }
            for t, tail, worst, bias, lasting, coarse in zip(
                times,
                np.asarray(estimate.tail),
                np.nanmax(by_node, axis=1),
                np.asarray(estimate.resolution_bias),
                np.asarray(estimate.lasting_bias),
                np.asarray(estimate.coarse_fraction),
                strict=True,
            )
        ],
    }


def describe_input(volume: TensorVolume, mask: np.ndarray | None) -> dict[str, Any]:
    """Return what a report says of the tensors."""
    return {
        "source": volume.source,
        "sha256": volume.digest,
        "shape": volume.shape,
        "spacing": volume.spacing,
        "length_unit": volume.length_unit,
        "unit": volume.unit,
        "median_mean_diffusivity": median_mean_diffusivity(volume),
        "order": volume.order,
        "frame": volume.frame,
        "voxels_inside": int(np.prod(volume.shape) if mask is None else mask.sum()),
        "notes": list(volume.notes),
        "repair": dict(volume.repair) or None,
    }


def describe_pairs(pairs: Eigenpairs) -> dict[str, Any]:
    """Return what a report says of eigenpairs."""
    values = np.asarray(pairs.eigenvalues)
    return {
        "k": pairs.k,
        "unknowns": sum(part.space.n_dof for part in pairs.pencil.parts),
        "solver": pairs.solver_name,
        "zero": pairs.n_null,
        "first_positive": float(values[min(pairs.n_null, pairs.k - 1)]),
        "last": float(values[-1]),
        "next": float(pairs.next_eigenvalue),
        "worst_residual": float(np.max(np.asarray(pairs.residuals))),
        "converged": int(np.sum(np.asarray(pairs.converged))),
        "cut_multiplet": int(pairs.cut_multiplet),
    }
