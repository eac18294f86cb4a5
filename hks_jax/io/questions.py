"""What makes one doubt that tensors were read as they were meant: units, frames, and how fibres cohere."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from hks_jax.io.tensor_order import fsl_signs, nearest_rotation
from hks_jax.io.units import length_question, unit_question
from hks_jax.io.volume import AXES, TensorVolume

ANISOTROPIC = 0.3
"""The fractional anisotropy from which on a tensor's principal direction is taken for a fibre's."""
_ENOUGH = 1000
"""Fewer voxels with both neighbours along their direction decide nothing."""
_BLOCK, _BLOCKS = 8, 8
"""Voxels, per axis, of the blocks whose scatter tells the error of a mean, as neighbours are not independent; and the
least number of blocks that tells it."""
CLEAR = 3.5
"""Standard errors by which one mean must be below another."""
_SMOOTH = 3.0
"""Degrees below which fibres go on so well that the difference is one of the steps from voxel to voxel."""

_SAID = "Principal directions and those of the two neighbours along them differ by"


class Alternative(NamedTuple):
    """Other axes that a file's components may be along."""

    name: str  # a frame, or an axis of the voxels or of the scanner that is reversed
    is_frame: bool  # whether it is a frame
    angle: float  # the mean, in degrees, between a principal direction and the mean of the two neighbours' along it
    errors: float  # by how many standard errors that is less than with the axes in which the file was read


class Coherence(NamedTuple):
    """How well the fibres of neighbours continue each other, as the file was read, and along other axes."""

    frame: str  # in which the file was read
    angle: float  # the mean, in degrees, between a principal direction and the mean of the two neighbours' along it
    others: tuple[Alternative, ...]  # the same along other axes

    @property
    def better(self) -> Alternative | None:
        """The axes along which fibres clearly continue best, if they are not those of the file as it was read.

        A frame comes before a reversed axis that gains hardly more: the two may differ by a small turn only.
        """
        clear = [a for a in self.others if a.errors > CLEAR and self.angle > _SMOOTH]
        best = min(clear, key=lambda a: a.angle, default=None)
        frames = [a for a in clear if a.is_frame and best and self.angle - a.angle > 0.8 * (self.angle - best.angle)]
        return min(frames, key=lambda a: a.angle, default=best)

    @property
    def worse(self) -> tuple[Alternative, ...]:
        """The axes along which fibres clearly continue worse than along those of the file as it was read."""
        return tuple(a for a in self.others if a.errors < -CLEAR)

    @property
    def note(self) -> str:
        """Say how well fibres continue, and along which axes worse; the empty text where they tell nothing."""
        worse = [f"along the {a.name} axes" for a in self.worse if a.is_frame]
        if flips := [a.name for a in self.worse if not a.is_frame]:
            worse.append(f"with {', '.join(flips)} reversed")
        return f"{_SAID} {self.angle:.1f}° in the mean, and clearly more {', or '.join(worse)}" if worse else ""

    def question(self, option: str) -> str:
        """Ask whether the frame, which `option` says, is wrong; the empty text where no other axes are better."""
        best, said = self.better, f"Wrong frame? {_SAID} {self.angle:.1f}° in the mean along the {self.frame} axes"
        if best is None:
            return ""
        if best.is_frame:
            return f'{said}, and by {best.angle:.1f}° along the {best.name} axes: try {option} "{best.name}"'
        return (
            f"{said}, and by {best.angle:.1f}° with the {best.name} axis reversed: look at the signs of the gradient "
            "directions, or at what turned the image but not its tensors"
        )


def coherence(volume: TensorVolume) -> Coherence | None:
    """Measure whether fibres continue along their own direction, along the axes of the file and along others.

    A principal direction v is compared with the mean of those of the two neighbours nearest to ±v, where both are
    anisotropic, too. Tensors along the right axes agree best. Compared are the frames of `hks_jax.io.read_tensors`, and
    the file's own with one axis reversed. None for a slice, and for fewer than a thousand voxels with such neighbours.
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
        # Where every fibre goes on straight, whichever the axes, there is no gain at all.
        if len(gain) < _ENOUGH or len(np.unique(block[both])) < _BLOCKS or not gain.any():
            continue
        scatter = math.sqrt(float((np.bincount(block[both], gain - gain.mean()) ** 2).sum()))
        errors = float(gain.sum()) / max(scatter, 1e-12)
        others.append(Alternative(name, is_frame, float(np.nanmean(angles)), errors))
    return Coherence(volume.frame, float(np.nanmean(own)), tuple(others))


def _fibres(volume: TensorVolume) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the anisotropic voxels inside, and their principal directions."""
    traces = np.trace(volume.tensors, axis1=-2, axis2=-1)  # zero where the background is
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
    """Return the angle, in degrees, to the mean direction of the two neighbours along a voxel's own; NaN without both.

    A fibre that bends turns one way before a voxel and the other way behind it: their mean does not feel that. Each
    neighbour by itself would, and circles around a heart would seem to go on best along their radii.
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
    """Return other axes, frames first: name, whether they are a frame, and a matrix that turns directions to them."""
    affine = volume.volume_affine
    to_voxel = {
        "voxel": np.eye(3),
        "fsl": np.diag(fsl_signs(affine[:3, :3])),
        "world": nearest_rotation(affine[:3, :3]).T,
    }
    candidates = []
    if volume.frame in to_voxel:
        back = to_voxel[volume.frame].T
        candidates += [(name, True, turn @ back) for name, turn in to_voxel.items() if name != volume.frame]
    flips = [np.diag([-1.0 if a == b else 1.0 for b in range(3)]) for a in range(3)]
    candidates += [(AXES[a], False, flip) for a, flip in enumerate(flips)]
    turn = to_voxel["world"]
    candidates += [(f"scanner's {AXES[a]}", False, turn @ flip @ turn.T) for a, flip in enumerate(flips)]
    kept = [("own", True, np.eye(3))]
    for name, is_frame, turn in candidates:
        # A turn and its negative are the same of a direction's two ends; below 5° nobody could tell.
        if all(np.linalg.norm(turn - s * other, 2) > 0.09 for _, _, other in kept for s in (1, -1)):
            kept.append((name, is_frame, turn))
    return kept[1:]


OPEN_FRAME = (
    "NIfTI does not declare the axes of its tensors: taken for those of the voxels; if they were fitted with FSL's "
    'b-vectors as they are, as DIPY does, pass frame "fsl"'
)
"""The note of a NIfTI file whose frame is open, where it matters."""


def questions(volume: TensorVolume) -> tuple[str, ...]:
    """Ask about tensors that look wrong: "Wrong frame?", "Wrong unit of length?", "Wrong unit?".

    Mirrored or turned tensors are as positive definite as right ones, but the fibres of neighbours no longer continue
    each other: the mean angle between a principal direction and those of the two neighbours along it is compared with
    the mean angle along other axes. This needs some thousand anisotropic voxels; lay the mask over the volume first.

    Units are asked about where lengths are in mm, and no living tissue has the median mean diffusivity, or no scan has
    voxels of this size.

    Args:
        volume: from `read_tensors` or `fit_dwi`; of a slice, only units are asked about.

    Returns:
        Sentences, with the remedy; none where nothing is to be asked.
    """
    return reviewed(volume)[1]


def reviewed(volume: TensorVolume) -> tuple[TensorVolume, tuple[str, ...]]:
    """Return the volume with notes about its fibres, in place of the note of an open frame, and the questions."""
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
