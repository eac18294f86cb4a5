"""How far the boundary of a domain reaches into its heat kernel signature."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.solve import eigenpairs
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.assembly import assemble
from hks_jax.fem.boundary import BoundarySpec, normalise_boundary
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.rim import pin_rim
from hks_jax.signatures.heat import hks_of_pairs


def boundary_influence(
    field: TensorField,
    times: Any,
    k: int,
    boundary: BoundarySpec = "neumann",
    solver: str | Eigensolver = "auto",
) -> Float[Array, "n_times *shape"]:
    """Return what part of the heat kernel signature the boundary decides, (k_N − k_D)/(k_N + k_D).

    k_N and k_D are the signatures with natural and with Dirichlet conditions on the whole rim, that of a mask included;
    k_N ≥ k_D. At a distance d from a straight side of a flat domain the ratio is exp(−d²/t): 1 on the rim, 0 where no
    heat has come back from it, whatever conditions are set there.

    Differentiable with respect to the tensors. It takes the eigenpairs of two problems.

    Args:
        field: the metric, 2D or 3D.
        times: (n_times,) positive, in (metric length)².
        k: how many eigenpairs of either problem.
        boundary: ``"neumann"`` or ``"periodic"``, one for all axes or one per axis.
        solver: as for `eigenpairs`.

    Returns:
        (n_times, *shape), 0 … 1, without unit; NaN outside the mask.

    Raises:
        ValueError: another boundary; a domain with no rim, or with no node off it; what `eigenpairs` and `hks` refuse.

    Warns:
        AccuracyWarning: as `eigenpairs` and `hks` do.
    """
    sides = normalise_boundary(boundary, field.grid.dimension)
    if any(condition not in ("neumann", "periodic") for pair in sides for condition in pair):
        raise ValueError(
            f'boundary: got {boundary!r}; expected "neumann" or "periodic" for each axis: natural and Dirichlet '
            "conditions on all sides that are not periodic are compared"
        )
    natural = assemble(field, boundary)
    assert isinstance(natural, Pencil)
    pinned = pin_rim(natural)
    if pinned.space.n_dof == natural.space.n_dof:
        raise ValueError(f"boundary: got {boundary!r}; the domain has no rim whose influence could be seen")
    pairs = (eigenpairs(pencil, k, solver=solver, multiplet="complete") for pencil in (natural, pinned))
    free, zero = (hks_of_pairs(each, times) for each in pairs)
    # Rounding where both are equal, and truncation where both are small, may leave the interval.
    return jnp.clip((free - zero) / (free + zero), 0, 1)
