"""From a tensor field or a mesh to its stiffness and mass: one element's integrals, mapped over all elements."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from itertools import product
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import real_array, require_count
from hks_jax.compilation import jit_quickly
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_checks import Interpolation
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, normalise_boundary
from hks_jax.fem.elements import Element, at_quadrature, element_matrices, simplex_element, tensor_product_element
from hks_jax.fem.fields import Field, checked_field
from hks_jax.fem.forms import Form, WeakForm, l2, laplace_beltrami
from hks_jax.fem.pencil import AnyPencil, MirrorPencil, Pencil
from hks_jax.fem.quadrature import MASS, Quadrature, moved
from hks_jax.fem.resolution import SampledMetric
from hks_jax.fem.space import (
    FunctionSpace,
    GridSpace,
    MeshSpace,
    VectorSpace,
    couplings_for,
    grid_space,
    mask_for,
    mesh_space,
    vector_space,
)
from hks_jax.fem.stencil import StencilOperator
from hks_jax.linear.operators import DiagonalOperator, PatternedOperator, SparseOperator, require_symmetric
from hks_jax.linear.pattern import SparsePattern
from hks_jax.linear.pencil import NullSpace
from hks_jax.traced import is_traced

MassKind = Literal["consistent", "lumped"]
MESH_BOUNDARIES = ("neumann", "dirichlet", "mean")


def assemble(
    domain: TensorField | SimplicialMesh,
    boundary: BoundarySpec = "neumann",
    mass: MassKind | Form = "consistent",
    *,
    potential: Any = None,
    density: Any = None,
    stiffness: Form | None = None,
    fields: Mapping[str, Any] | None = None,
    components: int = 1,
    degree: int = 1,
    midpoints: Any = None,
    quadrature: Quadrature = "gauss",
) -> AnyPencil:
    """Assemble the generalized eigenproblem Kφ = λMφ of an operator: by default the Laplace–Beltrami operator.

    K_ij = ∫ √|T| T⁻¹∇hᵢ·∇hⱼ and M_ij = ∫ √|T| hᵢhⱼ (Zobel, Reininghaus and Hotz, section 3), with Q1 elements and 2^d
    Gauss points on grids, T (or its logarithm: `TensorField.interpolation`) interpolated multilinearly; with P1 or P2
    elements on meshes, where T is constant on each triangle or tetrahedron.

    A *field* is a number, an array over the nodes (interpolated; shape of the grid, or (V,)), an array over the
    elements (n − 1 along each axis of a grid, n where it is periodic; the faces or cells of a mesh), or a function of
    one position x, the coordinates of a grid or a place in space, which JAX can trace. An array that could be either
    belongs to the nodes.

    Args:
        domain: a tensor field, a `SurfaceMesh` or a `TetMesh`.
        boundary: ``"neumann"`` (natural), ``"dirichlet"`` (φ = 0: these nodes are eliminated), ``"periodic"`` (node n
            is node 0: an axis of n nodes has the period n·h), ``"mirror"`` (the domain reflected on every side) or
            ``"mean"`` (two copies of the domain, glued along all of the rim); one name for all axes or one per axis,
            where a pair (low, high) of ``"neumann"``, ``"dirichlet"`` and ``"mean"`` tells the sides apart. The rim of
            a mask is natural, but under ``"mean"``, and under ``"dirichlet-rim"``, which is Dirichlet on all sides and
            there; or as one more entry says, after those of the axes: ``("periodic", "periodic", "dirichlet")``. A mesh
            takes ``"neumann"``, ``"dirichlet"`` or ``"mean"``, which act on its boundary.
        mass: ``"consistent"`` or ``"lumped"`` (row sums; diagonal); or a form of your own.
        potential: a field V of either sign: the operator is −Δ + V.
        density: a positive field ρ: the operator is −ρ⁻¹ div(ρ ∇·), in L² with the volume ρ√|T| dx.
        stiffness: a form of your own in place of both: a function ``form(u, v, w)``, linear in u and in v, of two shape
            functions with ``.value`` and ``.grad`` and of a point with ``.metric`` (d, d), its ``.inverse``, the
            position ``.x``, and ``w["name"]``, the fields. It returns one number, and is integrated with the volume
            √|T| dx. On meshes gradients and metric are those of space, along a surface tangential to it. Define it
            once: each new function is compiled anew (docs/operators.md).
        fields: for your forms, by name; they may have axes of their own after those of the places.
        components: of the functions. With c > 1 of them, as for elasticity, ``u.value`` is (c,), ``u.grad`` (c, d) with
            ``grad[i, j]`` = ∂uᵢ/∂xⱼ, and results have an axis of c after those of the nodes.
        degree: 1 or, on meshes, 2: values at the V vertices, then at the middles of the edges
            ``domain.triangulation.edges``.
        midpoints: of degree 2, where the middles of the edges are, (E, 3), which curves the sides; or a function of a
            place in space that moves the middles of straight sides there, on a `TetMesh` those of its boundary alone.
        quadrature: ``"gauss"``, or on grids ``"cancelling"``: points at which the leading error of heat kernel
            signatures cancels, at the same cost (docs/accuracy.md). The mass is consistent, and nodal values are no
            longer the unknowns φ: they are read from ½(I + D⁻¹M)φ, D the row sums of M, by all signatures.

    Returns:
        The pencil (stiffness, mass); with ``"mirror"`` and ``"mean"`` the `MirrorPencil` of the problems that make it
        up. With a potential or forms of your own nothing is known of the null space.

    Raises:
        ValueError: an unknown boundary, mass, degree or quadrature, a domain without elements or free nodes; ``"mean"``
            without a rim; a field of another shape, that is NaN, or a density that is not positive; a form that does
            not return one number, is not linear, or whose matrix is not symmetric (by how much, and where);
            ``"cancelling"`` with a mesh, a lumped mass or a form of your own.

    Warns:
        AccuracyWarning: a Dirichlet condition that no node of the domain feels.
    """
    operator, given = _checked_operator(mass, stiffness, components, potential, density, fields)
    if quadrature not in get_args(Quadrature):
        raise ValueError(f'quadrature: got {quadrature!r}; expected "gauss" or "cancelling"')
    if quadrature == "cancelling":
        for what, is_given in (
            ("a mesh, where no such points are known", isinstance(domain, SimplicialMesh)),
            ("a lumped mass, whose error no points cancel", operator.lumped),
            ("a form of your own, whose error is not known", operator.own),
        ):
            if is_given:
                raise ValueError(f'quadrature: got "cancelling" with {what}; expected "gauss"')
        operator = operator._replace(cancelling=True)
    if isinstance(domain, SimplicialMesh):
        if boundary not in MESH_BOUNDARIES:
            raise ValueError(f"boundary: got {boundary!r}; a mesh takes one of {', '.join(map(repr, MESH_BOUNDARIES))}")
        conditions = ("neumann", "dirichlet") if boundary == "mean" else (boundary,)
        nodes = _nodes_of_mesh(domain, degree, midpoints)
        if degree == 2 and operator.lumped:
            raise ValueError(
                'mass: got "lumped" with degree=2, whose row sums vanish at the vertices; use "consistent"'
            )
        spaces: list[Any] = [mesh_space(domain.triangulation, each, degree) for each in conditions]
        points = partial(_mesh_points, nodes, spaces[0])
        given = {name: value if callable(value) else domain.restrict(value) for name, value in given.items()}
        held = _checked_fields(operator, given, spaces[0], points, nodes.dtype)
        operator = operator._replace(checked=not (operator.own and is_traced((domain, held, nodes))))
        curved = midpoints is not None
        pencils = [_assemble_mesh(domain, nodes, held, each, operator, curved) for each in spaces]
        if curved and not is_traced(pencils) and np.isnan(pencils[0].mass.diagonal()).any():
            raise ValueError(
                "midpoints: they fold cells, or turn them inside out; move them nearer to the middles of straight sides"
            )
        return _joined(pencils, operator)
    if not isinstance(domain, TensorField):
        raise TypeError(f"domain: got {type(domain).__name__}; expected a TensorField, a SurfaceMesh or a TetMesh")
    if domain._tensors is not None and domain._tensors.ndim > domain.grid.dimension + 2:
        raise ValueError("domain: got a batch of tensor fields; expected one. Map over the batch with jax.vmap")
    if degree != 1 or midpoints is not None:
        raise ValueError(f"degree, midpoints: got {degree!r} for a grid, whose elements are Q1; they are for meshes")
    sides = normalise_boundary(boundary, domain.grid.dimension)
    if components > 1 and any("mirror" in pair for pair in sides):
        raise ValueError('boundary: got "mirror" with components, which a reflection would have to turn; use another')
    problems = doubled_problems(sides)
    spaces = [grid_space(domain.grid, problem) for problem in problems]
    space, held = spaces[0], {}
    if given:
        dtype = domain.tensors.dtype
        held = _checked_fields(operator, given, space, partial(_grid_points, domain.grid, space, dtype), dtype)
    operator = operator._replace(checked=not (operator.own and is_traced((domain, held))))
    pencils = [_assemble_grid(domain, held, each, operator) for each in spaces]
    if any("dirichlet" in conditions for conditions in sides) and (space.free == space.domain).all():
        where = (
            'acts on the sides of the grid, which the mask does not reach. "dirichlet-rim" takes in the mask\'s own rim'
            if sides[-1] == ("neumann", "neumann")
            else "acts nowhere: there is no mask whose rim it could hold on"
        )
        warn_of_accuracy(f'boundary: got {boundary!r}, but "dirichlet" {where}')
    return _joined(pencils, operator)


def _checked_operator(
    mass: MassKind | Form,
    stiffness: Form | None,
    components: int,
    potential: Any,
    density: Any,
    fields: Mapping[str, Any] | None,
) -> tuple[WeakForm, dict[str, Any]]:
    """Return what is to be assembled, and the fields that are given for it."""
    if mass not in ("consistent", "lumped") and not callable(mass):
        raise ValueError(f'mass: got {mass!r}; expected "consistent", "lumped" or a form')
    if stiffness is not None and not callable(stiffness):
        raise ValueError(f"stiffness: got {type(stiffness).__name__}; expected a form, a function of u, v and w")
    for name, form in (("stiffness", stiffness), ("mass", mass)):
        if is_traced([cell.cell_contents for cell in getattr(form, "__closure__", None) or ()]):
            raise ValueError(f"{name}: the form closes over traced values; hand them over by fields={{…}}, numbers too")
    require_count("components", components)
    own, given = stiffness is not None or callable(mass), dict(fields or {})
    named = {name: value for name, value in (("potential", potential), ("density", density)) if value is not None}
    if own and named:
        raise ValueError(
            f"{', '.join(named)}: got with a form of your own; pass fields={{{next(iter(named))!r}: …}}, for your "
            "form to read"
        )
    if (given or components > 1) and not own:
        raise ValueError("fields, components: they are for forms of your own; give stiffness= or mass=")
    if components > 1 and stiffness is None:
        raise ValueError("stiffness: got None with components; expected a form of functions with components")
    of_mass = mass if callable(mass) else l2
    return WeakForm(stiffness or laplace_beltrami, of_mass, mass == "lumped", components, own), given | named


def _checked_fields(
    operator: WeakForm, given: dict[str, Any], space: GridSpace | MeshSpace, points: Callable[[], Array], dtype: Any
) -> dict[str, Field]:
    def checked(name: str) -> Field:
        positive = name == "density" and not operator.own
        return checked_field(name, given[name], space, points, dtype, scalar=not operator.own, positive=positive)

    return {name: checked(name) for name in given}


def _joined(pencils: list[Pencil], operator: WeakForm) -> AnyPencil:
    """Return the pencil, or the problems that make up a doubled domain; checked where their forms are the user's."""
    if operator.own and operator.checked:
        for name in ("stiffness", "mass"):
            matrix = getattr(pencils[0], name)
            if isinstance(matrix, PatternedOperator):
                require_symmetric(name, *matrix.triplets(), matrix.size, "Make the form symmetric in u and v")
    if len(pencils) == 1:
        return pencils[0]
    if pencils[0].space.n_dof == pencils[-1].space.n_dof:
        raise ValueError('boundary: got "mean", but the domain has no rim: leave it out')
    free = [pencil.space.free for pencil in pencils]
    including = (tuple(j for j in range(i + 1) if not (own & ~free[j]).any()) for i, own in enumerate(free))
    return MirrorPencil(tuple(pencils), tuple(including))


