"""Integrals of stiffness and mass over the elements of grids and of meshes, and their sums."""

from dataclasses import replace
from functools import partial
from itertools import product
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.checks import real_array
from hks_jax.compilation import jit_quickly, numpy_where_known
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SimplicialMesh, oriented
from hks_jax.domain.tensor_checks import Interpolation
from hks_jax.domain.tensor_field import TensorField, diffusion_tensors
from hks_jax.fem.elements import MASS, Element, element_matrices, moved, simplex_element, tensor_product_element
from hks_jax.fem.fields import Field
from hks_jax.fem.forms import WeakForm
from hks_jax.fem.pencil import Pencil, assembled, gathered, row_sums_of
from hks_jax.fem.resolution import SampledMetric
from hks_jax.fem.space import GridSpace, MeshSpace, cells_of, couplings_for, mask_for, vector_space
from hks_jax.fem.stencil import StencilOperator

_ON_HOST = 1 << 17
"""NumPy integrates up to this number of tensor entries, which takes milliseconds and no compilation."""


def assemble_grid(field: TensorField, fields: dict[str, Field], space: GridSpace, operator: WeakForm) -> Pencil:
    """Return the pencil of a field, or of one part of a doubled domain."""
    # Masks, element and spacing are passed as arrays, so that problems that differ only in these arrays share one
    # compilation. The element is computed in double precision, since its rounding would scale the whole metric.
    tensors, spacing = diffusion_tensors(field) if operator.fick else field.tensors, np.array(field.grid.spacing)
    element = tensor_product_element(space.dimension)
    table = element.gradients / spacing, element.weights * spacing.prod(), spacing
    gradients, weights, steps = (np.asarray(x, tensors.dtype) for x in table)
    domain, elements = (mask_for(tensors, mask) for mask in (space.domain, space.elements))
    couplings, settings = couplings_for(tensors, space), (space.periodic, field.interpolation, operator)
    x = grid_points(field.grid, space, tensors.dtype) if operator.own else None
    arrays = tensors, domain, elements, couplings, gradients, weights, steps
    *matrices, lumped, volume = _grid_integrals(*arrays, x, fields, *settings)
    metric = SampledMetric(jax.lax.stop_gradient(field.tensors), steps, field.interpolation, operator.fick)
    density = _root(tensors, domain) if operator.fick else None
    if operator.components > 1:
        own, kept = vector_space(space, operator.components), np.flatnonzero(space.elements)
        one, other = (gathered(own, each[kept]) for each in matrices)
        sums = row_sums_of(own, matrices[1][kept])
        return assembled(one, other, sums, None, volume, None, own, operator, fields)
    stiffness, consistent = (StencilOperator(coefficients=each, space=space) for each in matrices)
    return assembled(stiffness, consistent, lumped, metric, volume, density, space, operator, fields)


@numpy_where_known()
def _root(xp: Any, tensors: Any, domain: Any) -> Any:
    """Return √|D| at the nodes of the domain, and 1 elsewhere."""
    return xp.sqrt(xp.where(domain, spd.determinant(tensors), 1))


def grid_points(grid: Grid, space: GridSpace, dtype: Any) -> Float[Array, "*elements q d"]:
    """Return the positions of the quadrature points; elements outside the domain get those of an element inside."""
    first = np.argwhere(space.elements)[0].astype(dtype)
    corners = np.array(list(product((0.0, 1.0), repeat=space.dimension)))
    inner = tensor_product_element(space.dimension).values @ corners
    origin, spacing, inner = (np.asarray(x, dtype) for x in (grid.origin, grid.spacing, inner))
    return _points_from(mask_for(jnp.zeros(()), space.elements), first, origin, spacing, inner)


