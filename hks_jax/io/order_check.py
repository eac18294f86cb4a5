"""Whether many tensors are invalid because their components were read in a wrong order."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import MANY
from hks_jax.io.tensor_order import ORDERS, unpack

_SAMPLE = 20_000
"""Tensors that are looked at before all are."""


class InvalidByOrder(NamedTuple):
    """How many tensors of a file are not positive definite under each order of components.

    Attributes:
        order: in which they were read.
        counts: how many are invalid, by order.
        of: how many there are, those that are exactly zero aside.
    """

    order: str
    counts: dict[str, int]
    of: int

    @property
    def fewer(self) -> list[str]:
        """The orders under which less than half as many are invalid, the fewest first."""
        own = self.counts[self.order]
        return sorted((name for name in self.counts if 2 * self.counts[name] < own), key=self.counts.__getitem__)

    @property
    def question(self) -> str:
        """Ask whether the order is wrong, with the counts; the empty text where no other has fewer invalid tensors."""
        if not self.fewer:
            return ""
        others = ", ".join(f'{count} in "{name}"' for name, count in self.counts.items() if name != self.order)
        return (
            f"Wrong order? Of {self.of} tensors that are not zero, {self.counts[self.order]} are not positive definite "
            f'as "{self.order}", {others}: try order "{self.fewer[0]}"'
        )


def invalid_by_order(components: Float[np.ndarray, "*shape n"], order: str) -> InvalidByOrder | None:
    """Count the tensors that are not positive definite under each order, where many are under their own.

    Validity does not depend on the axes that components are along, only on their order. It tells ``"nifti"``,
    ``"fsl"`` and the orders with the diagonal first apart, but hardly ``"mrtrix"`` and ``"vtk"``, which exchange two
    components beside the diagonal.

    Args:
        components: six of 3×3 matrices, or three of 2×2, in any order.
        order: in which they were read.

    Returns:
        The counts; None where few are invalid.
    """
    rows = components.reshape(-1, components.shape[-1])
    rows = rows[np.any(rows != 0, axis=-1)]
    sample = rows[:: max(1, len(rows) // _SAMPLE)]
    if not len(rows) or np.mean(spd.is_spd(unpack(sample, order))) >= 1 - MANY:
        return None
    counts = {name: int(np.sum(~spd.is_spd(unpack(rows, name)))) for name in ORDERS}
    return InvalidByOrder(order, counts, len(rows))
