"""From a tensor field or a mesh to its stiffness and mass: one element's integrals, mapped over all elements."""

from functools import lru_cache
from itertools import product
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.compilation import jit_quickly
from hks_jax.domain import spd
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_checks import Interpolation
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, normalise_boundary
from hks_jax.fem.elements import Element, at_quadrature, element_matrices, simplex_element, tensor_product_element
from hks_jax.fem.pencil import AnyPencil, MirrorPencil, Pencil
from hks_jax.fem.resolution import SampledMetric
from hks_jax.fem.space import FunctionSpace, GridSpace, MeshSpace, couplings_for, grid_space, mask_for, mesh_space
from hks_jax.fem.stencil import StencilOperator
from hks_jax.linear.operators import DiagonalOperator, Operator, PatternedOperator, SparseOperator
from hks_jax.linear.pattern import SparsePattern
from hks_jax.linear.pencil import NullSpace
from hks_jax.traced import is_traced

MassKind = Literal["consistent", "lumped"]
MESH_BOUNDARIES = ("neumann", "dirichlet", "mean")


def assemble(
    domain: TensorField | SimplicialMesh, boundary: BoundarySpec = "neumann", mass: MassKind = "consistent"
) -> AnyPencil:
    """Assemble the generalized eigenproblem Kφ = λMφ of the Laplace–Beltrami operator.

    K_ij = ∫ √|T| T⁻¹∇hᵢ·∇hⱼ and M_ij = ∫ √|T| hᵢhⱼ (Zobel, Reininghaus and Hotz, section 3), with Q1 elements and 2^d
    Gauss points on grids, T (or its logarithm: `TensorField.interpolation`) interpolated multilinearly; with P1
    elements on meshes, where T is constant on each triangle or tetrahedron.

    Args:
        domain: a tensor field, a `SurfaceMesh` or a `TetMesh`.
        boundary: ``"neumann"`` (natural), ``"dirichlet"`` (φ = 0: these nodes are eliminated), ``"periodic"`` (node n
            is node 0: an axis of n nodes has the period n·h), ``"mirror"`` (the domain reflected on every side) or
            ``"mean"`` (two copies of the domain, glued along all of the rim); one name for all axes or one per axis,
            where a pair (low, high) of ``"neumann"``, ``"dirichlet"`` and ``"mean"`` tells the sides apart. The rim of
            a mask is natural, but under ``"mean"``, and under ``"dirichlet-rim"``, which is Dirichlet on all sides and
            there; or as one more entry says, after those of the axes: ``("periodic", "periodic", "dirichlet")``. A mesh
            takes ``"neumann"``, ``"dirichlet"`` or ``"mean"``, which act on its boundary.
        mass: ``"consistent"`` or ``"lumped"`` (row sums; diagonal).

    Returns:
        The pencil (stiffness, mass); with ``"mirror"`` and ``"mean"`` the `MirrorPencil` of the problems that make it
        up.

    Raises:
        ValueError: an unknown boundary or mass, a domain without elements or free nodes; ``"mean"`` without a rim.

    Warns:
        AccuracyWarning: a Dirichlet condition that no node of the domain feels.
    """
    if mass not in ("consistent", "lumped"):
        raise ValueError(f'mass: got {mass!r}; expected "consistent" or "lumped"')
    if isinstance(domain, SimplicialMesh):
        if boundary not in MESH_BOUNDARIES:
            raise ValueError(f"boundary: got {boundary!r}; a mesh takes one of {', '.join(map(repr, MESH_BOUNDARIES))}")
        conditions = ("neumann", "dirichlet") if boundary == "mean" else (boundary,)
        return _joined([_assemble_mesh(domain, mesh_space(domain.triangulation, each), mass) for each in conditions])
    if not isinstance(domain, TensorField):
        raise TypeError(f"domain: got {type(domain).__name__}; expected a TensorField, a SurfaceMesh or a TetMesh")
    if domain._tensors is not None and domain._tensors.ndim > domain.grid.dimension + 2:
        raise ValueError("domain: got a batch of tensor fields; expected one. Map over the batch with jax.vmap")
    sides = normalise_boundary(boundary, domain.grid.dimension)
    problems = doubled_problems(sides)
    pencils = [_assemble_grid(domain, grid_space(domain.grid, problem), mass) for problem in problems]
    space = pencils[0].space
    if any("dirichlet" in conditions for conditions in sides) and (space.free == space.domain).all():
        where = (
            'acts on the sides of the grid, which the mask does not reach. "dirichlet-rim" takes in the mask\'s own rim'
            if sides[-1] == ("neumann", "neumann")
            else "acts nowhere: there is no mask whose rim it could hold on"
        )
        warn_of_accuracy(f'boundary: got {boundary!r}, but "dirichlet" {where}')
    return _joined(pencils)


