"""Suitable times and numbers of eigenpairs for a metric, before eigenpairs are computed."""

import math
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool

from hks_jax.domain.components import label_nodes
from hks_jax.eigen.weyl import weyl, weyl_number
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, normalise_boundary

DEFAULT_K = {2: 200, 3: 100}
"""The default number of eigenpairs by dimension. It is smaller in 3D, where factorisations cost more."""
RESOLVED = {2: 4.6, 3: 5.7}
"""The least λ_k·t, by dimension, at which at most 1 % of the signature lies beyond k pairs (`hks_jax.truncation`)."""
LAST = (math.pi / 2) ** 2
"""The value of λ₁·t at the largest time, at which √t is half the length of an interval with this eigenvalue."""
COARSE = 6.0
"""The least t/h² at which the grid spacing h biases the signature by at most 1 %."""


def default_k(dimension: int, unknowns: int) -> int:
    """Return the default number of eigenpairs: `DEFAULT_K`, or a quarter of the unknowns if that is less."""
    return max(1, min(DEFAULT_K[dimension], unknowns // 4))


def suitable(metric: Any, spacing: Any, inside: Bool[np.ndarray, "*shape"], boundary: BoundarySpec) -> dict[str, float]:
    """Return the times and k that suit a metric on a grid; see `suitable_times`.

    The metric (n, d, d) is given at the nodes inside the domain or at a representative sample of them.
    """
    metric, spacing = np.asarray(metric), np.asarray(spacing)
    d, share = len(spacing), inside.sum() / len(metric)
    boxes = scipy.ndimage.find_objects(label_nodes(inside, (False,) * d)[0].astype(int))
    steps = np.array([[part.stop - part.start - 1 for part in box] for box in boxes])  # the length of each component
    along = np.einsum("naa->na", metric) * spacing**2  # the squared distance of neighbours along each axis
    volume = float(np.sqrt(np.linalg.det(metric)).sum() * np.prod(spacing) * share)
    size = float(np.sqrt((np.median(along, axis=0) * steps**2).max()))
    problems = len(doubled_problems(normalise_boundary(boundary, d)))
    return suitable_times(d, volume, float(np.median(along.max(axis=1))), size, round(len(metric) * share), problems)


def suitable_times(
    dimension: int, volume: float, width2: float, size: float, nodes: int, problems: int = 1
) -> dict[str, float]:
    """Return the least times that the spacing and the default k resolve, the k for the former, and the largest time.

    `width2` is the squared distance between neighbouring nodes, and `size` is the domain's length. Under "mean" and
    "mirror" several problems share the eigenpairs.
    """
    least, unknowns = COARSE * width2, problems * nodes
    k = default_k(dimension, unknowns)
    return {
        "least_time": least,
        "k_for_least_time": math.ceil(weyl_number(RESOLVED[dimension] / least, problems * volume, dimension)),
        "k": k,
        "unknowns": unknowns,
        "least_time_of_k": RESOLVED[dimension] / weyl(k, problems * volume, dimension),
        "largest_time": LAST * (size / np.pi) ** 2,  # λ₁ of an interval of this length
    }
