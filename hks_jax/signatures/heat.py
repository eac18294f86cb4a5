"""The heat kernel, its trace, and the scale-invariant signature."""

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.checks import checked_times
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.filters import Derivative, Heat
from hks_jax.signatures.spectral import source_indices, spectral_columns, spectral_diagonal, spectral_trace
from hks_jax.signatures.times import positive_range, require_pairs
from hks_jax.signatures.truncation import warn_if_truncated


def heat_trace(pairs: Eigenpairs, times: Any) -> Float[Array, " n_times"]:
    """Compute the heat trace Σᵢ exp(−λᵢt) = ∫ HKS(t, x) dx at times (n_times,).

    Raises:
        ValueError: times that are not positive and finite.

    Warns:
        AccuracyWarning: times too small for the number of pairs or for the grid.
    """
    times = checked_times("times", times, require_pairs(pairs).eigenvalues.dtype)
    warn_if_truncated(pairs, times)
    return spectral_trace(pairs, Heat(times))


def heat_kernel(pairs: Eigenpairs, times: Any, sources: Any) -> Float[Array, "n_times n_sources *shape"]:
    """Compute columns of the heat kernel, k_t(x_s, x) = Σᵢ exp(−λᵢt) φᵢ(x_s) φᵢ(x).

    Args:
        pairs: from `eigenpairs`.
        times: (n_times,) positive.
        sources: node indices (n_sources, d), or (d,) for one; on a mesh vertex numbers (n_sources,).

    Returns:
        (n_times, n_sources, *shape); NaN outside the mask.

    Raises:
        ValueError: bad times, or sources out of range or outside the mask.
    """
    times = checked_times("times", times, require_pairs(pairs).eigenvalues.dtype)
    warn_if_truncated(pairs, times)
    return spectral_columns(pairs, Heat(times), source_indices(pairs, sources))


def scale_invariant_hks(
    pairs: Eigenpairs, n_frequencies: int = 6, n_times: int = 256, times: Any = None
) -> Float[Array, "n_frequencies *shape"]:
    """Compute the scale-invariant HKS (Bronstein and Kokkinos 2010): |FFT| of d/dτ log HKS(exp τ, x), low frequencies.

    Scaling the metric by β shifts τ by log β² and lowers log HKS by a constant; the derivative drops the constant, the
    modulus of the Fourier transform the shift. The default times follow the spectrum (log-spaced from 4 ln10/λ_last to
    4 ln10/λ₁), which makes the invariance exact; give ``times`` (log-spaced) to compare shapes at absolute scales.

    Args:
        pairs: from `eigenpairs`.
        n_frequencies: how many Fourier moduli, from frequency 0.
        n_times: how many samples of τ.
        times: (n,) log-spaced times instead of the default.

    Returns:
        (n_frequencies, *shape), without unit; NaN outside the mask and at Dirichlet nodes.
    """
    if times is None:
        first, last = positive_range(pairs)
        times = 4 * math.log(10.0) / jnp.geomspace(last, first, n_times)
    else:
        times = checked_times("times", times, require_pairs(pairs).eigenvalues.dtype)
        warn_if_truncated(pairs, times)
    if not 1 <= n_frequencies <= times.size // 2 + 1:
        raise ValueError(
            f"n_frequencies: got {n_frequencies}; {times.size} times have 1 … {times.size // 2 + 1} frequencies"
        )
    signature = spectral_diagonal(pairs, Heat(times))
    # d/dτ at t = exp τ is t d/dt, known in closed form: no differences needed.
    slope = spectral_diagonal(pairs, Derivative(Heat(times), Heat(times))) / signature
    return jnp.abs(jnp.fft.rfft(slope, axis=0))[:n_frequencies] / times.size
