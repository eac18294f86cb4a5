"""The signatures that a fit can match: their values for given eigenpairs, and how many eigenpairs they take."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_number
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.weyl import weyl_count
from hks_jax.fem.pencil import AnyPencil
from hks_jax.signatures.hks import hks
from hks_jax.signatures.kernels import heat_trace, wks
from hks_jax.signatures.truncation import resolving, truncation, truncation_map

TAIL = 1e-6
"""The share of the heat trace at the smallest time that may lie beyond the computed pairs."""
_LOST = 0.05
"""The share beyond all useful pairs that makes a time unresolvable."""


class Signature(eqx.Module):
    """A function of eigenpairs that a fit can match.

    Attributes:
        function: of the eigenpairs, then of the times or energies and of sigma where there are any.
        symbol: the symbol of a further argument: ``"t"`` for times, ``"e"`` for energies, empty for none.
        at_nodes: whether it has a value for each node.
        left_out: estimates the share of it that lies beyond the eigenpairs, from these and the times; None: the pairs
            that are computed define it.
        lowest: whether it is the lowest eigenvalues, as many as the target has.
        sigma: the width of wave kernels.
    """

    function: Callable[..., Array] = eqx.field(static=True)
    symbol: str = eqx.field(static=True, default="")
    at_nodes: bool = eqx.field(static=True, default=False)
    left_out: Callable[..., Array] | None = eqx.field(static=True, default=None)
    lowest: bool = eqx.field(static=True, default=False)
    sigma: Array | None = None

    def predict(self, pairs: Eigenpairs, times: Float[Array, " n"] | None) -> Array:
        """Return the signature of the pairs."""
        sigma = None if self.sigma is None or times is None else self.sigma.astype(times.dtype)
        return self.function(pairs, *(given for given in (times, sigma) if given is not None))

    def pairs_needed(self, k: int | None, times: np.ndarray | None, pencil: AnyPencil, field: TensorField) -> int:
        """Return how many eigenpairs to compute: k, or enough for the times at which something is observed."""
        if self.left_out is not None:
            enough = pairs_for(times, pencil, field)  # times too small for the grid are refused whatever k is
            return enough if k is None else k
        if k is not None:
            return k
        if self.sigma is None or times is None:
            raise ValueError("k: got None; a signature of your own needs the number of eigenpairs")
        largest = float(np.max(times))
        wanted = pairs_below(math.exp(largest + 2 * float(self.sigma)), pencil, field)
        _require_resolved(wanted, unknowns_of(pencil), f"energies up to {largest:.4g}, which take", "lower energies")
        return wanted


def wave_kernel(sigma: float | Float[Array, ""]) -> Signature:
    """Return the wave kernel signature, a `Signature` for `Data`.

    Args:
        sigma: the width of the kernels, as for `hks_jax.wks`.

    Raises:
        ValueError: a width that is not positive.
    """
    require_number("sigma", sigma)
    return Signature(wks, "e", at_nodes=True, sigma=jnp.asarray(sigma))


SIGNATURES = {
    "hks": Signature(hks, "t", at_nodes=True, left_out=truncation_map),
    "heat-trace": Signature(heat_trace, "t", left_out=lambda pairs, times: truncation(pairs, times).tail),
    "eigenvalues": Signature(lambda pairs: pairs.eigenvalues, lowest=True),
}


def pairs_below(eigenvalue: float, pencil: AnyPencil, field: TensorField) -> int:
    """Return about how many eigenvalues lie below one, by Weyl's law, and some more."""
    return math.ceil(1.1 * float(weyl_count(pencil, [eigenvalue], field)[0])) + 4


def pairs_for(times: Any, pencil: AnyPencil, field: TensorField) -> int:
    """Return how many pairs resolve the smallest time to `TAIL`: all, if that many are needed."""
    smallest, n_dof, d = float(np.min(np.asarray(times))), unknowns_of(pencil), pencil.space.dimension

    def count(tail: float) -> int:
        return pairs_below(resolving(tail, d) / smallest, pencil, field)

    needed = count(_LOST)
    least = smallest * (needed / _most_pairs(n_dof)) ** (2 / d)
    remedy = f"times from about {least:.3g}, or a finer grid"
    _require_resolved(needed, n_dof, f"{smallest:.4g}, which takes", remedy)
    return min(count(TAIL), n_dof)


def unknowns_of(pencil: AnyPencil) -> int:
    """Return how many eigenpairs there are."""
    return sum(part.space.n_dof for part in pencil.parts)


def _require_resolved(wanted: int, n_dof: int, what: str, remedy: str) -> None:
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


def _most_pairs(n_dof: int) -> int:
    return max(n_dof // 4, min(n_dof, 20))