def _assemble_grid(field: TensorField, fields: dict[str, Field], space: GridSpace, operator: WeakForm) -> Pencil:
    # Masks, element and spacing go in as arrays, so that problems that differ only in them share one compilation. The
    # element is made in double precision: its rounding would scale the whole metric.
    tensors, spacing = field.tensors, field.grid.spacing
    element = tensor_product_element(space.dimension).stretched(spacing)
    gradients, weights, steps = (np.asarray(x, tensors.dtype) for x in (element.gradients, element.weights, spacing))
    domain, elements = (mask_for(tensors, mask) for mask in (space.domain, space.elements))
    couplings, settings = couplings_for(tensors, space), (space.periodic, field.interpolation, operator)
    x = _grid_points(field.grid, space, tensors.dtype) if operator.own else None
    table = gradients, weights, steps
    *matrices, lumped, volume = _grid_integrals(tensors, domain, elements, couplings, *table, x, fields, *settings)
    metric = SampledMetric(jax.lax.stop_gradient(tensors), steps, field.interpolation)
    if operator.components > 1:
        own, kept = vector_space(space, operator.components), np.flatnonzero(space.elements)
        gathered = [_gathered(own, each[kept]) for each in matrices]
        sums = _row_sums(own, matrices[1][kept])
        return _pencil(gathered[0], gathered[1], sums, None, volume, own, operator, fields)
    stiffness, consistent = (StencilOperator(coefficients=each, space=space) for each in matrices)
    return _pencil(stiffness, consistent, lumped, metric, volume, space, operator, fields)


