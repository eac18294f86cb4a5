"""Multiple eigenvalues: which computed eigenvalues count as equal, and the truncation of a spectrum between them."""

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp

from hks_jax.arrays import library_of
from hks_jax.compilation import numpy_where_known


class Spectrum(NamedTuple):
    """Computed eigenvalues, and the numbers that decide which of them count as equal; constants in derivatives."""

    values: Any  # (k,) the eigenvalues, ascending
    following: Any  # the next eigenvalue
    origin: Any  # `Eigenpairs.spectral_origin`
    tolerance: Any  # `Eigenpairs.multiplet_tolerance`
    rounding: Any  # the rounding error of eigenvalues if no null space is known, otherwise 0


_SHIFTED = 16
"""The factor by which rounding may grow where a solver shifts the matrix."""


# If no null space is known, the origin is the lowest computed eigenvalue, so distances from it do not show the rounding
# errors of its copies. Copies differ by the rounding error of the matrix. In single precision on fine grids, this worst
# case exceeds the gaps of distinct eigenvalues, whose errors are smaller. So rounding counts only up to a thousandth of
# the spectrum's length, unless all eigenvalues are equal within rounding. In double precision, copies may then differ
# by more, because solvers that shift the matrix increase rounding.
def gaps_to_next(spectrum: Spectrum) -> Any:
    """Return, for each eigenvalue, the largest gap to the next one at which the two count as equal, (k)."""
    xp = library_of(spectrum.values)
    values, _, origin, tolerance, rounding = spectrum
    finfo, length = jnp.finfo(values.dtype), xp.nanmax(values, initial=-xp.inf) - origin
    shifted = _SHIFTED * rounding if values.dtype == jnp.float64 else rounding
    rounding = xp.where(length <= shifted, shifted, xp.minimum(rounding, length / 1000))
    stored = 4 * finfo.eps * xp.abs(values)
    return xp.maximum(xp.maximum(tolerance * (values - origin), stored), xp.maximum(rounding, finfo.tiny))


@numpy_where_known(static_argnums=3)
def is_unconfirmed(spectrum: Spectrum, kept: Any, bound: Any, optional: bool) -> Any:
    """Return whether the bound of a certificate, which may be ``optional``, is below the last kept eigenvalue."""
    xp = library_of(kept)
    last = xp.sum(kept) - 1
    # The solver counts outside of the copies' errors.
    shifted = spectrum._replace(rounding=_SHIFTED * spectrum.rounding)
    needed = spectrum.values[last] - 2 * gaps_to_next(shifted)[last]
    return bound < needed if optional else ~(bound >= needed)


@numpy_where_known()
def number_cut(spectrum: Spectrum, kept: Any) -> Any:
    """Return `Eigenpairs.cut_multiplet`."""
    xp = library_of(kept)
    count = xp.sum(kept)
    ends, index = _ends_of_multiplets(spectrum), xp.arange(len(kept))
    beyond = xp.append(spectrum.values, spectrum.following)[count]
    whole = ends[count - 1] | xp.isnan(beyond - spectrum.values[count - 1])  # pairs that were not found are NaN
    return xp.where(whole, 0, count - xp.max(xp.where(ends & (index < count), index + 1, 0)))


@numpy_where_known()
def numbered(spectrum: Spectrum) -> Any:
    """Return `Eigenpairs.multiplets`."""
    xp = library_of(spectrum.values)
    ends = _ends_of_multiplets(spectrum).astype(xp.int32)
    return xp.cumsum(ends, dtype=xp.int32) - ends


def _ends_of_multiplets(spectrum: Spectrum) -> Any:
    """Return the mask (k) of eigenvalues that differ from the next one."""
    xp = library_of(spectrum.values)
    return xp.diff(xp.append(spectrum.values, spectrum.following)) > gaps_to_next(spectrum)


MultipletChoice = Literal["report", "drop", "complete"]

SPARE = 8
"""The number of pairs beyond k that are computed to complete a multiple eigenvalue."""


@numpy_where_known(static_argnums=(1, 2))
def kept_of(spectrum: Spectrum, k: int, multiplet: MultipletChoice) -> Any:
    """Return the mask of the lowest k eigenvalues, or of a different number if k cuts a multiple one."""
    xp = library_of(spectrum.values)
    size, ends = len(spectrum.values), _ends_of_multiplets(spectrum)
    index = xp.arange(size)
    if multiplet == "report":
        count = xp.asarray(k)
    else:
        count = xp.max(xp.where(ends & (index < k), index + 1, 0))
        if multiplet == "complete":
            more = xp.min(xp.where(ends & (index >= k - 1), index + 1, size + 1))
            count = xp.where(more <= size, more, count)
        count = xp.where(count > 0, count, k)
    return index < count
