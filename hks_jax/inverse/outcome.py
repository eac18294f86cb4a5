"""What a fit has come to, and what the eigenpairs beyond k would have added to its residuals."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.assembly import assemble
from hks_jax.inverse.observation import Observation
from hks_jax.inverse.problem import TAIL, Problem, losses_of, pairs_below, unknowns_of
from hks_jax.inverse.unknowns import Values
from hks_jax.signatures.truncation import resolving, truncation, truncation_map

_NEAR = 0.1
"""A misfit is near to what truncation leaves where that is more than this part of it: a third of the residuals."""


class Outcome(NamedTuple):
    """What a fit has come to.

    Attributes:
        loss: half the weighted mean square of the residuals, plus the penalties.
        misfit: the part of the data.
        truncation: see `truncation_misfit`.
        pairs: the eigenpairs, without their arrays at nodes and without their pencil.
    """

    loss: Float[Array, ""]
    misfit: Float[Array, ""]
    truncation: Float[Array, ""]
    pairs: Eigenpairs


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
    if observation.signature not in ("hks", "heat-trace"):
        return jnp.zeros(())
    assert observation.times is not None
    pairs = jax.lax.stop_gradient(pairs)
    predicted, nodal = observation.predict(pairs), observation.signature == "hks"
    share = truncation_map(pairs, observation.times) if nodal else truncation(pairs, observation.times).tail
    change = observation.compare(predicted / (1 - share)) - observation.compare(predicted)
    return jnp.sum(change**2) / 2


def truncation_shows(misfit: float, left: float) -> bool:
    """Tell whether a misfit is near to what truncation leaves, and that is more than `TAIL`."""
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