def _pencil(
    stiffness: PatternedOperator,
    consistent: PatternedOperator,
    lumped: Float[Array, "*node_shape"],
    metric: SampledMetric | None,
    volume: Float[Array, ""],
    space: FunctionSpace,
    operator: WeakForm,
    fields: dict[str, Field],
) -> Pencil:
    mass = DiagonalOperator(entries=space.restrict(lumped)) if operator.lumped else consistent
    if operator.own:
        return Pencil(stiffness, mass, None, None, space)
    null_space = None if "potential" in fields else _constants(space, lumped)
    row_sums = space.restrict(lumped) if operator.cancelling else None
    return Pencil(stiffness, mass, metric, volume, space, null_space=null_space, row_sums=row_sums)


def _constants(space: FunctionSpace, values: Array) -> NullSpace:
    """Return what every stiffness of a Laplace–Beltrami operator annihilates: constants on natural components."""
    n_null, labels, numbers = space.n_null, space.null_labels, jnp if is_traced(values) else np
    if n_null == 0 or (n_null == 1 and (labels == 0).all()):
        vectors = numbers.ones((n_null, space.n_dof), values.dtype)
    else:
        number = numbers.arange(n_null, dtype=np.int32)[:, None]
        vectors = (numbers.asarray(labels, np.int32) == number).astype(values.dtype)
    return NullSpace(jnp.asarray(vectors), fixed=True)


