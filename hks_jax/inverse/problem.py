"""The least squares problem of a fit, which maps unknowns to a field, eigenpairs, a signature and residuals."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.compilation import jit_quickly
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.driver import eigenpairs
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.assembly import assemble
from hks_jax.inverse.observation import Observation
from hks_jax.inverse.regulariser import Regulariser
from hks_jax.inverse.signature import TAIL, pairs_below, unknowns_of
from hks_jax.inverse.unknowns import Unknowns, Values
from hks_jax.signatures.truncation import resolving, truncation

_NEAR = 0.1
"""A warning is issued if truncation causes more than a tenth of the misfit, that is, a third of the residuals."""
_ENOUGH = 1e-5
"""Single precision suffices for the derivative of residuals if the derivative of eigenpairs has a tolerance of at least
1e-5. For the Jacobian J on 64² nodes, single precision causes errors of 1e-6 in J and up to 3e-5 in Jᵀ, and the
tolerance 1e-5 causes errors of 5e-6 in J and 5e-5 in Jᵀ."""


class Outcome(NamedTuple):
    """The loss of a fit at given unknowns, with its parts and the eigenpairs."""

    loss: Float[Array, ""]  # half the weighted mean square of the residuals, plus the penalties
    misfit: Float[Array, ""]  # the data's part of the loss
    truncation: Float[Array, ""]  # see `Observation.truncation_misfit`
    pairs: Eigenpairs  # the eigenpairs without eigenvectors and pencil
    values: Values  # the unknowns
    gradient: Float[Array, ""]  # the norm of the gradient of the solver's objective; NaN if it was not computed


class Problem(eqx.Module):
    """Residuals as a function of the unknowns."""

    unknowns: Unknowns  # the parameters that vary
    observation: Observation  # the data
    regularisers: tuple[Regulariser, ...]  # penalties
    k: int = eqx.field(static=True)  # the number of eigenpairs
    boundary: Any = eqx.field(static=True)  # boundary conditions
    solver: str | Eigensolver = eqx.field(static=True)  # eigensolver

    def pairs(self, values: Values) -> Eigenpairs:
        """Return the eigenpairs of the field for given unknowns."""
        return self._pairs_of(self.unknowns.field(values))

    def _pairs_of(self, field: TensorField) -> Eigenpairs:
        # The signature is differentiable only if k does not split a multiple eigenvalue.
        return eigenpairs(field, self.k, self.boundary, self.solver, multiplet="complete")

    def evaluate(self, values: Values) -> tuple[Float[Array, " m"], Float[Array, " r"], Outcome]:
        """Return the residuals of the data, the residuals of the penalties, and the loss with its parts."""
        field = self.unknowns.field(values)
        pairs = self._pairs_of(field)
        data = _residuals_of(self.observation, pairs, self.solver)
        penalties = [each.residuals(self.unknowns, values, field) for each in self.regularisers]
        penalty = jnp.concatenate([jnp.zeros(0, data.dtype), *penalties])
        misfit = jnp.sum(data**2) / 2
        truncation = self.observation.truncation_misfit(pairs)
        pairs = pairs.with_problems(
            eqx.tree_at(lambda p: (p.frame, p.pencil), each, (None, None)) for each in pairs.problems
        )
        nan = jnp.full((), jnp.nan, data.dtype)
        outcome = Outcome(misfit + jnp.sum(penalty**2) / 2, misfit, truncation, pairs, values, nan)
        return data, penalty, jax.lax.stop_gradient(outcome)

    def residuals(self, values: Values) -> tuple[Float[Array, " m"], Float[Array, " r"]]:
        """Return the residuals of the data and of the penalties."""
        return self.evaluate(values)[:2]


# A heat signature is at least the contribution of the constant eigenfunctions. Other signatures, and heat signatures
# without constant eigenfunctions, may underflow in single precision, and logarithmic derivatives divide by signatures.
def _residuals_of(observation: Observation, pairs: Eigenpairs, solver: str | Eigensolver) -> Float[Array, " m"]:
    """Return the residuals, with a single precision derivative if the derivative of eigenpairs is no more accurate."""
    rough = isinstance(solver, Eigensolver) and solver.adjoint.tolerance >= _ENOUGH
    bounded = observation.signature.left_out is not None and pairs.n_null > 0
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


@jit_quickly(eqx.filter_jit)
def outcome_of(problem: Problem, values: Values) -> Outcome:
    """Return loss, misfit and eigenpairs at given unknowns."""
    return problem.evaluate(values)[2]


def discretisation_misfit(problem: Problem, outcome: Outcome) -> float:
    """Estimate the misfit between the metric's signatures on the grid and in the continuum; NaN if it is not known.

    The estimate is half the weighted sum of squares of the residuals between the target and the target with the
    relative error `Truncation.resolution_bias`, which is that of the median node.
    """
    observation = problem.observation
    if observation.signature.left_out is None:
        return math.nan
    pencil = assemble(problem.unknowns.field(outcome.values), problem.boundary)
    pairs = outcome.pairs.with_problems(
        eqx.tree_at(lambda p: p.pencil, each, part, is_leaf=lambda x: x is None)
        for each, part in zip(outcome.pairs.problems, pencil.parts, strict=True)
    )
    times, which = np.unique(observation.observed_times, return_inverse=True)
    bias = truncation(pairs, times).resolution_bias[which]
    residuals = observation.root_weights * observation.loss((1 + bias) * observation.target, observation.target)
    return float(jnp.sum(residuals**2) / 2)


def truncation_shows(misfit: float, left: float) -> bool:
    """Return whether truncation causes more than a tenth of the misfit, and relative errors above 2·`TAIL`."""
    return left > (2 * TAIL) ** 2 / 2 and left > _NEAR * misfit


def more_pairs(problem: Problem, values: Values) -> int:
    """Return a number of eigenpairs that is larger than the problem's k, and suffices for the field of the unknowns."""
    field = problem.unknowns.field(values)
    pencil = assemble(field, problem.boundary)
    smallest = float(np.min(problem.observation.observed_times))
    wanted = pairs_below(resolving(TAIL, pencil.space.dimension) / smallest, pencil, field)
    return min(max(wanted, math.ceil(1.25 * problem.k)), unknowns_of(pencil))
