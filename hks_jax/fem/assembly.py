"""Assembly of the matrix pencil of an operator on a tensor field or a mesh, with checks of all arguments."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import describe_array
from hks_jax.checks import real_array, require_count
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.elements import Quadrature
from hks_jax.fem.fields import checked_field
from hks_jax.fem.forms import Form, WeakForm, l2, laplace_beltrami
from hks_jax.fem.integrals import assemble_grid, assemble_mesh, grid_points, mesh_points
from hks_jax.fem.pencil import AnyPencil, MirrorPencil, Pencil
from hks_jax.fem.problems import problems_of
from hks_jax.linear.operators import PatternedOperator, require_symmetric
from hks_jax.traced import is_traced

MassKind = Literal["consistent", "lumped"]


def assemble(
    domain: TensorField | SimplicialMesh,
    boundary: BoundarySpec = "neumann",
    mass: MassKind = "consistent",
    *,
    potential: Any = None,
    density: Any = None,
    degree: int = 1,
    midpoints: Any = None,
    quadrature: Quadrature = "gauss",
) -> AnyPencil:
    """Assemble the generalized eigenproblem Kφ = λMφ of the domain's operator.

    With the metric T and the basis functions hᵢ, K_ij = ∫ √|T| T⁻¹∇hᵢ·∇hⱼ dx and M_ij = ∫ √|T| hᵢhⱼ dx (Zobel,
    Reininghaus and Hotz, section 3). A domain with ``operator="fick"`` has K_ij = ∫ D∇hᵢ·∇hⱼ dx and M_ij = ∫ hᵢhⱼ dx,
    where dx replaces the volume element √|T| dx everywhere below, and D = T⁻¹ is interpolated. On grids the elements
    are Q1 with 2^d Gauss points, and T or its logarithm is interpolated multilinearly (see `TensorField`). On meshes
    the elements are P1 or P2, and T is constant on each cell. `assemble_forms` assembles operators of your own.

    A *field* is a number, an array over the nodes, an array over the elements, or a function of position that JAX can
    trace. An array over the nodes, (*shape) or (V,), is interpolated. An array over the elements has n − 1 entries
    along a grid axis of n nodes (n if the axis is periodic), or an entry for each cell of a mesh. An array whose shape
    fits nodes and elements is taken as nodal.

    Args:
        domain: a tensor field, a `SurfaceMesh` or a `TetMesh`.
        boundary: ``"neumann"`` (natural), ``"dirichlet"`` (φ = 0: these nodes are eliminated), ``"periodic"`` (node n
            is node 0, so the period is n times the spacing), ``"mirror"`` (the domain is reflected on every side) or
            ``"mean"`` (two copies of the domain are glued along the whole rim). On grids give one name for all axes, or
            one entry per axis, which may be a pair (low, high) of ``"neumann"``, ``"dirichlet"`` and ``"mean"``. The
            condition on the rim of a mask is natural, except with ``"mean"`` and ``"dirichlet-rim"``, which act on the
            rim and on all sides. A further entry after those of the axes sets the condition on the rim: ``("periodic",
            "periodic", "dirichlet")``. On meshes ``"neumann"``, ``"dirichlet"`` and ``"mean"`` act on the boundary.
        mass: ``"consistent"``, or ``"lumped"`` (the diagonal matrix of row sums).
        potential: a field V of either sign; the operator becomes −Δ + V.
        density: a positive field ρ; the operator becomes −ρ⁻¹ div(ρ ∇·), in L² with the volume element ρ√|T| dx. With
            Fick's operator it is −ρ⁻¹ div(ρD∇·), with the volume element ρ dx.
        degree: 1 or, on meshes, 2. For degree 2, nodal arrays have the values at the V vertices, followed by the values
            at the midpoints of the edges ``domain.triangulation.edges``.
        midpoints: for degree 2, the positions (E, 3) of the edges' midpoints, which curve the edges; or a function from
            the midpoint of a straight edge to its new position. On a `TetMesh` the function moves boundary edges only.
        quadrature: ``"gauss"`` or, on grids, ``"cancelling"``: points for which the leading error of heat kernel
            signatures cancels (docs/accuracy.md). With ``"cancelling"``, the mass is consistent, and the unknowns φ are
            not nodal values: signatures compute nodal values as ½(I + D⁻¹M)φ, where the diagonal matrix D holds the row
            sums of M.

    Returns:
        The pencil (stiffness, mass). With ``"mirror"`` and ``"mean"`` the result is the `MirrorPencil` of the problems
        into which the doubled domain decomposes. With a potential, the null space is not known.

    Raises:
        ValueError: an unknown boundary, mass, degree or quadrature; a domain without elements or free nodes; ``"mean"``
            without a rim or without inner nodes; a field that has another shape or contains NaN; a density that is not
            positive; ``"cancelling"`` with a mesh or a lumped mass.

    Warns:
        AccuracyWarning: a Dirichlet condition holds at no node of the domain.

    Examples:
        >>> pencil, one = hj.assemble(field), jnp.ones(81)
        >>> print((pencil.mass @ one).sum().round(1), jnp.abs(pencil.stiffness @ one).max().round(3))  # area; K1 = 0
        2.0 0.0
    """
    if mass not in get_args(MassKind):
        forms = ". `assemble_forms` takes a form of your own" * callable(mass)
        raise ValueError(f'mass: got {mass!r}; expected "consistent" or "lumped"{forms}')
    if quadrature not in get_args(Quadrature):
        raise ValueError(f'quadrature: got {quadrature!r}; expected "gauss" or "cancelling"')
    if quadrature == "cancelling":
        for what, is_given in (
            ("a mesh, for which no cancelling points are known", isinstance(domain, SimplicialMesh)),
            ("a lumped mass, for which no cancelling points exist", mass == "lumped"),
        ):
            if is_given:
                raise ValueError(f'quadrature: got "cancelling" with {what}; expected "gauss"')
    given = {name: value for name, value in (("potential", potential), ("density", density)) if value is not None}
    operator = WeakForm(laplace_beltrami, l2, mass == "lumped", cancelling=quadrature == "cancelling")
    return _assembled(domain, boundary, operator, given, degree, midpoints)


def assemble_forms(
    domain: TensorField | SimplicialMesh,
    stiffness: Form = laplace_beltrami,
    mass: MassKind | Form = "consistent",
    boundary: BoundarySpec = "neumann",
    *,
    fields: Mapping[str, Any] | None = None,
    components: int = 1,
    degree: int = 1,
    midpoints: Any = None,
) -> AnyPencil:
    """Assemble the generalized eigenproblem Kφ = λMφ of weak forms of your own.

    A form is a function ``form(u, v, w)`` that is linear in u and in v and returns one number, which is integrated with
    the volume element √|T| dx (dx for a domain with ``operator="fick"``). The shape functions u and v have ``.value``
    and ``.grad``. The point w has the metric ``.metric`` (d, d), its inverse ``.inverse``, the position ``.x`` and the
    fields ``w["name"]``. On meshes, gradients and metric have components along the axes of space; on a surface,
    gradients and metric are tangential. Define a form once: each new function is compiled anew (docs/operators.md).

    Args:
        domain: a tensor field, a `SurfaceMesh` or a `TetMesh`.
        stiffness: the form of K, by default that of the Laplace–Beltrami operator.
        mass: the form of M; or ``"consistent"`` or ``"lumped"``, as in `assemble`.
        boundary: as in `assemble`.
        fields: the fields that the forms read, by name (see `assemble`); they may have further axes after those of
            nodes or elements.
        components: the number c of components of a function. For c > 1, as in elasticity, ``u.value`` is (c,),
            ``u.grad`` is (c, d) with ``grad[i, j]`` = ∂uᵢ/∂xⱼ, and results have an axis of length c after those of the
            nodes.
        degree: as in `assemble`.
        midpoints: as in `assemble`.

    Returns:
        The pencil (stiffness, mass), as in `assemble`. Its null space is not known.

    Raises:
        ValueError: the errors of `assemble`; a form that does not return one number, is not linear, or has an
            unsymmetric matrix (the message has the entry).

    Warns:
        AccuracyWarning: a Dirichlet condition holds at no node of the domain.

    Examples:
        >>> def energy(u, v, w):
        ...     return u.grad @ w.inverse @ v.grad + w["V"] * u.value * v.value
        >>> own, built_in = hj.assemble_forms(field, energy, fields={"V": 2.0}), hj.assemble(field, potential=2.0)
        >>> print(jnp.abs(own.stiffness.to_dense() - built_in.stiffness.to_dense()).max() < 1e-6)
        True
    """
    if mass not in get_args(MassKind) and not callable(mass):
        raise ValueError(f'mass: got {mass!r}; expected "consistent", "lumped" or a form')
    if not callable(stiffness):
        raise ValueError(f"stiffness: got {type(stiffness).__name__}; expected a form: a function of u, v and w")
    for name, form in (("stiffness", stiffness), ("mass", mass)):
        if is_traced([cell.cell_contents for cell in getattr(form, "__closure__", None) or ()]):
            raise ValueError(f"{name}: the form closes over traced arrays or numbers; pass all of them as fields={{…}}")
    require_count("components", components)
    if components > 1 and stiffness is laplace_beltrami:
        raise ValueError("stiffness: got none with components > 1; expected a form for vector-valued functions")
    if not isinstance(fields, Mapping | None):
        raise ValueError(f"fields: got {describe_array(fields)}; expected a dictionary {{name: array}}")
    operator = WeakForm(stiffness, mass if callable(mass) else l2, mass == "lumped", components, custom=True)
    return _assembled(domain, boundary, operator, dict(fields or {}), degree, midpoints)


def _on_each(
    pencil_on: Callable[..., Pencil], fields: dict[str, Any], spaces: Sequence[Any], operator: WeakForm
) -> list[Pencil]:
    return [pencil_on(fields, space, operator) for space in spaces]


def _assembled(
    domain: TensorField | SimplicialMesh,
    boundary: BoundarySpec,
    operator: WeakForm,
    given: dict[str, Any],
    degree: int,
    midpoints: Any,
) -> AnyPencil:
    """Return the pencil of forms that read the given fields."""
    operator = operator._replace(fick=getattr(domain, "operator", None) == "fick")
    points: Callable[..., Any]
    if isinstance(domain, SimplicialMesh):
        nodes = _mesh_nodes(domain, degree, midpoints)
        if degree == 2 and operator.lumped:
            raise ValueError(
                'mass: got "lumped" with degree=2, where row sums at the vertices are not positive. Use "consistent"'
            )
        points, dtype = partial(mesh_points, nodes), nodes.dtype
        pencil_on = partial(assemble_mesh, domain, nodes, midpoints is not None)
        pencils_on: Callable[..., list[Pencil]] = partial(_on_each, pencil_on)
    else:
        if not isinstance(domain, TensorField):
            raise TypeError(f"domain: got {type(domain).__name__}; expected a TensorField, a SurfaceMesh or a TetMesh")
        if domain._tensors is not None and domain._tensors.ndim > domain.grid.dimension + 2:
            raise ValueError("domain: got a batch of tensor fields; expected one field. Map over the batch by jax.vmap")
        if degree != 1 or midpoints is not None:
            got = f"degree {degree!r} and {'no' if midpoints is None else 'some'} midpoints"
            raise ValueError(f"degree, midpoints: got {got} for a grid, whose elements are Q1; leave both out")
        if operator.components > 1 and "mirror" in str(boundary):
            raise ValueError('boundary: got "mirror" with components; only scalar functions support "mirror"')
        nodes, dtype = None, domain.tensors.dtype
        points, pencils_on = partial(grid_points, domain.grid, dtype=dtype), partial(assemble_grid, domain)
    spaces = problems_of(domain, boundary, degree)
    built_in, held = not operator.custom, {}
    for name, value in given.items():
        settings = {"scalar": built_in, "positive": built_in and name == "density"}
        if isinstance(domain, SimplicialMesh) and not callable(value):
            # The place is known from the shape before cells are removed: afterwards there may be as many as vertices.
            at_nodes = ((domain.triangulation.n_vertices,), spaces[0].node_shape)
            settings["of_cells"] = np.shape(value)[:1] not in at_nodes
            value = domain.restrict(value) if settings["of_cells"] else value
        held[name] = checked_field(name, value, spaces[0], partial(points, spaces[0]), dtype, **settings)
    operator = operator._replace(checked=built_in or not is_traced((domain, held, nodes)))
    pencils = pencils_on(held, spaces, operator)
    if midpoints is not None and not is_traced(pencils) and np.isnan(pencils[0].mass.diagonal()).any():
        raise ValueError("midpoints: got positions that fold or invert cells; move them closer to the straight edges")
    if operator.custom and operator.checked:
        for name in ("stiffness", "mass"):
            matrix = getattr(pencils[0], name)
            if isinstance(matrix, PatternedOperator):
                require_symmetric(name, *matrix.triplets(), matrix.size, "Make the form symmetric in u and v")
    return pencils[0] if len(pencils) == 1 else MirrorPencil(tuple(pencils))


def _mesh_nodes(mesh: SimplicialMesh, degree: int, midpoints: Any) -> Float[Array, "nodes 3"]:
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