def _grid_points(grid: Grid, space: GridSpace, dtype: Any) -> Float[Array, "*elements q d"]:
    """Return the positions of the quadrature points; those of an element that exists in place of those of others."""
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
    return jnp.asarray(origin + spacing * (low[..., None, :] + inner))


@jit_quickly(static_argnames=("periodic", "interpolation", "operator"))
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
    """Return stiffness and mass as stencils, the row sums of the mass at all nodes, and the volume.

    Of functions with several components the matrices of all elements in place of stencils.
    """
    element = Element(tensor_product_element(len(periodic)).values, gradients, weights)
    tensors = spd.positive_or_nan(spd.identity_unless(domain, tensors))

    # Logarithms are taken at the nodes, and exponentials at the quadrature points, once: the compiler would fuse them
    # into everything that reads a component, and compute them again for each.
    nodal = tensors if interpolation == "linear" else spd.log(tensors)
    metric = jax.vmap(lambda corners: at_quadrature(corners, element))(_at_corners(nodal, periodic))
    if interpolation == "log-euclidean":
        metric = jax.lax.optimization_barrier(spd.exp(jax.lax.optimization_barrier(metric)))
    at_corners = partial(_at_corners, periodic=periodic)
    held = {name: field.at_points(at_corners, element.values, elements.shape) for name, field in fields.items()}
    places = None if x is None else x.reshape(-1, *x.shape[-2:])

    def kept(matrices: Float[Array, "E n n"]) -> Float[Array, "E n n"]:
        return jnp.where(elements.reshape(-1, 1, 1), matrices, 0)

    points = replace(element, values=tensor_product_element(len(periodic), MASS).values)

    def integrals(metric: Array, x: Array | None, fields: dict[str, Array]) -> tuple[Array, ...]:
        if not operator.cancelling:
            return element_matrices(metric, element, operator, x, fields)
        alone = {name: field for name, field in fields.items() if name != "potential"}
        energy, mass = element_matrices(metric, points, operator, x, alone)
        whole = moved(energy, metric, spacing)
        if "potential" in fields:
            whole = whole + element_matrices(metric, points, operator, x, fields)[0] - energy
        return whole, mass

    stiffness, mass = map(kept, jax.vmap(integrals)(metric, places, held))
    if operator.components > 1:
        return stiffness, mass, jnp.sum(mass, axis=-1), jnp.zeros((), mass.dtype)
    stiffness, mass = (_stencil(each.reshape(*elements.shape, *each.shape[1:]), periodic) for each in (stiffness, mass))
    # Before the couplings to eliminated nodes go: the basis functions add up to one only together with theirs.
    lumped = volumes = jnp.sum(mass, axis=0)
    if "density" in fields:
        volumes = kept((jnp.sqrt(spd.determinant(metric)) @ weights)[:, None, None])
    volume = jnp.sum(volumes)
    if couplings is None:
        return stiffness, mass, lumped, volume
    return jnp.where(couplings, stiffness, 0), jnp.where(couplings, mass, 0), lumped, volume


