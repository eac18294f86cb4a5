"""A metric from a volume of tensors of either sign, such as stress."""

from dataclasses import replace

import numpy as np

from hks_jax.domain.tensor_checks import (
    NUMBERS,
    PositiveMap,
    check_mapped,
    check_number,
    check_shift,
    checked_map,
    require_finite_symmetric,
)
from hks_jax.io.repair import find_invalid, without_background
from hks_jax.io.volume import TensorVolume


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
    values, vectors = np.linalg.eigh(volume.tensors[inside].astype(np.float64))
    with np.errstate(over="ignore"):  # told below
        values = np.exp(values / number) if how == "exp" else values + number
        mapped = ((vectors * values[:, None, :]) @ np.swapaxes(vectors, -1, -2)).astype(volume.tensors.dtype)
    check_mapped(volume.tensors[inside], mapped, how, number)
    tensors = volume.tensors.copy()
    tensors[inside] = 0.5 * (mapped + np.swapaxes(mapped, -1, -2))
    formula = f"exp(S/{number:g})" if how == "exp" else f"S + {number:g}·I"
    note = f"{formula} of all tensors S, {before} of {int(inside.sum())} of which are not positive definite"
    report = {"method": how, NUMBERS[how]: float(number), "voxels": before, "of": int(inside.sum())}
    return replace(volume, tensors=tensors, covariance=None, repair=report, notes=(*volume.notes, note))
