"""The problems of a domain: a function space, or several if the boundary conditions double the domain."""

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, normalise_boundary
from hks_jax.fem.space import GridSpace, MeshSpace, grid_space, mesh_space

MESH_BOUNDARIES = ("neumann", "dirichlet", "mean")


def problems_of(
    domain: TensorField | SimplicialMesh, boundary: BoundarySpec, degree: int
) -> list[GridSpace] | list[MeshSpace]:
    """Return the function space of each problem; the first one contains the functions of all problems.

    Raises:
        ValueError: an unknown boundary condition; ``"mirror"`` or ``"mean"`` for a domain that it does not double.

    Warns:
        AccuracyWarning: the mask does not reach the sides of the grid on which ``"dirichlet"`` acts.
    """
    spaces: list[GridSpace] | list[MeshSpace]
    if isinstance(domain, SimplicialMesh):
        if boundary not in MESH_BOUNDARIES:
            raise ValueError(f"boundary: got {boundary!r}; expected one of {', '.join(map(repr, MESH_BOUNDARIES))}")
        conditions = ("neumann", "dirichlet") if boundary == "mean" else (str(boundary),)
        spaces, mirrored = [mesh_space(domain.triangulation, each, degree) for each in conditions], False
    else:
        sides = normalise_boundary(boundary, domain.grid.dimension)
        spaces = [grid_space(domain.grid, problem) for problem in doubled_problems(sides)]
        mirrored = any("mirror" in pair for pair in sides)
        if any("dirichlet" in pair for pair in sides) and (spaces[0].free == spaces[0].domain).all():
            where = (
                "acts on the sides of the grid, which the mask does not reach. For the rim of the mask pass "
                '"dirichlet-rim"'
                if sides[-1] == ("neumann", "neumann")
                else "acts nowhere: there is no mask, and so no rim. Leave this condition out"
            )
            warn_of_accuracy(f'boundary: got {boundary!r}, but "dirichlet" {where}')
    if len(spaces) > 1 and spaces[0].n_dof == spaces[-1].n_dof:  # all problems are the same
        raise ValueError(
            'boundary: got "mirror", but the mask reaches no side of the grid, where the mirrors are. Pass "mean" '
            "for the rim of the mask"
            if mirrored
            else 'boundary: got "mean", but the domain has no rim; pass "neumann"'
        )
    return spaces
