"""Checks of tensors, and the messages about them, for grids, meshes and files alike."""

from typing import Any, Literal, NoReturn

import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.checks import real_array
from hks_jax.domain import spd
from hks_jax.traced import is_traced

MetricChoice = Literal["tensor", "inverse", "adjugate"]
Interpolation = Literal["linear", "log-euclidean"]

MANY = 0.05
"""The part of invalid tensors from which on they are no exceptions: noise at a mask's rim is fewer."""


def check_metric_choice(metric: str | None) -> None:
    """Raise ValueError unless it names what metric diffusion tensors stand for."""
    if metric not in ("tensor", "inverse", "adjugate"):
        raise ValueError(
            f'metric: got {metric!r}; expected "inverse" (g = D⁻¹, the distances of diffusion), '
            '"tensor" (g = D, as in the paper) or "adjugate" (g = |D| D⁻¹). There is no default: choose one'
        )


def checked_interpolation(interpolation: Any) -> Interpolation:
    """Return the name of an interpolation; raise ValueError for any other."""
    if interpolation not in ("linear", "log-euclidean"):
        raise ValueError(f'interpolation: got {interpolation!r}; expected "linear" or "log-euclidean"')
    return interpolation


def checked_tensors(
    name: str, tensors: Any, inside: Bool[np.ndarray, "*shape"], d: int, expected: str, place: str = "node"
) -> Float[Array, "*shape d d"]:
    """Return tensors (*inside.shape, d, d) as floating point; raise ValueError unless they are SPD inside."""
    array = real_array(name, tensors)
    if array.shape != (*inside.shape, d, d):
        raise ValueError(f"{name}: got shape {array.shape}; expected {expected}")
    if not is_traced(array):
        require_spd(name, np.asarray(array), inside, place)
    return array


def require_spd(
    name: str, tensors: Float[np.ndarray, "*shape d d"], inside: Bool[np.ndarray, "*shape"], place: str
) -> None:
    """Raise ValueError unless the tensors are finite, symmetric and positive definite inside.

    Args:
        name: of the argument.
        tensors: the tensors.
        inside: where they count.
        place: what they belong to: ``"node"`` (of a grid, which may have a mask), ``"vertex"``, …
    """
    require_finite_symmetric(name, tensors, inside, place)
    bad = inside & ~spd.is_spd(tensors)
    if bad.any():
        what = f"not positive definite, worst eigenvalue {least_eigenvalue(tensors[bad]):.3g}"
        of_grids = f"{_MASK}, or raise their eigenvalues (hks_jax.io.repair_tensors)"
        if bad.sum() > MANY * inside.sum():
            of_grids = (
                "So many are no noise: tensors that are indefinite by nature, such as stress, become a metric by "
                f"hks_jax.TensorField.from_indefinite. {_MASK}, if they are outside"
            )
        refuse(name, bad, inside, place, what, of_grids if place == "node" else "Raise their eigenvalues")


def require_finite_symmetric(
    name: str, tensors: Float[np.ndarray, "*shape d d"], inside: Bool[np.ndarray, "*shape"], place: str
) -> None:
    """Raise ValueError unless the tensors are finite and symmetric inside; see `require_spd`."""
    bad = inside & ~np.isfinite(tensors).all(axis=(-2, -1))
    if bad.any():
        refuse(name, bad, inside, place, "NaN or infinite", _MASK if place == "node" else "Replace them")
    bad = inside & unsymmetric(tensors)
    if bad.any():
        what = "Pass (T + Tᵀ)/2 if the difference is noise, or check the component order"
        refuse(name, bad, inside, place, "unsymmetric", what)


_MASK = "Exclude these nodes by the grid's mask"


def unsymmetric(tensors: Float[np.ndarray, "*shape d d"]) -> Bool[np.ndarray, "*shape"]:
    """Mark the matrices that are unsymmetric beyond rounding in single precision."""
    skew = np.abs(tensors - np.swapaxes(tensors, -1, -2)).max(axis=(-2, -1))
    return skew > 1e-5 * np.abs(tensors).max(axis=(-2, -1))


def least_eigenvalue(tensors: Float[np.ndarray, "n d d"]) -> float:
    """Return the least eigenvalue of some finite tensors, of their lower halves."""
    return float(np.linalg.eigvalsh(tensors.astype(np.float64)).min())


def refuse(
    name: str, bad: Bool[np.ndarray, "*shape"], inside: Bool[np.ndarray, "*shape"], place: str, what: str, remedy: str
) -> NoReturn:
    """Raise ValueError about some tensors: how many, where the first is, what is wrong, and what to do about it."""
    first = tuple(int(i) for i in np.argwhere(bad)[0])
    raise ValueError(
        f"{name}: {int(bad.sum())} of {int(inside.sum())} tensors are {what} (the first at {place} {first}); "
        f"expected symmetric positive definite tensors. {remedy}"
    )
