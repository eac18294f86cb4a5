"""The influence of a domain's boundary on its heat kernel signature."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.arrays import nan_is_meant
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.driver import eigenpairs
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.assembly import assemble
from hks_jax.fem.boundary import BoundarySpec, normalise_boundary
from hks_jax.signatures.filters import Heat
from hks_jax.signatures.hks import hks
from hks_jax.signatures.spectral_functions import spectral_diagonal
from hks_jax.signatures.truncation import resolved_times


@nan_is_meant
def boundary_influence(
    domain: TensorField | SimplicialMesh | Eigenpairs,
    times: Any,
    k: int | None = None,
    boundary: BoundarySpec = "neumann",
    solver: str | Eigensolver = "auto",
) -> Float[Array, "n_times *shape"]:
    """Return the share of the heat kernel signature that is due to the boundary, (k_N − k_D)/(k_N + k_D).

    Here k_N ≥ k_D are the signatures with Neumann and with Dirichlet conditions on the whole boundary, also that of a
    mask. At a distance d from a straight side of a flat domain the ratio is exp(−d²/t). It is 1 on the boundary and 0
    where the boundary has no effect yet, whatever its conditions are; NaN outside the mask.

    The result is differentiable with respect to the tensors. Two problems are solved for eigenpairs. Together they are
    the problem with the boundary ``"mean"``, whose signature is (k_N + k_D)/2.

    Args:
        domain: a metric in 2D or 3D, a mesh, or eigenpairs with the boundary ``"mean"``, which contain both problems.
        times: (n_times,) positive, in (metric length)².
        k: the number of eigenpairs of each problem; to be omitted if eigenpairs are given.
        boundary: ``"neumann"`` or ``"mean"``, which are equivalent here. Grids also accept ``"periodic"``, as one value
            for all axes or one per axis. To be omitted if eigenpairs are given.
        solver: the same as for `eigenpairs`.

    Raises:
        ValueError: if the boundary is invalid, if no or every node lies on it, or as in `eigenpairs` and `hks`.

    Warns:
        AccuracyWarning: as in `eigenpairs` and `hks`.

    Examples:
        >>> influence = hj.boundary_influence(field, [0.2], k=12)[0]
        >>> print(influence[0, 0], influence[4, 4] < 1)
        1.0 True
    """
    if isinstance(domain, Eigenpairs):
        if k is not None or boundary != "neumann":
            raise ValueError("k, boundary: got values for eigenpairs, which determine both; omit these arguments")
        if len(domain.pencil.parts) != 2:
            raise ValueError('domain: got eigenpairs of another boundary; compute them with boundary="mean"')
        times = resolved_times(domain, times)
        free, zero = (spectral_diagonal(domain.of_part(i), Heat(times)) for i in range(2))
    else:
        if k is None:
            raise ValueError("k: got None; expected the number of eigenpairs to compute for each of the two problems")
        pencil = assemble(domain, _glued(domain, boundary))
        pairs = (eigenpairs(part, k, solver=solver, multiplet="complete") for part in pencil.parts)
        free, zero = (hks(each, times) for each in pairs)
    # Rounding, where both are nearly equal, and truncation, where both are small, may cause values outside [0, 1].
    return jnp.clip((free - zero) / (free + zero), 0, 1)


def _glued(domain: TensorField | SimplicialMesh, boundary: BoundarySpec) -> BoundarySpec:
    """Return the boundary conditions with "mean" on every side that is not periodic."""
    if isinstance(domain, SimplicialMesh):
        if boundary not in ("neumann", "mean"):
            raise ValueError(f'boundary: got {boundary!r}; expected "neumann" for a mesh')
        return "mean"
    sides = normalise_boundary(boundary, domain.grid.dimension)
    if not {condition for pair in sides for condition in pair} <= {"neumann", "mean", "periodic"}:
        raise ValueError(
            f'boundary: got {boundary!r}; expected "neumann" or "periodic" for each axis. Neumann and Dirichlet '
            "conditions are compared on all sides that are not periodic"
        )
    return tuple("periodic" if pair == ("periodic", "periodic") else "mean" for pair in sides)
