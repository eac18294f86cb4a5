"""Error bars on the command line, from a chosen source of noise, and the signal-to-noise ratio of signatures."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj
from hks_jax.cli.computation import OfMesh, OfVolume, Solved, automatic_times, result_of, solver_of
from hks_jax.cli.parsing import Times
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, read_volume
from hks_jax.io.result import Result
from hks_jax.io.volume import require_position
from hks_jax.signatures.times import FREE, positive_range

_CANDIDATES = 4
"""The number of candidate times for each automatic time."""
_SIGNAL = 1.0
"""The signal-to-noise ratio at which automatic times begin."""
_LEAST = 0.1
"""The least share of nodes in the interior; fewer nodes do not represent the variation of a map."""
_FLOOR = 0.5
"""The least diffusivity of noisy tensors of volumes, as a fraction of the measured one. With less, an eigenproblem
takes several times as long."""
_CLEAR = 2.0
"""The report contains the first time with a signal-to-noise ratio above this value."""


class Noise(NamedTuple):
    """The noise of tensors, its source as in ``--noise``, and the number of noisy maps."""

    of_tensors: hj.TensorNoise
    source: str
    draws: int


def signature_of(
    solved: Solved,
    noise: Noise | None,
    progress: Progress,
    checkpoint: Path | None = None,
    scaled: np.ndarray | None = None,
) -> Result:
    """Compute the signature of a domain from its eigenpairs, with error bars unless `noise` is None.

    If the times are given by the products λ₁t in `scaled`, the times of noisy maps follow the noise of λ₁.
    """
    settings = solved.settings
    if noise is not None:
        bars, maps, interior, times = _error_bars(solved, noise, progress, checkpoint, scaled)
        settings = replace(settings, times=Times(times, settings.times.automatic))
    result = result_of(solved._replace(settings=settings), progress)
    if noise is None:
        return result
    ratio = np.asarray(bars.signal_to_noise_at(interior))
    nodes = np.isfinite(np.asarray(bars.value[0])).sum()
    clear = np.flatnonzero(ratio > _CLEAR)
    report = {
        "source": noise.source,
        "draws": bars.draws,
        "sampling_error": bars.sampling_error,
        "indefinite": float(bars.indefinite),
        "raised": float(bars.raised),
        "signal_to_noise": ratio.tolist(),
        "signal_to_noise_with_rim": np.asarray(bars.signal_to_noise).tolist(),
        "interior": (interior.reshape(len(ratio), -1).sum(axis=1) / nodes).tolist(),
        "claimed": np.asarray(bars.trusted).tolist(),
        f"exceeds_{_CLEAR:g}_from_t": float(times[clear[0]]) if clear.size else None,
    }
    for line in _told(ratio, times, result.unit):
        progress.note(line)
    # With a normalisation by the whole domain, the level of a map depends on the domain's volume, which differs from
    # that of constant tensors. Then only differences between nodes are compared.
    by_domain = settings.normalisation in ("heat-trace", "volume")
    axes = tuple(range(1, bars.value.ndim))
    level = jnp.nanmedian(bars.value - bars.null, axis=axes, keepdims=True) if by_domain else 0.0
    z = bars.z(bars.null + level)
    arrays = {"deviation": bars.deviation, "bias": bars.bias, "z": z, "noise_maps": maps}
    arrays = {**result.arrays, **{name: np.asarray(array) for name, array in arrays.items()}}
    return replace(result, arrays=arrays, report={**result.report, "noise": report})


def _told(ratio: np.ndarray, times: tuple[float, ...], unit: str) -> list[str]:
    """Return lines with the signal-to-noise ratio at each t, and with the times at which there is no signal."""
    at = [f"t = {t:.4g} {unit}".rstrip() for t in times]
    known = [f"{r:.2g} at {where}" for r, where in zip(ratio, at, strict=True) if np.isfinite(r)]
    lines = [f"signal-to-noise ratio: {', '.join(known)}"] if known else []
    if none := [where for r, where in zip(ratio, at, strict=True) if r == 0]:
        lines.append(f"noise explains all differences from constant tensors at {', '.join(none)}")
    if unknown := [where for r, where in zip(ratio, at, strict=True) if not np.isfinite(r)]:
        lines.append(f"no signal-to-noise ratio at {', '.join(unknown)}: the boundary influences nearly all nodes")
    return lines


def noise_of(domain: OfVolume | OfMesh, reading: Reading, draws: int, progress: Progress) -> Noise | None:
    """Return the noise of a domain's tensors according to ``--noise``, or None without this option."""
    source, volume = reading.noise, domain.volume
    if source is None:
        return None
    if volume is None:
        assert domain.tensors is not None
        try:
            level = float(source)
        except ValueError:
            raise ValueError(
                f"--noise: got {source!r}; expected a number, relative to the mean diffusivity, for tensors of a mesh"
            ) from None
        return Noise(hj.TensorNoise.relative(domain.tensors, level), source, draws)
    grid = volume.grid("all")
    if source == "residuals":
        if volume.covariance is None:
            raise ValueError("--noise: got residuals, which need a fit to diffusion-weighted images (--bval, --bvec)")
        noise = volume.noise(grid)
    elif source == "roughness":
        noise = hj.TensorNoise.from_roughness(volume.tensors, grid)
    elif (second := reading.second_scan) is not None:
        other = read_volume(second, progress)
        require_position(source, other.affine, volume.affine, volume.volume_shape)
        if other.shape == grid.shape and (lacking := int((grid.inside & ~other.inside).sum())):
            raise ValueError(
                f"--noise: got {source} without tensors at {lacking} of the {int(grid.inside.sum())} voxels of the "
                "domain; expected tensors of both scans. Pass --mask with the voxels that both scans cover"
            )
        noise = hj.TensorNoise.from_scans(volume.tensors, other.tensors, grid)
    else:
        noise = hj.TensorNoise.relative(volume.tensors, float(source), grid)
    return Noise(noise, source, draws)


