"""Units: of lengths as headers declare them, and of diffusivities, which hardly any header does."""

import math
import re
from collections.abc import Iterable
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from hks_jax.io.volume import TensorVolume

Unit = Literal["mm2/s", "um2/ms", "um2/s", "cm2/s", "m2/s"]

UNITS: dict[str, float] = {"mm2/s": 1.0, "um2/ms": 1e-3, "um2/s": 1e-6, "cm2/s": 1e2, "m2/s": 1e6}
"""The units of diffusivity, each in mm²/s. The unit "um2/ms" is also 10⁻³ mm²/s and 10⁻⁹ m²/s."""

MM2_PER_S = "mm²/s"
"""How messages write the unit that tensors are kept in."""

LIVING_TISSUE = (1e-4, 4e-3)
"""Mean diffusivities in mm²/s: from dense tissue to cerebrospinal fluid, which at 37 °C has 3e-3."""

_B_VALUES = (20.0, 1e5)
"""Between which the largest b-value of a diffusion scan is, in s/mm²."""

_VOXELS = (0.005, 50.0)
"""Between which the sizes of voxels are, in mm, from microscopy to the thickest slices."""

_PREFIXES = {
    **{"": 1e3, "centi": 10.0, "c": 10.0, "milli": 1.0, "m": 1.0, "nano": 1e-6, "n": 1e-6},
    **dict.fromkeys(("micro", "u", "\u00b5", "\u03bc"), 1e-3),  # the micro sign, and the Greek letter
}
"""How many mm a metre is with each prefix."""


def millimetres(where: str, text: str) -> float | None:
    """Return how many mm a header's unit of length is, such as "microns" or "µm"; None where it names none."""
    word = re.sub(r"^microns?$", "um", text.strip().lower())
    if word in ("", "???", "none", "unknown", "n/a"):
        return None
    prefix = re.sub(r"(m|met(er|re)s?)$", "", word)
    if prefix == word or prefix not in _PREFIXES:
        raise ValueError(f"{where}: got {text!r}; expected one of mm, cm, m, um, nm. Correct the header")
    return _PREFIXES[prefix]


def by_axis(values: Iterable[float]) -> str:
    """Write a number for each axis, as in ``2 × 2 × 2.5``."""
    return " × ".join(f"{value:.5g}" for value in values)


def scaled_beside(own: Float[np.ndarray, "4 4"], affine: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the affine of an image that declares no unit of length, in mm as `affine`, beside which it belongs.

    Programs lose the unit of masks and labels: it is mm, m or µm, the one in which the voxels are nearest in size.
    """
    ratio = np.linalg.norm(affine[:3, :3]) / np.linalg.norm(own[:3, :3])
    scale = min((1.0, 1e3, 1e-3), key=lambda s: abs(math.log(ratio / s)))
    return np.diag([scale, scale, scale, 1.0]) @ own


def in_mm2_per_s(volume: TensorVolume, unit: Unit) -> TensorVolume:
    """Return the volume with its tensors, which are in `unit`, in mm²/s."""
    if unit not in get_args(Unit):
        raise ValueError(f"unit: got {unit!r}; expected one of {', '.join(UNITS)}")
    if volume.unit:
        raise ValueError(f"unit: {volume.source} declares {volume.unit} itself; leave this out")
    scale = UNITS[unit]
    if scale == 1:
        return replace(volume, unit=MM2_PER_S)
    note = f"tensors in {unit} as asked: multiplied by {scale:g} they are in {MM2_PER_S}"
    return replace(volume, tensors=volume.tensors * scale, unit=MM2_PER_S, notes=(*volume.notes, note))


def length_question(volume: TensorVolume) -> str:
    """Ask whether lengths in mm are wrong, where no scan has such voxels; else return the empty text."""
    low, high = _VOXELS
    if volume.length_unit != "mm" or all(low <= h <= high for h in volume.spacing):
        return ""
    return (
        f"Wrong unit of length? Voxels of {by_axis(volume.spacing)} mm: scans have {low:g} to {high:g} mm, and t goes "
        "with the square. Correct the unit in the header (NIfTI: xyzt_units; NRRD: space units), or the voxel sizes"
    )


def unit_question(volume: TensorVolume) -> str:
    """Ask whether the unit is wrong, where no living tissue has such a mean diffusivity and lengths are in mm."""
    if volume.length_unit != "mm":
        return ""
    median = median_mean_diffusivity(volume)
    if median == 0 or is_plausible(median):
        return ""
    said = f"Wrong unit? The median mean diffusivity is {median:.3g} {MM2_PER_S}, and living tissue has "
    said += "{:g} to {:g}".format(*LIVING_TISSUE)
    for name, scale in UNITS.items():
        # Where a unit was told, the numbers are no longer those of the file.
        if is_plausible(median * scale) and not volume.unit:
            return f'{said}. It is {median * scale:.3g} if the numbers are in {name}: try unit "{name}"'
    return f"{said}; no usual unit explains it"


def median_mean_diffusivity(volume: TensorVolume) -> float:
    """Return the median over the voxels inside whose mean diffusivity is positive; 0 if there are none."""
    means = np.trace(volume.tensors[volume.inside], axis1=-2, axis2=-1) / volume.dimension
    means = means[np.isfinite(means) & (means > 0)]
    return float(np.median(means)) if means.size else 0.0


def b_value_question(largest: float) -> str:
    """Ask the same of b-values, in s/mm², by the largest of them; the empty text where it is plausible."""
    low, high = _B_VALUES
    if low <= largest <= high:
        return ""
    for name, scale in UNITS.items():
        if low <= largest / scale <= high:
            return (
                f"the largest b-value is {largest:g}, and scans have {low:g} to {high:g} s/mm². It would be "
                f"{largest / scale:g} s/mm² if the b-values are in the reciprocal of {name}: pass unit "
                f'"{name}", that of the tensors\''
            )
    return ""


def is_plausible(diffusivity: float) -> bool:
    """Tell whether living tissue has a mean diffusivity, in mm²/s."""
    return LIVING_TISSUE[0] <= diffusivity <= LIVING_TISSUE[1]
