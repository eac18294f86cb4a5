"""Find, count and repair tensors that are not positive definite."""

import math
from dataclasses import replace
from itertools import product
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import real_array, require_number
from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import (
    MANY,
    NUMBERS,
    PositiveMap,
    least_eigenvalue,
    positive_map,
    refuse,
    unsymmetric,
)
from hks_jax.io.volume import TensorVolume

Repair = Literal["clip", "mask", "nearest"]

REPAIRS: dict[str, str] = {
    "clip": "raise eigenvalues to a floor",
    "mask": "leave the voxels out",
    "nearest": "use the tensor of the nearest valid voxel",
}
"""The methods of repair, with descriptions for messages."""

_SAME, _TINY, _FILLED = 1e-6, 1e-6, 0.2
"""The relative tolerances for equal tensors and for zero tensors, and the share of voxels that a background exceeds."""


def find_invalid(volume: TensorVolume, floor: float | None = None) -> Bool[np.ndarray, "*shape"]:
    """Return the voxels inside the mask whose tensor is not finite or has an eigenvalue that is ≤ 0 or < `floor`.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), (1.0, 1.0), (0.0, 0.0))
        >>> print(hj.io.find_invalid(volume).sum(), hj.io.find_invalid(volume, floor=2.0).sum())  # eigenvalues 1 and 4
        0 81
    """
    inside = volume.inside
    bad = np.zeros(volume.shape, bool)
    bad[inside] = ~spd.is_spd(volume.tensors[inside])
    if floor is not None:
        require_number("floor", floor, above=-math.inf)
        good = inside & ~bad
        bad[good] = np.linalg.eigvalsh(volume.tensors[good].astype(np.float64))[:, 0] < floor
    return bad


def require_valid(volume: TensorVolume, argument: str = "repair") -> None:
    """Raise ValueError with remedies if tensors inside the mask of a volume are not positive definite."""
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
            remedy = f"{_why_so_many(volume, tensors[finite])}. If only a few tensors are invalid, c{remedy[1:]}"
        refuse("tensors", bad, volume.inside, "voxel", what, remedy)


