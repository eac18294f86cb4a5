"""Meshes of tetrahedra for tests."""

from itertools import permutations

import numpy as np


def box(shape, lengths=(1.0, 1.0, 1.0)):
    """Vertices in the order of a grid's nodes, and Kuhn's six tetrahedra for each of its boxes."""
    axes = [np.linspace(0, length, n) for n, length in zip(shape, lengths, strict=True)]
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    low = np.stack(np.indices([n - 1 for n in shape]), axis=-1).reshape(-1, 3) @ strides
    cells = []
    for order in permutations(range(3)):
        path = low[:, None] + np.cumsum([0, *strides[list(order)]])
        even = np.linalg.det(np.eye(3)[list(order)]) > 0
        cells.append(path if even else path[:, [1, 0, 2, 3]])
    return vertices, np.concatenate(cells)