def _error_bars(
    solved: Solved, noise: Noise, progress: Progress, checkpoint: Path | None, scaled: np.ndarray | None
) -> tuple[hj.Uncertainty, np.ndarray, np.ndarray, tuple[float, ...]]:
    """Return error bars, the sampled noise (n_draws, n_times, *shape), the interior (n_times, *shape), and the times.

    For the boundary condition ``"mean"``, the interior contains the nodes at which the boundary has little influence;
    it is empty at times with few such nodes. For other boundary conditions, the interior is the whole domain.
    Automatic times begin at the first time with a sufficient signal-to-noise ratio.
    """
    domain, pairs, settings = solved
    assert domain.tensors is not None
    assert domain.of_tensors is not None
    of_tensors, wanted = domain.of_tensors, settings.times.automatic
    times = settings.times.explicit or automatic_times(pairs, _CANDIDATES * wanted)
    maps: list[np.ndarray] = []
    solver = solver_of(settings, pairs.pencil, pairs.k, keep_spare=True)
    starts, start = isinstance(solver, hj.ChebyshevFilter), pairs

    def signature(D: Any) -> Any:
        nonlocal start
        assert settings.boundary is not None
        found = hj.eigenpairs(of_tensors(D), pairs.k, settings.boundary, solver, start=start if starts else None)
        if starts and start.problems[0].spare is None:  # the first call is for the measured tensors
            start = found
        if starts and not np.asarray(found.converged).all():
            progress.warn(f"error bars are not accurate: in a noisy map, {found.messages()[0]}")
        at = times if scaled is None else jnp.asarray(scaled) / positive_range(found)[0]
        return hj.hks(found, at, settings.normalisation)

    with progress.stage("error bars", f"{noise.draws} noisy maps"), warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)  # some warnings concern candidate times that are not chosen
        tensors = domain.tensors.astype(settings.dtype)
        in_volume = domain.volume is not None and domain.volume is not domain.place  # JAX cannot trace the sampling
        # The filter compiles its rounds itself, and outside `jit` it solves for fewer pairs of each problem.
        more: dict[str, Any] = {"draws": noise.draws, "compiled": not (in_volume or starts), "checkpoint": checkpoint}
        more |= {"floor": _FLOOR} if pairs.space.dimension == 3 else {}
        more |= {"each": lambda one: maps.append(np.asarray(one, np.float32)), "progress": progress.update}
        bars = hj.uncertainty(signature, tensors, noise.of_tensors, method="resample", **more)
        interior = np.isfinite(np.asarray(bars.value))
        if len(pairs.pencil.parts) == 2:
            nodes = interior[0].sum()
            interior &= np.asarray(hj.boundary_influence(pairs, times)) < FREE
            interior[interior.reshape(len(times), -1).sum(axis=1) < _LEAST * nodes] = False
    chosen = np.arange(len(times))
    if not settings.times.explicit:
        ratio = np.asarray(bars.signal_to_noise_at(interior))
        ratio = np.where(np.isfinite(ratio), ratio, np.asarray(bars.signal_to_noise))  # for an empty interior
        clear = np.flatnonzero(ratio >= _SIGNAL)
        first = min(int(clear[0]), len(times) - wanted) if clear.size else 0
        chosen = np.rint(np.linspace(first, len(times) - 1, wanted)).astype(int)
        bars = jax.tree.map(lambda leaf: leaf[chosen] if jnp.ndim(leaf) else leaf, bars)
    for message in bars.messages():
        progress.warn(message)
    return bars, np.stack(maps)[:, chosen], interior[chosen], tuple(times[i] for i in chosen)
