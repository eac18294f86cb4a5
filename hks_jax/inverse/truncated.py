"""What the eigenpairs beyond k would have added to a fit's residuals."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.assembly import assemble
from hks_jax.inverse.observation import Observation
from hks_jax.inverse.problem import TAIL, Problem, pairs_below, unknowns_of
from hks_jax.inverse.unknowns import Values
from hks_jax.signatures.tail import resolving, truncation_map
from hks_jax.signatures.truncation import truncation

_NEAR = 0.1
"""A misfit is near to what truncation leaves where that is more than this part of it: a third of the residuals."""


def truncation_misfit(problem: Problem, values: Values) -> Float[Array, ""]:
    """Estimate the misfit that the metric itself would have to a target of all pairs, as k are computed.

    Half the weighted sum of squares of the changes of the residuals that the missing pairs make, by `truncation_map`
    (heat traces: `truncation`). Zero for other signatures, whose residuals are defined by k pairs.
    """
    observation = problem.observation
    if observation.signature not in ("hks", "heat-trace"):
        return jnp.zeros(())
    pairs = problem.pairs(values)
    return _misfit_beyond(observation, pairs, observation.predict(pairs))


@eqx.filter_jit
def _misfit_beyond(observation: Observation, pairs: Eigenpairs, predicted: Array) -> Float[Array, ""]:
    assert observation.times is not None
    nodal = observation.signature == "hks"
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
