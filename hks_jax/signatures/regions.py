"""Signatures by region: what a label map's regions have in the mean, and how much they vary inside."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from hks_jax.checks import require_number, require_real


@dataclass(frozen=True, eq=False)
class RegionStatistics:
    """A signature's statistics over r regions; on the host.

    Attributes:
        labels: (r,) the regions' numbers, ascending.
        nodes: (r,) how many nodes of the region have a value: the nodes of the domain.
        coverage: (r,) their share of all of the region's nodes. What lies outside the mask has no value.
        volume: (r,) the nodes' number times that of one; an area in the plane.
        mean: (n_times, r) over the nodes, each counted alike.
        deviation: (n_times, r) the root mean square distance from that mean: the spread within the region (divided by
            the number of nodes, not by one less).
        median: (n_times, r).
    """

    labels: Int[np.ndarray, " r"]
    nodes: Int[np.ndarray, " r"]
    coverage: Float[np.ndarray, " r"]
    volume: Float[np.ndarray, " r"]
    mean: Float[np.ndarray, "n_times r"]
    deviation: Float[np.ndarray, "n_times r"]
    median: Float[np.ndarray, "n_times r"]


def region_statistics(values: Any, labels: Any, node_volume: float = 1.0) -> RegionStatistics:
    """Return mean, standard deviation and median of a signature over each region of a label map.

    Args:
        values: (n_times, *shape); NaN outside the domain, as signatures are.
        labels: (*shape) whole numbers: the number of the region that a node belongs to, 0 for none.
        node_volume: the volume (in the plane, the area) that one node stands for.

    Returns:
        One entry for every label but 0. A region without a node in the domain has the coverage 0 and NaN statistics.

    Raises:
        ValueError: shapes that disagree; labels that are no whole numbers, or 0 everywhere; times at which other nodes
            have values.
    """
    require_real("values", values)
    require_real("labels", labels)
    require_number("node_volume", node_volume)
    u, regions = np.asarray(values, np.float64), np.asarray(labels)
    if u.ndim < 2 or u.shape[1:] != regions.shape:
        raise ValueError(f"labels: got shape {regions.shape}; expected that of the values without times, {u.shape[1:]}")
    if not np.array_equal(regions, np.rint(regions)):
        raise ValueError("labels: got numbers with a fraction; expected whole numbers, 0 for none")
    u, regions = u.reshape(len(u), -1), regions.ravel().astype(np.int64)
    inside = np.isfinite(u[0])
    if not np.array_equal(np.isfinite(u), np.broadcast_to(inside, u.shape)):
        raise ValueError("values: NaN at some times alone; expected values at the same nodes at all times")
    labelled, whole = np.unique(regions[regions != 0], return_counts=True)
    if not labelled.size:
        raise ValueError("labels: 0 everywhere; expected the number of a region at some of the nodes")
    chosen = inside & (regions != 0)
    order = np.argsort(regions[chosen], kind="stable")
    nodes = np.searchsorted(regions[chosen][order], labelled, side="right")
    nodes = np.diff(nodes, prepend=0)
    sorted_values = u[:, chosen][:, order]
    mean, deviation, median = np.full((3, len(u), labelled.size), np.nan)
    for r, part in enumerate(np.split(sorted_values, np.cumsum(nodes)[:-1], axis=1)):
        if part.size:
            mean[:, r], deviation[:, r], median[:, r] = part.mean(1), part.std(1), np.median(part, axis=1)
    return RegionStatistics(labelled, nodes, nodes / whole, nodes * float(node_volume), mean, deviation, median)
