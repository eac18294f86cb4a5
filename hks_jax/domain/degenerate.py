"""Degenerate points of a two-dimensional tensor field: the points where its two eigenvalues are equal."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hks_jax.checks import require_count
from hks_jax.domain.components import active_elements
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


def degenerate_points(field: TensorField, merge: int = 2) -> DegeneratePoints:
    """Find the points of a 2D field where the two eigenvalues are equal, and the topological index of each.

    The vector v = (T₁₁ − T₂₂, 2T₁₂) is zero at the degenerate points of a tensor field T, and turns twice as fast as
    the eigenvectors of T. The components of v are interpolated bilinearly in each grid cell. If v makes a full turn
    along the sides of a cell, the cell has one degenerate point, of index ½ (wedge) or −½ (trisector). Neighbouring
    degenerate points are merged into one, whose index is the sum of their indices (Tricoche and others 2001).

    The function does not find degenerate points of index 0, two points of opposite index closer than `merge` cells, or
    points on the rim of the domain. If the eigenvalues are equal on a curve or in a region that does not touch the rim,
    the function finds the centre of the curve or region, unless its index is 0.

    Args:
        field: a 2D field. Cells with a node outside the mask are not part of the domain.
        merge: degenerate points in cells that are at most `merge` cells apart along either axis count as one point. The
            smallest allowed value is 1, because a point on an edge belongs to two cells.

    Returns:
        The points, sorted by the first and then by the second coordinate.

    Raises:
        ValueError: if the field is 3D, or if `merge` is less than 1.

    Examples:
        >>> hj.degenerate_points(hj.examples.degenerate_point_field(0.5, 9))
        DegeneratePoints(positions=array([[0., 0.]]), indices=array([0.5]))
    """
    require_field(field)
    grid = field.grid
    if grid.dimension != 2:
        raise ValueError(
            f"field: got a grid of shape {grid.shape}; expected 2 dimensions. In 3D equal eigenvalues form curves; "
            "take a slice"
        )
    require_count("merge", merge)
    nodal = np.asarray(field.domain_tensors)
    tensors = nodal.astype(np.float64)
    v = np.stack([tensors[..., 0, 0] - tensors[..., 1, 1], 2 * tensors[..., 0, 1]], axis=-1)
    active = active_elements(grid.inside, (False, False))
    # A vector is zero up to rounding if its length is at most `tiny`.
    tiny = 16 * np.finfo(nodal.dtype).eps * np.trace(tensors, axis1=-2, axis2=-1)
    winding, crossed, on_rim = _windings(v, tiny, active)
    cells = np.argwhere(active & ((winding != 0) | crossed))
    if len(cells) == 0:
        return DegeneratePoints(np.zeros((0, 2)), np.zeros(0))

    near = scipy.spatial.cKDTree(cells).query_pairs(merge, p=np.inf, output_type="ndarray")
    graph = coo_matrix((np.ones(len(near)), near.T), shape=(len(cells),) * 2)
    count, cluster = connected_components(graph, directed=False)
    turns = winding[tuple(cells.T)]
    # If the vector v is zero on an edge or node, its turns around each adjacent cell are arbitrary, but not their sum.
    index = np.bincount(cluster, turns, count) / 2
    settled = np.bincount(cluster, on_rim[tuple(cells.T)], count) == 0
    shared = crossed[tuple(cells.T)]
    exact = np.bincount(cluster, shared, count)[cluster] > 0
    weights = np.where(exact, shared, np.sign(turns) == np.sign(index[cluster])).astype(float)
    zeros = cells + _zeros_in_cells(v, cells)
    middle = np.stack([np.bincount(cluster, weights * z, count) for z in zeros.T], axis=-1)
    kept = settled & (index != 0)
    middle = middle[kept] / np.bincount(cluster, weights, count)[kept, None]
    order = np.lexsort((middle[:, 1], middle[:, 0]))
    return DegeneratePoints((grid.origin + middle * grid.spacing)[order], index[kept][order])


def _windings(
    v: Float[np.ndarray, "nx ny 2"], tiny: Float[np.ndarray, "nx ny"], active: Bool[np.ndarray, "mx my"]
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
        padded = np.pad(active, [(1, 1) if other != axis else (0, 0) for other in (0, 1)])
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
