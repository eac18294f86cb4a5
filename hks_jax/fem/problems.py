"""The problems of a domain: a function space, or several if the boundary conditions double the domain."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, sides_of
from hks_jax.fem.space import FunctionSpace, GridSpace, MeshSpace, grid_space, mesh_space

MESH_BOUNDARIES = ("neumann", "dirichlet", "mean")

S = TypeVar("S", bound=FunctionSpace)


def problems_of(
    domain: TensorField | SimplicialMesh, boundary: BoundarySpec, degree: int
) -> list[GridSpace] | list[MeshSpace]:
    """Return the function space of each problem; the first one contains the functions of all problems.

    Raises:
        ValueError: an unknown boundary condition; ``"mirror"`` or ``"mean"`` for a domain that it does not double, or
            that has no inner nodes.

    Warns:
        AccuracyWarning: a condition has no effect (`sides_of`).
    """
    spaces: list[GridSpace] | list[MeshSpace]
    if isinstance(domain, SimplicialMesh):
        if boundary not in MESH_BOUNDARIES:
            raise ValueError(f"boundary: got {boundary!r}; expected one of {', '.join(map(repr, MESH_BOUNDARIES))}")
        conditions = ("neumann", "dirichlet") if boundary == "mean" else (str(boundary),)
        spaces = _spaces(lambda condition: mesh_space(domain.triangulation, condition, degree), conditions, boundary)
        mirrored = False
    else:
        sides = sides_of(domain.grid, boundary)
        problems, mirrored = doubled_problems(sides), any("mirror" in pair for pair in sides)
        spaces = _spaces(lambda problem: grid_space(domain.grid, problem), problems, boundary)
    if len(spaces) > 1 and spaces[0].n_dof == spaces[-1].n_dof:  # all problems are the same
        raise ValueError(
            'boundary: got "mirror", but the mask reaches no side of the grid, where the mirrors are. Pass "mean" '
            "for the rim of the mask"
            if mirrored
            else 'boundary: got "mean", but the domain has no rim; pass "neumann"'
        )
    return spaces


def _spaces(space_of: Callable[[Any], S], problems: Sequence[Any], boundary: BoundarySpec) -> list[S]:
    """Return the space of each problem; raise ValueError if only the first problem has free nodes."""
    first = space_of(problems[0])
    try:
        return [first, *map(space_of, problems[1:])]
    except ValueError as error:  # the functions of these problems vanish on the rim or at mirrors
        raise ValueError(
            f"boundary: got {boundary!r}, but all nodes of the domain are on its rim or sides; the conditions "
            '"mean" and "mirror" need inner nodes. Pass "neumann", or use a finer grid or mesh, or a thicker mask'
        ) from error
