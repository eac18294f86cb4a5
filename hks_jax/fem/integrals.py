"""Integrals of stiffness and mass over the elements of grids and of meshes, and their sums."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.compilation import jit_quickly, library_of, numpy_where_known
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SimplicialMesh, oriented
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.elements import MASS, Element, element_matrices, moved, simplex_element, tensor_product_element
from hks_jax.fem.fields import Field
from hks_jax.fem.forms import WeakForm
from hks_jax.fem.host_integrals import Geometry, Integrals, Settings, host_integrals
from hks_jax.fem.pencil import Pencil, assembled, gathered, row_sums_of
from hks_jax.fem.resolution import SampledMetric
from hks_jax.fem.space import GridSpace, MeshSpace, couplings_for, mask_for, vector_space
from hks_jax.fem.stencil import StencilOperator
from hks_jax.linear.linear_map import instantiated
from hks_jax.linear.linear_program import HostMap, linear_program
from hks_jax.traced import is_traced


def assemble_grid(
    field: TensorField, fields: dict[str, Field], spaces: list[GridSpace], operator: WeakForm
) -> list[Pencil]:
    """Return the pencil of a field for each space; the first space contains the functions of all spaces."""
    # Masks, element and spacing are passed as arrays, so that fields that differ only in these arrays share one
    # compilation. The element is computed in double precision, since its rounding would scale the whole metric.
    space = spaces[0]
    tensors, spacing, density = field.tensors, np.array(field.grid.spacing), None
    element = tensor_product_element(space.dimension)
    table = element.gradients / spacing, element.weights * spacing.prod(), spacing
    gradients, weights, steps = (np.asarray(x, tensors.dtype) for x in table)
    domain, elements = (mask_for(tensors, mask) for mask in (space.domain, space.elements))
    if operator.fick:
        tensors, density = _diffusion(field.domain_tensors, domain)
    x = grid_points(field.grid, space, tensors.dtype) if operator.custom else None
    geometry = Geometry(domain, elements, couplings_for(tensors, space), gradients, weights, steps, x)
    settings = Settings(space.periodic, field.interpolation, operator)
    integrals = _grid_integrals(settings, geometry, tensors, fields)
    metric = SampledMetric(jax.lax.stop_gradient(field.tensors), steps, field.interpolation, operator.fick)

    def pencil(space: GridSpace) -> Pencil:
        *matrices, lumped, volume = integrals
        if operator.components > 1:
            functions, kept = vector_space(space, operator.components), np.flatnonzero(space.elements)
            one, other = (gathered(functions, each[kept]) for each in matrices)
            sums = row_sums_of(functions, matrices[1][kept])
            return assembled(one, other, sums, None, volume, None, functions, operator, fields)
        if space is not spaces[0]:
            couplings = couplings_for(tensors, space)
            assert couplings is not None
            matrices = [jnp.where(couplings, each, 0) for each in matrices]
        stiffness, consistent = (StencilOperator(coefficients=each, space=space) for each in matrices)
        return assembled(stiffness, consistent, lumped, metric, volume, density, space, operator, fields)

    return [pencil(each) for each in spaces]


@numpy_where_known()
def _diffusion(metric: Any, domain: Any) -> tuple[Any, Any]:
    """Return the tensors D = T⁻¹ of Fick's operator, and √|D| at the nodes of the domain and 1 elsewhere."""
    xp = library_of(domain)
    tensors = spd.inverse(metric)
    return tensors, xp.sqrt(xp.where(domain, spd.determinant(tensors), 1))


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


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _grid_integrals(settings: Settings, geometry: Geometry, tensors: Array, fields: dict[str, Field]) -> Integrals:
    """Return the integrals, computed by NumPy for small fields. Derivatives treat the geometry as constant."""
    host = host_integrals(settings, geometry, tensors, fields)
    return _compiled_integrals(settings, geometry, tensors, fields) if host is None else jax.device_put(host.value())


