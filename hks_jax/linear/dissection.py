"""Nested dissection: an elimination order of a sparse matrix's rows, and the structure of its fronts.

A separator divides the graph into two halves that the matrix does not couple. Further separators divide the halves
recursively, down to small cells. Elimination goes from the cells up to the first separator. All fronts of a level are
independent and of nearly equal size; padded to the largest size, they form one batch of dense blocks.

A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10 (1973).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from hks_jax.linear import accelerators
from hks_jax.linear.bisection import within_groups
from hks_jax.linear.elimination_tree import Level, Merged, merged
from hks_jax.linear.pattern import Pattern

Ints = Int[np.ndarray, " _"]


class Dissection(NamedTuple):
    """The elimination tree."""

    # from the first separator to the cells; level l has 2^l fronts, and front q has children 2q and 2q + 1
    levels: tuple[Level, ...]
    order: Int[np.ndarray, " n_dof"]  # the place of each degree of freedom among the levels' concatenated own nodes
    # the indices of the needed matrix entries in the array of entries; None means all entries in order
    entries: Int[np.ndarray, " m"] | None
    # the places of these entries in the concatenated blocks (fronts, s + r, s) of all levels. Of two entries equal by
    # symmetry only one is needed, whose row is not eliminated before its column. If all entries are listed, unneeded
    # ones have places out of range
    places: Int[np.ndarray, " m"]
    padding: Int[np.ndarray, " p"]  # the places of the diagonal entries of padding nodes
    merged: Merged | None  # the merged tree for solves on accelerators; None if solves use the tree itself


def dissect(pattern: Pattern) -> Dissection:
    """Return the elimination tree of a matrix with this pattern.

    Raises:
        ValueError: the factors have 2³¹ or more entries.
    """
    return _dissect(pattern, accelerators.at_hand())


@lru_cache(maxsize=16)
def _dissect(pattern: Pattern, merge: bool) -> Dissection:
    entries, rows, cols = pattern.places()
    n = pattern.size
    level, front, depth = pattern.bisect()
    own, slot = _own_nodes(level, front, depth)
    # Positive if an entry's row is eliminated before its column, zero if with it, negative if after it.
    order_of_ends = level[rows] - level[cols]
    above = np.flatnonzero(order_of_ends > 0)
    boundaries = _boundaries(level, front, depth, rows[above], cols[above])
    ranks = [within_groups(np.bincount(keys // n)) for keys in boundaries]
    # The width is at least 1; if no front is coupled to its parent, this column is padding. On the first level, which
    # has no parent, the width is 0.
    width = [int(rank.max(initial=min(number, 1) - 1)) + 1 for number, rank in enumerate(ranks)]
    # List each boundary node's front, and the node's place among the own and boundary nodes of the parent.
    placed = [(keys // n, slot[keys % n]) for keys in boundaries]
    for below, (at, place) in enumerate(placed[1:]):
        nodes = boundaries[below + 1] % n
        inherited = level[nodes] < below
        entry = np.searchsorted(boundaries[below], at[inherited] // 2 * n + nodes[inherited])
        place[inherited] = own[below].shape[1] + ranks[below][entry]
    levels = []
    for number, (nodes, rank, r) in enumerate(zip(own, ranks, width, strict=True)):
        fronts, s = nodes.shape
        boundary, children = np.zeros((fronts, r), int), np.zeros((2, fronts, 0), int)
        if number > 0:
            at, place = placed[number]
            size = own[number - 1].shape[1] + width[number - 1]
            boundary = np.full((fronts, r), fronts // 2 * size)
            boundary[at, rank] = at // 2 * size + place
        if number < depth - 1:
            at, place = placed[number + 1]
            children = np.full((2, fronts, s + r), 2 * fronts * width[number + 1])
            children[at % 2, at // 2, place] = at * width[number + 1] + ranks[number + 1]
        levels.append(Level(*(field.astype(np.int32) for field in (nodes, boundary, children))))
    order = np.empty(n + 1, int)
    order[np.concatenate([nodes.ravel() for nodes in own])] = np.arange(sum(nodes.size for nodes in own))

    _, height, stride = shapes = np.array([level.shape for level in levels]).T
    start = np.append(0, np.cumsum(np.prod(shapes, axis=0)))
    if start[-1] > np.iinfo(np.int32).max:
        raise ValueError(f"matrix: got {n} rows, whose factors have {start[-1]} entries; expected fewer than 2^31")
    mine = np.flatnonzero(order_of_ends <= 0)
    rows, cols, eliminated = rows[mine], cols[mine], level[cols[mine]]
    place = slot[rows]
    outside = np.flatnonzero(order_of_ends[mine] < 0)
    for number in range(1, depth):
        above = outside[eliminated[outside] == number]
        key = front[cols[above]] * n + rows[above]
        place[above] = stride[number] + ranks[number][np.searchsorted(boundaries[number], key)]
    column = (start[level] + front * (height * stride)[level] + slot).astype(np.int32)
    places = column[cols] + stride.astype(np.int32)[eliminated] * place
    padding = [
        first + q * h * s + j * (s + 1)
        for first, h, s, nodes in zip(start[:-1], height, stride, own, strict=True)
        for q, j in [np.nonzero(nodes == n)]
    ]
    listed, places = _listed(entries[mine], places, pattern.n_entries, int(start[-1]))
    several = merged(tuple(levels), n) if merge else None
    return Dissection(
        tuple(levels), order[:n].astype(np.int32), listed, places, np.concatenate(padding).astype(np.int32), several
    )


def _listed(entries: Ints, places: Ints, number: int, end: int) -> tuple[Ints | None, Ints]:
    """Return needed entries and their places, or the places of all entries if this takes less memory."""
    others = number - entries.size
    if others > entries.size or end + others > np.iinfo(np.int32).max:
        return entries.astype(np.int32), places.astype(np.int32)
    of_all, without = np.empty(number, np.int32), np.ones(number, bool)
    of_all[entries], without[entries] = places, False
    of_all[without] = np.arange(end, end + others)  # distinct places, because the scatter declares its indices unique
    return None, of_all


def _own_nodes(level: Ints, front: Ints, depth: int) -> tuple[list[np.ndarray], Ints]:
    """Return the own nodes (fronts, s) of each level's fronts, and the place of every node in its front."""
    n, own, slot = level.size, [], np.zeros(level.size, np.int32)
    for number in range(depth):
        nodes = np.flatnonzero(level == number)
        nodes = nodes[np.argsort(front[nodes], kind="stable")]
        slot[nodes] = within_groups(np.bincount(front[nodes]))
        table = np.full((1 << number, int(slot[nodes].max(initial=0)) + 1), n)
        table[front[nodes], slot[nodes]] = nodes
        own.append(table)
    return own, slot


def _boundaries(level: Ints, front: Ints, depth: int, rows: Ints, cols: Ints) -> list[Ints]:
    """Return each level's boundary nodes as sorted keys front·n + node.

    A front's boundary nodes are eliminated later. Such a node is coupled to the front's own nodes by an entry (row,
    column), or inherited from the boundary of a child.
    """
    n, keys, boundaries = level.size, np.empty(0, int), []
    eliminated, keys_of = level[rows], front[rows] * n + cols
    for number in reversed(range(depth)):
        inherited = keys // n // 2 * n + keys % n
        keys = np.sort(np.concatenate([inherited[level[keys % n] < number], keys_of[eliminated == number]]))
        keys = keys[np.append(True, keys[1:] > keys[:-1])[: keys.size]]  # np.unique hashes, which takes far longer
        boundaries.append(keys)
    return boundaries[::-1]
