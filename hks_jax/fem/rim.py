"""The rim of a domain, grid sides and mask alike: its length or area, and zero on all of it."""

import math
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from hks_jax.domain.components import wrap_nodes
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.domain.triangulation import FACETS
from hks_jax.fem.assembly import free_couplings
from hks_jax.fem.operators import StencilOperator
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import FunctionSpace, GridSpace


@jax.tree_util.register_static
class PinnedSpace(GridSpace):
    """The functions of a grid's space that vanish on the whole rim of the domain, a mask's included."""

    def __init__(self, space: GridSpace) -> None:
        super().__init__(space._grid, space.boundary)
        self.free = self.free & ~rim_nodes(space)
        if not self.free.any():
            raise ValueError("field: every node of the domain is on its rim; use a finer grid or a thicker mask")
        self._key = (*self._key, "pinned")


def pin_rim(pencil: Pencil) -> Pencil:
    """Return the Dirichlet problem of a grid's pencil with consistent mass: zero at every node of the rim.

    Unlike the boundary ``"dirichlet"`` this takes in the rim of a mask. Periodic axes stay periodic.
    """
    assert isinstance(pencil.stiffness, StencilOperator)
    assert isinstance(pencil.mass, StencilOperator)
    natural = pencil.stiffness.space
    space = PinnedSpace(natural)
    couplings = free_couplings(space)
    stiffness, mass = (
        StencilOperator(coefficients=jnp.where(couplings, operator.coefficients, 0), space=space)
        for operator in (pencil.stiffness, pencil.mass)
    )
    resolution = pencil.resolution.mapped(lambda values: space.restrict(natural.extend(values)))
    return Pencil(stiffness, mass, resolution, pencil.volume, space)


def rim_nodes(space: GridSpace) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes of the domain that do not have all their 2^d elements."""
    count = np.zeros(space.node_shape, dtype=int)
    padded = space.elements
    for axis, wraps in enumerate(space.periodic):
        before = [(1, 0) if a == axis else (0, 0) for a in range(space.dimension)]
        both = [(1, 1) if a == axis else (0, 0) for a in range(space.dimension)]
        padded = np.pad(padded, before, mode="wrap") if wraps else np.pad(padded, both)
    for start in product((0, 1), repeat=space.dimension):
        count += padded[tuple(slice(s, s + n) for s, n in zip(start, space.node_shape, strict=True))]
    return space.domain & (count < 2**space.dimension)


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
    sign = np.ones(faces.size)
    for end, condition in zip((0, -1), space.boundary[axis], strict=True):
        if condition == "dirichlet":
            sign[end] = -1
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
