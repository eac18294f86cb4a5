"""Signatures that are given by one filter: heat trace, heat kernel, scale-invariant HKS, WKS and custom functions."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import nan_is_meant
from hks_jax.checks import require_count, require_number, require_real
from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.eigen.eigenpairs import Eigenpairs, require_pairs
from hks_jax.signatures.filters import Custom, Derivative, Heat, Wave
from hks_jax.signatures.spectral_functions import source_indices, spectral_columns, spectral_diagonal, spectral_trace
from hks_jax.signatures.times import default_energies, positive_range
from hks_jax.signatures.truncation import resolved_times
from hks_jax.traced import is_traced


def heat_trace(pairs: Eigenpairs, times: Any) -> Float[Array, " n_times"]:
    """Compute the heat trace Σᵢ exp(−λᵢt) = ∫ HKS(t, x) dx at times (n_times,).

    Raises:
        ValueError: if times are not positive and finite.

    Warns:
        AccuracyWarning: if times are too small for the number of pairs or for the grid.

    Examples:
        >>> print(hj.heat_trace(pairs, [0.2, 10.0])[1].round(3))  # e^0 is left
        1.0
    """
    return spectral_trace(pairs, Heat(resolved_times(pairs, times)))


def heat_kernel(pairs: Eigenpairs, times: Any, sources: Any) -> Float[Array, "n_times n_sources *shape"]:
    """Compute columns of the heat kernel, k_t(x_s, x) = Σᵢ exp(−λᵢt) φᵢ(x_s) φᵢ(x); NaN outside the mask.

    Args:
        times: (n_times,) positive.
        sources: node indices (n_sources, d), or (d,) for one source; vertex numbers (n_sources,) on a mesh.

    Raises:
        ValueError: if times are invalid, or if a source is out of range or outside the mask.

    Examples:
        >>> heat = hj.heat_kernel(pairs, [0.2], (4, 4))[0, 0]
        >>> print((pairs.pencil.mass @ heat.ravel()).sum().round(3))  # the total heat
        1.0
    """
    return spectral_columns(pairs, Heat(resolved_times(pairs, times)), source_indices(pairs, sources))


@nan_is_meant
def scale_invariant_hks(
    pairs: Eigenpairs, n_frequencies: int = 6, n_times: int = 256, times: Any = None
) -> Float[Array, "n_frequencies *shape"]:
    """Compute the scale-invariant HKS (Bronstein and Kokkinos 2010): |FFT(d/dτ log HKS(exp τ, x))| at low frequencies.

    The variable τ is the logarithm of the time. Scaling all lengths by β shifts log HKS by log β² along τ, and
    subtracts a constant, which the derivative d/dτ removes. The modulus of the Fourier transform does not depend on
    shifts along τ. The default times scale with the spectrum, so invariance is exact. The moduli are dimensionless, and
    NaN outside the mask and at Dirichlet nodes.

    Args:
        n_frequencies: the number of Fourier moduli, from frequency 0.
        n_times: the number of times, if `times` is not given.
        times: (n,) log-spaced times; give all domains the same times to compare them at absolute scales. The default
            runs from 4 ln10/λ_last to 4 ln10/λ₁.

    Raises:
        ValueError: if n_frequencies is not from 1 to n/2 + 1, or if concrete times are not log-spaced.

    Examples:
        >>> nine = hj.eigenpairs(hj.TensorField(field.grid, 9 * field.tensors), k=12)
        >>> np.allclose(hj.scale_invariant_hks(nine), hj.scale_invariant_hks(pairs), atol=1e-3)
        True
    """
    for name, count in (("n_frequencies", n_frequencies), ("n_times", n_times)):
        require_count(name, count)
    if times is None:
        first, last = positive_range(pairs)
        times = 4 * math.log(10.0) / jnp.geomspace(last, first, n_times)
    else:
        times = resolved_times(pairs, times)
        _require_log_spaced(times)
    if not 1 <= n_frequencies <= times.size // 2 + 1:
        raise ValueError(
            f"n_frequencies: got {n_frequencies}; expected 1 to {times.size // 2 + 1} for {times.size} times"
        )
    signature = spectral_diagonal(pairs, Heat(times))
    # The derivative d/dτ at t = exp τ is t d/dt, which has a closed form.
    slope = spectral_diagonal(pairs, Derivative(Heat(times), Heat(times))) / signature
    return jnp.abs(jnp.fft.rfft(slope, axis=0))[:n_frequencies] / times.size


def _require_log_spaced(times: Float[Array, " n"]) -> None:
    times = jax.lax.stop_gradient(times)
    if is_traced(times):
        return
    steps = np.diff(np.log(np.asarray(times, np.float64)))
    # The logarithm of a rounded time t (1 + ε) has the error ε.
    if steps.size and not np.allclose(steps, np.mean(steps), rtol=1e-3, atol=4 * float(jnp.finfo(times.dtype).eps)):
        raise ValueError(
            f"times: got steps of log t from {steps.min():.4g} to {steps.max():.4g}; expected equal steps, which the "
            "Fourier transform along log t needs. Use np.geomspace"
        )


def wks(pairs: Eigenpairs, energies: Any = None, sigma: Any = None) -> Float[Array, "n_energies *shape"]:
    """Compute the wave kernel signature (Aubry, Schlickewei and Cremers 2011, eq. 9).

    WKS(e, x) = Σᵢ φᵢ(x)² exp(−(e − log λᵢ)²/2σ²) / Σᵢ exp(−(e − log λᵢ)²/2σ²) over the positive λᵢ,
    in 1/(metric length)^d; NaN outside the mask.

    Args:
        energies: (n,) values of log λ, by default the 100 values of `default_energies`.
        sigma: the width σ > 0 in log λ, by default the width of `default_energies`.

    Raises:
        ValueError: if only one of energies and sigma is given or one is invalid, or if no eigenvalue is positive.

    Warns:
        AccuracyWarning: if concrete energies are above log λ_last − 2σ, where pairs that were not computed contribute.

    Examples:
        >>> lowest = hj.wks(pairs)[0]
        >>> print((pairs.pencil.mass @ lowest.ravel()).sum().round(1))  # a mean of φᵢ²
        1.0
    """
    if (energies is None) != (sigma is None):
        raise ValueError("energies, sigma: got only one; expected both, as from `default_energies`, or neither")
    _, last = jax.lax.stop_gradient(positive_range(pairs))
    if energies is None:
        energies, sigma = default_energies(pairs)
    require_real("energies", energies)
    require_real("sigma", sigma)
    energies, sigma = (jnp.asarray(value, pairs.eigenvalues.dtype) for value in (energies, sigma))
    if energies.ndim != 1 or energies.size == 0 or (not is_traced(energies) and not np.isfinite(energies).all()):
        raise ValueError(f"energies: got {energies}; expected a non-empty 1-D array of finite values of log λ")
    if sigma.ndim != 0:
        raise ValueError(f"sigma: got shape {sigma.shape}; expected one positive width in log λ")
    require_number("sigma", sigma)
    _warn_of_energies(*jax.lax.stop_gradient((energies, sigma, last, pairs.next_eigenvalue)))
    # Dividing the numerator and the denominator by the largest exponential prevents underflow far from all log λᵢ.
    offset = _largest_exponents(*jax.lax.stop_gradient((energies, sigma, pairs.eigenvalues, pairs.kept)))
    bells = Wave(energies, jnp.broadcast_to(sigma, energies.shape), offset)
    return spectral_diagonal(pairs, bells, 1 / spectral_trace(pairs, bells))


def _warn_of_energies(energies: Array, sigma: Array, last: Array, following: Array) -> None:
    if is_traced((energies, sigma, last, following)) or np.isinf(following):
        return
    highest = math.log(float(last)) - 2 * float(sigma)
    # The last of the default energies has this value up to rounding.
    beyond = np.asarray(energies) > highest + 1e-3 * float(sigma)
    if beyond.any():
        warn_of_accuracy(
            f"energies: {int(beyond.sum())} of {beyond.size} energies, up to {float(np.max(energies)):.4g}, are too "
            "large for k: eigenpairs that were not computed contribute to them. Use energies of at most "
            f"{highest:.4g}, which is log λ_last − 2σ, or more eigenpairs"
        )


@numpy_where_known()
def _largest_exponents(energies: Any, sigma: Any, values: Any, kept: Any) -> Any:
    xp = library_of(energies)
    positive = kept & (values > 0)
    logs = xp.log(xp.where(positive, values, 1))
    exponents = xp.where(positive[None], -(((energies[:, None] - logs[None]) / sigma) ** 2) / 2, -xp.inf)
    return xp.max(exponents, axis=1)


def spectral_signature(
    pairs: Eigenpairs, function: Callable[[Any, Array], Array], parameters: Any, sources: Any = None
) -> Float[Array, "m *shape"]:
    """Compute Σᵢ f(θ, λᵢ) φᵢ(x)², or with sources Σᵢ f(θ, λᵢ) φᵢ(x_s) φᵢ(x), for any f and each of m parameters θ.

    The heat kernel signature is ``spectral_signature(pairs, lambda t, x: jnp.exp(-t * x), times)``. Derivatives with
    respect to the tensors and to θ are exact at eigenvalues of any multiplicity. With sources the result has the shape
    (m, n_sources, *shape). The result is NaN outside the mask.

    Args:
        function: maps (θ, λ) to f elementwise for λ of any shape, and is differentiable by JAX for λ > 0. Pass traced
            values in θ, not by closure. Define the function once, because every new function object is compiled again.
        parameters: θ, a pytree of floating point arrays with a leading axis m.
        sources: None for the diagonal, or node indices (n_sources, d) or (d,); vertex numbers on a mesh.

    Raises:
        ValueError: if the parameters have no common leading axis or a source is invalid.

    Examples:
        >>> signature = hj.spectral_signature(pairs, lambda t, x: jnp.exp(-t * x), jnp.array([0.2, 0.5]))
        >>> np.allclose(signature, hj.hks(pairs, [0.2, 0.5]), atol=1e-4)
        True
    """
    dtype = require_pairs(pairs).eigenvalues.dtype
    require_real("parameters", parameters)
    parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), parameters)
    shapes = [leaf.shape for leaf in jax.tree.leaves(parameters)]
    if not shapes or len({shape[:1] for shape in shapes}) != 1 or not all(shapes):
        raise ValueError(f"parameters: got arrays of shapes {shapes}; expected equal first axes, one entry per filter")
    filters = Custom(function, parameters)
    if sources is None:
        return spectral_diagonal(pairs, filters)
    return spectral_columns(pairs, filters, source_indices(pairs, sources))