@partial(_grid_integrals.defjvp, symbolic_zeros=True)
def _grid_integrals_jvp(settings: Settings, primals: tuple, changes: tuple) -> tuple[Integrals, Integrals]:
    change = instantiated(changes[1:])
    if is_traced(primals):
        return jax.jvp(partial(_compiled_integrals, settings, primals[0]), primals[1:], change)
    value = _grid_integrals(settings, *primals)
    return value, linear_program(_change_of_integrals, (settings,), primals, change, value, _host_map)


def _change_of_integrals(settings: Settings, geometry: Geometry, tensors: Array, fields: Any, change: Any) -> Integrals:
    return jax.jvp(partial(_compiled_integrals, settings, geometry), (tensors, fields), change)[1]


def _host_map(settings: Settings, geometry: Geometry, tensors: Array, fields: Any) -> HostMap | None:
    host = host_integrals(settings, geometry, tensors, fields)
    return None if host is None else host.derivative


Sums: TypeAlias = tuple[Array, Array, Array]
"""Stiffness and mass of some elements, and the metric's volume if it is not the sum of the mass."""
_AT_ONCE = 1 << 26
"""The number of entries of all element matrices up to which they are computed at once: 2048² or 101³ elements."""


@jit_quickly(static_argnums=0)
def _compiled_integrals(
    settings: Settings, geometry: Geometry, tensors: Float[Array, "*shape d d"], fields: dict[str, Field]
) -> Integrals:
    (periodic, interpolation, operator), (domain, elements, couplings, gradients, weights, spacing, x) = (
        settings,
        geometry,
    )
    d = len(periodic)
    element = Element(tensor_product_element(d).values, gradients, weights)
    points = replace(element, values=tensor_product_element(d, MASS).values)
    tensors = spd.positive_or_nan(spd.identity_outside(tensors, domain))
    # Logarithms of tensors are computed at the nodes, and exponentials at the quadrature points. Optimization barriers
    # keep the compiler from computing an exponential again wherever one of its components is used.
    nodal = Field(tensors if interpolation == "linear" else spd.log(tensors), "nodes")
    given = {name: _wrapped(field, periodic) for name, field in {"": nodal, **fields}.items()}
    at_corners = partial(_at_corners, d=d)

    def integrals(metric: Array, density: Array, x: Array | None, fields: dict[str, Array]) -> tuple[Array, ...]:
        if not operator.cancelling:
            return element_matrices(metric, density, element, operator, x, fields)
        alone = {name: field for name, field in fields.items() if name != "potential"}
        energy, mass = element_matrices(metric, density, points, operator, x, alone)
        whole = moved(energy, metric, spacing)
        if "potential" in fields:
            whole = whole + element_matrices(metric, density, points, operator, x, fields)[0] - energy
        return whole, mass

    def matrices(elements: Any, x: Array | None, given: dict[str, Field]) -> Sums:
        def kept(values: Float[Array, "E n n"]) -> Float[Array, "E n n"]:
            return jnp.where(elements.reshape(-1, 1, 1), values, 0)

        held = {name: field.at_points(at_corners, element.values, elements.shape) for name, field in given.items()}
        metric = held.pop("")
        if interpolation == "log-euclidean":
            metric = jax.lax.optimization_barrier(spd.exp(jax.lax.optimization_barrier(metric)))
        if operator.fick:  # the tensors are D
            metric = spd.inverse(metric)
        metric_density = jnp.sqrt(spd.determinant(metric))
        density = jnp.ones_like(metric_density) if operator.fick else metric_density
        places = None if x is None else x.reshape(-1, *x.shape[-2:])
        stiffness, mass = map(kept, jax.vmap(integrals)(metric, density, places, held))
        volume = jnp.zeros((), mass.dtype)
        if operator.fick or "density" in fields:
            volume = jnp.sum(kept((metric_density @ weights)[:, None, None]))
        return stiffness, mass, volume

    if operator.components > 1:
        stiffness, mass, _ = matrices(elements, x, given)
        return stiffness, mass, jnp.sum(mass, axis=-1), jnp.zeros((), mass.dtype)

    def stencils(elements: Any, x: Array | None, given: dict[str, Field]) -> Sums:
        stiffness, mass, volume = matrices(elements, x, given)
        one, other = (_stencil(each.reshape(*elements.shape, *each.shape[1:])) for each in (stiffness, mass))
        return one, other, volume

    planes = max(_AT_ONCE // (4**d * math.prod(elements.shape[1:])), 1)
    whole = stencils if elements.shape[0] <= planes else partial(_in_slabs, stencils, planes)
    *both, volume = whole(elements, x, given)
    stiffness, mass = (_folded(each, periodic) for each in both)
    # The row sums include couplings to eliminated nodes, because only the sum of all basis functions is one.
    lumped = jnp.sum(mass, axis=0)
    if not (operator.fick or "density" in fields):
        volume = jnp.sum(lumped)
    if couplings is None:
        return stiffness, mass, lumped, volume
    return jnp.where(couplings, stiffness, 0), jnp.where(couplings, mass, 0), lumped, volume


def _wrapped(field: Field, periodic: tuple[bool, ...]) -> Field:
    """Return a field whose nodal values have the first node again after the last along periodic axes."""
    if field.at != "nodes":
        return field
    ends = [(0, int(wraps)) for wraps in periodic] + [(0, 0)] * (field.values.ndim - len(periodic))
    return Field(jnp.pad(field.values, ends, mode="wrap"), "nodes")


def _at_corners(nodal: Float[Array, "*nodes_and_rest"], d: int) -> Float[Array, "E n ..."]:
    """Return the values at the corners of the elements between all nodes; the first d axes are those of the grid."""
    corners = [nodal[corner] for corner in product(*[(slice(None, -1), slice(1, None))] * d)]
    return jnp.stack(corners, axis=d).reshape(-1, 2**d, *nodal.shape[d:])


def _stencil(matrices: Float[Array, "*elements n n"]) -> Float[Array, "offsets *nodes"]:
    """Assemble element matrices, whose entry (a, b) couples the node at corner a to the node at offset b − a."""
    d = matrices.ndim - 2
    couplings = jnp.moveaxis(matrices, (-2, -1), (0, 1)).reshape(2**d, *(2,) * d, *matrices.shape[:d])
    # In 3D, one `pad` for each corner a, with all corners b, compiles twice as fast as one `pad` for each pair (a, b).
    total = jnp.zeros((), matrices.dtype)
    for a, node in enumerate(product((0, 1), repeat=d)):
        total = total + jnp.pad(couplings[a], [(1 - i, i) for i in node] + [(i, 1 - i) for i in node])
    return total.reshape(3**d, *total.shape[d:])


def _folded(stencil: Float[Array, "offsets *nodes"], periodic: tuple[bool, ...]) -> Float[Array, "offsets *shape"]:
    """Add the couplings of the last node along periodic axes to those of the first node, which is the same node."""
    for axis, wraps in enumerate(periodic, start=1):
        if wraps:
            inner = jax.lax.slice_in_dim(stencil, 0, -1, axis=axis)
            last = jax.lax.slice_in_dim(stencil, -1, None, axis=axis)
            stencil = inner + jnp.pad(last, [(0, n - 1 if a == axis else 0) for a, n in enumerate(inner.shape)])
    return stencil


# The matrices of all elements of a grid, and the intermediate results, take eight times the memory of the stencils.
def _in_slabs(
    stencils: Callable[..., Sums],
    planes: int,
    elements: Bool[np.ndarray | Array, "*elements"],
    x: Float[Array, "*elements q d"] | None,
    given: dict[str, Field],
) -> Sums:
    """Return ``stencils(elements, x, given)``, computed for ``planes`` planes of elements at a time."""
    count, *others = elements.shape
    elements = jnp.asarray(elements)

    of_slab = jax.checkpoint(stencils)  # derivatives would otherwise store the element matrices of all slabs

    def add(total: Sums, number: Array) -> tuple[Sums, None]:
        start = jnp.minimum(number * planes, count - planes)
        again = start + jnp.arange(planes) < number * planes  # the last two slabs overlap

        def part(values: Array, size: int = planes, axis: int = 0) -> Array:
            return jax.lax.dynamic_slice_in_dim(values, start, size, axis)

        def of_planes(field: Field) -> Field:
            size = planes + (field.at == "nodes")
            return field if field.at == "everywhere" else Field(part(field.values, size), field.at)

        some = {name: of_planes(field) for name, field in given.items()}
        own_elements = part(elements) & ~again.reshape(-1, *[1] * len(others))
        *both, volume = of_slab(own_elements, None if x is None else part(x), some)
        stiffness, mass = (
            jax.lax.dynamic_update_slice_in_dim(whole, part(whole, planes + 1, 1) + each, start, 1)
            for whole, each in zip(total[:2], both, strict=True)
        )
        return (stiffness, mass, total[2] + volume), None

    dtype = given[""].values.dtype
    none = jnp.zeros((3 ** (1 + len(others)), count + 1, *(n + 1 for n in others)), dtype)
    total, _ = jax.lax.scan(add, (none, none, jnp.zeros((), dtype)), jnp.arange(-(-count // planes)))
    return total


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
        jacobians = oriented(jnp.einsum("qia,nix->nqxa", slopes, nodes[space.cells], precision="highest"))
        metric = spd.positive_or_nan(jnp.einsum("nqxa,nqxb->nqab", jacobians, jacobians, precision="highest"))
    else:
        metric, jacobians = (jnp.broadcast_to(x[:, None], (*shape, *x.shape[1:])) for x in (mesh.metric, mesh._edges))
    held = {
        name: field.at_points(lambda x: x[space.cells], element.values, shape[:1]) for name, field in fields.items()
    }
    x, seen = (mesh_points(nodes, space), jacobians) if operator.custom else (None, None)

    density = metric_density = jnp.sqrt(spd.determinant(metric))
    if operator.fick:  # the volume element is that of space
        density = jnp.sqrt(spd.determinant(jnp.einsum("nqxa,nqxb->nqab", jacobians, jacobians, precision="highest")))
    integrals = jax.vmap(partial(element_matrices, element=element, form=operator))
    stiffness, mass = integrals(metric, density, x=x, fields=held, jacobians=seen)
    functions = space if operator.components == 1 else vector_space(space, operator.components)
    lumped = volumes = row_sums_of(functions, mass)
    weights, ratio = element.weights.astype(metric.dtype), None
    if operator.fick or "density" in fields:
        volumes = metric_density @ weights
    if operator.fick:
        ratio = _mean_over_cells(space, density**2 / metric_density @ weights, density @ weights)
    own_metric, of_space = jax.lax.stop_gradient((mesh.metric, mesh.metric_of_space))
    sampled = SampledMetric(own_metric, None, of_space=of_space)
    matrices = gathered(functions, stiffness), gathered(functions, mass)
    return assembled(*matrices, lumped, sampled, jnp.sum(volumes), ratio, functions, operator, fields)


def _mean_over_cells(space: MeshSpace, weighted: Float[Array, " n"], weights: Float[Array, " n"]) -> Array:
    """Return the weighted mean at each node over its cells, and 0 at nodes without cells."""

    def total(values: Float[Array, " n"]) -> Array:
        each = jnp.broadcast_to(values[:, None], space.cells.shape)
        return jax.ops.segment_sum(each.ravel(), space.cells.ravel(), space.free.size)

    sums = total(weights)
    return (total(weighted) / jnp.where(sums > 0, sums, 1)).reshape(space.node_shape)
