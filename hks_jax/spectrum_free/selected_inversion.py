"""The diagonal of exp(−tM⁻¹K)M⁻¹ by rational approximation and selected inversion.

exp(−x) ≈ Re Σ w/(x − z), so the diagonal is that of Re Σ w (tK − zM)⁻¹.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.compilation import jit_quickly
from hks_jax.linear.dissection import Dissection
from hks_jax.linear.operators import Operator, PatternedOperator, shifted
from hks_jax.linear.selected_inversion import diagonal_of_inverse
from hks_jax.spectrum_free.poles import exponential_poles


def pole_pairs(dtype: Any) -> int:
    """Return how many pairs of poles approximate the exponential to rounding."""
    return 7 if jnp.finfo(dtype).bits > 32 else 4


@jit_quickly()
def selected_inversion(
    stiffness: PatternedOperator, mass: Operator, times: Float[Array, " m"], dissection: Dissection
) -> Float[Array, "m n_dof"]:
    """Return the diagonal at each time.

    Args:
        stiffness: K.
        mass: M, with no entries where K has none.
        times: t.
        dissection: the elimination tree of K's pattern.
    """
    poles, weights = exponential_poles(pole_pairs(times.dtype))
    complex_type = np.result_type(times.dtype, np.complex64)

    # One pole at a time, also in the transpose: what it needs is computed again.
    @jax.checkpoint
    def term(inputs: tuple[Array, Array, Array]) -> Array:
        time, pole, weight = inputs
        diagonal = diagonal_of_inverse(dissection, shifted(stiffness, mass, pole / time.astype(complex_type)))
        return jnp.real(weight * diagonal) / time

    def at(time: Array) -> Array:
        some = jnp.broadcast_to(time, poles.shape), jnp.asarray(poles, complex_type), jnp.asarray(weights, complex_type)
        return jnp.sum(jax.lax.map(term, some), axis=0)

    return jax.lax.map(at, times)