@jax.jit
def _points_from(
    elements: Bool[np.ndarray | Array, "*elements"],
    first: Float[np.ndarray | Array, " d"],
    origin: Float[np.ndarray | Array, " d"],
    spacing: Float[np.ndarray | Array, " d"],
    inner: Float[np.ndarray | Array, "q d"],
) -> Float[Array, "*elements q d"]:
    low = jnp.moveaxis(jnp.indices(elements.shape), 0, -1).astype(first.dtype)
    low = jnp.where(elements[..., None], low, first)
    inner, origin, spacing = (
        jnp.reshape(x, (1,) * elements.ndim + (-1, low.shape[-1])) for x in (inner, origin, spacing)
    )
    return origin + spacing * (low[..., None, :] + inner)


def _numpy_rule(known: SimpleNamespace, x: SimpleNamespace | None, y: list[Any] | None) -> Any:
    """Compute the integrals without fields, their tangents, or the cotangents of the tensors, with NumPy."""
    tensors, domain, periodic, operator = known.tensors, known.domain, known.periodic, known.operator
    plain = operator == WeakForm(lumped=operator.lumped, fick=operator.fick) and not known.fields
    if (
        not plain
        or known.interpolation != "linear"
        or tensors.size > _ON_HOST
        or (x is not None and len(jax.tree.leaves(vars(x))) > 1)
    ):
        return None
    gradients, weights = known.gradients, known.weights
    d, n, dtype, shape = len(periodic), 2 ** len(periodic), tensors.dtype, domain.shape
    h, nodes = tensor_product_element(d).values.astype(dtype), np.asarray(tensors).reshape(-1, d, d)
    corners = np.array(list(product((0, 1), repeat=d)))
    offsets = (corners[None] - corners[:, None] + 1) @ 3 ** np.arange(d)[::-1]
    cells = cells_of(np.asarray(known.elements), shape, periodic)
    places = cells[:, :, None] + offsets * domain.size
    of_stiffness = np.einsum("q,qia,qjb->qabij", weights, gradients, gradients).reshape(-1, n * n)
    of_mass = np.einsum("q,qi,qj->qij", weights, h, h).reshape(-1, n * n)
    coupled = np.ones((), bool) if known.couplings is None else known.couplings
    # Nodes outside the domain have no influence, whatever their tensors are.
    valid = np.where(domain.ravel(), np.where(spd.is_spd(nodes), 1, np.nan), 0).astype(dtype)[:, None, None]

    def inside(nodal: np.ndarray) -> np.ndarray:
        at_corners = (nodal * valid)[cells].reshape(-1, n, d * d)
        return np.matmul(h, at_corners).reshape(-1, n, d, d)

    def integrals(flux: np.ndarray, density: np.ndarray, metric_density: np.ndarray) -> tuple[Any, ...]:
        of_elements = flux.reshape(len(cells), -1) @ of_stiffness, density @ of_mass
        sums = (np.bincount(places.ravel(), each.ravel(), 3**d * domain.size) for each in of_elements)
        stiffness, mass = (each.astype(dtype).reshape(3**d, *shape) for each in sums)
        couplings = np.where(coupled, stiffness, 0), np.where(coupled, mass, 0)
        return *couplings, mass.sum(axis=0), np.sum(metric_density @ weights)

    # The integrands of a metric T have d(√|T| T⁻¹) = √|T| (½ tr(T⁻¹dT) T⁻¹ − T⁻¹dT T⁻¹) and d√|T| = ½√|T| tr(T⁻¹dT).
    # The integrands of Fick's operator, whose tensors are D, are D and 1, and |D|^(−½) for the volume of the metric.
    given, fick = inside(nodes), operator.fick
    root, inverse = np.sqrt(spd.determinant(given)), spd.inverse(given)
    flux, across = given if fick else root[..., None, None] * inverse, np.swapaxes(inverse, -1, -2)
    if x is None:
        return integrals(flux, np.ones_like(root) if fick else root, 1 / root if fick else root)
    if y is None:
        change = inside(np.asarray(x.tensors).reshape(-1, d, d))
        half = np.sum(across * change, axis=(-2, -1)) / 2
        if fick:
            return integrals(change, np.zeros_like(root), -half / root)
        return integrals(half[..., None, None] * flux - flux @ change @ inverse, root * half, root * half)
    stiffness, mass = np.where(coupled, y[0], 0), np.where(coupled, y[1], 0) + y[2]
    of_flux, of_root = (
        each.ravel()[places].reshape(-1, n * n) @ table.T
        for each, table in ((stiffness, of_stiffness), (mass, of_mass))
    )
    of_flux, of_volume = of_flux.reshape(given.shape), y[3] * weights
    if fick:
        of_tensors = of_flux - (of_volume / (2 * root))[..., None, None] * across
    else:
        half = (np.sum(flux * of_flux, axis=(-2, -1)) + root * (of_root + of_volume)) / 2
        of_tensors = half[..., None, None] * across - root[..., None, None] * across @ of_flux @ across
    of_corners = np.matmul(h.T, of_tensors.reshape(-1, n, d * d)).reshape(-1, d * d)
    sums = [np.bincount(cells.ravel(), each, domain.size) for each in of_corners.T]
    return {"tensors": (np.stack(sums, axis=-1).reshape(-1, d, d) * valid).astype(dtype).reshape(tensors.shape)}


