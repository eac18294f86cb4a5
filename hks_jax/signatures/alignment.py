"""Rotations of modes within multiple eigenvalues, which make the modes of two domains comparable."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import nan_is_meant
from hks_jax.checks import require_number
from hks_jax.eigen.eigenpairs import Eigenpairs, require_pairs
from hks_jax.linear.products import matmul
from hks_jax.signatures.modes import decompose
from hks_jax.signatures.spectral_functions import source_indices
from hks_jax.traced import is_traced


class Alignment(eqx.Module):
    """Modes that are aligned with those of another domain (`align`).

    Attributes:
        pairs: the eigenpairs with the aligned modes, rotation @ vectors.
        rotation: (k, k) the orthogonal matrix, which mixes only modes of one group. Coefficients become c @ rotation.T.
        groups: (k,) the number of each mode's group.
        spread: (k,) the difference of the extreme eigenvalues in each mode's group, relative to its largest eigenvalue.
            A spectral function with the filter f changes at most as much as f changes over the group.
        agreement: (k,) the correlation, about 0, of each aligned mode with its mode of the reference over the
            correspondence; NaN for modes that the correspondence does not see, which stay as they were.
    """

    pairs: Eigenpairs
    rotation: Float[Array, "k k"]
    groups: Int[np.ndarray, " k"]
    spread: Float[np.ndarray, " k"]
    agreement: Float[np.ndarray, " k"]


@nan_is_meant
def align(pairs: Eigenpairs, reference: Eigenpairs, correspondence: Any, gap: float | None = None) -> Alignment:
    """Rotate the modes of a domain, within multiple eigenvalues, so that they agree best with those of another domain.

    Signs of modes and bases of multiple eigenvalues are arbitrary, and differ between subjects. In each group of modes,
    the rotation solves the orthogonal Procrustes problem min ‖AQᵀ − B‖, where A and B hold the readings of the group's
    modes, and of the reference's modes of the same numbers, in the correspondence. Modes of other groups do not mix: if
    the order of eigenvalues differs between the domains, that remains.

    Every spectral function Φf(Λ)Φᵀ, hence every signature, stays unchanged, up to the `Alignment.spread` of eigenvalues
    in the groups, which for multiple eigenvalues is rounding. Derivatives treat the rotation as constant.

    Args:
        pairs: the result of `eigenpairs`.
        reference: the eigenpairs of the other domain, at least as many.
        correspondence: two arrays, on the domain and on the reference: either node indices (s, d), or vertex numbers
            (s,), of s corresponding landmarks, or m corresponding maps (m, *shape), such as indicators of parcels,
            which are read by `decompose`. Maps see no odd modes of a doubled domain.
        gap: if given, neighbouring eigenvalues with a smaller difference, relative to the larger, count as equal too,
            because in another subject they may come in another order. The aligned modes are then no eigenfunctions:
            `Eigenpairs.residuals` and `converged` tell by how much.

    Raises:
        ValueError: if values are traced, because the groups depend on them, if the arrays have different numbers of
            entries, or if the reference has fewer pairs.

    Warns:
        AccuracyWarning: if the correspondence does not determine the rotation in some group of several modes.

    Examples:
        >>> flipped = hj.align(pairs, pairs, (field.grid.nodes.T, -field.grid.nodes.T))
        >>> print(jnp.allclose(hj.hks(flipped.pairs, [0.5]), hj.hks(pairs, [0.5]), rtol=1e-5))
        True
    """
    for name, given in (("pairs", pairs), ("reference", reference)):
        require_pairs(given)
        if is_traced(jax.lax.stop_gradient((given.eigenvalues, given.vectors))):
            raise ValueError(
                f"{name}: got traced values, which do not show the groups of equal eigenvalues; align outside of "
                "functions under jax.jit and jax.vmap"
            )
    if gap is not None:
        require_number("gap", gap, 1)
    if reference.k < pairs.k:
        raise ValueError(f"reference: got {reference.k} pairs; expected at least as many as pairs has, {pairs.k}")
    if not isinstance(correspondence, tuple | list) or len(correspondence) != 2:
        raise ValueError("correspondence: got no two arrays; expected (on the domain, on the reference)")
    own, other = (
        _readings(*jax.lax.stop_gradient((one, given)))
        for one, given in zip((pairs, reference), correspondence, strict=True)
    )
    if len(own) != len(other):
        raise ValueError(f"correspondence: got {len(own)} and {len(other)} landmarks or maps; expected equal numbers")
    # Groups, rotations and residuals are constant in derivatives.
    known, of_reference = jax.lax.stop_gradient((pairs, reference))
    groups, partners = _groups(known, gap), _partners(known, of_reference)
    k, values = pairs.k, np.asarray(known.eigenvalues, np.float64)
    rotation, spread, agreement = np.eye(k), np.zeros(k), np.full(k, np.nan)
    undetermined = 0
    for group in range(groups.max(initial=-1) + 1):
        modes = np.flatnonzero(groups == group)
        spread[modes] = np.ptp(values[modes]) / max(np.abs(values[modes]).max(), np.finfo(float).tiny)
        A = own[:, modes]
        if (partners[modes] < 0).any() or not A.any():
            continue
        B = other[:, partners[modes]]
        u, sizes, v = np.linalg.svd(B.T @ A)
        undetermined += len(modes) > 1 and sizes[-1] <= 1e-6 * np.linalg.norm(A) * np.linalg.norm(B)
        rotation[np.ix_(modes, modes)] = u @ v
        aligned = A @ (u @ v).T
        norms = np.linalg.norm(aligned, axis=0) * np.linalg.norm(B, axis=0)
        agreement[modes] = np.where(norms > 0, np.sum(aligned * B, axis=0) / np.where(norms > 0, norms, 1), np.nan)
    if undetermined:
        warn_of_accuracy(
            f"correspondence: {len(own)} landmarks or maps do not determine the rotation in {undetermined} groups of "
            "several modes. Use more of them"
        )
    return Alignment(_turned(pairs, rotation, spread), jnp.asarray(rotation), groups, spread, agreement)


def _readings(pairs: Eigenpairs, given: Any) -> Float[np.ndarray, "m k"]:
    """Return the values of the modes at landmarks, or the coefficients of maps."""
    shape = np.shape(given)
    if shape[1:] != pairs.space.node_shape and np.issubdtype(np.asarray(given).dtype, np.integer):
        nodes = source_indices(pairs, given)
        modes = pairs.space.extend(pairs.at_nodes, outside=0.0).reshape(pairs.k, -1)
        return np.asarray(modes, np.float64)[:, nodes].T
    maps = decompose(pairs, given)
    return np.asarray(maps, np.float64).reshape(-1, pairs.k)


def _groups(pairs: Eigenpairs, gap: float | None) -> Int[np.ndarray, " k"]:
    """Return the number of each mode's group.

    All modes of a group belong to one problem of a doubled domain. Either all of them are kept, or none is.
    """
    values = np.asarray(pairs.eigenvalues, np.float64)
    kind = 2 * np.asarray(pairs.problem_numbers) + np.asarray(pairs.kept)
    labels = np.asarray(pairs.multiplets)
    if gap is not None:
        new = (np.diff(labels) > 0) & ~(np.diff(values) < gap * np.abs(values[1:]))
        labels = np.append(0, np.cumsum(new))[: pairs.k]
    return np.unique(labels * (kind.max(initial=0) + 1) + kind, return_inverse=True)[1].reshape(-1)


def _partners(pairs: Eigenpairs, reference: Eigenpairs) -> Int[np.ndarray, " k"]:
    """Return the reference's mode of the same number in the same problem of a doubled domain; −1 without one."""
    of_own, of_other = np.asarray(pairs.problem_numbers), np.asarray(reference.problem_numbers)
    partners = np.full(pairs.k, -1)
    for number in np.unique(of_own):
        mine, theirs = np.flatnonzero(of_own == number), np.flatnonzero(of_other == number)
        both = min(len(mine), len(theirs))
        partners[mine[:both]] = theirs[:both]
    return partners


