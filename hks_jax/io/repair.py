"""Tensors that are not positive definite: finding, counting and, if asked, repairing them."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_number
from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import (
    MANY,
    NUMBERS,
    PositiveMap,
    check_mapped,
    check_number,
    check_shift,
    checked_map,
    least_eigenvalue,
    refuse,
    require_finite_symmetric,
    unsymmetric,
)
from hks_jax.io.volume import TensorVolume

Repair = Literal["clip", "mask", "nearest"]

REPAIRS: dict[str, str] = {
    "clip": "raise eigenvalues to a floor",
    "mask": "leave the voxels out",
    "nearest": "take the nearest voxel's tensor",
}
"""The choices, for messages."""

LISTED = 20
"""The number of voxels that a report lists."""

_SAME, _TINY, _FILLED = 1e-6, 1e-6, 0.2
"""Relative difference of tensors that are the same; relative size of tensors that are nothing; least share of them."""


def find_invalid(volume: TensorVolume, floor: float | None = None) -> Bool[np.ndarray, "*shape"]:
    """Mark the voxels inside whose tensor is not finite and positive definite, or has an eigenvalue below `floor`."""
    if floor is not None:
        require_number("floor", floor, above=-math.inf)
    inside = volume.inside
    bad = np.zeros(volume.shape, bool)
    bad[inside] = ~spd.is_spd(volume.tensors[inside])
    if floor is not None:
        good = inside & ~bad
        bad[good] = np.linalg.eigvalsh(volume.tensors[good].astype(np.float64))[:, 0] < floor
    return bad


def find_unsymmetric(volume: TensorVolume) -> Bool[np.ndarray, "*shape"]:
    """Mark the voxels inside whose matrix is unsymmetric beyond rounding, as `hks_jax.TensorField` refuses them."""
    return volume.inside & unsymmetric(volume.tensors)


def require_valid(volume: TensorVolume, argument: str = "repair") -> None:
    """Raise ValueError where tensors inside are not positive definite: how many, where the first is, the choices."""
    bad = find_invalid(volume)
    if bad.any():
        tensors = volume.tensors[bad]
        finite, what = np.isfinite(tensors).all(axis=(-2, -1)), "not positive definite"
        if finite.any():
            what += f", worst eigenvalue {least_eigenvalue(tensors[finite]):.3g}"
        if not finite.all():
            what += f", {int((~finite).sum())} of them NaN or infinite"
        choices = ", ".join(f'"{name}" ({does})' for name, does in REPAIRS.items())
        remedy = f"Choose {argument}: {choices}"
        if bad.sum() > MANY * volume.inside.sum():
            remedy = f"{_why_so_many(volume, tensors[finite])}. For a few exceptions c{remedy[1:]}"
        refuse("tensors", bad, volume.inside, "voxel", what, remedy)


def repair_tensors(volume: TensorVolume, method: Repair, floor: float | None = None) -> TensorVolume:
    """Return the volume with the tensors inside its mask positive definite, and a report of the changes.

    Args:
        volume: the tensors. Without a mask, voxels whose tensor is exactly zero are left out first: programs write the
            background so.
        method: what to do with tensors that are not positive definite (or have an eigenvalue below `floor`):
            ``"clip"`` raises their eigenvalues to the floor, which gives the nearest such tensor in the Frobenius norm;
            ``"mask"`` takes them out of the mask; ``"nearest"`` puts the tensor of the nearest valid voxel (by
            distance in space) in their place.
        floor: the least eigenvalue allowed, in the tensors' units. None: any positive one is allowed, and ``"clip"``
            raises to a hundredth of the median mean eigenvalue of the valid tensors.

    Returns:
        The volume; its ``repair`` holds method, floor, how many voxels of how many, how many of them are not finite,
        the worst eigenvalue, the box that holds them and the first indices. A note says the same in a sentence.

    Raises:
        ValueError: an unknown method, a floor that is not positive; no valid tensor at all; NaN or infinite tensors
            for ``"clip"``.
    """
    if method not in REPAIRS:
        raise ValueError(f"repair: got {method!r}; expected {', '.join(map(repr, REPAIRS))}")
    if floor is not None:
        require_number("floor", floor)
    volume = without_background(volume)
    bad, inside = find_invalid(volume, floor), volume.inside
    finite = bad & np.isfinite(volume.tensors).all(axis=(-2, -1))
    count, of, where = int(bad.sum()), int(inside.sum()), np.argwhere(bad)
    report: dict[str, Any] = {
        "method": method,
        "floor": floor,
        "voxels": count,
        "of": of,
        "not_finite": int((bad & ~finite).sum()),
        "worst_eigenvalue": least_eigenvalue(volume.tensors[finite]) if finite.any() else None,
        "box": [where.min(0).tolist(), where.max(0).tolist()] if count else None,
        "first": where[:LISTED].tolist(),
    }
    if not count:
        return replace(volume, repair=report)
    if count == of:
        raise ValueError(f"repair: none of the {of} tensors is positive definite; check order and units")
    if count > MANY * of:
        warn_of_accuracy(
            f"repair: {count} of {of} tensors ({count / of:.0%}) are not as required, and the signature is to that "
            f"part one of the repair. {_why_so_many(volume, volume.tensors[finite])}"
        )
    wrong = "are not positive definite" if floor is None else f"have an eigenvalue below {floor:g}"
    worst = f" (the worst eigenvalue is {report['worst_eigenvalue']:.3g})" if finite.any() else ""
    mask, tensors, covariance = volume.mask, volume.tensors.copy(), volume.covariance
    if method == "mask":
        mask, done = inside & ~bad, "left out"
    elif method == "clip":
        if report["not_finite"]:
            raise ValueError(
                f"repair: {report['not_finite']} tensors are NaN or infinite and have no eigenvalues to clip; choose "
                '"mask" or "nearest"'
            )
        if floor is None:
            typical = np.trace(tensors[inside & ~bad], axis1=-2, axis2=-1) / volume.dimension
            report["floor"] = floor = 0.01 * float(np.median(typical))
        tensors[bad], done = (
            _of_eigenvalues(tensors[bad], partial(np.maximum, floor)),
            f"eigenvalues raised to {floor:.3g}",
        )
    else:
        nearest = ndimage.distance_transform_edt(
            bad | ~inside, sampling=volume.spacing, return_distances=False, return_indices=True
        )
        source, done = tuple(index[bad] for index in nearest), "replaced by the nearest valid one"
        tensors[bad] = tensors[source]
        if covariance is not None:
            covariance = covariance.copy()
            covariance[bad] = covariance[source]
    notes = (*volume.notes, f"repair: {count} of {of} tensors {wrong}{worst}: {done}")
    return replace(volume, tensors=tensors, mask=mask, covariance=covariance, repair=report, notes=notes)


def _why_so_many(volume: TensorVolume, finite: Float[np.ndarray, "n d d"]) -> str:
    """Ask why more than a few tensors, whose finite ones are given, are invalid: a wrong order, or no diffusion."""
    question = "" if volume.invalid_by_order is None else volume.invalid_by_order.question
    if question or not len(finite):
        return question or "So many are no noise: NaN is often what lies outside a mask"
    largest = np.abs(np.linalg.eigvalsh(finite.astype(np.float64))).max()
    return (
        "So many are no noise. Tensors that are indefinite by nature, such as stress, become a metric by a map of all "
        f"of them: exp(S/s) with a scale s (eigenvalues of the invalid ones reach {largest:.3g} in size), or "
        f"S + c·I with a shift c > {-least_eigenvalue(finite):.3g}; see positive_tensors, on the command line "
        "--positive"
    )


def without_background(volume: TensorVolume) -> TensorVolume:
    """Take voxels whose tensor is exactly zero, which is how programs write the background, as outside."""
    if volume.mask is not None:
        return volume
    inside = np.any(volume.tensors != 0, axis=(-2, -1))
    if inside.all() or not inside.any():
        return volume
    note = f"no mask: the {int((~inside).sum())} voxels whose tensor is zero count as outside"
    return replace(volume, mask=inside, notes=(*volume.notes, note))


def find_background(volume: TensorVolume) -> tuple[Bool[np.ndarray, "*shape"], str] | None:
    """Return the voxels that a program seems to have filled in as background, and a sentence; None if few do.

    No measurement gives the same isotropic tensor twice, nor one that is a millionth of the others: programs such as
    ANTs write either where there is no signal. Of a volume with a mask, and of one that is alike everywhere, None.
    """
    if volume.mask is not None:
        return None
    tensors, d = volume.tensors, volume.dimension
    with np.errstate(invalid="ignore", over="ignore"):  # of tensors that are not finite
        mean = np.trace(tensors, axis1=-2, axis2=-1, dtype=np.float64) / d
        isotropic = mean > 0
        for i, j in product(range(d), repeat=2):  # one by one: volumes are large
            isotropic &= np.abs(tensors[..., i, j] - (mean if i == j else 0.0)) <= _SAME * mean
    if not (mean > 0).any():
        return None
    tiny = np.abs(mean) <= _TINY * np.quantile(mean[mean > 0], 0.99)
    values, counts = np.unique(mean[isotropic].astype(np.float32), return_counts=True)
    filled = float(values[np.argmax(counts)]) if counts.size else np.nan
    same = isotropic & (np.abs(mean - filled) <= _SAME * filled)
    found = same if same.sum() >= tiny.sum() else tiny
    if found.sum() <= _FILLED * found.size or found.all():
        return None
    what = f"have the same isotropic tensor, {filled:.3g}·I" if found is same else "have tensors near zero"
    return found, (
        f"no mask: {int(found.sum())} of {found.size} voxels {what}, as programs write background, and count as inside"
    )


def _of_eigenvalues(
    tensors: Float[np.ndarray, "n d d"], function: Callable[[np.ndarray], np.ndarray]
) -> Float[np.ndarray, "n d d"]:
    """Return the symmetric parts of tensors with a function of their eigenvalues in place of these."""
    values, vectors = np.linalg.eigh(0.5 * (tensors + np.swapaxes(tensors, -1, -2)).astype(np.float64))
    mapped = (vectors * function(values)[:, None, :]) @ np.swapaxes(vectors, -1, -2)
    return (0.5 * (mapped + np.swapaxes(mapped, -1, -2))).astype(tensors.dtype)


def positive_tensors(volume: TensorVolume, how: PositiveMap, number: float) -> TensorVolume:
    """Return the volume with all of its tensors S mapped to positive definite ones, for tensors such as stress.

    ``"exp"`` takes exp(S/number), ``"shift"`` takes S + number·I: the maps of `hks_jax.TensorField.from_indefinite`.
    The result is a metric itself: go on with ``metric="tensor"``.

    Returns:
        The volume; its ``repair`` holds the map, its number, and how many tensors of how many were not positive
        definite before. A note says the same in a sentence.

    Raises:
        ValueError: an unknown map; NaN, infinite or unsymmetric tensors; a scale or shift that is too small.
    """
    how = checked_map(how)
    check_number("tensors", how, number)
    volume = without_background(volume)
    inside, before = volume.inside, int(find_invalid(volume).sum())
    require_finite_symmetric("tensors", volume.tensors, inside, "voxel")
    check_shift("tensors", volume.tensors[inside], how, number)
    with np.errstate(over="ignore"):  # told below
        mapped = _of_eigenvalues(
            volume.tensors[inside], lambda values: np.exp(values / number) if how == "exp" else values + number
        )
    check_mapped(volume.tensors[inside], mapped, how, number)
    tensors = volume.tensors.copy()
    tensors[inside] = mapped
    formula = f"exp(S/{number:g})" if how == "exp" else f"S + {number:g}·I"
    note = f"{formula} of all tensors S, {before} of {int(inside.sum())} not positive definite"
    report = {"method": how, NUMBERS[how]: float(number), "voxels": before, "of": int(inside.sum())}
    return replace(volume, tensors=tensors, covariance=None, repair=report, notes=(*volume.notes, note))


def require_symmetric(volume: TensorVolume) -> None:
    """Raise ValueError where a format that keeps one half of each tensor would lose the other."""
    if unsymmetric := int(find_unsymmetric(volume).sum()):
        raise ValueError(
            f"volume: {unsymmetric} tensors are unsymmetric, and this format keeps one half of them only. Write their "
            "symmetric part (T + Tᵀ)/2, or an .npz or .vti"
        )
