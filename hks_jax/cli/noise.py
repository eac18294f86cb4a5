"""Error bars on the command line: where the noise comes from, and what of the signature exceeds it."""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hks_jax.accuracy import AccuracyWarning
from hks_jax.cli.job import Settings, automatic_times
from hks_jax.cli.options import Times
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import read_volume
from hks_jax.cli.result import Result
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.driver import eigenpairs
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.io.volume import TensorVolume
from hks_jax.signatures.boundary import boundary_influence
from hks_jax.signatures.hks import hks
from hks_jax.uncertainty import TensorNoise, Uncertainty, uncertainty

_CANDIDATES = 4
"""How many times as many times are looked at as automatic ones are asked for."""
_SIGNAL = 1.0
"""The signal to noise from which on automatic times begin."""
_RIM = 0.1
"""The share of a signature that the boundary may decide (`boundary_influence`) at nodes of the interior."""
_LEAST = 0.1
"""The share of the nodes that an interior has at least: fewer do not tell how a map varies."""
_CLEAR = 2.0
"""The signal to noise that the report names the first time of."""


class Bars(NamedTuple):
    """Error bars of a signature, the noise (n_draws, n_times, *shape) of which they are made, and the interior.

    The interior (n_times, *shape) is where the boundary decides little, under ``"mean"``, and empty at times that leave
    few such nodes; else it is all of the domain.
    """

    uncertainty: Uncertainty
    maps: np.ndarray
    interior: np.ndarray


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


def noise_of(args: argparse.Namespace, volume: TensorVolume, grid: Grid, progress: Progress) -> TensorNoise:
    """Return the noise that the arguments name.

    Raises:
        FileNotFoundError: neither a number, nor a word that is known, nor a file.
        ValueError: residuals of what was not fitted; a second scan that does not fit the first.
    """
    if args.noise == "residuals":
        if volume.covariance is None:
            raise ValueError("--noise: residuals are those of a fit to diffusion-weighted images (--bval, --bvec)")
        return TensorNoise(volume.covariance, grid)
    if args.noise == "roughness":
        return TensorNoise.from_roughness(volume.tensors, grid)
    second = second_scan(args)
    if second is not None:
        return TensorNoise.from_scans(volume.tensors, read_volume(second, progress).tensors, grid)
    return TensorNoise.relative(volume.tensors, float(args.noise), grid)


def error_bars(
    volume: TensorVolume, noise: TensorNoise, pairs: Eigenpairs, settings: Settings, draws: int, progress: Progress
) -> tuple[Bars, Settings]:
    """Compute error bars; return them, and the settings with the times, which begin where there is signal."""
    wanted = settings.times.automatic
    times = settings.times.explicit or automatic_times(pairs, _CANDIDATES * wanted)
    grid = noise.grid
    assert grid is not None
    assert settings.metric is not None
    assert settings.boundary is not None
    boundary = settings.boundary

    def signature(D: Any) -> Any:
        field = TensorField.from_diffusion(grid, D, settings.metric, interpolation=settings.interpolation)
        return hks(eigenpairs(field, pairs.k, boundary, settings.solver), times, settings.normalisation)

    with progress.stage("error bars", f"{draws} noisy maps"), warnings.catch_warnings():
        warnings.simplefilter("ignore", AccuracyWarning)  # of times that are not chosen, too
        tensors = volume.tensors.astype(settings.dtype)
        maps: list[np.ndarray] = []

        def keep(one: Any) -> None:
            maps.append(np.asarray(one, np.float32))

        bars = uncertainty(
            signature, tensors, noise, method="resample", draws=draws, progress=progress.update, each=keep
        )
        interior = np.isfinite(np.asarray(bars.value))
        if len(pairs.pencil.parts) == 2:
            nodes = interior[0].sum()
            interior &= np.asarray(boundary_influence(pairs, times)) < _RIM
            interior[interior.reshape(len(times), -1).sum(axis=1) < _LEAST * nodes] = False
    chosen = np.arange(len(times))
    if not settings.times.explicit:
        ratio = np.asarray(bars.signal_to_noise_at(interior))
        ratio = np.where(np.isfinite(ratio), ratio, np.asarray(bars.signal_to_noise))  # where all is near the rim
        clear = np.flatnonzero(ratio >= _SIGNAL)
        first = min(int(clear[0]), len(times) - wanted) if clear.size else 0
        chosen = np.rint(np.linspace(first, len(times) - 1, wanted)).astype(int)
        bars = jax.tree.map(lambda leaf: leaf[chosen] if jnp.ndim(leaf) else leaf, bars)
        times = tuple(times[i] for i in chosen)
    for message in bars.messages():
        progress.warn(message)
    return Bars(bars, np.stack(maps)[:, chosen], interior[chosen]), replace(settings, times=Times(times, wanted))


def with_error_bars(result: Result, found: Bars, source: str) -> Result:
    """Return a result with error bars, and with what the report says of them."""
    bars = found.uncertainty
    ratio = np.asarray(bars.signal_to_noise_at(found.interior))
    nodes = np.isfinite(np.asarray(bars.value[0])).sum()
    clear = np.flatnonzero(ratio > _CLEAR)
    report = {
        "source": source,
        "draws": bars.draws,
        "sampling_error": bars.sampling_error,
        "indefinite": float(bars.indefinite),
        "signal_to_noise": ratio.tolist(),
        "signal_to_noise_with_rim": np.asarray(bars.signal_to_noise).tolist(),
        "interior": (found.interior.reshape(len(ratio), -1).sum(axis=1) / nodes).tolist(),
        "claimed": np.asarray(bars.trusted).tolist(),
        f"exceeds_{_CLEAR:g}_from_t": float(result.times[clear[0]]) if clear.size else None,
    }
    arrays = {"deviation": np.asarray(bars.deviation), "bias": np.asarray(bars.bias), "noise_maps": found.maps}
    return replace(result, arrays={**result.arrays, **arrays}, report={**result.report, "noise": report})


def z_of(result: Result) -> Float[np.ndarray, "n_times *shape"] | None:
    """Return how many standard deviations the signature is from that of flat space, or from its median."""
    if "deviation" not in result.arrays:
        return None
    values, normalisation = result.values, result.settings["normalisation"]
    ones = (-1, *[1] * (values.ndim - 1))
    if normalisation in ("raw", "flat"):
        power = 0 if normalisation == "flat" else -(values.ndim - 1) / 2
        reference = ((4 * np.pi * result.times) ** power).reshape(ones)
    else:
        reference = np.nanmedian(values.reshape(len(values), -1), axis=1).reshape(ones)
    return (values - reference) / result.arrays["deviation"]
