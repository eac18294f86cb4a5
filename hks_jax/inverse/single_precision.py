"""Residuals with a derivative in single precision, where that of the eigenpairs has no more digits."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.solver import Eigensolver
from hks_jax.inverse.observation import Observation

_ENOUGH = 1e-5
"""The accuracy of the solver's derivative for which single precision will do. Measured at 64² nodes, it costs 1e-6 in J
and 1e-5 to 3e-5 in Jᵀ; solves to this tolerance cost 5e-6 and 5e-5, where nothing is smooth."""


# A heat signature is not below that of the constants. Others, and those where the constants are no eigenfunctions, may
# be less than any number in single precision, which their logarithms are divided by.
def residuals_of(observation: Observation, pairs: Eigenpairs, solver: str | Eigensolver) -> Float[Array, " m"]:
    """Return the residuals, whose derivative is in single precision where the solver's derivative needs no more."""
    rough = isinstance(solver, Eigensolver) and solver.adjoint.tolerance >= _ENOUGH
    bounded = observation.signature in ("hks", "heat-trace") and pairs.n_null > 0
    return (_rough if rough and bounded else Observation.residuals)(observation, pairs)


@eqx.filter_custom_jvp
def _rough(observation: Observation, pairs: Eigenpairs) -> Float[Array, " m"]:
    return observation.residuals(pairs)


@_rough.def_jvp
def _rough_jvp(primals: tuple, tangents: tuple) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    residuals = _rough(*primals)
    _, change = eqx.filter_jvp(Observation.residuals, _in_single(primals), _in_single(tangents))
    return residuals, change.astype(residuals.dtype)


def _in_single(tree: Any) -> Any:
    return jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree)
