"""Where to truncate a spectrum: multiple eigenvalues are kept whole or left out."""

from functools import partial
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

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


@partial(jax.jit, static_argnames=("k", "multiplet"))
def _choose(
    values: Float[Array, " n"],
    following: Float[Array, ""],
    origin: Float[Array, ""],
    multiplet_tolerance: Float[Array, ""],
    k: int,
    multiplet: MultipletChoice,
) -> tuple[Bool[Array, " n"], Float[Array, ""]]:
    """Return which pairs are kept, and the eigenvalue after them."""
    size = len(values)
    sequence = jnp.append(values, following)
    index = jnp.arange(size)
    tolerance = multiplet_gap(values, origin, multiplet_tolerance)
    complete_up_to = jnp.diff(sequence) > tolerance
    if multiplet == "report":
        count = jnp.asarray(k)
    else:
        count = jnp.max(jnp.where(complete_up_to & (index < k), index + 1, 0))
        if multiplet == "complete":
            more = jnp.min(jnp.where(complete_up_to & (index >= k - 1), index + 1, size + 1))
            count = jnp.where(more <= size, more, count)
        count = jnp.where(count > 0, count, k)
    return index < count, sequence[count]
