"""Detect tensors that were read in a wrong unit or frame, from their size and from the coherence of fibres."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from hks_jax.io.tensor_order import fsl_signs, nearest_rotation
from hks_jax.io.units import length_question, unit_question
from hks_jax.io.volume import AXES, TensorVolume

ANISOTROPIC = 0.3
"""The fractional anisotropy above which a tensor's principal direction counts as the direction of a fibre."""
_ENOUGH = 1000
"""Frames are compared if at least this number of voxels have both neighbours along their direction."""
_BLOCK, _BLOCKS = 8, 8
"""The size of blocks, in voxels per axis, and their least number. The standard error of a mean comes from the scatter
between blocks, because neighbouring voxels are correlated."""
CLEAR = 3.5
"""The number of standard errors above which the difference between two mean angles is significant."""
_SMOOTH = 3.0
"""The mean angle, in degrees, below which differences between frames come from the discrete steps between voxels."""

_SAID = "Principal directions differ from the mean direction of their two neighbours along the fibre by"


class Alternative(NamedTuple):
    """Alternative axes for the components of a file."""

    name: str  # a frame, or the reversed axis, which belongs to the voxels or to the scanner
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

        A frame is preferred to a reversed axis of almost equal gain, because the two may differ by a small rotation.
        """
        clear = [a for a in self.others if a.errors > CLEAR and self.angle > _SMOOTH]
        best = min(clear, key=lambda a: a.angle, default=None)
        frames = [a for a in clear if a.is_frame and best and self.angle - a.angle > 0.8 * (self.angle - best.angle)]
        return min(frames, key=lambda a: a.angle, default=best)

    @property
    def worse(self) -> tuple[Alternative, ...]:
        """The alternative axes along which fibres line up clearly worse than in the frame of the file."""
        return tuple(a for a in self.others if a.errors < -CLEAR)

    @property
    def note(self) -> str:
        """A sentence that compares the alignment of fibres with clearly worse axes; empty if there are none."""
        worse = [f"along the {a.name} axes" for a in self.worse if a.is_frame]
        if flips := [a.name for a in self.worse if not a.is_frame]:
            worse.append(f"with {', '.join(flips)} reversed")
        said = f"The axes of the tensors seem right. {_SAID} {self.angle:.1f}° on average, and clearly more"
        return f"{said} {', or '.join(worse)}" if worse else ""

    def question(self, option: str) -> str:
        """Return a question whether the argument `option` is wrong, or the empty text if no other axes are better."""
        best, said = self.better, f"Wrong frame? {_SAID} {self.angle:.1f}° on average along the {self.frame} axes"
        if best is None:
            return ""
        if best.is_frame:
            return f'{said}, but only by {best.angle:.1f}° along the {best.name} axes: try {option} "{best.name}"'
        return (
            f"{said}, but only by {best.angle:.1f}° with the {best.name} axis reversed. Check the signs of the "
            "gradient directions, and whether a program reoriented the image without its tensors"
        )


def coherence(volume: TensorVolume) -> Coherence | None:
    """Measure how well fibres of neighbouring voxels line up, in the frame of the file and along alternative axes.

    The principal direction v at an anisotropic voxel is compared with the mean direction at its two neighbours along
    ±v, if both are anisotropic. The angle between v and this mean is least in the correct frame. Alternative axes are
    the frames of `read_tensors` and reversed axes. The result is None for a slice, or for fewer than 1000 such angles.
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
        # If all fibres are straight along both sets of axes, all angles are zero, and so is the gain.
        if len(gain) < _ENOUGH or len(np.unique(block[both])) < _BLOCKS or not gain.any():
            continue
        scatter = math.sqrt(float((np.bincount(block[both], gain - gain.mean()) ** 2).sum()))
        errors = float(gain.sum()) / max(scatter, 1e-12)
        others.append(Alternative(name, is_frame, float(np.nanmean(angles)), errors))
    return Coherence(volume.frame, float(np.nanmean(own)), tuple(others))


def _fibres(volume: TensorVolume) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the anisotropic voxels inside the mask, and their principal directions."""
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

    Along a curved fibre, the directions at the two neighbours deviate to opposite sides, and the deviations cancel in
    the mean. With a single neighbour, circular fibres around a heart would seem to line up best along radii.
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


OPEN_FRAME = (
    "The NIfTI file does not declare the axes of its tensors, which are read along the voxel axes. If the tensors were "
    'fitted with unchanged FSL b-vectors, as DIPY does, pass frame "fsl"'
)
"""The note for a NIfTI file that declares no frame, if the frames "voxel" and "fsl" differ."""


def questions(volume: TensorVolume) -> tuple[str, ...]:
    """Check tensors for a wrong frame or unit; return questions such as "Wrong unit?", each with a remedy.

    Reflected or rotated tensors are still positive definite, but fibres of neighbouring voxels do not line up. The
    function therefore computes the mean angle between the principal directions at a voxel and at its neighbours along
    the fibre, and compares the angles for several frames. It needs about 1000 anisotropic voxels; set the mask first.

    If lengths are in mm, the function also checks that the size of the voxels is usual for scans, and that the median
    mean diffusivity occurs in living tissue. For a slice, only the units are checked.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), (2.0, 2.0), (0.0, 0.0), length_unit="mm")
        >>> hj.io.questions(volume)[0][:11]  # 2.5 mm²/s is not of tissue
        'Wrong unit?'
    """
    return reviewed(volume)[1]


def reviewed(volume: TensorVolume) -> tuple[TensorVolume, tuple[str, ...]]:
    """Return the volume, with a note about its fibres in place of the note `OPEN_FRAME`, and its `questions`."""
    found = coherence(volume) if volume.length_unit == "mm" else None
    notes = [note for note in volume.notes if note != OPEN_FRAME]
    wrong_frame, settled = "", False
    if found is not None:
        wrong_frame = found.question("bvec_frame" if volume.order == "fit" else "frame")
        settled = any(a.is_frame and a.name == "fsl" for a in found.worse)
        if found.note and not wrong_frame:
            notes.append(found.note)
    if OPEN_FRAME in volume.notes and not (wrong_frame or settled):
        wrong_frame = OPEN_FRAME
    asked = tuple(filter(None, (wrong_frame, length_question(volume), unit_question(volume))))
    return replace(volume, notes=tuple(notes)), asked
