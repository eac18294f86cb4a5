"""Heat flow of functions on a domain."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import checked_times, require_real
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.filters import Heat
from hks_jax.signatures.spectral import spectral_flow
from hks_jax.signatures.times import require_pairs
from hks_jax.signatures.truncation import TAIL_LIMIT
from hks_jax.traced import is_traced


def heat_flow(pairs: Eigenpairs, times: Any, functions: Any) -> Float[Array, "n_times *functions_and_shape"]:
    """Let functions diffuse on the domain: u(t) = Σᵢ exp(−λᵢt) φᵢ ∫φᵢu, the solution of ∂u/∂t = −Δu.

    Anisotropic where the metric is. Differentiable with respect to the functions, the times and the tensors.

    Args:
        pairs: from `eigenpairs`. Their boundary conditions hold for u, too: with ``"dirichlet"`` its values there are
            not used. With ``"mirror"`` and ``"mean"`` u is continued evenly, which is the flow with ``"neumann"``
            there.
        times: (n_times,) positive, in (metric length)².
        functions: (*shape), or several (…, *shape); values outside the mask are not used.

    Returns:
        (n_times, *functions.shape); NaN outside the mask, 0 at Dirichlet nodes.

    Raises:
        ValueError: times that are not positive; functions of another shape, or not finite inside the mask.

    Warns:
        AccuracyWarning: what of a function lies beyond the k pairs has not decayed at some time to 1 % of its norm.
    """
    dtype = require_pairs(pairs).eigenvalues.dtype
    times, shape = checked_times("times", times, dtype), pairs.space.node_shape
    require_real("functions", functions)
    u = jnp.asarray(functions, dtype)
    if u.shape[u.ndim - len(shape) :] != shape:
        raise ValueError(f"functions: got shape {u.shape}; expected {shape}, or more axes before it")
    if not is_traced(u):
        lacking = int((~np.isfinite(np.asarray(u))[..., pairs.space.free]).sum())
        if lacking:
            raise ValueError(f"functions: {lacking} values inside the mask are NaN or infinite; expected finite ones")
    rows = jnp.where(pairs.space.domain, u, 0).reshape(-1, *shape)
    _warn_if_truncated(pairs, times, rows)
    return spectral_flow(pairs, Heat(times), rows).reshape(*times.shape, *u.shape)


def _warn_if_truncated(pairs: Eigenpairs, times: Float[Array, " n_times"], rows: Float[Array, "s *shape"]) -> None:
    pairs, times, rows = jax.lax.stop_gradient((pairs, times, rows))
    if is_traced((pairs.eigenvalues, pairs.pencil, times, rows)):
        return
    mass, u = pairs.pencil.parts[0].mass, pairs.space.restrict(rows)
    image = mass.apply(u)
    n_parts = len(pairs.pencil.parts)
    coefficients = n_parts * jnp.matmul(image, pairs.vectors.T, precision="highest")
    used = pairs.of_part(0).kept
    squared = n_parts * jnp.sum(u * image, axis=1)
    beyond = jnp.maximum(squared - jnp.sum(jnp.where(used, coefficients**2, 0), axis=1), 0)
    share = float(jnp.max(jnp.where(squared > 0, beyond / jnp.where(squared > 0, squared, 1), 0))) ** 0.5
    rate = float(pairs.next_eigenvalue - pairs.spectral_origin)
    left = share * float(np.exp(-float(jnp.min(times)) * rate))
    if left > TAIL_LIMIT:
        enough = np.log(share / TAIL_LIMIT) / rate
        warn_of_accuracy(
            f"times: the heat flow at t = {float(jnp.min(times)):.4g} lacks up to {left:.1%} of a function's norm, "
            f"which lies beyond the computed eigenpairs. Use times from about {enough:.4g}, or more eigenpairs",
        )
