"""Degenerate points of a two-dimensional tensor field: the points where its two eigenvalues are equal."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hks_jax.checks import require_number, require_static
from hks_jax.domain.components import active_elements, wraps_per_axis
from hks_jax.domain.tensor_field import TensorField, require_field


class DegeneratePoints(NamedTuple):
    """Degenerate points of a field.

    Attributes:
        positions: (n, 2) coordinates.
        indices: (n,) the topological index of each point, a multiple of ½: the number of turns of the eigenvectors
            along a closed curve around the point.
    """

    positions: Float[np.ndarray, "n 2"]
    indices: Float[np.ndarray, " n"]


_CENTRINGS = 4
"""The number of times that a disc of merged points is centred on its points."""


def degenerate_points(
    field: TensorField, merge: float = 2, periodic: bool | Sequence[bool] = False
) -> DegeneratePoints:
    """Find the points of a 2D field where the two eigenvalues are equal, and the topological index of each.

    The vector v = (T₁₁ − T₂₂, 2T₁₂) is zero at the degenerate points of a tensor field T, and turns twice as fast as
    the eigenvectors of T. The components of v are interpolated bilinearly in each grid cell. If v makes a full turn
    along the sides of a cell, the cell has one degenerate point, of index ½ (wedge) or −½ (trisector). On a grid, a
    point of higher index appears as several near points. Points within `merge` cells of their centre are merged into
    one, whose index i is the sum of their indices (Tricoche and others 2001), if |i| ≥ 1; for |i| > 1 the distance is
    larger by (|i| − 1)/2 cells. Merging does not continue from point to point, and does not change the sum of all
    indices.

    Points of the same index nearer than `merge` cells thus count as one. A wedge and a trisector are found if they are
    in different cells: of 60 pairs at random places and angles, 24 were found at a distance of 1 cell, 52 at 1.25
    cells, and all from 1.5 cells. Two wedges were found as two in 32 of 60 pairs at 2 cells, and in all from 2.5 cells.
    Of 100 single points at random places, all were found as one if |i| ≤ 2, 97 if |i| = 2.5, and about 60 if |i| = 3;
    with ``merge=3``, all were.

    The function does not find points of index 0 or points on the rim of the domain. If the eigenvalues are equal on a
    curve or in a region that does not touch the rim, the function finds the centre of the curve or region, unless its
    index is 0. Where noise exceeds the difference of the eigenvalues, every fifth cell has a point of its own: smooth
    the tensors first (`smooth_tensors`).

    Args:
        field: a 2D field. Cells with a node outside the mask are not part of the domain.
        merge: the distance, in cells, up to which degenerate points count as one.
        periodic: whether the axes are periodic, so that node n is node 0; one value for all axes, or one per axis. If
            both are, the indices add up to zero.

    Returns:
        The points, sorted by the first and then by the second coordinate.

    Raises:
        ValueError: if the field is 3D, or if `merge` is not positive; a bad `periodic`.

    Examples:
        >>> hj.degenerate_points(hj.examples.degenerate_point_field(0.5, 9))
        DegeneratePoints(positions=array([[0., 0.]]), indices=array([0.5]))
    """
    require_field(field)
    require_static("field", field)
    grid = field.grid
    if grid.dimension != 2:
        raise ValueError(
            f"field: got a grid of shape {grid.shape}; expected 2 dimensions. In 3D equal eigenvalues form curves; "
            "take a slice"
        )
    require_number("merge", merge)
    wraps = wraps_per_axis(periodic, 2)
    nodal = np.asarray(field.domain_tensors)
    tensors = np.pad(nodal.astype(np.float64), [*((0, int(w)) for w in wraps), (0, 0), (0, 0)], mode="wrap")
    v = np.stack([tensors[..., 0, 0] - tensors[..., 1, 1], 2 * tensors[..., 0, 1]], axis=-1)
    active = active_elements(grid.inside, wraps)
    # A vector is zero up to rounding if its length is at most `tiny`.
    tiny = 16 * np.finfo(nodal.dtype).eps * np.trace(tensors, axis1=-2, axis2=-1)
    winding, crossed, on_rim = _windings(v, tiny, active, wraps)
    cells = np.argwhere(active & ((winding != 0) | crossed))
    if len(cells) == 0:
        return DegeneratePoints(np.zeros((0, 2)), np.zeros(0))

    # If the vector v is zero on an edge or node, its turns around each adjacent cell are arbitrary, but not their sum.
    period = np.where(wraps, grid.shape, 0)
    at = tuple(cells.T)
    turns, shared = winding[at], crossed[at]
    near = _tree(cells, period).query_pairs(1, p=np.inf, output_type="ndarray")
    near = near[shared[near].all(axis=1)]
    graph = coo_matrix((np.ones(len(near)), near.T), shape=(len(cells),) * 2)
    cluster = connected_components(graph, directed=False)[1]
    count = int(cluster.max()) + 1
    settled = np.bincount(cluster, on_rim[at], count) == 0
    index = np.bincount(cluster, turns, count) / 2
    exact = np.bincount(cluster, shared, count) > 0
    middle = _means(cells + _zeros_in_cells(v, cells), cluster, np.ones(len(cells)), count, period)
    middle, index, exact = middle[settled], index[settled], exact[settled]

    point = _merged(middle, index, merge, period)
    count = int(point.max(initial=-1)) + 1
    total = np.bincount(point, index, count)
    counted = np.where((np.bincount(point, exact, count) > 0)[point], exact, np.sign(index) == np.sign(total[point]))
    kept = total != 0
    positions = _means(middle, point, counted.astype(float), count, period)[kept]
    order = np.lexsort((positions[:, 1], positions[:, 0]))
    return DegeneratePoints((grid.origin + positions * grid.spacing)[order], total[kept][order])


def _tree(positions: np.ndarray, period: Int[np.ndarray, "2"]) -> scipy.spatial.cKDTree:
    return scipy.spatial.cKDTree(_modulo(positions, period), boxsize=period)


def _modulo(positions: np.ndarray, period: Int[np.ndarray, "2"]) -> np.ndarray:
    whole = np.where(period > 0, period, np.inf)
    return np.where(period > 0, np.mod(positions, whole), positions)


def _means(
    positions: Float[np.ndarray, "n 2"],
    cluster: Int[np.ndarray, " n"],
    weights: Float[np.ndarray, " n"],
    count: int,
    period: Int[np.ndarray, "2"],
) -> Float[np.ndarray, "count 2"]:
    """Return the weighted mean position of each cluster; positions are taken on the side where the first one is."""
    first = positions[np.unique(cluster, return_index=True)[1]]
    apart = positions - first[cluster]
    apart = apart - period * np.rint(apart / np.where(period > 0, period, np.inf))
    total = np.bincount(cluster, weights, count)
    total = np.where(total > 0, total, 1)
    means = first + np.stack([np.bincount(cluster, weights * z, count) / total for z in apart.T], axis=-1)
    return _modulo(means, period)


def _merged(
    positions: Float[np.ndarray, "n 2"],
    index: Float[np.ndarray, " n"],
    merge: float,
    period: Int[np.ndarray, "2"],
) -> Int[np.ndarray, " n"]:
    """Number the merged points, and return the number at each of the n points.

    The discs around all points take turns, the disc with the largest sum of indices first. A disc whose remaining
    points have the sum −½, 0 or ½ is not merged. Other discs are first centred on their remaining points.
    """
    tree = _tree(positions, period)
    discs = tree.query_ball_point(tree.data, merge, return_sorted=True)
    sums = np.array([index[disc].sum() for disc in discs])
    number = np.full(len(index), -1)
    for seed in np.argsort(-np.abs(sums), kind="stable"):
        rest = np.array([i for i in discs[seed] if number[i] < 0], dtype=int)
        if number[seed] >= 0 or abs(index[rest].sum()) < 1:
            continue
        # Along a square of half width r about a point of index i, v turns by 2|i|·360°/8r from node to node. The turns
        # are ambiguous from 180°, that is for r < |i|/2. So points of higher index reach further.
        for _ in range(_CENTRINGS):
            centre = _means(positions[rest], np.zeros(len(rest), dtype=int), np.ones(len(rest)), 1, period)[0]
            reach = merge + (abs(index[rest].sum()) - 1) / 2
            around = np.array([i for i in tree.query_ball_point(centre, reach) if number[i] < 0], dtype=int)
            if abs(index[around].sum()) < 1:
                break
            rest = around
        number[rest] = seed
    alone = number < 0
    number[alone] = np.flatnonzero(alone)
    return np.unique(number, return_inverse=True)[1]


def _windings(
    v: Float[np.ndarray, "nx ny 2"],
    tiny: Float[np.ndarray, "nx ny"],
    active: Bool[np.ndarray, "mx my"],
    wraps: tuple[bool, ...],
) -> tuple[Int[np.ndarray, "mx my"], Bool[np.ndarray, "mx my"], Bool[np.ndarray, "mx my"]]:
    """Return the turns of the vector v around each cell; mark cells with v = 0 on an edge, or on an edge in the rim."""
    angle = np.arctan2(v[..., 1], v[..., 0])
    zero = np.hypot(v[..., 0], v[..., 1]) <= tiny
    number = np.zeros(active.shape)
    crossed, on_rim = np.zeros(active.shape, dtype=bool), np.zeros(active.shape, dtype=bool)
    for axis in (0, 1):
        first, second = _ends(v, axis)
        a, b = _ends(angle, axis)
        turn = np.mod(b - a + np.pi, 2 * np.pi) - np.pi
        # The line through the vectors v at the two ends of an edge passes the origin at the distance |cross|/apart.
        apart = np.linalg.norm(second - first, axis=-1)
        cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
        opposite = np.sum(first * second, axis=-1) < 0
        limit = np.maximum(*_ends(tiny, axis))
        through = opposite & (np.abs(cross) <= limit * apart)
        through |= np.logical_or(*_ends(zero, axis))
        beside = [(1, 1) if other != axis else (0, 0) for other in (0, 1)]
        padded = np.pad(active, beside, mode="wrap") if wraps[1 - axis] else np.pad(active, beside)
        low, high = _ends(padded, 1 - axis)
        rim = through & ~(low & high)
        sign = 1 if axis == 0 else -1
        (one, two), (rim_one, rim_two), (by_one, by_two) = (_ends(e, 1 - axis) for e in (turn, rim, through))
        number += sign * (one - two)
        crossed |= by_one | by_two
        on_rim |= rim_one | rim_two
    return np.rint(number / (2 * np.pi)).astype(int), crossed, on_rim


def _ends(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    n = values.shape[axis]
    return values.take(range(n - 1), axis), values.take(range(1, n), axis)


def _zeros_in_cells(v: Float[np.ndarray, "nx ny 2"], cells: Int[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Return the zero of the bilinear interpolant in each cell, or the cell's centre, in units of the cell's sides.

    Eliminating x from both components of a₀ + a₁x + a₂y + a₃xy = 0 gives a quadratic equation in y.
    """
    i, j = cells.T
    p00, p10, p01, p11 = v[i, j], v[i + 1, j], v[i, j + 1], v[i + 1, j + 1]
    c0, c1, c2, c3 = p00, p10 - p00, p01 - p00, p11 - p10 - p01 + p00

    def cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    A, B, C = cross(c2, c3), cross(c0, c3) + cross(c2, c1), cross(c0, c1)
    with np.errstate(divide="ignore", invalid="ignore"):
        q = -(B + np.where(B < 0, -1, 1) * np.sqrt(B**2 - 4 * A * C)) / 2
        y = np.stack([q / A, C / q], axis=1)
        slope, value = c1[:, None] + c3[:, None] * y[..., None], c0[:, None] + c2[:, None] * y[..., None]
        x = -np.sum(slope * value, axis=-1) / np.sum(slope**2, axis=-1)
    roots = np.stack([x, y], axis=-1)
    beyond = np.nan_to_num(np.max(np.abs(roots - 0.5), axis=-1), nan=np.inf, posinf=np.inf)
    best = np.take_along_axis(roots, np.argmin(beyond, axis=1)[:, None, None], axis=1)[:, 0]
    inside = beyond.min(axis=1)[:, None] <= 0.5 + 1e-6
    return np.where(inside, best, 0.5)
