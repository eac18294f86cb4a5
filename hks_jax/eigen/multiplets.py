"""Where to truncate a spectrum: multiple eigenvalues are kept whole or left out."""

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp

from hks_jax.eigen.eigenpairs import Eigenpairs

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
        pairs: more than k pairs where there are more, k + `SPARE` + 1 to complete.
        k: how many to keep.
        multiplet: ``"report"`` keeps exactly k; ``"drop"`` leaves out the copies of a multiple eigenvalue that k cuts
            (unless nothing would be left); ``"complete"`` takes its missing copies in if there are at most `SPARE`,
            and else drops it.
    """
    size = min(pairs.k, k + SPARE) if multiplet == "complete" else k
    values = jax.lax.stop_gradient(pairs.eigenvalues)
    sequence = jnp.concatenate([values, jnp.full(size + 1, jnp.inf, values.dtype)])[: size + 1]
    index = jnp.arange(size)
    tolerance = pairs.multiplet_tolerance * jnp.maximum(sequence[:-1], jnp.finfo(values.dtype).tiny)
    complete_up_to = jnp.diff(sequence) > tolerance
    if multiplet == "report":
        count = jnp.asarray(k)
    else:
        count = jnp.max(jnp.where(complete_up_to & (index < k), index + 1, 0))
        if multiplet == "complete":
            more = jnp.min(jnp.where(complete_up_to & (index >= k - 1), index + 1, size + 1))
            count = jnp.where(more <= size, more, count)
        count = jnp.where(count > 0, count, k)

    def leading(p: Eigenpairs) -> tuple:
        return p.eigenvalues, p.vectors, p.frame, p.residuals, p.converged, p.part

    # Vectors and frame are the same array except to derivatives: to shorten it once saves memory.
    shortened = {id(leaf): leaf[:size] for leaf in leading(pairs)}
    shorter = eqx.tree_at(leading, pairs, tuple(shortened[id(leaf)] for leaf in leading(pairs)))
    return eqx.tree_at(lambda p: (p.kept, p.next_eigenvalue), shorter, (index < count, sequence[count]))
