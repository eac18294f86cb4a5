"""How far the boundary of a domain reaches into its heat kernel signature."""

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
    """Return what part of the heat kernel signature the boundary decides, (k_N − k_D)/(k_N + k_D).

    k_N and k_D are the signatures with natural and with Dirichlet conditions on the whole rim, that of a mask included;
    k_N ≥ k_D. At a distance d from a straight side of a flat domain the ratio is exp(−d²/t): 1 on the rim, 0 where no
    heat has come back from it, whatever conditions are set there.

    Differentiable with respect to the tensors. It takes the eigenpairs of two problems, which are also those of the
    boundary ``"mean"``, whose signature is (k_N + k_D)/2.

    Args:
        domain: the metric, 2D or 3D; or a mesh; or eigenpairs with the boundary ``"mean"``, which hold both problems.
        times: (n_times,) positive, in (metric length)².
        k: how many eigenpairs of either problem; not with eigenpairs.
        boundary: ``"neumann"`` or, the same here, ``"mean"``; on grids also ``"periodic"``, one for all axes or one per
            axis. Not with eigenpairs.
        solver: as for `eigenpairs`.

    Returns:
        (n_times, *shape), 0 … 1, without unit; NaN outside the mask.

    Raises:
        ValueError: another boundary, or other eigenpairs; a domain with no rim, or with no node off it; what
            `eigenpairs` and `hks` refuse.

    Warns:
        AccuracyWarning: as `eigenpairs` and `hks` do.
    """
    if isinstance(domain, Eigenpairs):
        if k is not None or boundary != "neumann":
            raise ValueError("k, boundary: eigenpairs have them already; leave them out")
        if len(domain.pencil.parts) != 2:
            raise ValueError('domain: got eigenpairs of another boundary than "mean"; compute them with that')
        times = resolved_times(domain, times)
        free, zero = (spectral_diagonal(domain.of_part(i), Heat(times)) for i in range(2))
    else:
        if k is None:
            raise ValueError("k: got None; say how many eigenpairs of either problem to compute")
        pencil = assemble(domain, _glued(domain, boundary))
        pairs = (eigenpairs(part, k, solver=solver, multiplet="complete") for part in pencil.parts)
        free, zero = (hks(each, times) for each in pairs)
    # Rounding where both are equal, and truncation where both are small, may leave the interval.
    return jnp.clip((free - zero) / (free + zero), 0, 1)


def _glued(domain: TensorField | SimplicialMesh, boundary: BoundarySpec) -> BoundarySpec:
    """Return the boundary that has the mean on all of the rim."""
    if isinstance(domain, SimplicialMesh):
        if boundary not in ("neumann", "mean"):
            raise ValueError(f'boundary: got {boundary!r}; a mesh takes "neumann" here')
        return "mean"
    sides = normalise_boundary(boundary, domain.grid.dimension)
    if not {condition for pair in sides for condition in pair} <= {"neumann", "mean", "periodic"}:
        raise ValueError(
            f'boundary: got {boundary!r}; expected "neumann" or "periodic" for each axis: natural and Dirichlet '
            "conditions on all sides that are not periodic are compared"
        )
    return tuple("periodic" if pair == ("periodic", "periodic") else "mean" for pair in sides)
