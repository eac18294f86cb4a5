"""The least squares problem of a fit: from unknowns to a field, its eigenpairs, its signature, and the residuals."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.compilation import jit_quickly
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.driver import eigenpairs
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.solver import Eigensolver
from hks_jax.eigen.weyl import weyl_count
from hks_jax.fem.assembly import assemble
from hks_jax.fem.pencil import AnyPencil
from hks_jax.inverse.observation import Observation
from hks_jax.inverse.regulariser import Regulariser
from hks_jax.inverse.unknowns import Unknowns, Values
from hks_jax.signatures.truncation import resolving, truncation, truncation_map

TAIL = 1e-6
"""What part of the heat trace at the smallest time may lie beyond the pairs that are computed."""
_LOST = 0.05
"""What part makes a time unresolvable."""
_NEAR = 0.1
"""The share of truncation in a misfit from which on it is told: a third of the residuals."""
_ENOUGH = 1e-5
"""The accuracy of the solver's derivative for which single precision will do. Measured at 64² nodes, it costs 1e-6 in J
and 1e-5 to 3e-5 in Jᵀ; solves to this tolerance cost 5e-6 and 5e-5, where nothing is smooth."""


class Problem(eqx.Module):
    """Residuals as a function of the unknowns."""

    unknowns: Unknowns  # what varies
    observation: Observation  # what is to be matched
    regularisers: tuple[Regulariser, ...]  # penalties
    k: int = eqx.field(static=True)  # eigenpairs
    boundary: Any = eqx.field(static=True)  # boundary conditions
    solver: str | Eigensolver = eqx.field(static=True)  # eigensolver

    def pairs(self, values: Values) -> Eigenpairs:
        """Return the eigenpairs of the field that the values stand for."""
        return self._pairs_of(self.unknowns.field(values))

    def _pairs_of(self, field: TensorField) -> Eigenpairs:
        # Of a multiplet that k cuts, the derivative exists only with all of its copies, or none.
        return eigenpairs(field, self.k, self.boundary, self.solver, multiplet="complete")

    def residuals(self, values: Values) -> tuple[Float[Array, " m"], Float[Array, " r"]]:
        """Return the residuals of the data and those of the penalties: half the sum of squares is the loss."""
        return self.residuals_and_pairs(values)[:2]

    def residuals_and_pairs(self, values: Values) -> tuple[Float[Array, " m"], Float[Array, " r"], Eigenpairs]:
        """Return the residuals, and the eigenpairs from which they were computed."""
        field = self.unknowns.field(values)
        pairs = self._pairs_of(field)
        data = _residuals_of(self.observation, pairs, self.solver)
        penalties = [each.residuals(self.unknowns, values, field) for each in self.regularisers]
        return data, jnp.concatenate([jnp.zeros(0, data.dtype), *penalties]), pairs


def losses_of(data: Float[Array, " m"], penalties: Float[Array, " r"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the loss, and the misfit, which is the part of the data."""
    misfit = jnp.sum(data**2) / 2
    return misfit + jnp.sum(penalties**2) / 2, misfit


def pairs_below(eigenvalue: float, pencil: AnyPencil, field: TensorField) -> int:
    """Return about how many eigenvalues lie below one, by Weyl's law, and some more."""
    return math.ceil(1.1 * float(weyl_count(pencil, [eigenvalue], field)[0])) + 4


def require_resolved(wanted: int, n_dof: int, what: str, remedy: str) -> None:
    """Warn where more eigenpairs are wanted than are near to those of the manifold; refuse more than twice as many.

    A fit may come to a metric of more volume, which takes more of them, and must be able to begin there.
    """
    most = _most_pairs(n_dof)
    if wanted <= most:
        return
    message = (
        f"times: got {what} about {wanted} eigenpairs; with {n_dof} unknowns {most} are near enough to those of the "
        f"manifold to be fitted. Use {remedy}"
    )
    if wanted > min(2 * most, n_dof):
        raise ValueError(message)
    warn_of_accuracy(message)


def pairs_for(times: Any, pencil: AnyPencil, field: TensorField) -> int:
    """Return how many eigenpairs resolve the smallest time to `TAIL`: all, if that many are needed."""
    smallest, n_dof, d = float(np.min(np.asarray(times))), unknowns_of(pencil), pencil.space.dimension

    def count(tail: float) -> int:
        return pairs_below(resolving(tail, d) / smallest, pencil, field)

    needed = count(_LOST)
    least = smallest * (needed / _most_pairs(n_dof)) ** (2 / d)
    remedy = f"times from about {least:.3g}, or a finer grid"
    require_resolved(needed, n_dof, f"{smallest:.4g}, which takes", remedy)
    return min(count(TAIL), n_dof)


