"""The heat kernel signature from eigenpairs, and its normalisations."""

import math
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.filters import Heat
from hks_jax.signatures.spectral_functions import spectral_diagonal, spectral_trace
from hks_jax.signatures.times import dimension_of, measure_of
from hks_jax.signatures.truncation import resolved_times

Normalisation = Literal["raw", "heat-trace", "volume", "flat"]


def hks(
    pairs: Eigenpairs,
    times: Any,
    normalisation: Normalisation = "raw",
) -> Float[Array, "n_times *shape"]:
    """Compute the heat kernel signature HKS(t, x) = k_t(x, x) = Σᵢ exp(−λᵢt) φᵢ(x)².

    See Sun, Ovsjanikov and Guibas 2009, eq. 5, and Zobel, Reininghaus and Hotz, section 2. `hks_auto` and
    `hks_spectrum_free` reach smaller times. The unit of ``"raw"`` is 1/(metric length)^d, and 1/length^d for Fick's
    operator. The signature is NaN outside the mask, and 0 at Dirichlet nodes.

    Args:
        times: (n_times,) positive, in (metric length)².
        normalisation: ``"raw"`` is the signature itself. ``"heat-trace"`` divides it by the heat trace Σᵢ exp(−λᵢt)
            (Sun et al.). ``"volume"`` multiplies it by the domain's area or volume, of the metric or of Fick's volume
            element dx, so that it tends to 1 for large t, except with a potential. ``"flat"`` multiplies it by
            (4πt)^(d/2), or by (4πt)^(d/2) √|D| for Fick's operator, so that it tends to 1 for small t away from the
            boundary, or to 1/ρ with a density ρ. At vertices of a mesh, √|D| is the mean over the cells around them.

    Raises:
        ValueError: if times are not positive and finite, or if the normalisation is unknown.

    Warns:
        AccuracyWarning: if times are too small for the number of pairs or for the grid (see `truncation`).

    Examples:
        >>> signature = hj.hks(pairs, [0.2, 10.0], normalisation="volume")
        >>> print(signature[1].min().round(3), signature[1].max().round(3))  # heat has spread evenly
        1.0 1.0
    """
    times = resolved_times(pairs, times)
    scale = None if normalisation == "raw" else _of_times(pairs, times, normalisation)
    return _of_nodes(pairs, normalisation, spectral_diagonal(pairs, Heat(times), scale))


def normaliser(pairs: Eigenpairs, times: Float[Array, " n"], normalisation: str) -> Float[Array, "n *broadcast"]:
    """Return the factor at each time, and at each node or for all nodes, by which `hks` multiplies the signature."""
    factors = _of_times(pairs, times, normalisation)
    return _of_nodes(pairs, normalisation, factors.reshape(-1, *[1] * len(pairs.space.node_shape)))


def _of_nodes(pairs: Eigenpairs, normalisation: str, values: Float[Array, "n *any"]) -> Float[Array, "n *shape"]:
    """Return the values, times √|D| with the normalisation "flat" of Fick's operator."""
    density = pairs.pencil.density if normalisation == "flat" else None
    return values if density is None else values * density


def _of_times(pairs: Eigenpairs, times: Float[Array, " n"], normalisation: str) -> Float[Array, " n"]:
    if normalisation == "raw":
        return jnp.ones_like(times)
    if normalisation == "heat-trace":
        return 1 / spectral_trace(pairs, Heat(times))
    if normalisation == "volume":
        return jnp.broadcast_to(measure_of(pairs, 'normalisation="volume"'), times.shape)
    if normalisation == "flat":
        return (4 * math.pi * times) ** (dimension_of(pairs, 'normalisation="flat"') / 2)
    raise ValueError(f'normalisation: got {normalisation!r}; expected "raw", "heat-trace", "volume" or "flat"')
