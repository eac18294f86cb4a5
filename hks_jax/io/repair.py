"""Find, count and repair tensors that are not positive definite."""

import math
from dataclasses import replace
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_number
from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import (
    MANY,
    NUMBERS,
    PositiveMap,
    least_eigenvalue,
    positive_map,
    refuse_tensors,
    unsymmetric,
)
from hks_jax.io.units import is_plausible, median_mean_diffusivity
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


_SINGULAR = 0.01
"""The least eigenvalue of diffusion tensors, relative to the median mean diffusivity. No tissue has a smaller one, and
no usual scan measures it, because it changes the signal by less than 1 %. Programs set it where a fit fails: DIPY
raises negative eigenvalues to about 1e-9 mm²/s. In the metric D⁻¹ such voxels are extremely large, and their slow modes
precede those of the tissue."""
_NO_LIQUID = 1e-7
"""The eigenvalue in mm²/s below which no diffusion tensor is admissible, whatever the median."""
_ROUNDED = 1e-3
"""The share by which an eigenvalue may be below the least admissible one, because files round tensors to float32."""


def least_admissible(volume: TensorVolume) -> float:
    """Return the eigenvalue below which a tensor inside the mask of a volume counts as nearly singular.

    For diffusion tensors, this eigenvalue is a hundredth of the median mean diffusivity, or 1e-7 mm²/s if that is more.
    Tensors count as diffusion tensors if their unit is known, or if lengths are in mm and the median is that of living
    tissue in mm²/s. For other tensors, and after a repair or a map to positive definite tensors, the result is zero.
    """
    median = median_mean_diffusivity(volume)
    diffusion = volume.unit or (volume.length_unit == "mm" and is_plausible(median))
    return max(_SINGULAR * median, _NO_LIQUID) if diffusion and not volume.repair else 0.0


class Invalid(NamedTuple):
    """The invalid tensors inside the mask of a volume; see `find_invalid`."""

    bad: Bool[np.ndarray, "*shape"]  # all voxels of invalid tensors
    singular: Bool[np.ndarray, "*shape"]  # the voxels of invalid tensors that are positive definite
    floor: float  # the least admissible eigenvalue


def invalid_in(volume: TensorVolume, floor: float | None = None) -> Invalid:
    """Find the invalid tensors of a volume as `find_invalid` does, and tell those that are positive definite."""
    if floor is None:
        floor = least_admissible(volume)
    require_number("floor", floor, above=-math.inf)
    inside = volume.inside
    bad, singular = np.zeros(volume.shape, bool), np.zeros(volume.shape, bool)
    bad[inside] = ~spd.is_spd(volume.tensors[inside])
    if floor > 0:
        good = inside & ~bad
        singular[good] = np.linalg.eigvalsh(volume.tensors[good].astype(np.float64))[:, 0] < floor * (1 - _ROUNDED)
    return Invalid(bad | singular, singular, floor)


def find_invalid(volume: TensorVolume, floor: float | None = None) -> Bool[np.ndarray, "*shape"]:
    """Return the voxels inside the mask whose tensor is not finite or has an eigenvalue that is ≤ 0 or < `floor`.

    An eigenvalue counts as below `floor` if it is smaller by more than a thousandth, because files round tensors.

    If `floor` is None, diffusion tensors must not be nearly singular: their eigenvalues must be at least a hundredth
    of the median mean diffusivity. Tensors are diffusion tensors if their unit is known (`TensorVolume.unit`), or if
    lengths are in mm and the median is that of living tissue in mm²/s.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), (1.0, 1.0), (0.0, 0.0))
        >>> print(hj.io.find_invalid(volume).sum(), hj.io.find_invalid(volume, floor=2.0).sum())  # eigenvalues 1 and 4
        0 81
    """
    return invalid_in(volume, floor).bad


def describe_invalid(volume: TensorVolume, found: Invalid) -> str:
    """Return words about invalid tensors, such as "not positive definite, …"."""
    tensors, singular = volume.tensors[found.bad], int(found.singular.sum())
    finite = np.isfinite(tensors).all(axis=(-2, -1))
    words, unit = "not positive definite", f" {volume.unit}" * bool(volume.unit)
    small = f"with an eigenvalue below {found.floor:.3g}{unit}"
    if singular == len(tensors):
        words = f"nearly singular, {small}"
    elif singular:
        words += f" or ({singular} of them) nearly singular, {small}"
    if finite.any():
        words += f", worst eigenvalue {least_eigenvalue(tensors[finite]):.3g}"
    return words + f", {int((~finite).sum())} of them NaN or infinite" * bool((~finite).any())


