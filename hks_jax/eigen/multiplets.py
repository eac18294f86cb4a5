"""Multiple eigenvalues: which computed eigenvalues count as equal, and the truncation of a spectrum between them."""

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp

from hks_jax.compilation import library_of, numpy_where_known


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


class Cut(NamedTuple):
    """The multiple eigenvalues of a spectrum, and doubts about its last kept pairs; see `Eigenpairs`."""

    multiplets: Any  # (k,) the number of the multiple eigenvalue that each eigenvalue belongs to
    cut_multiplet: Any  # the number of kept pairs of the multiple eigenvalue that the cut divides
    unconfirmed: Any  # whether the solver's certificate ends below the last kept eigenvalue


@numpy_where_known(static_argnums=3)
def cut_of(spectrum: Spectrum, kept: Any, bound: Any, optional: bool) -> Cut:
    """Return the cut after the kept pairs; the certificate, which may be ``optional``, ends at ``bound``."""
    xp = library_of(kept)
    values, ends, count = spectrum.values, _ends_of_multiplets(spectrum), xp.sum(kept)
    numbers = xp.cumsum(ends, dtype=xp.int32) - ends.astype(xp.int32)
    last, beyond = values[count - 1], xp.append(values, spectrum.following)[count]
    whole = ends[count - 1] | xp.isnan(beyond - last)  # pairs that were not found are NaN
    begin = xp.max(xp.where(ends & (xp.arange(len(kept)) < count), xp.arange(1, len(kept) + 1), 0))
    # The solver counts outside of the copies' errors.
    shifted = spectrum._replace(rounding=_SHIFTED * spectrum.rounding)
    needed = last - 2 * gaps_to_next(shifted)[count - 1]
    return Cut(numbers, xp.where(whole, 0, count - begin), bound < needed if optional else ~(bound >= needed))


def _ends_of_multiplets(spectrum: Spectrum) -> Any:
    """Return the mask (k) of eigenvalues that differ from the next one."""
    xp = library_of(spectrum.values)
    return xp.diff(xp.append(spectrum.values, spectrum.following)) > gaps_to_next(spectrum)


MultipletChoice = Literal["report", "drop", "complete"]

TO_COMPLETE = 8
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
