"""Detect tensors that were read in a wrong unit or frame, from their size and from the coherence of fibres."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from hks_jax.io.repair import singular_question
from hks_jax.io.tensor_order import fsl_signs, nearest_rotation
from hks_jax.io.units import length_question, unit_question
from hks_jax.io.volume import AXES, TensorVolume
from hks_jax.naming import argument

ANISOTROPIC = 0.3
"""The fractional anisotropy above which a tensor's principal direction counts as the direction of a fibre."""
_ENOUGH = 1000
"""The number of voxels with two anisotropic neighbours along the fibre that a comparison of frames needs."""
_BLOCK, _BLOCKS = 8, 8
"""The size of cubic blocks of voxels, in voxels per axis, and the least number of blocks. The standard error of a mean
angle comes from the scatter between blocks of voxels, because neighbouring voxels are correlated."""
CLEAR = 3.5
"""The number of standard errors above which the difference between the mean angles in two frames is significant."""
_SMOOTH = 3.0
"""The mean angle between fibres of neighbouring voxels, in degrees, below which frames are not distinguished, because
each fibre's direction is rounded to a step between voxels."""

_SAID = "Principal directions differ from the mean direction of their two neighbours along the fibre by"


class Alternative(NamedTuple):
    """Alternative axes for the components of a file."""

    name: str  # a frame, or the reversed axis, such as "x" (a voxel axis) or "scanner's x"
    is_frame: bool  # whether `name` is a frame
    angle: float  # the mean angle, in degrees, between a principal direction and the mean direction of its neighbours
    errors: float  # the decrease of `angle` relative to the axes in which the file was read, in standard errors


class Coherence(NamedTuple):
    """The alignment of fibres in neighbouring voxels, in the frame of the file and along alternative axes."""

    frame: str  # the frame in which the file was read
    angle: float  # the mean angle, in degrees, between a principal direction and the mean direction of its neighbours
    others: tuple[Alternative, ...]  # results for alternative axes

    @property
    def better(self) -> Alternative | None:
        """The alternative axes with the best alignment of fibres, if it is clearly better than in the file's frame.

        A frame is preferred to a reversed axis of almost equal mean angle, because both may give almost the same axes.
        """
        clear = [a for a in self.others if a.errors > CLEAR and self.angle > _SMOOTH]
        best = min(clear, key=lambda a: a.angle, default=None)
        frames = [a for a in clear if a.is_frame and best and self.angle - a.angle > 0.8 * (self.angle - best.angle)]
        return min(frames, key=lambda a: a.angle, default=best)

    @property
    def worse(self) -> tuple[Alternative, ...]:
        """The alternative axes for which fibres line up worse than in the file's frame by over 3.5 standard errors."""
        return tuple(a for a in self.others if a.errors < -CLEAR)

    @property
    def note(self) -> str:
        """A note that the file's frame seems right, with the axes that are clearly worse; empty if none are worse."""
        worse = [f"along the {a.name} axes" for a in self.worse if a.is_frame]
        if flips := [a.name for a in self.worse if not a.is_frame]:
            worse.append(f"with {', '.join(flips)} reversed")
        said = f"The axes of the tensors seem right. {_SAID} {self.angle:.1f}° on average; the angle is clearly larger"
        return f"{said} {', or '.join(worse)}" if worse else ""

    def question(self, name: str) -> str:
        """Return a question whether the argument `name` is wrong, or the empty text if no other axes are better."""
        best, said = self.better, f"Wrong frame? {_SAID} {self.angle:.1f}° on average along the {self.frame} axes"
        if best is None:
            return ""
        if best.is_frame:
            return f"{said}, but only by {best.angle:.1f}° along the {best.name} axes: try {argument(name, best.name)}"
        return (
            f"{said}, but only by {best.angle:.1f}° with the {best.name} axis reversed. Check the signs of the "
            "gradient directions, and whether a program reoriented the image without its tensors"
        )


