"""The signatures that a fit can match: their values and the number of eigenpairs they need."""

import math
import operator
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
from hks_jax.signatures.times import times_of
from hks_jax.signatures.truncation import resolving, truncated_share, truncation_map

TAIL = 1e-6
"""The share of the heat trace at the smallest time that may lie beyond the computed eigenpairs."""
_LOST = 0.05
"""A time is too small for a grid if more than 5 % of the heat trace lies beyond the accurate eigenpairs."""


class Signature(eqx.Module):
    """A function of eigenpairs that a fit can match.

    Attributes:
        function: a function of the eigenpairs and, if the signature has them, of times or energies and sigma.
        symbol: the symbol of a further argument: ``"t"`` for times, ``"e"`` for energies, empty for none.
        at_nodes: whether the signature has a value at each node.
        left_out: a function of eigenpairs and times that estimates the share of the signature beyond the eigenpairs, or
            None if the computed pairs define the signature.
        lowest: whether the signature consists of the lowest eigenvalues; their number is the size of the target.
        sigma: the width of wave kernels.
    """

    function: Callable[..., Array] = eqx.field(static=True)
    symbol: str = eqx.field(static=True, default="")
    at_nodes: bool = eqx.field(static=True, default=False)
    left_out: Callable[..., Array] | None = eqx.field(static=True, default=None)
    lowest: bool = eqx.field(static=True, default=False)
    sigma: Array | None = None

    def predict(self, pairs: Eigenpairs, times: Float[Array, " n"] | None) -> Array:
        """Return the signature of the eigenpairs."""
        sigma = None if self.sigma is None or times is None else self.sigma.astype(times.dtype)
        return self.function(pairs, *(given for given in (times, sigma) if given is not None))

    def pairs_needed(self, k: int | None, times: np.ndarray | None, pencil: AnyPencil, field: TensorField) -> int:
        """Return the number of eigenpairs to compute: k or, by default, enough for the observed times."""
        if self.left_out is not None:
            enough = pairs_for(times, pencil, field)  # raises if times are too small for the grid
            return enough if k is None else k
        if k is not None:
            return k
        if self.sigma is None or times is None:
            raise ValueError("k: got None; expected the number of eigenpairs, which a custom signature needs")
        largest = float(np.max(times))
        wanted = pairs_below(math.exp(largest + 2 * float(self.sigma)), pencil, field)
        _require_resolved(wanted, unknowns_of(pencil), f"energies up to {largest:.4g}, which take", "lower energies")
        return wanted


def wave_kernel(sigma: float | Float[Array, ""]) -> Signature:
    """Return the wave kernel signature, a `Signature` for `Data`.

    Args:
        sigma: the width of the kernels, as for `hks_jax.wks`.

    Raises:
        ValueError: if the width is not positive.

    Examples:
        >>> signature = hj.inverse.wave_kernel(0.5)
        >>> np.allclose(signature.predict(pairs, jnp.array([1.0, 2.0])), hj.wks(pairs, [1.0, 2.0], 0.5))
        True
    """
    require_number("sigma", sigma)
    return Signature(wks, "e", at_nodes=True, sigma=jnp.asarray(sigma))


def _tail(pairs: Eigenpairs, times: Any) -> Array:
    return truncated_share(pairs, times_of(pairs, times))[0]


SIGNATURES = {
    "hks": Signature(hks, "t", at_nodes=True, left_out=truncation_map),
    "heat-trace": Signature(heat_trace, "t", left_out=_tail),
    "eigenvalues": Signature(operator.attrgetter("eigenvalues"), lowest=True),
}


def pairs_below(eigenvalue: float, pencil: AnyPencil, field: TensorField) -> int:
    """Return a generous estimate of the number of eigenvalues below a bound, by Weyl's law."""
    return math.ceil(1.1 * float(weyl_count(pencil, [eigenvalue], field)[0])) + 4


def pairs_for(times: Any, pencil: AnyPencil, field: TensorField) -> int:
    """Return the number of eigenpairs whose heat trace lacks a share `TAIL` at the smallest time."""
    smallest, n_dof, d = float(np.min(np.asarray(times))), unknowns_of(pencil), pencil.space.dimension

    def count(tail: float) -> int:
        return pairs_below(resolving(tail, d) / smallest, pencil, field)

    needed = count(_LOST)
    least = smallest * (needed / _most_pairs(n_dof)) ** (2 / d)
    remedy = f"times from about {least:.3g}, or a finer grid"
    _require_resolved(needed, n_dof, f"{smallest:.4g}, which takes", remedy)
    return min(count(TAIL), n_dof)


def unknowns_of(pencil: AnyPencil) -> int:
    """Return the number of unknowns of a pencil, which is the number of its eigenpairs."""
    return sum(part.space.n_dof for part in pencil.parts)


def _require_resolved(wanted: int, n_dof: int, what: str, remedy: str) -> None:
    """Warn if more eigenpairs are needed than are accurate; raise ValueError if more than twice as many are needed.

    An initial metric may need more eigenpairs than the fitted metric, and gets up to twice the usual number.
    """
    most = _most_pairs(n_dof)
    if wanted <= most:
        return
    message = (
        f"times: got {what} about {wanted} eigenpairs, but with {n_dof} unknowns only {most} are accurate enough for "
        f"a fit. Use {remedy}"
    )
    if wanted > min(2 * most, n_dof):
        raise ValueError(message)
    warn_of_accuracy(message)


def _most_pairs(n_dof: int) -> int:
    return max(n_dof // 4, min(n_dof, 20))
