"""Which times and how many eigenpairs suit a metric, before anything is computed."""

import math
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool

from hks_jax.domain.components import label_nodes
from hks_jax.eigen.weyl import weyl, weyl_number
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, normalise_boundary

DEFAULT_K = {2: 200, 3: 100}
"""Eigenpairs by dimension. A volume's factorisations cost so much more that fewer pairs take as long."""
RESOLVED = {2: 4.6, 3: 5.7}
"""λ_k·t, by dimension, from which on the pairs beyond k are 1 % of the signature (see `hks_jax.truncation`)."""
SHOWN = 1e-2
"""All but the constant has decayed to this at the largest time; a picture still shows it."""
LAST = -math.log(SHOWN)
"""λ₁·t at that time."""
COARSE = 6.0
"""t/h² from which the grid's spacing h biases it by at most 1 %."""


def default_k(dimension: int, unknowns: int) -> int:
    """Return the default number of eigenpairs: `DEFAULT_K`, or a quarter of the unknowns where these are few."""
    return max(1, min(DEFAULT_K[dimension], unknowns // 4))


def suitable(metric: Any, spacing: Any, inside: Bool[np.ndarray, "*shape"], boundary: BoundarySpec) -> dict[str, float]:
    """Return the times and k that suit a metric on a grid; see `suitable_times`.

    The metric (n, d, d) is that at the nodes inside the domain, or at some of them that stand for all.
    """
    metric, spacing = np.asarray(metric), np.asarray(spacing)
    d, share = len(spacing), inside.sum() / len(metric)
    boxes = scipy.ndimage.find_objects(label_nodes(inside, (False,) * d)[0].astype(int))
    steps = np.array([[part.stop - part.start - 1 for part in box] for box in boxes])  # how long each component is
    along = np.einsum("naa->na", metric) * spacing**2  # squared distances of neighbours, per axis
    volume = float(np.sqrt(np.linalg.det(metric)).sum() * np.prod(spacing) * share)
    size = float(np.sqrt((np.median(along, axis=0) * steps**2).max()))
    problems = len(doubled_problems(normalise_boundary(boundary, d)))
    return suitable_times(d, volume, float(np.median(along.max(axis=1))), size, round(len(metric) * share), problems)


def suitable_times(
    dimension: int, volume: float, width2: float, size: float, nodes: int, problems: int = 1
) -> dict[str, float]:
    """Return the least time that the spacing allows, what k it takes, what the default k allows, and the largest.

    `width2` is the square of the distance between neighbouring nodes, `size` the domain's length. Under the mean and
    with mirrors several problems share the eigenpairs.
    """
    least, unknowns = COARSE * width2, problems * nodes
    k = default_k(dimension, unknowns)
    return {
        "least_time": least,
        "k_for_least_time": math.ceil(weyl_number(RESOLVED[dimension] / least, problems * volume, dimension)),
        "k": k,
        "unknowns": unknowns,
        "least_time_of_k": RESOLVED[dimension] / weyl(k, problems * volume, dimension),
        "largest_time": LAST * (size / np.pi) ** 2,  # λ₁ is that of an interval of this length
    }
