"""The elements of a masked grid, and their connected components."""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hks_jax.checks import require_real, require_static


def as_mask(name: str, values: Any) -> Bool[np.ndarray, "*shape"]:
    """Return a mask of zeros and ones as booleans; raise ValueError for other values."""
    require_static(name, values)
    require_real(name, values)
    array = np.asarray(values)
    if array.dtype != bool and not np.isin(array, (0, 1)).all():
        raise ValueError(
            f"{name}: got dtype {array.dtype} with values other than 0 and 1; expected booleans. Threshold them, for "
            "example mask > 0.5"
        )
    return array.astype(bool)


def wraps_per_axis(periodic: bool | Sequence[bool], dimension: int) -> tuple[bool, ...]:
    """Return which axes are periodic; raise ValueError unless the argument is a bool or one bool per axis."""
    wraps = (periodic,) * dimension if isinstance(periodic, bool | np.bool_) else tuple(np.atleast_1d(periodic))
    if len(wraps) != dimension or not all(isinstance(wrap, bool | np.bool_) for wrap in wraps):
        raise ValueError(f"periodic: got {periodic!r}; expected True, False, or a tuple of {dimension}, one per axis")
    return tuple(bool(wrap) for wrap in wraps)


def wrap_nodes(nodes: np.ndarray, periodic: tuple[bool, ...]) -> np.ndarray:
    """Repeat the first node after the last along periodic axes, so that each axis has one node more than elements."""
    return np.pad(nodes, [(0, int(wraps)) for wraps in periodic], mode="wrap")


def _corners(dimension: int) -> list[tuple[slice, ...]]:
    """Return slices for each corner, which select this corner of all elements from the result of `wrap_nodes`."""
    return list(product(*[(slice(None, -1), slice(1, None))] * dimension))


def active_elements(mask: Bool[np.ndarray, "*shape"], periodic: tuple[bool, ...]) -> np.ndarray:
    """Mark the elements with all 2^d nodes inside the mask; a periodic axis has n elements, others have n − 1."""
    nodes = wrap_nodes(mask, periodic)
    return np.logical_and.reduce([nodes[corner] for corner in _corners(mask.ndim)])


def element_nodes(elements: np.ndarray, periodic: tuple[bool, ...]) -> np.ndarray:
    """Return at each node the greatest value of the adjacent elements; the values are booleans or labels."""
    nodes = np.zeros([n + 1 for n in elements.shape], elements.dtype)
    for corner in _corners(elements.ndim):
        np.maximum(nodes[corner], elements, out=nodes[corner])
    for axis, wraps in enumerate(periodic):
        if wraps:
            ends = nodes.take([0, -1], axis=axis).max(axis=axis, keepdims=True)
            inner = nodes.take(range(1, nodes.shape[axis] - 1), axis=axis)
            nodes = np.concatenate([ends, inner], axis=axis)
    return nodes


def rim_nodes(elements: np.ndarray, periodic: tuple[bool, ...]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes on the rim of a mask: nodes of the domain with an adjacent grid element outside the domain."""
    return element_nodes(elements, periodic) & element_nodes(~elements, periodic)


def boundary_nodes(elements: np.ndarray, periodic: tuple[bool, ...]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes on the rim of a mask and on the sides of the grid that are not periodic."""
    margins = [0 if wraps else 1 for wraps in periodic]
    around = np.pad(elements, [(m, m) for m in margins])
    return rim_nodes(around, periodic)[tuple(slice(m, -m or None) for m in margins)]


def label_nodes(mask: Bool[np.ndarray, "*shape"], periodic: tuple[bool, ...]) -> tuple[Int[np.ndarray, "*shape"], int]:
    """Label the connected components of the domain: two nodes are neighbours when they share an element.

    Returns the labels (0 outside, 1 … n inside) and their number n.
    """
    elements = active_elements(mask, periodic)
    # Elements that share a node are connected, but two neighbouring nodes need not share an element. Therefore elements
    # are labelled, and nodes take the labels of their elements. Labels that meet at periodic sides are merged.
    labels, count = scipy.ndimage.label(elements, structure=np.ones((3,) * mask.ndim, dtype=bool))
    nodes = element_nodes(labels, periodic)
    if any(periodic) and count > 1:
        around = wrap_nodes(nodes, periodic)
        rows, cols = np.concatenate([[labels[elements], around[c][elements]] for c in _corners(mask.ndim)], axis=1) - 1
        graph = coo_matrix((np.ones(rows.size), (rows, cols)), shape=(count, count))
        count, merged = connected_components(graph, directed=False)
        nodes = np.where(nodes > 0, merged[nodes - 1] + 1, 0)
    return nodes, int(count)


def bounding_box(inside: Bool[np.ndarray, "*shape"], margin: int = 2) -> tuple[slice, ...]:
    """Return the slices of the bounding box of the True entries, with a margin."""
    (box,) = scipy.ndimage.find_objects(inside.astype(int))
    ends = zip(box, inside.shape, strict=True)
    return tuple(slice(max(part.start - margin, 0), min(part.stop + margin, n)) for part, n in ends)
