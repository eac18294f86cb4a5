"""What makes one doubt that tensors were read as they were meant, though nothing about them is invalid."""

from dataclasses import replace

from hks_jax.io.coherence import coherence, frame_question
from hks_jax.io.units import length_question, unit_question
from hks_jax.io.volume import TensorVolume

OPEN_FRAME = (
    "NIfTI does not declare the axes of its tensors: taken for those of the voxels; if they were fitted with FSL's "
    'b-vectors as they are, as DIPY does, pass frame "fsl"'
)
"""The note of a NIfTI file whose frame is open, where it matters."""


def questions(volume: TensorVolume) -> tuple[str, ...]:
    """Ask what the tensors of a volume give reason to: "Wrong frame?", "Wrong unit of length?", "Wrong unit?".

    Mirrored or turned tensors are as positive definite as right ones, but the fibres of neighbours no longer continue
    each other: the mean angle between a principal direction and those of the two neighbours along it is compared with
    what it is along other axes. It needs a volume of some thousand anisotropic voxels; lay the mask over it first.

    Units are asked about where lengths are in mm and the median mean diffusivity is one that no living tissue has, or
    the voxels are of a size that no scan has.

    Args:
        volume: from `read_tensors` or `fit_dwi`; not a slice, for the former.

    Returns:
        Sentences, with the remedy; none where nothing is to be asked.
    """
    return reviewed(volume)[1]


def reviewed(volume: TensorVolume) -> tuple[TensorVolume, tuple[str, ...]]:
    """Return the volume with notes of what its fibres tell, and the questions.

    The note of an open frame is then a question, or settled.
    """
    found = coherence(volume) if volume.length_unit == "mm" else None
    notes = [note for note in volume.notes if note != OPEN_FRAME]
    wrong_frame = frame_question(found, "bvec_frame" if volume.order == "fit" else "frame")
    if found is not None and not wrong_frame and found.note:
        notes.append(found.note)
    settled = found is not None and any(a.is_frame and a.name == "fsl" for a in found.worse)
    if OPEN_FRAME in volume.notes and not (wrong_frame or settled):
        wrong_frame = OPEN_FRAME
    asked = tuple(filter(None, (wrong_frame, length_question(volume), unit_question(volume))))
    return replace(volume, notes=tuple(notes)), asked
