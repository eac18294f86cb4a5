"""Weyl's law: estimates of eigenvalue counts from the volume of a domain and the measure of its boundary."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.checks import require_real, require_static
from hks_jax.domain.components import wrap_nodes
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.domain.triangulation import FACETS
from hks_jax.eigen.eigenpairs import Eigenpairs, require_pairs
from hks_jax.fem.pencil import AnyPencil, MirrorPencil, Pencil
from hks_jax.fem.space import FunctionSpace, GridSpace, MeshSpace


def weyl(count: float, volume: Any, dimension: int) -> Any:
    """Estimate the eigenvalue with the index ``count``, by the first term of `weyl_number`."""
    constant = 4 * math.pi if dimension == 2 else (6 * math.pi**2) ** (2 / 3)
    return constant * (count / volume) ** (2 / dimension)


def weyl_number(values: Any, volume: float, dimension: int, rim: float = 0.0) -> Any:
    """Estimate the number of eigenvalues below λ ≥ 0; see `weyl_count`, and `rim_measure` for ``rim``."""
    if dimension == 2:
        return (volume * values + rim * values**0.5) / (4 * math.pi)
    return volume * values**1.5 / (6 * math.pi**2) + rim * values / (16 * math.pi)


def weyl_count(
    problem: Eigenpairs | AnyPencil, values: Any, domain: TensorField | SimplicialMesh | None = None
) -> Float[np.ndarray, " n"]:
    """Estimate the number of eigenvalues below each of several values, by Weyl's law.

    In 2D, N(λ) ≈ (A λ ± L √λ)/4π, where A is the area and L is the length of the boundary. In 3D, N(λ) ≈ V λ^(3/2)/6π²
    ± S λ/16π, where V is the volume and S is the area of the boundary. The boundary term is positive for a natural
    boundary, and negative for a Dirichlet boundary (Ivrii 1980). For a mask, L or S is the measure of a staircase of
    element faces, whose steps eigenfunctions resolve only if √λ times the node spacing is close to 1.

    Args:
        problem: the result of `eigenpairs` or `assemble`, which has volume, dimension and boundary conditions.
        values: (n,) λ ≥ 0, in 1/(metric length)².
        domain: the field or mesh of the problem, from which the boundary term is computed; None omits this term.

    Returns:
        (n,) estimates, as a NumPy array.

    Raises:
        ValueError: λ is negative; the problem has a potential, or no volume; the domain does not belong to the problem.

    Examples:
        >>> print(hj.weyl_count(pairs, [20 * np.pi]).round(1))  # area · λ/4π
        [10.]
    """
    pencil = require_pairs(problem).pencil if isinstance(problem, Eigenpairs) else problem
    if not isinstance(pencil, Pencil | MirrorPencil):
        raise TypeError(f"problem: got {type(problem).__name__}; expected the result of `eigenpairs` or `assemble`")
    d = pencil.space.dimension
    volume = pencil.volume if pencil.measured else None
    if volume is None:
        raise ValueError("problem: got matrices without dimension or volume; give `sparse_pencil` both numbers")
    if any(part.has_potential for part in pencil.parts):
        raise ValueError("problem: got an operator with a potential, which Weyl's law omits; use `count_eigenvalues`")
    require_static("values", values)
    require_static("problem", volume)
    require_real("values", values)
    numbers = np.asarray(values, np.float64)
    if not (np.isfinite(numbers) & (numbers >= 0)).all():
        raise ValueError(f"values: got {numbers.min()}; expected finite, nonnegative numbers")
    if not isinstance(domain, TensorField | SimplicialMesh | None):
        raise TypeError(f"domain: got {type(domain).__name__}; expected a TensorField or a mesh")
    if domain is None:
        return weyl_number(numbers, float(volume), d)
    shape = domain.grid.shape if isinstance(domain, TensorField) else (len(domain.vertices),)
    nodes = pencil.space.node_shape
    if isinstance(pencil.space, MeshSpace):  # elements of degree 2 have more nodes than vertices
        nodes = (pencil.space.triangulation.n_vertices,)
    if shape != nodes:
        raise ValueError(f"domain: got shape {shape}; expected the problem's shape {nodes}")
    # The parts of a doubled domain have opposite conditions on the boundary where the domain was doubled.
    rim = sum(rim_measure(domain, part.space) for part in pencil.parts)
    return weyl_number(numbers, float(volume), d, rim)


def rim_measure(domain: TensorField | SimplicialMesh, space: FunctionSpace) -> float:
    """Return the metric length (area in 3D) of the natural boundary minus the length of the Dirichlet boundary."""
    if not isinstance(domain, SimplicialMesh):
        assert isinstance(space, GridSpace)
        return sum(_grid_rim(domain, space, axis) for axis in range(space.dimension))
    d, triangulation = space.dimension, domain.triangulation
    cell, corner = np.divmod(triangulation.boundary_facets, d + 1)
    corners = np.concatenate([np.zeros((1, d)), np.eye(d)])[FACETS[d][corner]]  # in the basis of the cell's edges
    steps = corners[:, 1:] - corners[:, :1]
    gram = np.einsum("fia,fab,fjb->fij", steps, np.asarray(domain.metric, np.float64)[cell], steps)
    measure = float(np.sqrt(np.linalg.det(gram)).sum()) / math.factorial(d - 1)
    return -measure if "dirichlet" in space.boundary[0] else measure


def _grid_rim(field: TensorField, space: GridSpace, axis: int) -> float:
    """Return the signed measure of the faces normal to one axis that belong to exactly one element."""
    d, spacing = space.dimension, field.grid.spacing
    others = [a for a in range(d) if a != axis]
    tensors = np.asarray(field.domain_tensors, np.float64)[..., others, :][..., others]
    density = wrap_nodes(np.sqrt(np.linalg.det(tensors)), space.periodic)
    # Integrate over each face by the trapezoidal rule in the other axes; along ``axis``, entries remain nodal values.
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
    sign = np.full(faces.size, -1.0 if "dirichlet" in space.boundary[-1] else 1.0)
    if not space.periodic[axis]:
        sign[[0, -1]] = [-1 if condition == "dirichlet" else 1 for condition in space.boundary[axis]]
    return float(faces @ sign)
