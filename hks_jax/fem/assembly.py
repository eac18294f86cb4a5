"""From a tensor field or a mesh to a pencil: what is asked for, checked, and assembled on its domain."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Array

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_count
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, normalise_boundary
from hks_jax.fem.elements import Quadrature
from hks_jax.fem.fields import Field, checked_field
from hks_jax.fem.forms import Form, WeakForm, l2, laplace_beltrami
from hks_jax.fem.grid_assembly import assemble_grid, grid_points
from hks_jax.fem.mesh_assembly import assemble_mesh, mesh_nodes, mesh_points
from hks_jax.fem.pencil import AnyPencil, MirrorPencil, Pencil
from hks_jax.fem.space import GridSpace, MeshSpace, grid_space, mesh_space
from hks_jax.linear.operators import PatternedOperator, require_symmetric
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
            signatures cancels (docs/accuracy.md). The mass is consistent, and nodal values are no longer the unknowns
            φ: all signatures read them from ½(I + D⁻¹M)φ, D the row sums of M.

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
        nodes = mesh_nodes(domain, degree, midpoints)
        if degree == 2 and operator.lumped:
            raise ValueError(
                'mass: got "lumped" with degree=2, whose row sums vanish at the vertices; use "consistent"'
            )
        spaces: list[Any] = [mesh_space(domain.triangulation, each, degree) for each in conditions]
        points = partial(mesh_points, nodes, spaces[0])
        at_vertices = (domain.triangulation.n_vertices,)
        given = {
            name: value if callable(value) or np.shape(value)[:1] == at_vertices else domain.restrict(value)
            for name, value in given.items()
        }
        held = _checked_fields(operator, given, spaces[0], points, nodes.dtype)
        operator = operator._replace(checked=not (operator.own and is_traced((domain, held, nodes))))
        curved = midpoints is not None
        pencils = [assemble_mesh(domain, nodes, held, each, operator, curved) for each in spaces]
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
        held = _checked_fields(operator, given, space, partial(grid_points, domain.grid, space, dtype), dtype)
    operator = operator._replace(checked=not (operator.own and is_traced((domain, held))))
    pencils = [assemble_grid(domain, held, each, operator) for each in spaces]
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
    known = not operator.own
    return {
        name: checked_field(name, value, space, points, dtype, scalar=known, positive=known and name == "density")
        for name, value in given.items()
    }


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
