"""From a tensor field or a surface to its stiffness and mass: one element's integrals, mapped over all elements."""

from functools import lru_cache, partial
from itertools import product
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.domain.static_array import StaticArray
from hks_jax.domain.surface_mesh import SurfaceMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import BoundarySpec, mirror_problems, normalise_boundary
from hks_jax.fem.elements import at_quadrature, element_matrices, tensor_product_element, triangle_element
from hks_jax.fem.operators import DiagonalOperator, Operator, SparseOperator, StencilOperator
from hks_jax.fem.pencil import MirrorPencil, Pencil
from hks_jax.fem.space import GridSpace, MeshSpace, grid_space, mesh_space

MassKind = Literal["consistent", "lumped"]


def assemble(
    domain: TensorField | SurfaceMesh, boundary: BoundarySpec = "neumann", mass: MassKind = "consistent"
) -> Pencil | MirrorPencil:
    """Assemble the generalized eigenproblem Kφ = λMφ of the Laplace–Beltrami operator.

    K_ij = ∫ √|T| T⁻¹∇hᵢ·∇hⱼ and M_ij = ∫ √|T| hᵢhⱼ (Zobel, Reininghaus and Hotz, section 3), with Q1 elements and 2^d
    Gauss points on grids, T interpolated multilinearly; with P1 elements on surface meshes.

    Args:
        domain: a tensor field or a surface mesh.
        boundary: ``"neumann"`` (natural), ``"dirichlet"`` (φ = 0: these nodes are eliminated), ``"periodic"`` (node n
            is node 0: an axis of n nodes has the period n·h) or ``"mirror"`` (the domain reflected on every side); one
            name for all axes or one per axis, where a pair (low, high) of the first two tells the sides apart. They
            act on the sides of the grid; the rim of a mask is always natural. A surface mesh takes ``"neumann"`` or
            ``"dirichlet"``, which act on its rim.
        mass: ``"consistent"`` or ``"lumped"`` (row sums; diagonal).

    Returns:
        The pencil (stiffness, mass); with ``"mirror"`` the `MirrorPencil` of the mixed problems that make it up.

    Raises:
        ValueError: an unknown boundary or mass, a domain without elements or free nodes.

    Warns:
        AccuracyWarning: a Dirichlet condition that no node of the domain feels.
    """
    if mass not in ("consistent", "lumped"):
        raise ValueError(f'mass: got {mass!r}; expected "consistent" or "lumped"')
    if isinstance(domain, SurfaceMesh):
        if boundary not in ("neumann", "dirichlet"):
            raise ValueError(f'boundary: got {boundary!r}; a surface mesh takes "neumann" or "dirichlet"')
        return _assemble_mesh(domain, mesh_space(domain.triangulation, boundary), mass)
    if not isinstance(domain, TensorField):
        raise TypeError(f"domain: got {type(domain).__name__}; expected a TensorField or a SurfaceMesh")
    if domain._tensors is not None and domain._tensors.ndim > domain.grid.dimension + 2:
        raise ValueError("domain: got a batch of tensor fields; expected one. Map over the batch with jax.vmap")
    sides = normalise_boundary(boundary, domain.grid.dimension)
    problems = mirror_problems(sides)
    pencils = [_assemble_grid(domain, grid_space(domain.grid, problem), mass) for problem in problems]
    space = pencils[0].space
    if any("dirichlet" in conditions for conditions in sides) and (space.free == space.domain).all():
        warn_of_accuracy(
            f'boundary: got {boundary!r}, but "dirichlet" acts on the sides of the grid, which the mask does not '
            "reach. The mask's own rim is natural",
        )
    return pencils[0] if len(pencils) == 1 else MirrorPencil(tuple(pencils))


def _assemble_grid(field: TensorField, space: GridSpace, mass: MassKind) -> Pencil:
    # The masks go in as arrays, so that problems that differ only in them share one compilation.
    tensors = field.domain_tensors
    tensors = jnp.where(space.domain[..., None, None], tensors, jnp.eye(space.dimension, dtype=tensors.dtype))
    stiffness, consistent, lumped, width = _grid_integrals(
        tensors, space.elements, free_couplings(space), space.periodic, space.grid.spacing
    )
    return _pencil(
        StencilOperator(coefficients=stiffness, space=space),
        StencilOperator(coefficients=consistent, space=space),
        lumped,
        width,
        mass,
    )


@partial(jax.jit, static_argnames=("periodic", "spacing"))
def _grid_integrals(
    tensors: Float[Array, "*shape d d"],
    elements: Bool[Array, "*elements"],
    couplings: Bool[Array, "offsets *shape"],
    periodic: tuple[bool, ...],
    spacing: tuple[float, ...],
) -> tuple[Array, Array, Array, Array]:
    """Return stiffness and mass as stencils, ∫ √|T| hᵢ of all nodes, and the nodes' mesh width."""
    element = tensor_product_element(spacing)

    def integrals(corner_tensors: Float[Array, "n d d"]) -> tuple[Array, Array]:
        return element_matrices(at_quadrature(corner_tensors, element), element)

    def stencil(matrices: Float[Array, "E n n"]) -> Float[Array, "offsets *shape"]:
        kept = jnp.where(elements[..., None, None], matrices.reshape(*elements.shape, *matrices.shape[1:]), 0)
        return _stencil(kept, periodic)

    stiffness, mass = jax.vmap(integrals)(_corner_tensors(tensors, periodic))
    squared = jnp.asarray(np.square(spacing), tensors.dtype)
    width = jnp.sqrt(jnp.max(jnp.diagonal(tensors, axis1=-2, axis2=-1) * squared, axis=-1))
    stiffness, mass = stencil(stiffness), stencil(mass)
    # Before the couplings to eliminated nodes go: the basis functions add up to one only together with theirs.
    lumped = jnp.sum(mass, axis=0)
    return jnp.where(couplings, stiffness, 0), jnp.where(couplings, mass, 0), lumped, width