def singular_question(volume: TensorVolume) -> str:
    """Return a question if diffusion tensors are nearly singular (see `find_invalid`), or else the empty text."""
    found = invalid_in(volume)
    singular = found.singular
    if not singular.any():
        return ""
    first = tuple(np.argwhere(singular)[0].tolist())
    return (
        f"Nearly singular? {int(singular.sum())} of {int(volume.inside.sum())} tensors are "
        f"{describe_invalid(volume, found._replace(bad=singular))} (the first at voxel {first}). No tissue has such "
        'tensors; in the metric D⁻¹ they are extremely large. Use repair_tensors(volume, "nearest")'
    )


def require_valid(volume: TensorVolume, argument: str = "repair") -> None:
    """Raise ValueError with remedies if tensors inside the mask of a volume are invalid (see `find_invalid`)."""
    found = invalid_in(volume)
    if count := int(found.bad.sum()):
        choices = ", ".join(f'"{name}" ({does})' for name, does in REPAIRS.items())
        remedy = f"Choose {argument}: {choices}"
        if 2 * found.singular.sum() > count:
            remedy += (
                ". No tissue has eigenvalues so small; programs set them where a fit fails or a voxel has no signal. "
                "A smaller floor, such as clip:1e-12, keeps them"
            )
        if count > MANY * volume.inside.sum():
            remedy = f"{_why_so_many(volume, found)}. If only a few tensors are invalid, c{remedy[1:]}"
        what = describe_invalid(volume, found)
        refuse_tensors("tensors", found.bad, volume.inside, "voxel", what, remedy)