def coherence(volume: TensorVolume) -> Coherence | None:
    """Measure how well fibres of neighbouring voxels line up, in the frame of the file and along alternative axes.

    The principal direction at an anisotropic voxel is compared with the mean principal direction at the two neighbours
    along the fibre, if both are anisotropic. The mean angle between principal directions and mean directions is least
    in the correct frame. Alternative axes are the frames of `read_tensors` and reversed axes. The result is None for a
    slice, or if fewer than 1000 voxels have two anisotropic neighbours along the fibre.
    """
    if volume.dimension != 3:
        return None
    voxels, directions = _fibres(volume)
    if len(voxels) < _ENOUGH:
        return None
    index = np.full(volume.shape, -1)
    index[tuple(voxels.T)] = np.arange(len(voxels))
    spacing = np.array(volume.spacing)
    own = _angles(voxels, directions, index, spacing)
    if np.isfinite(own).sum() < _ENOUGH:
        return None
    block = np.ravel_multi_index((voxels // _BLOCK).T, [n // _BLOCK + 1 for n in volume.shape])
    others = []
    for name, is_frame, turn in _alternatives(volume):
        angles = _angles(voxels, directions @ turn.T.astype(directions.dtype), index, spacing)
        both = np.isfinite(own) & np.isfinite(angles)
        gain = (own - angles)[both]
        # If fibres are straight in the file's frame and along the alternative axes, all angles and gains are zero.
        if len(gain) < _ENOUGH or len(np.unique(block[both])) < _BLOCKS or not gain.any():
            continue
        scatter = math.sqrt(float((np.bincount(block[both], gain - gain.mean()) ** 2).sum()))
        errors = float(gain.sum()) / max(scatter, 1e-12)
        others.append(Alternative(name, is_frame, float(np.nanmean(angles)), errors))
    return Coherence(volume.frame, float(np.nanmean(own)), tuple(others))


def _fibres(volume: TensorVolume) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    traces = np.trace(volume.tensors, axis1=-2, axis2=-1)  # zero in the background
    usable: Bool[np.ndarray, "*shape"] = volume.inside & np.isfinite(volume.tensors).all(axis=(-2, -1)) & (traces > 0)
    tensors = volume.tensors[usable].astype(np.float64)
    values, vectors = np.linalg.eigh(0.5 * (tensors + np.swapaxes(tensors, -1, -2)))
    spread = ((values - values.mean(axis=-1, keepdims=True)) ** 2).sum(axis=-1)
    fibre = (values[:, 0] > 0) & (1.5 * spread > ANISOTROPIC**2 * (values**2).sum(axis=-1))
    return np.argwhere(usable)[fibre], vectors[fibre, :, -1]


def _angles(
    voxels: Int[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    index: Int[np.ndarray, "nx ny nz"],
    spacing: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " n"]:
    """Return the angle, in degrees, between each direction and the mean direction of its two neighbours, or NaN.

    Along a curved fibre, the directions at a voxel's two neighbours deviate to opposite sides, and the mean of the two
    directions has no deviation. With only one neighbour, circular fibres around a heart would seem to be radial.
    """
    steps = directions / spacing
    steps = np.rint(steps / np.abs(steps).max(axis=1, keepdims=True)).astype(int)
    mean, both = np.zeros_like(directions), np.full(len(voxels), True)
    for sign in (1, -1):
        beside = voxels + sign * steps
        there = ((beside >= 0) & (beside < index.shape)).all(axis=1)
        neighbour = np.where(there, index[tuple(np.where(there[:, None], beside, 0).T)], -1)
        both &= neighbour >= 0
        cosine = np.einsum("na,na->n", directions, directions[neighbour])
        mean += np.where(cosine >= 0, 1.0, -1.0)[:, None] * directions[neighbour]
    cosine = np.einsum("na,na->n", directions, mean) / np.maximum(np.linalg.norm(mean, axis=1), 1e-12)
    return np.where(both, np.degrees(np.arccos(np.minimum(cosine, 1.0))), np.nan)


def _alternatives(volume: TensorVolume) -> list[tuple[str, bool, Float[np.ndarray, "3 3"]]]:
    """Return alternative axes, frames first: the name, whether it is a frame, and the matrix applied to directions."""
    linear = volume.volume_affine[:3, :3]
    world = nearest_rotation(linear).T
    to_voxel = {"voxel": np.eye(3), "fsl": np.diag(fsl_signs(linear)), "world": world}
    back, flips = to_voxel.get(volume.frame), [np.diag(1 - 2 * axis) for axis in np.eye(3)]
    frames = [] if back is None else [(name, True, turn @ back.T) for name, turn in to_voxel.items()]
    axes = [(AXES[a], False, flip) for a, flip in enumerate(flips)]
    scanners = [(f"scanner's {AXES[a]}", False, world @ flip @ world.T) for a, flip in enumerate(flips)]
    kept = [("own", True, np.eye(3))]
    for name, is_frame, turn in (*frames, *axes, *scanners):
        # A rotation and its negative are equivalent for fibres, and rotations below 5° cannot be distinguished.
        if all(np.linalg.norm(turn - s * other, 2) > 0.09 for _, _, other in kept for s in (1, -1)):
            kept.append((name, is_frame, turn))
    return kept[1:]


def undeclared_frame() -> str:
    """Return the note for a NIfTI file that declares no frame, if the frames "voxel" and "fsl" differ."""
    return (
        "The NIfTI file does not declare the axes of its tensors, which are read along the voxel axes. If the tensors "
        f"were fitted with unchanged FSL b-vectors, as DIPY does, pass {argument('frame', 'fsl')}"
    )


def questions(volume: TensorVolume) -> tuple[str, ...]:
    """Check tensors for a wrong frame or unit, and nearly singular tensors; return questions, each with a remedy.

    Reflected or rotated tensors are still positive definite, but fibres of neighbouring voxels do not line up. The
    function therefore compares, for several frames, the mean angle between the principal directions at a voxel and at
    its neighbours along the fibre. The comparison needs about 1000 anisotropic voxels inside the mask; set it first.

    If lengths are in mm, the function also checks that the size of the voxels is usual for scans, and that the median
    mean diffusivity occurs in living tissue. For a slice, the frame is not checked. Tensors are nearly singular if
    `find_invalid` finds them although they are positive definite.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), (2.0, 2.0), (0.0, 0.0), length_unit="mm")
        >>> hj.io.questions(volume)[0][:11]  # 2.5 mm²/s is not of tissue
        'Wrong unit?'
    """
    return tuple(filter(None, (*reviewed(volume)[1], singular_question(volume))))


def reviewed(volume: TensorVolume) -> tuple[TensorVolume, tuple[str, ...]]:
    """Return the volume, with a note about its fibres instead of `undeclared_frame`, and questions on its axes."""
    found = coherence(volume) if volume.length_unit == "mm" else None
    undeclared = undeclared_frame()
    notes = [note for note in volume.notes if note != undeclared]
    wrong_frame, settled = "", False
    if found is not None:
        wrong_frame = found.question("bvec_frame" if volume.order == "fit" else "frame")
        settled = any(a.is_frame and a.name == "fsl" for a in found.worse)
        if found.note and not wrong_frame:
            notes.append(found.note)
    if undeclared in volume.notes and not (wrong_frame or settled):
        wrong_frame = undeclared
    asked = tuple(filter(None, (wrong_frame, length_question(volume), unit_question(volume))))
    return replace(volume, notes=tuple(notes)), asked