@jit_quickly(static_argnames=("periodic", "interpolation", "operator"), numpy_rule=_numpy_rule)
def _grid_integrals(
    tensors: Float[Array, "*shape d d"],
    domain: Bool[np.ndarray | Array, "*shape"],
    elements: Bool[np.ndarray | Array, "*elements"],
    couplings: Bool[np.ndarray | Array, "offsets *shape"] | None,
    gradients: Float[np.ndarray | Array, "q n d"],
    weights: Float[np.ndarray | Array, " q"],
    spacing: Float[np.ndarray | Array, " d"],
    x: Float[Array, "*elements q d"] | None,
    fields: dict[str, Field],
    periodic: tuple[bool, ...],
    interpolation: Interpolation,
    operator: WeakForm,
) -> tuple[Array, Array, Array, Array]:
    """Return stiffness and mass as stencils (as element matrices for vectors), the mass's row sums and the volume."""
    element = Element(tensor_product_element(len(periodic)).values, gradients, weights)
    tensors = spd.positive_or_nan(spd.identity_outside(tensors, domain))

    # Logarithms of tensors are computed at the nodes, and exponentials at the quadrature points. Optimization barriers
    # keep the compiler from computing an exponential again wherever one of its components is used.
    nodal = tensors if interpolation == "linear" else spd.log(tensors)
    at_corners = partial(_at_corners, periodic=periodic)
    at_points = partial(Field.at_points, corners=at_corners, shape_values=element.values, elements=elements.shape)
    metric = at_points(Field(nodal, "nodes"))
    if interpolation == "log-euclidean":
        metric = jax.lax.optimization_barrier(spd.exp(jax.lax.optimization_barrier(metric)))
    if operator.fick:  # the tensors are D
        metric = spd.inverse(metric)
    metric_density = jnp.sqrt(spd.determinant(metric))
    density = jnp.ones_like(metric_density) if operator.fick else metric_density
    held = {name: at_points(field) for name, field in fields.items()}
    places = None if x is None else x.reshape(-1, *x.shape[-2:])

    def kept(matrices: Float[Array, "E n n"]) -> Float[Array, "E n n"]:
        return jnp.where(elements.reshape(-1, 1, 1), matrices, 0)

    points = replace(element, values=tensor_product_element(len(periodic), MASS).values)

    def integrals(metric: Array, density: Array, x: Array | None, fields: dict[str, Array]) -> tuple[Array, ...]:
        if not operator.cancelling:
            return element_matrices(metric, density, element, operator, x, fields)
        alone = {name: field for name, field in fields.items() if name != "potential"}
        energy, mass = element_matrices(metric, density, points, operator, x, alone)
        whole = moved(energy, metric, spacing)
        if "potential" in fields:
            whole = whole + element_matrices(metric, density, points, operator, x, fields)[0] - energy
        return whole, mass

    stiffness, mass = map(kept, jax.vmap(integrals)(metric, density, places, held))
    if operator.components > 1:
        return stiffness, mass, jnp.sum(mass, axis=-1), jnp.zeros((), mass.dtype)
    stiffness, mass = (_stencil(each.reshape(*elements.shape, *each.shape[1:]), periodic) for each in (stiffness, mass))
    # The row sums include couplings to eliminated nodes, because only the sum of all basis functions is one.
    lumped = volumes = jnp.sum(mass, axis=0)
    if operator.fick or "density" in fields:
        volumes = kept((metric_density @ weights)[:, None, None])
    volume = jnp.sum(volumes)
    if couplings is None:
        return stiffness, mass, lumped, volume
    return jnp.where(couplings, stiffness, 0), jnp.where(couplings, mass, 0), lumped, volume


