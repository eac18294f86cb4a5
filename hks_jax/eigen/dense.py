"""All eigenpairs by dense linear algebra: the reference for every other solver."""

from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.checks import require_number
from hks_jax.eigen.solver import Eigensolver, RawPairs, Report, silent
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.standard_form import pencil_eigh


class Dense(Eigensolver[SymmetricPencil]):
    """Cholesky reduction M = LLᵀ to L⁻¹KL⁻ᵀ, then `eigh`: O(n³) time, O(n²) memory, exact multiplicities."""

    name: ClassVar[str] = "dense"
    tolerance: float = eqx.field(default=1e-8, static=True)

    def __check_init__(self) -> None:
        """Check the settings."""
        require_number("tolerance", self.tolerance, 1)

    def lowest(self, pencil: SymmetricPencil, k: int, report: Report = silent) -> RawPairs:
        """Return the k lowest eigenpairs."""
        return _dense(pencil.stiffness.to_dense(), pencil.mass.to_dense(), k)

    def guards(self, k: int, n_dof: int) -> int:
        """Return all the pairs beyond k: they cost nothing, and leave no complement to solve on."""
        return n_dof - k


@partial(jax.jit, static_argnames="k")
def _dense(stiffness: Float[Array, "n n"], mass: Float[Array, "n n"], k: int) -> RawPairs:
    values, vectors = pencil_eigh(stiffness, mass, k)
    return values, vectors.T, jnp.asarray(jnp.inf, values.dtype)
