"""Random maps with the energies of a map in the modes of its domain."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import nan_is_meant
from hks_jax.checks import require_count, require_real
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.linear import lapack
from hks_jax.signatures.modes import energy, reconstruct
from hks_jax.traced import is_traced

_LACKING = 0.01
"""The share of a map's variance beyond the modes above which its surrogates are warned of."""


@nan_is_meant
def surrogates(
    pairs: Eigenpairs, f: Any, key: Any, n: int = 1, groups: Any = None
) -> Float[Array, "n *functions_and_shape"]:
    """Return random maps with the energy of f in each group of modes: eigenstrapping (Koussis et al. 2024).

    In each group, the coefficients of f are multiplied by a random orthogonal matrix, uniformly distributed. By
    default, groups are the multiple eigenvalues; then the maps' distribution does not depend on the bases of the
    eigenspaces, and a simple eigenvalue's coefficient only changes its sign. Modes with the eigenvalue 0, the means of
    the components, stay. All maps of f are multiplied by the same matrices, which keeps their inner products in each
    group, such as the covariance of a time series; for independent surrogates of several maps, call the function for
    each with a key of its own.

    The correlation with f has the mean 0 and the variance Σ p²/m over the groups, where p is the group's share of the
    variance of f and m the number of its modes. The part of f beyond the modes has no surrogate, and is left out.

    Args:
        pairs: the result of `eigenpairs`.
        f: (*shape) or (…, *shape), as in `decompose`.
        key: a key of `jax.random`.
        n: the number of surrogates.
        groups: (k,) integers, the number of each mode's group, if modes of different eigenvalues shall be mixed. For a
            closed surface like a cortex, ``np.floor(np.sqrt(np.arange(k)))`` gives the groups of a sphere.

    Returns:
        (n, *shape) or (n, …, *shape), NaN outside the mask.

    Raises:
        ValueError: as in `decompose`, or if the groups are not k integers.

    Warns:
        AccuracyWarning: if over 1 % of a map's variance lies beyond the modes. Its surrogates are then smoother than
            the map, and tests with them find too much.

    Examples:
        >>> f = hj.reconstruct(pairs, jnp.arange(12.0))
        >>> like = hj.surrogates(pairs, f, jax.random.key(0), n=3)
        >>> print(like.shape, jnp.allclose(hj.energy(pairs, like).total, hj.energy(pairs, f).total))
        (3, 9, 9) True
    """
    require_count("n", n)
    found = energy(pairs, f)
    _tell_if_lacking(pairs.k, jax.lax.stop_gradient(found.explained))
    labels = pairs.multiplets if groups is None else _checked_groups(groups, pairs.k)
    even = pairs.problems[0]
    turns = pairs.of_even(even.kept & (even.eigenvalues != 0))
    rotations = _random_rotations(key, n, jnp.asarray(labels), turns, pairs.eigenvalues.dtype)
    turned = jnp.einsum("nij,...j->n...i", rotations, found.coefficients, precision="highest")
    return reconstruct(pairs, turned)


# The QR factorisation of a matrix of independent normal entries, with a positive diagonal of R, has a factor Q that is
# uniformly distributed over the orthogonal matrices (Mezzadri 2007). Entries between groups are zero and stay zero.
def _random_rotations(
    key: Any, n: int, labels: Int[Array, " k"], turns: Bool[Array, " k"], dtype: Any
) -> Float[Array, "n k k"]:
    """Return random orthogonal matrices that mix only modes of one group; modes that do not turn stay."""
    k = len(labels)
    within = (labels[:, None] == labels[None]) & turns[:, None] & turns[None]
    stays = jnp.diag((~turns).astype(dtype))
    entries = jnp.where(within[None], jax.random.normal(key, (n, k, k), dtype), stays[None])
    q = jax.vmap(lapack.orthonormal_columns)(entries)
    of_r = jnp.sum(q * entries, axis=1)  # the diagonal of R = QᵀA
    return q * jnp.where(of_r < 0, -1, 1)[:, None, :].astype(dtype)


def _checked_groups(groups: Any, k: int) -> Array:
    require_real("groups", groups)
    if is_traced(groups):
        return jnp.asarray(groups)
    labels = np.asarray(groups)
    if labels.shape != (k,) or not (np.isfinite(labels).all() and np.array_equal(labels, np.rint(labels))):
        raise ValueError(f"groups: got {labels.dtype} {labels.shape}; expected {k} integers, one for each mode")
    return jnp.asarray(labels.astype(int))


def _tell_if_lacking(k: int, explained: Float[Array, "*functions k"]) -> None:
    if is_traced(explained):
        return
    worst = float(np.max(1 - np.nan_to_num(explained, nan=1.0)[..., -1], initial=0.0))
    if worst > _LACKING:
        warn_of_accuracy(
            f"f: {worst:.1%} of the variance lies beyond the {k} modes, and is left out of the surrogates, which "
            "are smoother than f. Use more modes"
        )
