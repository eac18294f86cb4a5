"""Units of lengths, which headers declare, and of diffusivities, which most headers do not declare."""

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from hks_jax.io.volume import TensorVolume
from hks_jax.naming import argument

Unit = Literal["mm2/s", "um2/ms", "um2/s", "cm2/s", "m2/s"]

UNITS: dict[str, float] = {"mm2/s": 1.0, "um2/ms": 1e-3, "um2/s": 1e-6, "cm2/s": 1e2, "m2/s": 1e6}
"""The units of diffusivity, each in mm²/s. The unit "um2/ms" equals 10⁻³ mm²/s and 10⁻⁹ m²/s."""

MM2_PER_S = "mm²/s"
"""The unit to which diffusivities are converted, as messages and `TensorVolume.unit` write it."""

LIVING_TISSUE = (1e-4, 4e-3)
"""The range of mean diffusivities in mm²/s, from dense tissue to cerebrospinal fluid (3e-3 at 37 °C)."""

_B_VALUES = (20.0, 1e5)
"""The range of the largest b-value of a diffusion scan, in s/mm²."""

_VOXELS = (0.005, 50.0)
"""The range of voxel sizes in mm, from microscopy to the thickest slices."""

_PREFIXES = {
    **{"": 1e3, "centi": 10.0, "c": 10.0, "milli": 1.0, "m": 1.0, "nano": 1e-6, "n": 1e-6},
    **dict.fromkeys(("micro", "u", "\u00b5", "\u03bc"), 1e-3),  # the micro sign, and the Greek letter
}
"""For each prefix of the metre, the length in mm of the unit with this prefix."""


def millimetres(where: str, text: str) -> float | None:
    """Return the length in mm of a header's unit, such as "microns" or "µm"; None if the text names no unit."""
    word = re.sub(r"^microns?$", "um", text.strip().lower())
    if word in ("", "???", "none", "unknown", "n/a"):
        return None
    prefix = re.sub(r"(m|met(er|re)s?)$", "", word)
    if prefix == word or prefix not in _PREFIXES:
        raise ValueError(f"{where}: got {text!r}; expected one of mm, cm, m, um, nm. Correct the header")
    return _PREFIXES[prefix]


def by_axis(values: Iterable[float]) -> str:
    """Return numbers, one per axis, as a text such as ``2 × 2 × 2.5``."""
    return " × ".join(f"{value:.5g}" for value in values)


def unit_in(text: str) -> Unit | None:
    """Return the unit of diffusivity that a text names, such as ``mm^2/s`` or ``µm²·ms⁻¹``; None for other texts."""
    word = text.strip().lower().translate(str.maketrans("\u00b5\u03bc²⁻¹·*", "uu2-1..", "^ "))
    word = re.sub(r"\.*(ms|s)-1$", r"/\1", word)
    return next((unit for unit in get_args(Unit) if unit == word), None)


def unknown_unit(got: object) -> str:
    """Return the error's text for a unit of tensors that is not one of `UNITS`."""
    return f"unit: got {got!r}; expected one of {', '.join(UNITS)}"


def in_mm2_per_s(volume: TensorVolume, unit: Unit, why: str = "as asked") -> TensorVolume:
    """Return the volume with its tensors converted from `unit` to mm²/s; a note says why they have this unit."""
    if unit not in UNITS:
        raise ValueError(unknown_unit(unit))
    if volume.unit:
        raise ValueError(
            f"unit: got {unit!r}, but {volume.source} declares its unit, and its numbers are in {volume.unit} now. "
            "Leave this argument out"
        )
    scale = UNITS[unit]
    if scale == 1:
        return replace(volume, unit=MM2_PER_S)
    note = f"tensors multiplied by {scale:g} to convert them from {unit}, {why}, to {MM2_PER_S}"
    return replace(volume, tensors=volume.tensors * scale, unit=MM2_PER_S, notes=(*volume.notes, note))


def length_question(volume: TensorVolume) -> str:
    """Return a question if lengths are in mm and a voxel size is implausible for a scan, or else the empty text."""
    low, high = _VOXELS
    if volume.length_unit != "mm" or all(low <= h <= high for h in volume.spacing):
        return ""
    return (
        f"Wrong unit of length? The voxel sizes are {by_axis(volume.spacing)} mm, but scans have {low:g} to {high:g} "
        "mm. Correct the unit in the header (NIfTI: xyzt_units; NRRD: space units), or the voxel sizes"
    )


def unit_question(volume: TensorVolume) -> str:
    """Return a question if lengths are in mm and the median mean diffusivity is implausible, or else the empty text."""
    if volume.length_unit != "mm":
        return ""
    median = median_mean_diffusivity(volume)
    if median == 0 or is_plausible(median):
        return ""
    said = f"Wrong unit? The median mean diffusivity is {median:.3g} {MM2_PER_S}, but living tissue has "
    said += "{:g} to {:g}".format(*LIVING_TISSUE)
    for name, scale in UNITS.items():
        # If the unit is known, the numbers were converted already.
        if is_plausible(median * scale) and not volume.unit:
            remedy = f"try {argument('unit', name)}"
            return f"{said}. If the numbers are in {name}, the median is {median * scale:.3g}: {remedy}"
    return f"{said}. No usual unit explains this median"


def median_mean_diffusivity(volume: TensorVolume) -> float:
    """Return the median of the positive mean diffusivities inside the mask, or 0 if there are none."""
    means = np.trace(volume.tensors[volume.inside], axis1=-2, axis2=-1) / volume.dimension
    means = means[np.isfinite(means) & (means > 0)]
    return float(np.median(means)) if means.size else 0.0


MEDIAN = "the median of the mean eigenvalues of the tensors in the domain"
"""The definition of D in the length √(Dt)."""


def unit_of_times(volume: TensorVolume, metric: str | None) -> str:
    """Return the unit of t, a squared length in the metric of tensors D; the empty text if it is not known.

    Lengths must be in mm, and the tensors in mm²/s, as declared or as their plausible diffusivity suggests. For the
    metric D⁻¹ the unit is s. For D it is mm⁴/s, and for |D|D⁻¹ it is mm⁴/s in 2D and mm⁶/s² in 3D.
    """
    known = volume.unit == MM2_PER_S or (not volume.unit and is_plausible(median_mean_diffusivity(volume)))
    if volume.length_unit != "mm" or not known:
        return ""
    return {"inverse": "s", "tensor": "mm⁴/s", "adjugate": "mm⁴/s" if volume.dimension == 2 else "mm⁶/s²"}[
        metric or "tensor"
    ]


def b_value_question(largest: float, unit: str) -> str:
    """Return a message if the largest b-value, in the reciprocal of `unit`, is implausible, or else the empty text."""
    (low, high), read = _B_VALUES, largest / UNITS[unit]
    if low <= read <= high:
        return ""
    for name, scale in UNITS.items():
        if low <= largest / scale <= high:
            return (
                f"the largest b-value is {read:g}; expected {low:g} to {high:g} s/mm². If the b-values are in "
                f"1/({name}), the largest is {largest / scale:g} s/mm²: pass {argument('unit', name)}"
            )
    return ""


def is_plausible(diffusivity: float) -> bool:
    """Return whether a mean diffusivity, in mm²/s, occurs in living tissue."""
    return LIVING_TISSUE[0] <= diffusivity <= LIVING_TISSUE[1]