def _at_corners(nodal: Float[Array, "*shape_and_rest"], periodic: tuple[bool, ...]) -> Float[Array, "E n ..."]:
    d, rest = len(periodic), nodal.shape[len(periodic) :]
    nodes = jnp.pad(nodal, [*[(0, int(wraps)) for wraps in periodic], *[(0, 0)] * len(rest)], mode="wrap")
    corners = [nodes[corner] for corner in product(*[(slice(None, -1), slice(1, None))] * d)]
    return jnp.stack(corners, axis=d).reshape(-1, 2**d, *rest)


def _stencil(matrices: Float[Array, "*elements n n"], periodic: tuple[bool, ...]) -> Float[Array, "offsets *shape"]:
    """Assemble element matrices, whose entry (a, b) couples the node at corner a to the node at offset b − a."""
    d = len(periodic)
    couplings = jnp.moveaxis(matrices, (-2, -1), (0, 1)).reshape(2**d, *(2,) * d, *matrices.shape[:d])
    # In 3D, one `pad` for each corner a, with all corners b, compiles twice as fast as one `pad` for each pair (a, b).
    total = jnp.zeros((), matrices.dtype)
    for a, node in enumerate(product((0, 1), repeat=d)):
        total = total + jnp.pad(couplings[a], [(1 - i, i) for i in node] + [(i, 1 - i) for i in node])
    total = total.reshape(3**d, *total.shape[d:])
    for axis, wraps in enumerate(periodic, start=1):
        if wraps:  # on a periodic axis, the last node is the first
            inner = jax.lax.slice_in_dim(total, 0, -1, axis=axis)
            last = jax.lax.slice_in_dim(total, -1, None, axis=axis)
            total = inner + jnp.pad(last, [(0, n - 1 if a == axis else 0) for a, n in enumerate(inner.shape)])
    return total


def mesh_nodes(mesh: SimplicialMesh, degree: int, midpoints: Any) -> Float[Array, "nodes 3"]:
    """Return the positions of the nodes: the vertices and, for degree 2, the midpoints of the edges."""
    if degree not in (1, 2):
        raise ValueError(f"degree: got {degree!r}; expected 1 or 2")
    vertices = mesh.vertices
    if degree == 1:
        if midpoints is not None:
            raise ValueError("midpoints: got positions with degree=1, whose edges are straight; pass degree=2")
        return vertices
    middles = jnp.mean(vertices[mesh.triangulation.edges], axis=1)
    if midpoints is None:
        return jnp.concatenate([vertices, middles])
    if mesh._metric is not None:
        raise ValueError("midpoints: got positions for a mesh with a given metric; leave out midpoints or metric")
    moved = midpoints
    if callable(midpoints):
        on_surface = mesh.triangulation.boundary_edges | (mesh.triangulation.dimension == 2)
        moved = middles.at[on_surface].set(jax.vmap(midpoints)(middles[on_surface]))
    moved = real_array("midpoints", moved)
    if moved.shape != middles.shape:
        raise ValueError(
            f"midpoints: got shape {moved.shape}; expected {middles.shape}, one position for each edge of "
            "mesh.triangulation.edges, or a function that maps an edge's midpoint (3,) to its new position"
        )
    return jnp.concatenate([vertices, moved.astype(vertices.dtype)])