def _pencil(stiffness: Operator, consistent: Operator, lumped: Array, width: Array, mass: MassKind) -> Pencil:
    """Choose the mass; ``lumped`` and ``width`` are nodal."""
    space, volume = stiffness.space, jnp.sum(lumped)
    chosen = consistent if mass == "consistent" else DiagonalOperator(entries=space.restrict(lumped), space=space)
    return Pencil(stiffness, chosen, space.restrict(width), volume)


def _corner_tensors(tensors: Float[Array, "*shape d d"], periodic: tuple[bool, ...]) -> Float[Array, "E n d d"]:
    """Gather the tensors at the corners of every element."""
    d = len(periodic)
    nodes = jnp.pad(tensors, [*[(0, int(wraps)) for wraps in periodic], (0, 0), (0, 0)], mode="wrap")
    corners = [nodes[corner] for corner in product(*[(slice(None, -1), slice(1, None))] * d)]
    return jnp.stack(corners, axis=d).reshape(-1, 2**d, d, d)


def _stencil(matrices: Float[Array, "*elements n n"], periodic: tuple[bool, ...]) -> Float[Array, "offsets *shape"]:
    """Add up element matrices into 3^d coefficients a node.

    Local pair (a, b) of corners couples the element's node at corner a to the node at offset b − a.
    """
    d = len(periodic)
    couplings = jnp.moveaxis(matrices, (-2, -1), (0, 1)).reshape(2**d, *(2,) * d, *matrices.shape[:d])
    # For all corners b at once: one pad for each a, and not one for each pair, is half as long to compile in 3D.
    total = jnp.zeros((), matrices.dtype)
    for a, node in enumerate(product((0, 1), repeat=d)):
        total = total + jnp.pad(couplings[a], [(1 - i, i) for i in node] + [(i, 1 - i) for i in node])
    total = total.reshape(3**d, *total.shape[d:])
    for axis, wraps in enumerate(periodic, start=1):
        if wraps:  # the last node is the first again
            inner = jax.lax.slice_in_dim(total, 0, -1, axis=axis)
            last = jax.lax.slice_in_dim(total, -1, None, axis=axis)
            total = inner + jnp.pad(last, [(0, n - 1 if a == axis else 0) for a, n in enumerate(inner.shape)])
    return total


@lru_cache(maxsize=16)
def free_couplings(space: GridSpace) -> np.ndarray:
    """Tell for which offsets and nodes both ends are free, bool (3^d, *shape)."""
    free, d = space.free, space.dimension
    for axis, wraps in enumerate(space.periodic):
        widths = [(1, 1) if a == axis else (0, 0) for a in range(d)]
        free = np.pad(free, widths, mode="wrap" if wraps else "constant")
    starts = product((0, 1, 2), repeat=d)
    shape = space.node_shape
    return np.stack(
        [space.free & free[tuple(slice(s, s + n) for s, n in zip(start, shape, strict=True))] for start in starts]
    )


@partial(jax.jit, static_argnames=("space", "mass"))
def _assemble_mesh(mesh: SurfaceMesh, space: MeshSpace, mass: MassKind) -> Pencil:
    element = triangle_element()
    metric, points = mesh.metric, element.weights.size

    def integrals(triangle_metric: Float[Array, "2 2"]) -> tuple[Array, Array]:
        return element_matrices(jnp.broadcast_to(triangle_metric, (points, 2, 2)), element)

    stiffness, consistent = jax.vmap(integrals)(metric)
    where, slots, rows, cols = _mesh_pattern(space)

    def gather(matrices: Float[Array, "F 3 3"]) -> SparseOperator:
        data = jax.ops.segment_sum(matrices.reshape(-1)[where.value], slots.value, rows.value.size)
        return SparseOperator(data=data, space=space, rows=rows, cols=cols)

    # A vertex is as coarse as its longest edge.
    longest = jnp.sqrt(jnp.maximum(jnp.max(jnp.diagonal(metric, axis1=1, axis2=2), axis=1), 0))
    width = jax.ops.segment_max(jnp.repeat(longest, 3), mesh.faces.ravel(), mesh.vertices.shape[0])
    lumped = jax.ops.segment_sum(jnp.sum(consistent, axis=-1).ravel(), mesh.faces.ravel(), mesh.vertices.shape[0])
    return _pencil(gather(stiffness), gather(consistent), lumped, width, mass)


@lru_cache(maxsize=16)
def _mesh_pattern(space: MeshSpace) -> tuple[StaticArray, StaticArray, StaticArray, StaticArray]:
    """Which local entries count (both ends free), the matrix entry that each adds to, and the entries' positions."""
    n = space.n_dof
    faces = space.degrees_of_freedom[space.triangulation.faces]
    rows, cols = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, (1, 3)).ravel()
    where = np.flatnonzero((rows >= 0) & (cols >= 0))
    keys, slots = np.unique(rows[where] * n + cols[where], return_inverse=True)
    return StaticArray(where), StaticArray(slots), StaticArray(keys // n), StaticArray(keys % n)