def _most_pairs(n_dof: int) -> int:
    return max(n_dof // 4, min(n_dof, 20))


def unknowns_of(pencil: AnyPencil) -> int:
    """Return how many eigenpairs there are."""
    return sum(part.space.n_dof for part in pencil.parts)


# A heat signature is not below that of the constants. Others, and those where the constants are no eigenfunctions, may
# be less than any number in single precision, which their logarithms are divided by.
def _residuals_of(observation: Observation, pairs: Eigenpairs, solver: str | Eigensolver) -> Float[Array, " m"]:
    """Return the residuals, whose derivative is in single precision where the solver's derivative needs no more."""
    rough = isinstance(solver, Eigensolver) and solver.adjoint.tolerance >= _ENOUGH
    bounded = observation.signature.symbol == "t" and pairs.n_null > 0
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


class Outcome(NamedTuple):
    """What a fit has come to."""

    loss: Float[Array, ""]  # half the weighted mean square of the residuals, plus the penalties
    misfit: Float[Array, ""]  # the part of the data
    truncation: Float[Array, ""]  # see `truncation_misfit`
    pairs: Eigenpairs  # the eigenpairs, without their arrays at nodes and without their pencil


def residuals_and_outcome(problem: Problem, values: Values) -> tuple[Float[Array, " m"], Float[Array, " r"], Outcome]:
    """Return the residuals of the data and those of the penalties, and what a fit has come to with these unknowns."""
    data, penalties, pairs = problem.residuals_and_pairs(values)
    left = truncation_misfit(problem.observation, pairs)
    pairs = eqx.tree_at(lambda p: (p.vectors, p.frame, p.pencil), pairs, (None, None, None))
    return data, penalties, jax.lax.stop_gradient(Outcome(*losses_of(data, penalties), left, pairs))


@jit_quickly(eqx.filter_jit)
def outcome_of(problem: Problem, values: Values) -> Outcome:
    """Return what a fit has come to with these unknowns."""
    return residuals_and_outcome(problem, values)[2]


def truncation_misfit(observation: Observation, pairs: Eigenpairs) -> Float[Array, ""]:
    """Estimate the misfit that the metric itself would have to a target of all pairs, as k are computed.

    Half the weighted sum of squares of the changes of the residuals that the missing pairs make, by `truncation_map`
    (heat traces: `truncation`). Zero for other signatures, whose residuals are defined by k pairs.
    """
    if observation.signature.symbol != "t":
        return jnp.zeros(())
    assert observation.times is not None
    pairs, at_nodes = jax.lax.stop_gradient(pairs), observation.signature.at_nodes
    predicted = observation.predict(pairs)
    share = truncation_map(pairs, observation.times) if at_nodes else truncation(pairs, observation.times).tail
    change = observation.compare(predicted / (1 - share)) - observation.compare(predicted)
    return jnp.sum(change**2) / 2


def truncation_shows(misfit: float, left: float) -> bool:
    """Tell whether truncation makes a large share of a misfit, and is itself more than `TAIL`."""
    return left > (2 * TAIL) ** 2 / 2 and left > _NEAR * misfit


def more_pairs(problem: Problem, values: Values) -> int:
    """Return how many pairs to go on with where those of a problem are too few for the field that it has come to."""
    field = problem.unknowns.field(values)
    pencil = assemble(field, problem.boundary)
    smallest = float(np.min(observed_times(problem.observation)))
    wanted = pairs_below(resolving(TAIL, pencil.space.dimension) / smallest, pencil, field)
    return min(max(wanted, math.ceil(1.25 * problem.k)), unknowns_of(pencil))


def observed_times(observation: Observation) -> Float[np.ndarray, " n"]:
    """Return the times at which something is observed."""
    assert observation.times is not None
    per_time = math.prod(observation.shape[1:])
    return np.asarray(observation.times)[np.unique(observation.entries.value // per_time)]


def pairs_of_stage(
    observation: Observation, k: int | None, shape: tuple[int, ...], pencil: AnyPencil, field: TensorField
) -> int:
    """Return how many eigenpairs to compute for what a stage observes."""
    if observation.signature.name == "eigenvalues":
        return shape[0]
    if observation.times is None:
        if k is None:
            raise ValueError("k: got None; a signature of your own needs the number of eigenpairs")
        return k
    if observation.sigma is not None:
        reach = float(jnp.max(observation.times) + 2 * observation.sigma)
        wanted, unknowns = pairs_below(math.exp(reach), pencil, field), unknowns_of(pencil)
        if k is None:
            what = f"energies up to {float(jnp.max(observation.times)):.4g}, which take"
            require_resolved(wanted, unknowns, what, "lower energies")
    else:
        wanted = pairs_for(observed_times(observation), pencil, field)  # those of this stage
    return wanted if k is None else k