def _joined(pencils: list[Pencil]) -> AnyPencil:
    """Return the pencil, or the problems that make up a doubled domain."""
    if len(pencils) == 1:
        return pencils[0]
    if pencils[0].space.n_dof == pencils[-1].space.n_dof:
        raise ValueError('boundary: got "mean", but the domain has no rim: leave it out')
    free = [pencil.space.free for pencil in pencils]
    including = (tuple(j for j in range(i + 1) if not (own & ~free[j]).any()) for i, own in enumerate(free))
    return MirrorPencil(tuple(pencils), tuple(including))


def _assemble_grid(field: TensorField, space: GridSpace, mass: MassKind) -> Pencil:
    # Masks, element and spacing go in as arrays, so that problems that differ only in them share one compilation. The
    # element is made in double precision: its rounding would scale the whole metric.
    tensors, spacing = field.tensors, field.grid.spacing
    element = tensor_product_element(space.dimension).stretched(spacing)
    gradients, weights, steps = (np.asarray(x, tensors.dtype) for x in (element.gradients, element.weights, spacing))
    domain, elements = (mask_for(tensors, mask) for mask in (space.domain, space.elements))
    couplings, settings = couplings_for(tensors, space), (space.periodic, field.interpolation)
    *stencils, lumped, volume = _grid_integrals(tensors, domain, elements, couplings, gradients, weights, *settings)
    stiffness, consistent = (StencilOperator(coefficients=each, space=space) for each in stencils)
    chosen = _chosen_mass(mass, space, consistent, lumped)
    metric = SampledMetric(jax.lax.stop_gradient(tensors), steps, field.interpolation)
    return Pencil(stiffness, chosen, metric, volume, space, null_space=_constants(space, tensors))


def _constants(space: FunctionSpace, values: Array) -> NullSpace:
    """Return what every stiffness of a Laplace–Beltrami operator annihilates: constants on natural components."""
    n_null, labels, numbers = space.n_null, space.null_labels, jnp if is_traced(values) else np
    if n_null == 0 or (n_null == 1 and (labels == 0).all()):
        vectors = numbers.ones((n_null, space.n_dof), values.dtype)
    else:
        number = numbers.arange(n_null, dtype=np.int32)[:, None]
        vectors = (numbers.asarray(labels, np.int32) == number).astype(values.dtype)
    return NullSpace(jnp.asarray(vectors), fixed=True)


def _chosen_mass(
    mass: MassKind, space: FunctionSpace, consistent: PatternedOperator, lumped: Float[Array, "*node_shape"]
) -> Operator:
    return consistent if mass == "consistent" else DiagonalOperator(entries=space.restrict(lumped))


