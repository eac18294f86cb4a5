"""Which elements of a masked grid exist, and how they hang together."""

from itertools import product

import numpy as np
import scipy
from jaxtyping import Bool, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


def wrap_nodes(nodes: np.ndarray, periodic: tuple[bool, ...]) -> np.ndarray:
    """Repeat the first node after the last along the periodic axes: one more than the elements everywhere."""
    return np.pad(nodes, [(0, int(wraps)) for wraps in periodic], mode="wrap")


def active_elements(mask: Bool[np.ndarray, "*shape"], periodic: tuple[bool, ...]) -> np.ndarray:
    """Mark the elements all of whose 2^d nodes are inside the mask, shape n (periodic axes) or n − 1."""
    nodes = wrap_nodes(mask, periodic)
    corners = product(*[(slice(None, -1), slice(1, None))] * mask.ndim)
    return np.logical_and.reduce([nodes[corner] for corner in corners])


def element_nodes(elements: np.ndarray, periodic: tuple[bool, ...]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes of the given elements."""
    nodes = np.zeros([n + 1 for n in elements.shape], dtype=bool)
    for corner in product(*[(slice(None, -1), slice(1, None))] * elements.ndim):
        nodes[corner] |= elements
    for axis, wraps in enumerate(periodic):
        if wraps:
            first, last = _face(nodes.ndim, axis, 0), _face(nodes.ndim, axis, -1)
            nodes[first] |= nodes[last]
            nodes = np.delete(nodes, -1, axis=axis)
    return nodes


def rim_nodes(elements: np.ndarray, periodic: tuple[bool, ...]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes on the rim of a mask: those that lack an element which the grid itself has."""
    count = np.zeros([n + (not wraps) for n, wraps in zip(elements.shape, periodic, strict=True)], dtype=int)
    beside = elements
    for axis, wraps in enumerate(periodic):
        before = [(1, int(not wraps)) if a == axis else (0, 0) for a in range(elements.ndim)]
        beside = np.pad(beside, before, mode="wrap" if wraps else "edge")  # beyond a side all is as before it
    for start in product((0, 1), repeat=elements.ndim):
        count += beside[tuple(slice(s, s + n) for s, n in zip(start, count.shape, strict=True))]
    return (count > 0) & (count < 2**elements.ndim)


def label_nodes(mask: Bool[np.ndarray, "*shape"], periodic: tuple[bool, ...]) -> tuple[Int[np.ndarray, "*shape"], int]:
    """Label the connected components of the domain: two nodes are neighbours when they share an element.

    Returns the labels (0 outside, 1 … n inside) and their number n.
    """
    elements = active_elements(mask, periodic)
    everything = np.ones((3,) * mask.ndim, dtype=bool)
    nodes = element_nodes(elements, periodic)
    # Elements that share a node hang together; on the nodes this is the labelling of the elements' union,
    # except that two nodes may be neighbours without sharing an element. So label elements, then hand down.
    labels, count = scipy.ndimage.label(elements, structure=everything)
    padded = np.zeros([n + 1 for n in elements.shape], dtype=labels.dtype)
    for corner in product(*[(slice(None, -1), slice(1, None))] * mask.ndim):
        np.maximum(padded[corner], labels, out=padded[corner])
    edges = []
    for axis, wraps in enumerate(periodic):
        if wraps:
            first, last = padded[_face(mask.ndim, axis, 0)], padded[_face(mask.ndim, axis, -1)]
            both = (first > 0) & (last > 0)
            edges.append(np.stack([first[both], last[both]]))
            padded[_face(mask.ndim, axis, 0)] = np.maximum(first, last)
            padded = np.delete(padded, -1, axis=axis)
    if edges and count > 1:
        rows, cols = np.concatenate(edges, axis=1) - 1
        count, merged = connected_components(
            coo_matrix((np.ones(rows.size), (rows, cols)), shape=(count, count)), directed=False
        )
        padded = np.where(padded > 0, merged[padded - 1] + 1, 0)
    return np.where(nodes, padded, 0), int(count)


def _face(ndim: int, axis: int, index: int) -> tuple[slice | int, ...]:
    return tuple(index if a == axis else slice(None) for a in range(ndim))
