"""The least squares problem of a fit: from unknowns to a field, its eigenpairs, its signature, and the residuals."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.driver import eigenpairs
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.solver import Eigensolver
from hks_jax.eigen.weyl import weyl_count
from hks_jax.fem.pencil import AnyPencil
from hks_jax.inverse.observation import Observation
from hks_jax.inverse.regulariser import Regulariser
from hks_jax.inverse.single_precision import residuals_of
from hks_jax.inverse.unknowns import Unknowns, Values
from hks_jax.signatures.truncation import resolving

TAIL = 1e-6
"""What part of the heat trace at the smallest time may lie beyond the pairs that are computed."""
_LOST = 0.05
"""What part makes a time unresolvable."""


class Problem(eqx.Module):
    """Residuals as a function of the unknowns.

    Attributes:
        unknowns: what varies.
        observation: what is to be matched.
        regularisers: penalties.
        k: eigenpairs.
        boundary: boundary conditions.
        solver: eigensolver.
    """

    unknowns: Unknowns
    observation: Observation
    regularisers: tuple[Regulariser, ...]
    k: int = eqx.field(static=True)
    boundary: Any = eqx.field(static=True)
    solver: str | Eigensolver = eqx.field(static=True)

    def pairs(self, values: Values) -> Eigenpairs:
        """Return the eigenpairs of the field that the values stand for."""
        return self._pairs_of(self.unknowns.field(values))

    def _pairs_of(self, field: TensorField) -> Eigenpairs:
        # Of a multiplet that k cuts, the derivative exists only with all of its copies, or none.
        return eigenpairs(field, self.k, self.boundary, self.solver, multiplet="complete")

    def residuals(self, values: Values) -> tuple[Float[Array, " m"], Float[Array, " r"]]:
        """Return the residuals of the data and those of the penalties: half the sum of squares is the loss."""
        return self.residuals_and_pairs(values)[:2]

    def residuals_and_pairs(self, values: Values) -> tuple[Float[Array, " m"], Float[Array, " r"], Eigenpairs]:
        """Return the residuals, and the eigenpairs from which they were computed."""
        field = self.unknowns.field(values)
        pairs = self._pairs_of(field)
        data = residuals_of(self.observation, pairs, self.solver)
        penalties = [each.residuals(self.unknowns, values, field) for each in self.regularisers]
        return data, jnp.concatenate([jnp.zeros(0, data.dtype), *penalties]), pairs


def losses_of(data: Float[Array, " m"], penalties: Float[Array, " r"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the loss, and the misfit, which is the part of the data."""
    misfit = jnp.sum(data**2) / 2
    return misfit + jnp.sum(penalties**2) / 2, misfit


def pairs_below(eigenvalue: float, pencil: AnyPencil, field: TensorField) -> int:
    """Return about how many eigenvalues lie below one, by Weyl's law, and some more."""
    return math.ceil(1.1 * float(weyl_count(pencil, [eigenvalue], field)[0])) + 4


def require_resolved(wanted: int, n_dof: int, what: str, remedy: str) -> None:
    """Warn where more eigenpairs are wanted than are near to those of the manifold; refuse more than twice as many.

    A fit may come to a metric of more volume, which takes more of them, and must be able to begin there.
    """
    most = _most_pairs(n_dof)
    if wanted <= most:
        return
    message = (
        f"times: got {what} about {wanted} eigenpairs; with {n_dof} unknowns {most} are near enough to those of the "
        f"manifold to be fitted. Use {remedy}"
    )
    if wanted > min(2 * most, n_dof):
        raise ValueError(message)
    warn_of_accuracy(message)


def pairs_for(times: Any, pencil: AnyPencil, field: TensorField) -> int:
    """Return how many eigenpairs resolve the smallest time to `TAIL`: all, if that many are needed.

    Raises:
        ValueError: the grid does not resolve that time.
    """
    smallest, n_dof, d = float(np.min(np.asarray(times))), unknowns_of(pencil), pencil.space.dimension

    def count(tail: float) -> int:
        return pairs_below(resolving(tail, d) / smallest, pencil, field)

    needed = count(_LOST)
    least = smallest * (needed / _most_pairs(n_dof)) ** (2 / d)
    remedy = f"times from about {least:.3g}, or a finer grid"
    require_resolved(needed, n_dof, f"{smallest:.4g}, which takes", remedy)
    return min(count(TAIL), n_dof)


def _most_pairs(n_dof: int) -> int:
    return max(n_dof // 4, min(n_dof, 20))


def unknowns_of(pencil: AnyPencil) -> int:
    """Return how many eigenpairs there are."""
    return sum(part.space.n_dof for part in pencil.parts)
