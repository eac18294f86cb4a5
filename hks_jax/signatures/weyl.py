"""Weyl's law: how many eigenvalues there are, from the volume of a domain and of its rim."""

from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.checks import require_real
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.weyl import weyl_number
from hks_jax.fem.pencil import AnyPencil
from hks_jax.fem.rim import rim_measure


def weyl_count(
    problem: Eigenpairs | AnyPencil, values: Any, domain: TensorField | SimplicialMesh | None = None
) -> Float[np.ndarray, " n"]:
    """Return how many eigenvalues lie below each of some numbers, by Weyl's law.

    In 2D N(λ) ≈ (A λ ± L √λ)/4π with the area A, in 3D N(λ) ≈ V λ^(3/2)/6π² ± S λ/16π; plus with the length L or area S
    of the natural part of the rim, minus with that of the Dirichlet part (Ivrii 1980). Where a mask is the domain, its
    rim is the staircase that the elements make: eigenfunctions feel all of it only where √λ times the spacing nears 1.

    Args:
        problem: from `eigenpairs` or `assemble`: volume, dimension and boundary conditions.
        values: (n,) λ ≥ 0, in 1/(metric length)².
        domain: the field or the mesh that the problem is of, for the second term; None: the first alone.

    Returns:
        (n,), on the host.

    Raises:
        ValueError: a negative λ; a domain that the problem is not of.
    """
    pencil = problem.pencil if isinstance(problem, Eigenpairs) else problem
    d = pencil.space.dimension
    volume = pencil.volume if pencil.measured else None
    if volume is None:
        raise ValueError("problem: Weyl's law needs dimension and volume; give them to `sparse_pencil`")
    require_real("values", values)
    numbers = np.asarray(values, np.float64)
    if not (np.isfinite(numbers) & (numbers >= 0)).all():
        raise ValueError(f"values: got {numbers.min()}; expected eigenvalues, finite and not negative")
    if domain is None:
        return weyl_number(numbers, float(volume), d)
    shape = domain.grid.shape if isinstance(domain, TensorField) else (len(domain.vertices),)
    if shape != pencil.space.node_shape:
        raise ValueError(f"domain: got one of shape {shape}; expected that of the problem, {pencil.space.node_shape}")
    # The problems that make up a doubled domain have opposite conditions where it was doubled.
    rim = sum(rim_measure(domain, part.space) for part in pencil.parts)
    return weyl_number(numbers, float(volume), d, rim)
