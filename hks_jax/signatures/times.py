"""Checks of eigenpairs and times, default energies, and times that suit a metric without eigenpairs."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from hks_jax.checks import checked_times, require_count
from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.domain.components import active_elements, boundary_nodes, label_nodes
from hks_jax.eigen.eigenpairs import Eigenpairs, require_pairs
from hks_jax.eigen.weyl import weyl, weyl_number
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, normalise_boundary
from hks_jax.traced import is_traced


def times_of(pairs: Eigenpairs, times: Any) -> Float[Array, " n"]:
    """Return times as an array with the dtype of the pairs; raise TypeError or ValueError if they are invalid."""
    return checked_times(times, require_pairs(pairs).problems[0].eigenvalues.dtype)


def dimension_of(pairs: Eigenpairs, purpose: str) -> int:
    """Return the dimension of the manifold; raise ValueError if it is not known."""
    return _stated(pairs.space.dimension, "dimension", "manifold", purpose)


def volume_of(pairs: Eigenpairs, purpose: str) -> Float[Array, ""]:
    """Return the area or volume of the domain in its metric; raise ValueError if it is not known."""
    return _stated(pairs.pencil.volume, "volume", "domain", purpose)


def measure_of(pairs: Eigenpairs, purpose: str) -> Float[Array, ""]:
    """Return the integral of 1 with the mass; raise ValueError if it is not known."""
    return _stated(pairs.pencil.measure, "volume", "domain", purpose)


def _stated(value: Any, name: str, of: str, purpose: str) -> Any:
    if value is None:
        raise ValueError(
            f"pairs: got matrices without the {name} of the {of}, which {purpose} needs. Use `sparse_pencil(K, M, "
            f"{name}=…)`"
        )
    return value


def positive_range(pairs: Eigenpairs) -> tuple[Array, Array]:
    """Return the first positive and the last eigenvalue; raise ValueError if no eigenvalue can be positive.

    A multiple eigenvalue is returned as the mean over its multiplet, which is differentiable.
    """
    if _n_positive(require_pairs(pairs)) < 1:
        raise ValueError(
            f"pairs: got {pairs.k} eigenvalues, none positive (each component without a Dirichlet side has the "
            "eigenvalue 0). Compute more eigenpairs"
        )
    return _ends(pairs.eigenvalues, pairs.kept, pairs.multiplet_tolerance)


@numpy_where_known()
def _ends(values: Any, kept: Any, tolerance: Any) -> tuple[Any, Any]:
    xp = library_of(values)

    def mean_of_copies(value: Any) -> Any:
        copies = kept & (xp.abs(values - value) <= tolerance * value)
        return xp.sum(xp.where(copies, values, 0)) / xp.sum(copies, dtype=values.dtype)

    return mean_of_copies(values[xp.argmax(values > 0)]), mean_of_copies(values[xp.sum(kept) - 1])


def _n_positive(pairs: Eigenpairs) -> int:
    """Return the number of kept eigenvalues that are positive, or an upper bound for traced values."""
    values, kept = jax.lax.stop_gradient((pairs.eigenvalues, pairs.kept))
    if not is_traced((values, kept)):
        return int((np.asarray(kept) & (np.asarray(values) > 0)).sum())
    return pairs.k - pairs.n_null if pairs.null_space_known else pairs.k


def default_energies(pairs: Eigenpairs, n: int = 100) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Return n energies and the width σ of the wave kernel signature (Aubry, Schlickewei and Cremers 2011).

    The width is σ = 7 (log λ_last − log λ₁)/n, and the energies run from log λ₁ + 2σ to log λ_last − 2σ.

    Examples:
        >>> energies, sigma = hj.default_energies(pairs)
        >>> print(jnp.isclose(energies[0], jnp.log(pairs.eigenvalues[1]) + 2 * sigma))
        True
    """
    require_count("n", n, 29)  # fewer energies would not exceed the range 4σ
    if _n_positive(require_pairs(pairs)) < 2:
        raise ValueError(
            f"pairs: got {_n_positive(pairs)} positive eigenvalue(s); expected at least two. Compute more eigenpairs"
        )
    first, last = (jnp.log(value) for value in positive_range(pairs))
    sigma = 7 * (last - first) / n
    return jnp.linspace(first + 2 * sigma, last - 2 * sigma, n), sigma