def repair_tensors(volume: TensorVolume, method: Repair, floor: float | None = None) -> TensorVolume:
    """Return the volume with positive definite tensors inside its mask, and a report of the changes.

    Args:
        volume: the tensors. If there is no mask, voxels whose tensor is exactly zero are left out first, because many
            programs write the background as zero.
        method: the repair of invalid tensors, which are not positive definite or have an eigenvalue below `floor`.
            ``"clip"`` raises eigenvalues of an invalid tensor to the floor, which gives the nearest admissible tensor
            in the Frobenius norm. ``"mask"`` removes the voxels of invalid tensors from the mask. ``"nearest"``
            replaces an invalid tensor by the tensor of the nearest valid voxel in space.
        floor: the least admissible eigenvalue, in the tensors' unit. If `floor` is None, `find_invalid` decides which
            tensors are invalid, and the floor of ``"clip"`` is 1 % of the median of the valid tensors' mean
            eigenvalues, and at least that of `find_invalid`. The repaired tensors are also valid by the median after
            the repair, for example when they are read from a file again.

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
    found, inside = invalid_in(volume, floor), volume.inside
    mended, raised_to = volume, floor
    while found.bad.any() and not found.bad[inside].all():
        if method == "clip" and (lost := int((~np.isfinite(volume.tensors[found.bad]).all(axis=(-2, -1))).sum())):
            raise ValueError(
                f"repair: {lost} tensors are NaN or infinite and have no eigenvalues to clip. Choose "
                '"mask" or "nearest"'
            )
        mended, raised_to = _mended(volume, found, method, floor)
        # The repair changes the median of the tensors, and so which tensors are admissible afterwards.
        needed = 0.0 if floor is not None else least_admissible(mended)
        if needed <= found.floor:
            break
        found = invalid_in(volume, needed)
    bad, least = found.bad, found.floor
    finite = bad & np.isfinite(volume.tensors).all(axis=(-2, -1))
    count, of, where = int(bad.sum()), int(inside.sum()), np.argwhere(bad)
    report: dict[str, Any] = {
        "method": method,
        "floor": raised_to,
        "voxels": count,
        "of": of,
        "not_finite": int((bad & ~finite).sum()),
        "worst_eigenvalue": least_eigenvalue(volume.tensors[finite]) if finite.any() else None,
        "box": [where.min(0).tolist(), where.max(0).tolist()] if count else None,
        "first": where[:20].tolist(),
    }
    if not count:
        return replace(volume, repair=report)
    wrong = f"have an eigenvalue below {least:.3g}" if least else "are not positive definite"
    if count > MANY * of:
        why = _why_so_many(volume, found, chosen=floor is not None)
        if count == of:
            raise ValueError(f"repair: all {of} tensors {wrong}. {why}")
        warn_of_accuracy(
            f"repair: {count} of {of} tensors ({count / of:.0%}) {wrong}, so the signature depends strongly on the "
            f"repair. {why}"
        )
    worst = f" (the worst eigenvalue is {report['worst_eigenvalue']:.3g})" if finite.any() else ""
    done = {
        "mask": "the repair leaves out the voxels of invalid tensors",
        "clip": f"the repair raises eigenvalues of invalid tensors to {raised_to or 0:.3g}",
        "nearest": "the nearest valid tensor replaces each invalid tensor",
    }[method]
    worst += f", the first at voxel {tuple(report['first'][0])}"
    notes = (*volume.notes, f"repair: {count} of {of} tensors {wrong}{worst}; {done}")
    return replace(mended, repair=report, notes=notes)


def _mended(
    volume: TensorVolume, found: Invalid, method: Repair, floor: float | None
) -> tuple[TensorVolume, float | None]:
    """Return the volume with its invalid tensors repaired, and the floor, which ``"clip"`` chooses if it is None."""
    bad, inside, tensors, changed = found.bad, volume.inside, volume.tensors.copy(), dict[str, Any]()
    if method == "mask":
        return volume.with_mask(inside & ~bad), floor
    if method == "clip":
        if floor is None:
            typical = np.trace(tensors[inside & ~bad], axis1=-2, axis2=-1) / volume.dimension
            floor = max(_SINGULAR * float(np.median(typical)), found.floor)
        wrong_ones = tensors[bad].astype(np.float64)
        values, vectors = np.linalg.eigh(wrong_ones + np.swapaxes(wrong_ones, -1, -2))
        tensors[bad] = (vectors * np.maximum(values / 2, floor)[:, None, :]) @ np.swapaxes(vectors, -1, -2)
    else:
        nearest = ndimage.distance_transform_edt(
            bad | ~inside, sampling=volume.spacing, return_distances=False, return_indices=True
        )
        source = tuple(index[bad] for index in nearest)
        tensors[bad] = tensors[source]
        for name in ("covariance", "modes"):
            if (known := getattr(volume, name)) is not None:
                changed[name] = known.copy()
                changed[name][bad] = known[source]
    return replace(volume, tensors=tensors, **changed), floor


def _why_so_many(volume: TensorVolume, found: Invalid, chosen: bool = False) -> str:
    """Return a possible reason for many invalid tensors, such as a wrong order, or a floor that the user chose."""
    tensors = volume.tensors[found.bad]
    finite = tensors[np.isfinite(tensors).all(axis=(-2, -1))]
    question = "" if volume.invalid_by_order is None else volume.invalid_by_order.question
    if chosen and not question:
        return "Choose a lower floor, or leave out voxels at the boundary of the mask"
    if question or not len(finite):
        return question or "Noise does not explain all invalid tensors. Programs often write NaN outside a mask"
    if 2 * found.singular.sum() > len(finite):
        return "Noise does not explain all invalid tensors. Programs often write tensors near zero outside a mask"
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
        isotropic, size = mean > 0, np.abs(mean)  # stresses may have the mean zero
        for i, j in product(range(d), repeat=2):  # a loop saves memory
            isotropic &= np.abs(tensors[..., i, j] - (mean if i == j else 0.0)) <= _SAME * mean
            size = np.maximum(size, np.abs(tensors[..., i, j]))
    usual = size[(size > 0) & np.isfinite(size)]
    if not usual.size:
        return None
    tiny = size <= _TINY * np.quantile(usual, 0.99)
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
    inside, before = volume.inside, int(find_invalid(volume).sum())
    mapped = np.asarray(positive_map("tensors", volume.tensors, how, number, inside, "voxel"))
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