def _at_corners(nodal: Float[Array, "*shape_and_rest"], periodic: tuple[bool, ...]) -> Float[Array, "E n ..."]:
    """Gather what is at the nodes at the corners of every element."""
    d, rest = len(periodic), nodal.shape[len(periodic) :]
    nodes = jnp.pad(nodal, [*[(0, int(wraps)) for wraps in periodic], *[(0, 0)] * len(rest)], mode="wrap")
    corners = [nodes[corner] for corner in product(*[(slice(None, -1), slice(1, None))] * d)]
    return jnp.stack(corners, axis=d).reshape(-1, 2**d, *rest)


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


def _nodes_of_mesh(mesh: SimplicialMesh, degree: int, midpoints: Any) -> Float[Array, "nodes 3"]:
    """Return the places of the nodes: the vertices, and of degree 2 the middles of the edges."""
    if degree not in (1, 2):
        raise ValueError(f"degree: got {degree!r}; expected 1 or 2")
    vertices = mesh.vertices
    if degree == 1:
        if midpoints is not None:
            raise ValueError("midpoints: got with degree=1, whose sides are straight; pass degree=2")
        return vertices
    middles = jnp.mean(vertices[mesh.triangulation.edges], axis=1)
    if midpoints is None:
        return jnp.concatenate([vertices, middles])
    if mesh._metric is not None:
        raise ValueError("midpoints: the mesh has a metric of its own, constant in each cell; leave midpoints out")
    if callable(midpoints):
        moved = jax.vmap(midpoints)(middles)
        if mesh.triangulation.dimension == 3:
            moved = jnp.where(mesh.triangulation.boundary_edges[:, None], moved, middles)
    else:
        moved = real_array("midpoints", midpoints)
    if moved.shape != middles.shape:
        raise ValueError(
            f"midpoints: got shape {moved.shape}; expected {middles.shape}, one for each of "
            "mesh.triangulation.edges, or a function of one place"
        )
    return jnp.concatenate([vertices, moved.astype(vertices.dtype)])


