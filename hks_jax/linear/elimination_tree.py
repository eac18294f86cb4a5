"""The levels of an elimination tree, and their merging for solves on accelerators.

A front and its descendants on the following levels merge into one front with an explicit inverse. Merging increases
memory traffic but reduces kernel launches; the groups of levels are chosen for the least total cost. Merging affects
only the matrices of solves. The factorisation, and hence the inertia, proceeds level by level.

The method replaces many substitutions by few explicit inverses: F. L. Alvarado, A. Pothen and R. Schreiber, Highly
parallel sparse triangular solution, in Graph Theory and Sparse Matrix Computation (Springer 1993).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from hks_jax.linear.bisection import within_groups

_TRAFFIC = 20e6
"""The memory traffic in bytes during one launch: 4 µs at 4.8 TB/s."""
_LAUNCHES = 4
"""The number of launches per level in a solve: a gather and a product, both upwards and downwards."""
_BYTES = 8
"""The size of a number."""
_ALIGNED = 64
"""Large fronts have a multiple of this number of nodes; otherwise XLA would copy their matrices to pad them."""


class Level(NamedTuple):
    """The fronts of one level: each eliminates its own s nodes, and is coupled to r boundary nodes eliminated later.

    In smaller fronts, indices are padded with the first number that is out of range.
    """

    own: Int[np.ndarray, "fronts s"]  # the eliminated degrees of freedom
    # the places of the boundary nodes among the (fronts, s + r) nodes of the level above
    boundary: Int[np.ndarray, "fronts r"]
    # the places of the front's nodes among the (fronts, r) boundary nodes of the level below. A node has up to c such
    # places; in an elimination tree, one for each child. Empty for cells
    children: Int[np.ndarray, "c fronts s_plus_r"]

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape (fronts, s + r, s) of the blocks with the columns of the own nodes."""
        fronts, s = self.own.shape
        return fronts, s + self.boundary.shape[1], s


class Merged(NamedTuple):
    """The merged tree, which solves use instead of the elimination tree."""

    levels: tuple[Level, ...]  # the merged levels
    order: Int[np.ndarray, " n_dof"]  # the place of each degree of freedom among the levels' concatenated own nodes
    # for each merged level and each tree level merged in it: the places of the tree level's own nodes (fronts, s)
    # among those of the merged level; out of range for padding
    rows: tuple[tuple[Int[np.ndarray, "_fronts _s"], ...], ...]
    # for each merged level: the places of its own nodes (fronts, s) among the concatenated own nodes of its tree
    # levels; out of range for padding
    places: tuple[Int[np.ndarray, "_fronts _s"], ...]


def merged(levels: tuple[Level, ...], n: int) -> Merged:
    """Merge levels of the elimination tree of n degrees of freedom."""
    groups = divided(levels, n)
    own, rows, places = zip(*(_own_nodes(levels[first:end], n) for first, end in groups), strict=True)
    of_levels = _boundary_nodes(levels, n)
    boundaries = [of_levels[first] for first, _ in groups]
    nodes = [np.concatenate(both, axis=1) for both in zip(own, boundaries, strict=True)]
    children, result = np.zeros((0, *nodes[-1].shape), int), []
    for number in reversed(range(len(groups))):
        fronts, r = boundaries[number].shape
        below, boundary = children, np.zeros((fronts, r), int)
        if number > 0:
            above = nodes[number - 1]
            front, slot = np.nonzero(boundaries[number] < n)
            place = _find(above, front // (fronts // len(above)), boundaries[number][front, slot], n)
            boundary[:] = above.size
            boundary[front, slot] = place
            counts, ascending = np.bincount(place, minlength=above.size), np.argsort(place, kind="stable")
            children = np.full((max(int(counts.max()), 1), above.size), fronts * r)
            children[within_groups(counts), place[ascending]] = (front * r + slot)[ascending]
            children = children.reshape(-1, *above.shape)
        result.append(Level(*(field.astype(np.int32) for field in (own[number], boundary, below))))
    order = np.empty(n + 1, np.int32)
    order[np.concatenate([nodes.ravel() for nodes in own])] = np.arange(sum(nodes.size for nodes in own))
    return Merged(tuple(result[::-1]), order[:n], rows, places)


def divided(levels: tuple[Level, ...], n: int) -> list[tuple[int, int]]:
    """Return the first level and the end of each group of levels, for the least cost of solves."""
    depth = len(levels)
    counts = [np.sum(level.own < n, axis=1) for level in levels]
    best: list[tuple[float, int]] = [(0.0, depth)] * (depth + 1)
    for first in reversed(range(depth)):
        fronts, sizes, ways = 1 << first, np.zeros(1 << first, int), []
        r = levels[first].boundary.shape[1]
        for end in range(first + 1, depth + 1):
            sizes += counts[end - 1].reshape(fronts, -1).sum(axis=1)
            s = int(sizes.max())
            traffic = _BYTES * float(fronts) * s * (s + 2 * r)
            ways.append((traffic / _TRAFFIC + _LAUNCHES + best[end][0], end))
        best[first] = min(ways)
    groups, first = [], 0
    while first < depth:
        groups.append((first, best[first][1]))
        first = best[first][1]
    return groups


def _own_nodes(levels: tuple[Level, ...], n: int) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """Return the own nodes of the merged fronts, and the ``rows`` and ``places`` of `Merged` for one level."""
    fronts = len(levels[0].own)
    sizes = np.array([level.own.size for level in levels])
    start = np.cumsum(sizes) - sizes
    nodes = np.concatenate([level.own.reshape(fronts, -1) for level in levels], axis=1)
    where = np.concatenate(
        [(at + np.arange(size)).reshape(fronts, -1) for at, size in zip(start, sizes, strict=True)], axis=1
    )
    last = np.argsort(nodes == n, axis=1, kind="stable")  # padding comes last
    s = int(np.sum(nodes < n, axis=1).max(initial=1))
    s = min(s if s < _ALIGNED else -(-s // _ALIGNED) * _ALIGNED, nodes.shape[1])
    own = np.take_along_axis(nodes, last, axis=1)[:, :s]
    places = np.take_along_axis(where, last, axis=1)[:, :s]
    row = np.full(sizes.sum(), fronts * s, np.int32)
    row[places[own < n]] = np.flatnonzero(own < n)
    rows = tuple(
        row[at : at + level.own.size].reshape(level.own.shape) for at, level in zip(start, levels, strict=True)
    )
    return own, rows, np.where(own < n, places, row.size).astype(np.int32)


def _boundary_nodes(levels: tuple[Level, ...], n: int) -> list[np.ndarray]:
    """Return the degrees of freedom at the boundary of each level's fronts, padded with n."""
    nodes, result = np.empty(0, int), []
    for level in levels:
        boundary = np.append(nodes, n)[np.minimum(level.boundary, nodes.size)]
        nodes = np.concatenate([level.own, boundary], axis=1).ravel()
        result.append(boundary)
    return result


def _find(nodes: np.ndarray, front: np.ndarray, node: np.ndarray, n: int) -> np.ndarray:
    """Return the flat places of given nodes of given fronts in an array of nodes (fronts, m)."""
    keys = (np.arange(len(nodes))[:, None] * (n + 1) + nodes).ravel()
    ascending = np.argsort(keys, kind="stable")
    return ascending[np.searchsorted(keys, front * (n + 1) + node, sorter=ascending)]
