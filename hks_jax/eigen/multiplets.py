"""Where to truncate a spectrum: multiple eigenvalues are kept whole or left out."""

from typing import Any, Literal, get_args

import equinox as eqx
import jax

from hks_jax.compilation import numpy_where_known
from hks_jax.eigen.eigenpairs import Eigenpairs, multiplet_gap

MultipletChoice = Literal["report", "drop", "complete"]

SPARE = 8
"""How many pairs beyond k are computed to complete a multiple eigenvalue."""


def check_choice(multiplet: str) -> None:
    """Raise ValueError for an unknown choice."""
    if multiplet not in get_args(MultipletChoice):
        raise ValueError(f'multiplet: got {multiplet!r}; expected "report", "drop" or "complete"')


def truncate(pairs: Eigenpairs, k: int, multiplet: MultipletChoice) -> Eigenpairs:
    """Keep k pairs, or as many fewer or more as make the last eigenvalue's multiplicity complete.

    Args:
        pairs: k pairs with the eigenvalue that follows them; to complete, up to `SPARE` more.
        k: how many to keep.
        multiplet: ``"report"`` keeps exactly k; ``"drop"`` leaves out the copies of a multiple eigenvalue that k cuts
            (unless nothing would be left); ``"complete"`` takes its missing copies in if there are at most `SPARE`,
            and else drops it.
    """
    known = pairs.eigenvalues, pairs.next_eigenvalue, pairs.spectral_origin, pairs.multiplet_tolerance
    chosen = _choose(*jax.lax.stop_gradient(known), k, multiplet)
    return eqx.tree_at(lambda p: (p.kept, p.next_eigenvalue), pairs, chosen)


@numpy_where_known(static_argnums=(4, 5))
def _choose(
    xp: Any, values: Any, following: Any, origin: Any, tolerance: Any, k: int, multiplet: MultipletChoice
) -> tuple[Any, Any]:
    """Return which pairs (n) are kept, and the eigenvalue after them."""
    size = len(values)
    sequence = xp.append(values, following)
    index = xp.arange(size)
    complete_up_to = xp.diff(sequence) > multiplet_gap(xp, values, origin, tolerance)
    if multiplet == "report":
        count = xp.asarray(k)
    else:
        count = xp.max(xp.where(complete_up_to & (index < k), index + 1, 0))
        if multiplet == "complete":
            more = xp.min(xp.where(complete_up_to & (index >= k - 1), index + 1, size + 1))
            count = xp.where(more <= size, more, count)
        count = xp.where(count > 0, count, k)
    return index < count, sequence[count]
