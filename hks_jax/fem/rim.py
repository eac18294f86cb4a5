"""The rim of a domain, grid sides and mask alike: its length or area."""

import math

import numpy as np

from hks_jax.domain.components import wrap_nodes
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.domain.triangulation import FACETS
from hks_jax.fem.space import FunctionSpace, GridSpace


def rim_measure(domain: TensorField | SimplicialMesh, space: FunctionSpace) -> float:
    """Return the length (in 3D the area) in the metric of the rim's natural part minus that of its Dirichlet part.

    Args:
        domain: the field or mesh; not traced.
        space: the space of its functions, which knows the conditions.
    """
    if isinstance(domain, SimplicialMesh):
        return _mesh_rim(domain, space)
    assert isinstance(space, GridSpace)
    return sum(_grid_rim(domain, space, axis) for axis in range(space.dimension))


def _grid_rim(field: TensorField, space: GridSpace, axis: int) -> float:
    """Add up the faces across one axis that belong to one element only."""
    d, spacing = space.dimension, field.grid.spacing
    others = [a for a in range(d) if a != axis]
    tensors = np.asarray(field.domain_tensors, np.float64)[..., others, :][..., others]
    density = wrap_nodes(np.sqrt(np.linalg.det(tensors)), space.periodic)
    # At each face the trapezoidal rule over its nodes; indices along the axis are those of nodes.
    for a in others:
        n = density.shape[a]
        density = (density.take(range(n - 1), a) + density.take(range(1, n), a)) / 2
    density *= np.prod([spacing[a] for a in others])
    elements = space.elements
    ends = [(1, 1) if a == axis else (0, 0) for a in range(d)]
    padded = np.pad(elements, ends, mode="wrap") if space.periodic[axis] else np.pad(elements, ends)
    n = padded.shape[axis]
    rim = padded.take(range(n - 1), axis) ^ padded.take(range(1, n), axis)
    if space.periodic[axis]:
        rim, density = (array.take(range(n - 2), axis) for array in (rim, density))
    faces = np.where(rim, density, 0).sum(axis=tuple(others))
    sign = np.full(faces.size, -1.0 if "dirichlet" in space.boundary[-1] else 1.0)
    for end, condition in zip((0, -1), space.boundary[axis], strict=True):
        sign[end] = -1 if condition == "dirichlet" else 1
    return float(faces @ sign)


def _mesh_rim(mesh: SimplicialMesh, space: FunctionSpace) -> float:
    """Add up the facets that belong to one cell only."""
    d, triangulation = space.dimension, mesh.triangulation
    cell, corner = np.divmod(triangulation.boundary_facets, d + 1)
    corners = np.concatenate([np.zeros((1, d)), np.eye(d)])[FACETS[d][corner]]  # in the basis of the cell's edges
    steps = corners[:, 1:] - corners[:, :1]
    gram = np.einsum("fia,fab,fjb->fij", steps, np.asarray(mesh.metric, np.float64)[cell], steps)
    measure = float(np.sqrt(np.linalg.det(gram)).sum()) / math.factorial(d - 1)
    return -measure if "dirichlet" in space.boundary[0] else measure