def repair_tensors(volume: TensorVolume, method: Repair, floor: float | None = None) -> TensorVolume:
    """Return the volume with positive definite tensors inside its mask, and a report of the changes.

    Args:
        volume: the tensors. If there is no mask, voxels whose tensor is exactly zero are left out first, because many
            programs write the background as zero.
        method: the repair of invalid tensors, which are not positive definite or have an eigenvalue below `floor`.
            ``"clip"`` raises eigenvalues of an invalid tensor to the floor, which gives the nearest admissible tensor
            in the Frobenius norm. ``"mask"`` removes the voxels of invalid tensors from the mask. ``"nearest"``
            replaces an invalid tensor by the tensor of the nearest valid voxel in space.
        floor: the least admissible eigenvalue, in the tensors' unit. If `floor` is None, all positive eigenvalues are
            admissible, and the floor of ``"clip"`` is 1 % of the median of the valid tensors' mean eigenvalues.

    Returns:
        The repaired volume, with a note that summarises the repair. The volume's attribute ``repair`` contains the
        method, the floor, the number of repaired voxels and of all voxels, the number of tensors that are not finite,
        the worst eigenvalue, and the bounding box and first indices of the repaired voxels.

    Raises:
        ValueError: the method is unknown, the floor is not positive, no tensor is valid, or a tensor is NaN or infinite
            and the method is ``"clip"``.

    Examples:
        >>> tensors = np.array(field.tensors)
        >>> tensors[4, 4] = np.diag([4.0, -1.0])
        >>> repaired = hj.io.repair_tensors(hj.io.TensorVolume(tensors, (1.0, 1.0), (0.0, 0.0)), "clip", floor=0.5)
        >>> print(repaired.tensors[4, 4].diagonal())
        [4.  0.5]
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
        "first": where[:20].tolist(),
    }
    if not count:
        return replace(volume, repair=report)
    wrong = "are not positive definite" if floor is None else f"have an eigenvalue below {floor:g}"
    if count > MANY * of:
        why = _why_so_many(volume, volume.tensors[finite], floor)
        if count == of:
            raise ValueError(f"repair: all {of} tensors {wrong}. {why}")
        warn_of_accuracy(
            f"repair: {count} of {of} tensors ({count / of:.0%}) {wrong}, so the signature depends strongly on the "
            f"repair. {why}"
        )
    worst = f" (the worst eigenvalue is {report['worst_eigenvalue']:.3g})" if finite.any() else ""
    tensors, changed = volume.tensors.copy(), dict[str, Any]()
    if method == "mask":
        changed["mask"], done = inside & ~bad, "the repair leaves out the voxels of invalid tensors"
    elif method == "clip":
        if report["not_finite"]:
            raise ValueError(
                f"repair: {report['not_finite']} tensors are NaN or infinite and have no eigenvalues to clip. Choose "
                '"mask" or "nearest"'
            )
        if floor is None:
            typical = np.trace(tensors[inside & ~bad], axis1=-2, axis2=-1) / volume.dimension
            report["floor"] = floor = 0.01 * float(np.median(typical))
        wrong_ones = tensors[bad].astype(np.float64)
        values, vectors = np.linalg.eigh(wrong_ones + np.swapaxes(wrong_ones, -1, -2))
        raised = (vectors * np.maximum(values / 2, floor)[:, None, :]) @ np.swapaxes(vectors, -1, -2)
        tensors[bad], done = raised, f"the repair raises eigenvalues of invalid tensors to {floor:.3g}"
    else:
        nearest = ndimage.distance_transform_edt(
            bad | ~inside, sampling=volume.spacing, return_distances=False, return_indices=True
        )
        source, done = tuple(index[bad] for index in nearest), "the nearest valid tensor replaces each invalid tensor"
        tensors[bad] = tensors[source]
        for name in ("covariance", "modes"):
            if (known := getattr(volume, name)) is not None:
                changed[name] = known.copy()
                changed[name][bad] = known[source]
    notes = (*volume.notes, f"repair: {count} of {of} tensors {wrong}{worst}; {done}")
    return replace(volume, tensors=tensors, **changed, repair=report, notes=notes)


def _why_so_many(volume: TensorVolume, finite: Float[np.ndarray, "n d d"], floor: float | None = None) -> str:
    """Return a possible reason for many invalid tensors, such as a wrong order; `finite` has the finite ones."""
    question = "" if volume.invalid_by_order is None else volume.invalid_by_order.question
    if floor is not None and not question:
        return "Choose a lower floor, or leave out voxels at the boundary of the mask"
    if question or not len(finite):
        return question or "Noise does not explain all invalid tensors. Programs often write NaN outside a mask"
    largest = np.abs(np.linalg.eigvalsh(finite.astype(np.float64))).max()
    return (
        "Noise does not explain all invalid tensors. Tensors S of stress or strain are naturally indefinite, and need "
        f"a map to positive definite tensors: exp(S/s) with a scale s (|eigenvalue| ≤ {largest:.3g} for the invalid "
        f"tensors), or S + c·I with a shift c > {-least_eigenvalue(finite):.3g}. Use positive_tensors or --positive"
    )


def without_background(volume: TensorVolume) -> TensorVolume:
    """Return the volume with a mask that excludes zero tensors, which many programs write in the background."""
    if volume.mask is not None:
        return volume
    inside = np.any(volume.tensors != 0, axis=(-2, -1))
    if inside.all() or not inside.any():
        return volume
    note = f"no mask given: the {int((~inside).sum())} voxels with a zero tensor count as outside"
    return replace(volume, mask=inside, notes=(*volume.notes, note))


def find_background(volume: TensorVolume) -> tuple[Bool[np.ndarray, "*shape"], str] | None:
    """Return the voxels that a program filled as background, and a sentence about them; None if there are few.

    Where there is no signal, programs such as ANTs write exactly equal isotropic tensors, or tensors a million times
    smaller than others, unlike measured tensors. The result is None for a volume with a mask, and for a constant field.

    Examples:
        >>> tensors = np.array(field.tensors)
        >>> tensors[:5] = np.eye(2)
        >>> found, sentence = hj.io.find_background(hj.io.TensorVolume(tensors, (1.0, 1.0), (0.0, 0.0)))
        >>> print(found.sum())
        45
    """
    if volume.mask is not None:
        return None
    tensors, d = volume.tensors, volume.dimension
    with np.errstate(invalid="ignore", over="ignore"):  # tensors may be NaN or infinite
        mean = np.trace(tensors, axis1=-2, axis2=-1, dtype=np.float64) / d
        isotropic = mean > 0
        for i, j in product(range(d), repeat=2):  # a loop saves memory
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
        f"no mask given: {int(found.sum())} of {found.size} voxels {what}, probably background, and count as inside"
    )


def positive_tensors(volume: TensorVolume, how: PositiveMap, number: float) -> TensorVolume:
    """Map all tensors S inside the mask, such as stresses, to positive definite tensors, and return the volume.

    The map ``"exp"`` gives exp(S/s) with the scale s = `number`, and the map ``"shift"`` gives S + c·I with the shift
    c = `number`; see `hks_jax.TensorField.from_indefinite`. The mapped tensors are a metric: use ``metric="tensor"``.

    Returns:
        The mapped volume, with a note that summarises the map. The volume's attribute ``repair`` contains the map, its
        scale or shift, the number of tensors that were not positive definite, and the number of all tensors.

    Raises:
        ValueError: the map is unknown; a tensor is NaN, infinite or unsymmetric; the scale or shift is too small.

    Examples:
        >>> stress = hj.io.TensorVolume(np.tile(np.diag([1.0, -1.0]), (9, 9, 1, 1)), (1.0, 1.0), (0.0, 0.0))
        >>> print(hj.io.positive_tensors(stress, "exp", 1.0).tensors[4, 4].diagonal().round(3))
        [2.718 0.368]
    """
    volume = without_background(volume)
    inside, before = volume.inside, int(find_invalid(volume).sum())
    given = real_array("tensors", volume.tensors)
    mapped = np.asarray(positive_map("tensors", given, how, number, inside, "voxel"))
    tensors = np.where(inside[..., None, None], mapped, volume.tensors)
    formula = f"exp(S/{number:g})" if how == "exp" else f"S + {number:g}·I"
    note = f"{formula} of all tensors S; {before} of {int(inside.sum())} tensors were not positive definite"
    report = {"method": how, NUMBERS[how]: float(number), "voxels": before, "of": int(inside.sum())}
    return replace(volume, tensors=tensors, covariance=None, modes=None, repair=report, notes=(*volume.notes, note))


def require_symmetric(volume: TensorVolume) -> None:
    """Raise ValueError if a tensor is unsymmetric, for formats that store only one half of each tensor."""
    if count := int((volume.inside & unsymmetric(volume.tensors)).sum()):
        raise ValueError(
            f"volume: got {count} unsymmetric tensors, but this format stores only one half of a tensor. Write "
            "the symmetric parts (T + Tᵀ)/2, or use .npz or .vti"
        )
