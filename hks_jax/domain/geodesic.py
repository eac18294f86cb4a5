"""Meshes of the unit sphere and ball with cells of nearly equal size, made by subdividing an icosahedron."""

from itertools import permutations, product

import numpy as np
from jaxtyping import Float, Int

_CENTRE = 12


def _icosahedron() -> tuple[Float[np.ndarray, "12 3"], Int[np.ndarray, "20 3"]]:
    golden = (1 + np.sqrt(5)) / 2
    one = [(0, a, b * golden) for a, b in product((-1, 1), repeat=2)]
    vertices = np.array([np.roll(v, turn) for turn in range(3) for v in one], dtype=float)
    near = np.linalg.norm(vertices[:, None] - vertices, axis=-1) < 2.1  # the edges have length 2
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)]
    faces = np.array([t for t in triples if near[t[0], t[1]] and near[t[1], t[2]] and near[t[2], t[0]]])
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


# Kuhn's subdivision cuts each cube of a lattice into d! simplices. The vertices of a simplex form a path of unit steps,
# one along each axis. The large simplex n ≥ x₁ ≥ … ≥ x_d ≥ 0 is the union of n^d of these simplices. Two large
# simplices match at a common facet, because both cut it into triangles with edges parallel to the facet's edges.
def _kuhn(n: int, dimension: int) -> tuple[Int[np.ndarray, "p corners"], Int[np.ndarray, "cells corners"]]:
    """Subdivide a simplex into n^d cells; return the points, as barycentric coordinates times n, and the cells."""
    lattice = np.indices((n + 1,) * dimension).reshape(dimension, -1).T
    points = lattice[(np.diff(lattice, axis=1) <= 0).all(axis=1)]
    strides = (n + 1) ** np.arange(dimension)[::-1]
    number = np.full((n + 1) ** dimension, -1)
    number[points @ strides] = np.arange(len(points))
    cells = []
    for order in permutations(range(dimension)):
        path = np.cumsum([np.zeros(dimension, int), *np.eye(dimension, dtype=int)[list(order)]], axis=0)
        corners = points[:, None] + path
        inside = (corners <= n).all(axis=(1, 2)) & (np.diff(corners, axis=2) <= 0).all(axis=(1, 2))
        cells.append(number[corners[inside] @ strides])
    ends = np.concatenate([np.full((len(points), 1), n), points, np.zeros((len(points), 1), int)], axis=1)
    return -np.diff(ends, axis=1), np.concatenate(cells)


def _glued(
    simplices: Int[np.ndarray, "s corners"], n: int
) -> tuple[Int[np.ndarray, "V 13"], Int[np.ndarray, "cells corners"]]:
    """Subdivide simplices between the icosahedron's 12 vertices and centre; merge the points on common facets."""
    weights, cells = _kuhn(n, simplices.shape[1] - 1)
    shares = np.zeros((len(simplices), len(weights), _CENTRE + 1), np.int16)
    for i, simplex in enumerate(simplices):
        shares[i][:, simplex] = weights
    points, number = np.unique(shares.reshape(-1, _CENTRE + 1), axis=0, return_inverse=True)
    return points, number.reshape(len(simplices), -1)[:, cells].reshape(-1, cells.shape[1])


def geodesic(n: int, dimension: int) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "cells corners"]]:
    """Return the points and cells of the unit sphere (dimension 2, triangles oriented outward) or ball (3, tetrahedra).

    The sphere has 10n² + 2 points and 20n² triangles. The ball has n layers about its centre and 20n³ tetrahedra.
    """
    corners, faces = _icosahedron()
    shares, cells = _glued(faces if dimension == 2 else np.insert(faces, 0, _CENTRE, axis=1), n)
    vertices = shares[:, :_CENTRE] @ corners
    length, radius = np.linalg.norm(vertices, axis=1), 1 - shares[:, _CENTRE] / n
    vertices *= (radius / np.where(length > 0, length, 1))[:, None]
    frames = vertices[cells] if dimension == 2 else vertices[cells[:, 1:]] - vertices[cells[:, :1]]
    # A cell with a negative determinant is inverted, so two of its vertices are swapped.
    left = np.linalg.det(frames) < 0
    return vertices, np.where(left[:, None], cells[:, [1, 0, *range(2, dimension + 1)]], cells)