FREE = 0.1
"""The influence of the boundary below which a node counts as free of it: at a distance of 1.5 √t from a flat side."""
DEFAULT_K = {2: 200, 3: 100}
"""The default number of eigenpairs by dimension. It is smaller in 3D, where factorisations cost more."""
RESOLVED = {2: 4.6, 3: 5.7}
"""The least λ_k·t, by dimension, at which at most 1 % of the signature lies beyond k pairs (`hks_jax.truncation`)."""
LAST = (math.pi / 2) ** 2
"""The largest value of λ₁·t, at which √t is half the length of an interval with the first eigenvalue λ₁. At
larger times, the signature mainly shows the size of the domain."""
COARSE = 6.0
"""The least ratio t/h² of time to squared node spacing at which the grid biases the signature by at most 1 %."""


def default_k(dimension: int, unknowns: int) -> int:
    """Return the default number of eigenpairs: `DEFAULT_K`, or a quarter of the unknowns if this quarter is less."""
    return max(1, min(DEFAULT_K[dimension], unknowns // 4))


def suitable(metric: Any, spacing: Any, inside: Bool[np.ndarray, "*shape"], boundary: BoundarySpec) -> dict[str, float]:
    """Return the times and k that suit a metric on a grid; see `suitable_times`.

    The metric (n, d, d) is given at the nodes inside the domain or at a representative sample of these nodes.
    """
    metric, spacing = np.asarray(metric), np.asarray(spacing)
    d, share = len(spacing), inside.sum() / len(metric)
    sides = normalise_boundary(boundary, d)
    periodic = tuple(pair == ("periodic", "periodic") for pair in sides[:-1])
    labels, count = label_nodes(inside, periodic)
    steps = np.stack([_steps(labels, count, axis, wraps) for axis, wraps in enumerate(periodic)], axis=1)
    along = np.einsum("naa->na", metric) * spacing**2  # the squared distance of neighbours along each axis
    volume = float(np.sqrt(np.linalg.det(metric)).sum() * np.prod(spacing) * share)
    size = float(np.sqrt((np.median(along, axis=0) * steps**2).max()))
    rim = boundary_nodes(active_elements(inside, periodic), periodic)
    depth = math.inf
    if rim.any():
        beyond = [(n // 2,) * 2 if wraps else (0, 0) for n, wraps in zip(inside.shape, periodic, strict=True)]
        to_rim = scipy.ndimage.distance_transform_edt(np.pad(~rim, beyond, "wrap"), np.sqrt(np.median(along, axis=0)))
        within = tuple(slice(low, low + n) for (low, _), n in zip(beyond, inside.shape, strict=True))
        depth = float(np.median(to_rim[within][inside]))
    problems = len(doubled_problems(sides))
    spacing2, nodes = float(np.median(along.max(axis=1))), round(len(metric) * share)
    return suitable_times(d, volume, spacing2, size, nodes, problems, depth)


def _steps(labels: Int[np.ndarray, "*shape"], count: int, axis: int, wraps: bool) -> Float[np.ndarray, " count"]:
    """Return the extent of each labelled component along an axis, in node spacings.

    The extent around a periodic axis is half of the period: a circle's first eigenvalue is that of half its length.
    """
    n = labels.shape[axis]
    filled = np.zeros((count + 1, n), bool)
    filled[labels, np.arange(n).reshape([-1 if a == axis else 1 for a in range(labels.ndim)])] = True
    planes = filled[1:].sum(axis=1)
    return np.where(wraps & (planes == n), n / 2, planes - 1)


def suitable_times(
    dimension: int, volume: float, width2: float, size: float, nodes: int, problems: int = 1, depth: float = math.inf
) -> dict[str, float]:
    """Return a dictionary of times and numbers of eigenpairs that suit a domain.

    The node spacing resolves ``least_time``, which takes ``k_for_least_time`` eigenpairs; ``k``, the default number,
    resolves ``least_time_of_k``. `width2` is the squared distance between neighbouring nodes, `size` the greatest
    extent of the domain, `problems` the number of even and odd problems under "mean" and "mirror", and `depth` the
    median distance of the nodes from the boundary, infinite without a boundary. At the largest time, about half of the
    nodes are free of the boundary, or, as at ``time_by_size``, √t is half of `size`.
    """
    least, unknowns = COARSE * width2, problems * nodes
    by_size = LAST * (size / math.pi) ** 2  # an interval of length `size` has λ₁ = (π/size)²
    k = default_k(dimension, unknowns)
    return {
        "least_time": least,
        "k_for_least_time": math.ceil(weyl_number(RESOLVED[dimension] / least, problems * volume, dimension)),
        "k": k,
        "unknowns": unknowns,
        "least_time_of_k": RESOLVED[dimension] / weyl(k, problems * volume, dimension),
        # At the distance d from a flat side, exp(−d²/t) is the influence of the boundary.
        "largest_time": min(by_size, max(depth, 0.0) ** 2 / -math.log(FREE)),
        "time_by_size": by_size,
    }