def _mesh_points(nodes: Float[Array, "nodes 3"], space: MeshSpace) -> Float[Array, "n q 3"]:
    """Return the places of the quadrature points in each cell."""
    values = jnp.asarray(simplex_element(space.dimension, space.degree).values, nodes.dtype)
    return jnp.einsum("qi,nix->nqx", values, nodes[space.cells], precision="highest")


@jit_quickly(static_argnames=("space", "operator", "curved"))
def _assemble_mesh(
    mesh: SimplicialMesh,
    nodes: Float[Array, "nodes 3"],
    fields: dict[str, Field],
    space: MeshSpace,
    operator: WeakForm,
    curved: bool,
) -> Pencil:
    element = simplex_element(space.dimension, space.degree)
    shape = len(space.cells), element.weights.size
    if curved:
        slopes = jnp.asarray(element.gradients, nodes.dtype)
        frames = mesh._oriented(jnp.einsum("qia,nix->nqxa", slopes, nodes[space.cells], precision="highest"))
        metric = spd.positive_or_nan(jnp.einsum("nqxa,nqxb->nqab", frames, frames, precision="highest"))
    else:
        metric, frames = (jnp.broadcast_to(x[:, None], (*shape, *x.shape[1:])) for x in (mesh.metric, mesh._edges))
    held = {
        name: field.at_points(lambda x: x[space.cells], element.values, shape[:1]) for name, field in fields.items()
    }
    x, seen = (_mesh_points(nodes, space), frames) if operator.own else (None, None)

    def integrals(metric: Array, x: Array | None, frames: Array | None, fields: dict[str, Array]) -> tuple[Array, ...]:
        return element_matrices(metric, element, operator, x, fields, frames)

    stiffness, mass = jax.vmap(integrals)(metric, x, seen, held)
    own = space if operator.components == 1 else vector_space(space, operator.components)
    lumped = volumes = _row_sums(own, mass)
    if "density" in fields:
        volumes = jnp.sqrt(spd.determinant(metric)) @ element.weights.astype(metric.dtype)
    # How far P1 elements err is known from their edges; of P2 no such estimate is.
    sampled = SampledMetric(jax.lax.stop_gradient(mesh.metric), None) if space.degree == 1 else None
    return _pencil(
        _gathered(own, stiffness), _gathered(own, mass), lumped, sampled, jnp.sum(volumes), own, operator, fields
    )


def _gathered(space: MeshSpace | VectorSpace, matrices: Float[Array, "E m m"]) -> SparseOperator:
    """Add up the matrices of all elements."""
    where, slots, pattern = _sparse_pattern(space)
    return SparseOperator(jax.ops.segment_sum(matrices.reshape(-1)[where], slots, pattern.rows.size), pattern)


def _row_sums(space: MeshSpace | VectorSpace, matrices: Float[Array, "E m m"]) -> Float[Array, "*node_shape"]:
    """Return the row sums at all nodes, those to eliminated nodes included."""
    sums = jnp.sum(matrices, axis=-1).ravel()
    return jax.ops.segment_sum(sums, space.cells.ravel(), space.free.size).reshape(space.node_shape)


@lru_cache(maxsize=16)
def _sparse_pattern(space: MeshSpace | VectorSpace) -> tuple[np.ndarray, np.ndarray, SparsePattern]:
    """Return which local entries count (both ends free), the matrix entry that each adds to, and the pattern."""
    n, corners = space.n_dof, space.cells.shape[1]
    cells = space.degrees_of_freedom[space.cells]
    rows, cols = np.repeat(cells, corners, axis=1).ravel(), np.tile(cells, (1, corners)).ravel()
    where = np.flatnonzero((rows >= 0) & (cols >= 0))
    keys, slots = np.unique(rows[where] * n + cols[where], return_inverse=True)
    return where, slots, SparsePattern(n, keys // n, keys % n)
