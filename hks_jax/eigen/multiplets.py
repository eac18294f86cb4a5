"""Where to truncate a spectrum: multiple eigenvalues are kept whole or left out."""

from functools import partial
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

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
    kept, following = _choose(values, pairs.multiplet_tolerance, k, size, multiplet)

    def leading(p: Eigenpairs) -> tuple:
        return p.eigenvalues, p.vectors, p.frame, p.residuals, p.converged, p.part

    # Vectors and frame are the same array except to derivatives: to shorten it once saves memory.
    distinct = {id(leaf): leaf for leaf in leading(pairs)}
    shortened = dict(zip(distinct, _first(list(distinct.values()), size), strict=True))
    shorter = eqx.tree_at(leading, pairs, tuple(shortened[id(leaf)] for leaf in leading(pairs)))
    return eqx.tree_at(lambda p: (p.kept, p.next_eigenvalue), shorter, (kept, following))


@partial(jax.jit, static_argnames="size")
def _first(arrays: list[Array], size: int) -> list[Array]:
    return [array[:size] for array in arrays]


@partial(jax.jit, static_argnames=("k", "size", "multiplet"))
def _choose(
    values: Float[Array, " n"], multiplet_tolerance: Float[Array, ""], k: int, size: int, multiplet: MultipletChoice
) -> tuple[Bool[Array, " size"], Float[Array, ""]]:
    """Return which of the first pairs are kept, and the eigenvalue after them."""
    sequence = jnp.concatenate([values, jnp.full(size + 1, jnp.inf, values.dtype)])[: size + 1]
    index = jnp.arange(size)
    tolerance = multiplet_tolerance * jnp.maximum(sequence[:-1], jnp.finfo(values.dtype).tiny)
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
