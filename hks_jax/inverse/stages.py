"""The stages of a fit: what is observed in each, and how many eigenpairs that takes."""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.pencil import AnyPencil
from hks_jax.inverse.observation import Observation
from hks_jax.inverse.outcome import observed_times
from hks_jax.inverse.problem import pairs_below, pairs_for, require_resolved, unknowns_of


def stages_of(
    whole: Observation, weights: Any, shape: tuple[int, ...], count: int, build: Callable[[Any], Observation]
) -> list[Observation]:
    """Return the observation of each stage: the largest times first."""
    if count == 1 or whole.signature not in ("hks", "heat-trace"):
        return [whole]
    assert whole.times is not None
    order = np.argsort(-np.asarray(whole.times))
    base = np.broadcast_to(np.ones(()) if weights is None else np.asarray(weights, float), shape)
    stages = []
    for stage in range(1, count):
        used = np.zeros(shape[0], dtype=bool)
        used[order[: math.ceil(shape[0] * stage / count)]] = True
        stages.append(build(base * used.reshape(-1, *[1] * (len(shape) - 1))))
    return [*stages, whole]


def pairs_of_stage(
    observation: Observation,
    k: int | None,
    shape: tuple[int, ...],
    pencil: AnyPencil,
    field: TensorField,
) -> int:
    """Return how many eigenpairs to compute."""
    if observation.signature == "eigenvalues":
        return shape[0]
    if callable(observation.signature):
        if k is None:
            raise ValueError("k: got None; a signature of your own needs the number of eigenpairs")
        return k
    assert observation.times is not None
    if observation.signature == "wks":
        assert observation.sigma is not None
        reach = float(jnp.max(observation.times) + 2 * observation.sigma)
        wanted, unknowns = pairs_below(math.exp(reach), pencil, field), unknowns_of(pencil)
        if k is None:
            what = f"energies up to {float(jnp.max(observation.times)):.4g}, which take"
            require_resolved(wanted, unknowns, what, "lower energies")
    else:
        wanted = pairs_for(observed_times(observation), pencil, field)  # those of this stage
    return wanted if k is None else k