def mesh_points(nodes: Float[Array, "nodes 3"], space: MeshSpace) -> Float[Array, "n q 3"]:
    """Return the positions of the quadrature points in each cell."""
    values = jnp.asarray(simplex_element(space.dimension, space.degree).values, nodes.dtype)
    return jnp.einsum("qi,nix->nqx", values, nodes[space.cells], precision="highest")


@jit_quickly(static_argnames=("space", "operator", "curved"))
def assemble_mesh(
    mesh: SimplicialMesh,
    nodes: Float[Array, "nodes 3"],
    curved: bool,
    fields: dict[str, Field],
    space: MeshSpace,
    operator: WeakForm,
) -> Pencil:
    """Return the pencil of a mesh; if ``curved``, the edges of the mesh pass through the midpoints among the nodes."""
    element = simplex_element(space.dimension, space.degree)
    shape = len(space.cells), element.weights.size
    if curved:
        slopes = jnp.asarray(element.gradients, nodes.dtype)
        frames = oriented(jnp, jnp.einsum("qia,nix->nqxa", slopes, nodes[space.cells], precision="highest"))
        metric = spd.positive_or_nan(jnp.einsum("nqxa,nqxb->nqab", frames, frames, precision="highest"))
    else:
        metric, frames = (jnp.broadcast_to(x[:, None], (*shape, *x.shape[1:])) for x in (mesh.metric, mesh._edges))
    held = {
        name: field.at_points(lambda x: x[space.cells], element.values, shape[:1]) for name, field in fields.items()
    }
    x, seen = (mesh_points(nodes, space), frames) if operator.own else (None, None)

    density = metric_density = jnp.sqrt(spd.determinant(metric))
    if operator.fick:  # the volume element is that of space
        density = jnp.sqrt(spd.determinant(jnp.einsum("nqxa,nqxb->nqab", frames, frames, precision="highest")))
    integrals = jax.vmap(partial(element_matrices, element=element, form=operator))
    stiffness, mass = integrals(metric, density, x=x, fields=held, frames=seen)
    own = space if operator.components == 1 else vector_space(space, operator.components)
    lumped = volumes = row_sums_of(own, mass)
    weights, ratio = element.weights.astype(metric.dtype), None
    if operator.fick or "density" in fields:
        volumes = metric_density @ weights
    if operator.fick:
        ratio = _mean_over_cells(space, density**2 / metric_density @ weights, density @ weights)
    # The error of P1 elements is estimated from the lengths of edges. No error estimate is known for P2 elements.
    sampled = None
    if space.degree == 1:
        own_metric, of_space = jax.lax.stop_gradient((mesh.metric, mesh.metric_of_space))
        sampled = SampledMetric(own_metric, None, of_space=of_space)
    matrices = gathered(own, stiffness), gathered(own, mass)
    return assembled(*matrices, lumped, sampled, jnp.sum(volumes), ratio, own, operator, fields)


def _mean_over_cells(space: MeshSpace, weighted: Float[Array, " n"], weights: Float[Array, " n"]) -> Array:
    """Return the weighted mean at each node over its cells, and 0 at nodes without cells."""

    def total(values: Float[Array, " n"]) -> Array:
        each = jnp.broadcast_to(values[:, None], space.cells.shape)
        return jax.ops.segment_sum(each.ravel(), space.cells.ravel(), space.free.size)

    sums = total(weights)
    return (total(weighted) / jnp.where(sums > 0, sums, 1)).reshape(space.node_shape)
