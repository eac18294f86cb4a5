"""The wave kernel signature."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.checks import require_number, require_real
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.filters import Wave
from hks_jax.signatures.spectral import spectral_diagonal, spectral_trace
from hks_jax.signatures.times import default_energies, positive_range
from hks_jax.traced import is_traced


def wks(pairs: Eigenpairs, energies: Any = None, sigma: Any = None) -> Float[Array, "n_energies *shape"]:
    """Compute the wave kernel signature (Aubry, Schlickewei and Cremers 2011, eq. 9).

    WKS(e, x) = Σᵢ φᵢ(x)² exp(−(e − log λᵢ)²/2σ²) / Σᵢ exp(−(e − log λᵢ)²/2σ²) over the positive λᵢ.

    Args:
        pairs: from `eigenpairs`.
        energies: (n,) values of log λ; default: `default_energies`, 100 of them.
        sigma: the width σ > 0 in log λ; default: the one that belongs to the default energies.

    Returns:
        (n_energies, *shape) in 1/(metric length)^d; NaN outside the mask.

    Raises:
        ValueError: only one of energies and sigma given, wrong shape, sigma ≤ 0, no positive eigenvalue.
    """
    if (energies is None) != (sigma is None):
        raise ValueError("energies, sigma: give both or neither; `default_energies(pairs, n)` returns a pair of them")
    positive_range(pairs)
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
    # The largest exponent is taken out of both sums: they do not underflow far outside of the spectrum.
    offset = _largest_exponents(*jax.lax.stop_gradient((energies, sigma, pairs.eigenvalues, pairs.kept)))
    bells = Wave(energies, jnp.broadcast_to(sigma, energies.shape), offset)
    return spectral_diagonal(pairs, bells, 1 / spectral_trace(pairs, bells))


@jax.jit
def _largest_exponents(
    energies: Float[Array, " n"], sigma: Float[Array, ""], values: Float[Array, " k"], kept: Bool[Array, " k"]
) -> Float[Array, " n"]:
    positive = kept & (values > 0)
    logs = jnp.log(jnp.where(positive, values, 1))
    exponents = jnp.where(positive[None], -jnp.square((energies[:, None] - logs[None]) / sigma) / 2, -jnp.inf)
    return jnp.max(exponents, axis=1)
