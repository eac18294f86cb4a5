"""Statistics of signatures over the regions of a label map."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from hks_jax.checks import require_number, require_real, require_static


@dataclass(frozen=True, eq=False)
class RegionStatistics:
    """Statistics of a signature over r regions, as NumPy arrays.

    Attributes:
        labels: (r,) the regions' numbers in ascending order.
        nodes: (r,) the number of the region's nodes in the domain, where the signature has a value.
        coverage: (r,) the share of the region's nodes that lie in the domain.
        volume: (r,) the number of nodes times the volume (in 2D, the area) of one node.
        mean: (n_times, r) the unweighted mean over the nodes.
        deviation: (n_times, r) the standard deviation within the region, with the number of nodes as divisor.
        median: (n_times, r) the median over the nodes.
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
        values: (n_times, *shape) a signature, with NaN outside the domain.
        labels: (*shape) integers, the number of each node's region or 0 for none.
        node_volume: the volume (in 2D, the area) of one node.

    Returns:
        One entry for each nonzero label. A region without a node in the domain has coverage 0 and NaN statistics.

    Raises:
        ValueError: if shapes disagree, if labels are all 0 or not integers, or if the nodes with values depend on time.

    Examples:
        >>> labels = np.where(field.grid.nodes[..., 0] < 0.5, 1, 2)
        >>> hj.region_statistics(labels[None].astype(float), labels).mean
        array([[1., 2.]])
    """
    for name, given in (("values", values), ("labels", labels)):
        require_static(name, given)
        require_real(name, given)
    require_number("node_volume", node_volume)
    u, regions = np.asarray(values, np.float64), np.asarray(labels)
    if u.ndim < 2 or u.shape[1:] != regions.shape:
        raise ValueError(f"labels: got shape {regions.shape}; expected the values' shape without times, {u.shape[1:]}")
    if not (np.isfinite(regions).all() and np.array_equal(regions, np.rint(regions))):
        raise ValueError("labels: got fractional numbers or infinity; expected integers, 0 for no region")
    u, regions = u.reshape(len(u), -1), regions.ravel().astype(np.int64)
    inside = np.isfinite(u[0])
    if not np.array_equal(np.isfinite(u), np.broadcast_to(inside, u.shape)):
        raise ValueError("values: got nodes with NaN at only some times; expected NaN at all times or at none")
    labelled, whole = np.unique(regions[regions != 0], return_counts=True)
    if not labelled.size:
        raise ValueError("labels: got 0 at all nodes; expected a region's number at some nodes")
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
