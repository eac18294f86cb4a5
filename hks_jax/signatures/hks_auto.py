"""The heat kernel signature from eigenpairs at large times, and without them at small times."""

import math
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.accuracy import AccuracyWarning, warn_of_accuracy
from hks_jax.arrays import nan_is_meant
from hks_jax.checks import require_number
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.hks import Normalisation, hks, normaliser
from hks_jax.signatures.times import times_of
from hks_jax.signatures.truncation import truncation
from hks_jax.spectrum_free.heat_diagonal import hks_spectrum_free
from hks_jax.spectrum_free.plan import Unattainable, choose_method, least_work, work
from hks_jax.traced import is_traced

_DEARER = 10.0
"""The largest work for comparing the two methods at one time, relative to the work of the spectrum-free method."""


class AutomaticHKS(eqx.Module):
    """A heat kernel signature that comes from eigenpairs at some times, and from a spectrum-free method at the others.

    Attributes:
        values: (n_times, *shape) the signature.
        times: (n_times,).
        spectral: (n_times,) bool, whether the signature at a time was computed from eigenpairs.
        tail: (n_times,) the estimated share of the signature that the eigenpairs lack, which decides the method.
        method: the spectrum-free method, ``"colouring"`` or ``"selected-inversion"``; ``"none"`` if it was not used.
        overlap_time: the shortest time from eigenpairs, at which both methods were compared; NaN if they were not.
        overlap_difference: the greatest difference between the two methods at `overlap_time`, relative to
            (4πt)^(−d/2); NaN without comparison.
    """

    values: Float[Array, "n_times *shape"]
    times: Float[Array, " n_times"]
    spectral: Bool[Array, " n_times"]
    tail: Float[Array, " n_times"]
    method: str = eqx.field(static=True)
    overlap_time: Float[Array, ""]
    overlap_difference: Float[Array, ""]

    def summary(self) -> str:
        """Return a few lines of text with the times of each method and the difference between the methods."""
        times, spectral = np.asarray(self.times), np.asarray(self.spectral)
        lines = []
        for name, which in (("eigenpairs", spectral), (self.method, ~spectral)):
            some = [f"{t:.4g}" for t in times[which]]
            if some:
                listed = ", ".join(some[:8]) + (" …" if len(some) > 8 else "")
                lines.append(f"{len(some)} of {times.size} times use {name}: {listed}")
        if math.isfinite(float(self.overlap_time)):
            lines.append(
                f"at t = {float(self.overlap_time):.4g} the signatures with and without eigenpairs differ by "
                f"{float(self.overlap_difference):.1e} · (4πt)^(−d/2)"
            )
        return "\n".join(lines)


@nan_is_meant
def hks_auto(
    pairs: Eigenpairs, times: Any, normalisation: Normalisation = "raw", tolerance: float = 1e-4
) -> AutomaticHKS:
    """Compute the heat kernel signature with the suitable method at each time, and report the choice.

    The signature is computed from the pairs at times at which they lack at most the share `tolerance` of it on average
    over the domain (by the estimate of `truncation`), and by `hks_spectrum_free` at the other times. If both methods
    are used, they are compared at the shortest time computed from the pairs, unless the comparison takes more than ten
    times the work of `hks_spectrum_free` at the other times.

    Args:
        times: (n_times,) positive; the normalisation is as in `hks`.
        tolerance: the allowed error of `hks_spectrum_free` at every node, relative to (4πt)^(−d/2), with its factor for
            a potential; and the allowed share that the pairs lack, which is a mean over the domain. Single nodes may
            lack several times as much (`truncation_map`): 4 to 7 times in measurements.

    Raises:
        ValueError: as in `hks`; if values are traced, because the choice depends on them; or if ``"heat-trace"`` is
            used at times at which the pairs do not suffice.

    Warns:
        AccuracyWarning: if the methods differ by ten times the tolerance, or if times are too small for the grid.

    Examples:
        >>> print(hj.hks_auto(pairs, [0.05, 0.5]).spectral)  # the first takes more than 12 pairs
        [False  True]
    """
    require_number("tolerance", tolerance, 1)
    times = times_of(pairs, times)
    known_pairs, known_times = jax.lax.stop_gradient((pairs, times))
    if is_traced((known_pairs.eigenvalues, known_times)):
        raise ValueError(
            "times: got traced values (jax.jit, vmap), but the choice of a method depends on values; use `hks` or, for "
            "small times, `hks_spectrum_free`"
        )
    estimate = truncation(known_pairs, known_times)
    spectral = np.asarray(estimate.tail) <= tolerance
    nan = jnp.asarray(np.nan, times.dtype)
    if spectral.all():
        values = hks(pairs, times, normalisation)
        return AutomaticHKS(values, times, jnp.asarray(spectral), estimate.tail, "none", nan, nan)
    small = np.flatnonzero(~spectral)
    pencil = pairs.pencil
    settings = choose_method(pencil, times[small], "auto", tolerance)
    raw = hks_spectrum_free(pencil, times[small], method=settings or "selected-inversion", tolerance=tolerance)
    if normalisation == "heat-trace":
        raise ValueError(
            'normalisation: got "heat-trace", which needs the eigenvalues that the pairs lack; use "raw", "volume" or '
            '"flat", or more pairs'
        )
    others = raw * normaliser(pairs, times[small], normalisation)
    # `hks_spectrum_free` uses no eigenpairs, so at its times only the grid can cause a warning.
    some = jax.tree.map(lambda leaf: leaf[small] if leaf.ndim else leaf, estimate)
    for message in eqx.tree_at(lambda e: e.tail, some, jnp.zeros(small.size)).messages():
        warn_of_accuracy(message)
    values = jnp.zeros((times.size, *others.shape[1:]), others.dtype).at[small].set(others)
    overlap = difference = nan
    if spectral.any():
        large = np.flatnonzero(spectral)
        of_pairs = hks(pairs, times[large], normalisation)
        values = values.at[large].set(of_pairs)
        overlap = jnp.min(known_times[large])
        least = work(settings, pencil, times[small])
        difference = _difference(known_pairs, overlap[None], tolerance, _DEARER * least)
        overlap = jnp.where(jnp.isnan(difference), nan, overlap)
        if float(difference) > 10 * tolerance:
            warn_of_accuracy(
                f"at t = {float(overlap):.4g} the signatures with and without eigenpairs differ by "
                f"{float(difference):.1e}, more than ten times the tolerance {tolerance:.1e}. Check the pairs' "
                "residuals, or compute more pairs, which single nodes may lack (see hks_jax.truncation_map)",
            )
    name = "selected-inversion" if settings is None else "colouring"
    return AutomaticHKS(values, times, jnp.asarray(spectral), estimate.tail, name, overlap, difference)


def _difference(pairs: Eigenpairs, times: Float[Array, " 1"], tolerance: float, most: float) -> Float[Array, ""]:
    """Return the greatest difference of the signatures with and without pairs, relative to (4πt)^(−d/2), or NaN."""
    pencil = pairs.pencil
    try:
        settings = least_work(pencil, times, tolerance)
    except Unattainable:
        return jnp.asarray(np.nan, times.dtype)
    if work(settings, pencil, times) > most:
        return jnp.asarray(np.nan, times.dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AccuracyWarning)
        spectral = hks(pairs, times)
        other = hks_spectrum_free(pencil, times, method=settings or "selected-inversion", tolerance=tolerance)
    return jnp.nanmax(jnp.abs(spectral - other) * normaliser(pairs, times, "flat"))