@jit_quickly(static_argnames=("periodic", "interpolation"))
def _grid_integrals(
    tensors: Float[Array, "*shape d d"],
    domain: Bool[np.ndarray | Array, "*shape"],
    elements: Bool[np.ndarray | Array, "*elements"],
    couplings: Bool[np.ndarray | Array, "offsets *shape"] | None,
    gradients: Float[np.ndarray | Array, "q n d"],
    weights: Float[np.ndarray | Array, " q"],
    periodic: tuple[bool, ...],
    interpolation: Interpolation,
) -> tuple[Array, Array, Array, Array]:
    """Return stiffness and mass as stencils, ∫ √|T| hᵢ of all nodes, and the volume."""
    element = Element(tensor_product_element(len(periodic)).values, gradients, weights)
    tensors = spd.positive_or_nan(spd.identity_unless(domain, tensors))

    # Logarithms are taken at the nodes, and exponentials at the quadrature points, once: the compiler would fuse them
    # into everything that reads a component, and compute them again for each.
    nodal = tensors if interpolation == "linear" else spd.log(tensors)
    metric = jax.vmap(lambda corners: at_quadrature(corners, element))(_corner_tensors(nodal, periodic))
    if interpolation == "log-euclidean":
        metric = jax.lax.optimization_barrier(spd.exp(jax.lax.optimization_barrier(metric)))

    def stencil(matrices: Float[Array, "E n n"]) -> Float[Array, "offsets *shape"]:
        kept = jnp.where(elements[..., None, None], matrices.reshape(*elements.shape, *matrices.shape[1:]), 0)
        return _stencil(kept, periodic)

    stiffness, mass = jax.vmap(lambda points: element_matrices(points, element))(metric)
    stiffness, mass = stencil(stiffness), stencil(mass)
    # Before the couplings to eliminated nodes go: the basis functions add up to one only together with theirs.
    lumped = jnp.sum(mass, axis=0)
    if couplings is None:
        return stiffness, mass, lumped, jnp.sum(lumped)
    return jnp.where(couplings, stiffness, 0), jnp.where(couplings, mass, 0), lumped, jnp.sum(lumped)


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


@jit_quickly(static_argnames=("space", "mass"))
def _assemble_mesh(mesh: SimplicialMesh, space: MeshSpace, mass: MassKind) -> Pencil:
    metric, element = mesh.metric, simplex_element(space.dimension)
    cells, n_vertices = space.triangulation.cells, space.triangulation.n_vertices
    points = element.weights.size

    def integrals(cell_metric: Float[Array, "d d"]) -> tuple[Array, Array]:
        return element_matrices(jnp.broadcast_to(cell_metric, (points, *cell_metric.shape)), element)

    stiffness, consistent = jax.vmap(integrals)(metric)
    where, slots, pattern = _mesh_pattern(space)

    def gather(matrices: Float[Array, "n corners corners"]) -> SparseOperator:
        entries = jax.ops.segment_sum(matrices.reshape(-1)[where], slots, pattern.rows.size)
        return SparseOperator(entries, pattern)

    lumped = jax.ops.segment_sum(jnp.sum(consistent, axis=-1).ravel(), cells.ravel(), n_vertices)
    chosen = _chosen_mass(mass, space, gather(consistent), lumped)
    sampled = SampledMetric(jax.lax.stop_gradient(metric), None)
    return Pencil(gather(stiffness), chosen, sampled, jnp.sum(lumped), space, null_space=_constants(space, metric))


@lru_cache(maxsize=16)
def _mesh_pattern(space: MeshSpace) -> tuple[np.ndarray, np.ndarray, SparsePattern]:
    """Return which local entries count (both ends free), the matrix entry that each adds to, and the pattern."""
    n, corners = space.n_dof, space.dimension + 1
    cells = space.degrees_of_freedom[space.triangulation.cells]
    rows, cols = np.repeat(cells, corners, axis=1).ravel(), np.tile(cells, (1, corners)).ravel()
    where = np.flatnonzero((rows >= 0) & (cols >= 0))
    keys, slots = np.unique(rows[where] * n + cols[where], return_inverse=True)
    return where, slots, SparsePattern(n, keys // n, keys % n)