# A unit vector v = Σ qⱼφⱼ has the residual ‖Kv − λMv‖ in the norm of M⁻¹, which is at most max |λⱼ − λ|.
def _turned(pairs: Eigenpairs, rotation: Float[np.ndarray, "k k"], spread: Float[np.ndarray, " k"]) -> Eigenpairs:
    """Return the pairs with rotated vectors, and with the residuals that rotating unequal eigenvalues causes."""
    problems, known = [], jax.lax.stop_gradient(pairs)
    numbers = np.asarray(known.problem_numbers)
    for number, (each, constant) in enumerate(zip(pairs.problems, known.problems, strict=True)):
        places = np.flatnonzero(numbers == number)
        q, apart = np.eye(each.k), np.zeros(each.k)  # pairs of a problem beyond the k of the doubled domain stay
        q[: len(places), : len(places)], apart[: len(places)] = rotation[np.ix_(places, places)], spread[places]
        mixed = jnp.asarray(apart > np.maximum(1e-6, 10 * np.asarray(constant.residuals, np.float64)))
        larger = jnp.maximum(each.residuals, jnp.asarray(apart, each.residuals.dtype))
        residuals, converged = jnp.where(mixed, larger, each.residuals), each.converged & ~mixed
        frame = matmul(jnp.asarray(q, each.frame.dtype), each.frame)
        problems.append(replace(each, frame=frame, residuals=residuals, converged=converged))
    return pairs.with_problems(problems)
