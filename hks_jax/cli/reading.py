"""Read the volume of tensors that the options for reading describe, and its domain."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool

from hks_jax.cli.combinations import require_metric, require_reading_options
from hks_jax.cli.computation import OfVolume, Settings, domain_of_volume
from hks_jax.cli.progress import Progress
from hks_jax.domain.components import label_nodes
from hks_jax.domain.tensor_checks import MetricChoice, OperatorChoice
from hks_jax.io import TensorVolume, erode, fit_dwi, positive_tensors, read_mask, read_tensors, repair_tensors
from hks_jax.io.formats import format_of
from hks_jax.io.nifti import described_by, is_nifti, siblings, sidecar_of
from hks_jax.io.plausibility import reviewed
from hks_jax.io.repair import find_background, require_valid, without_background
from hks_jax.io.tensor_order import Order
from hks_jax.io.units import Unit, unit_question
from hks_jax.naming import with_option


@dataclass(frozen=True)
class Reading:
    """The files of tensors and how to read them, with the names of the options.

    With `strict_unit`, an implausible mean diffusivity without ``--unit`` raises ValueError.
    """

    file: Path
    others: Sequence[Path]
    slice: tuple[str, int] | None
    mask: Path | None
    background: Literal["outside", "inside"] | None
    erode: int
    order: Order | None
    frame: str | None
    unit: Unit | None
    array: str | None
    spacing: list[float] | None
    confidence: float
    repair: tuple[Literal["clip", "mask", "nearest"], float | None] | None
    positive: tuple[Literal["exp", "shift"], float] | None
    bval: Path | None
    bvec: Path | None
    bvec_frame: str | None
    b_max: float | None
    metric: MetricChoice | None = None
    operator: OperatorChoice = "laplace-beltrami"
    components: Literal["raise", "largest", "all"] = "raise"
    noise: str | None = None
    strict_unit: bool = False

    @classmethod
    def of(cls, args: argparse.Namespace, **given: Any) -> "Reading":
        """Return the options in `args`; values in `given` replace some of them."""
        chosen = vars(args) | given
        return cls(**{field.name: chosen[field.name] for field in fields(cls) if field.name in chosen})

    @property
    def image(self) -> str:
        """The suffix of images with results; empty for NumPy's files."""
        return format_of(self.file).image

    @property
    def second_scan(self) -> "Reading | None":
        """The second scan, if ``--noise`` names a file, or else None."""
        if self.noise is None or not is_file(self.noise):
            return None
        of_images: Any = dict.fromkeys(("bval", "bvec", "bvec_frame", "b_max"))
        return replace(self, file=Path(self.noise), others=(), noise=None, **of_images)

    @property
    def files(self) -> dict[str, list[str]]:
        """The files from which the tensors are read, grouped by role."""
        images: list[Any] = [self.file, *self.others]
        if not self.others and self.bval is None:
            images = list(siblings(self.file))
        named = described_by([str(image) for image in images])
        sidecar = sidecar_of(named) if self.bval is None and is_nifti(named) else None
        sidecars = [] if sidecar is None or not sidecar.is_file() else [sidecar]
        given = {"file": images, "sidecar": sidecars, "mask": [self.mask], "bval": [self.bval], "bvec": [self.bvec]}
        inputs = {role: [str(path) for path in paths if path is not None] for role, paths in given.items()}
        if (second := self.second_scan) is not None:
            inputs["noise"] = [*second.files["file"], *second.files["sidecar"]]
        return inputs


def is_file(noise: str | None) -> bool:
    """Return whether ``--noise`` names a file, which is a second scan."""
    if noise in (None, "residuals", "roughness"):
        return False
    try:
        float(noise)
    except ValueError:
        return True
    return False


def read_volume(reading: Reading, progress: Progress) -> TensorVolume:
    """Read the tensors by `read`, and raise ValueError if they do not define a metric."""
    require_metric(reading)
    volume = read(reading, progress)
    require_metric(reading, volume)
    if 1 in volume.shape:
        raise ValueError(f"--slice: the volume is one voxel thick. Pass --slice {'xyz'[volume.shape.index(1)]}=0")
    if (lost := without_element(volume)).any():
        progress.note(note := outside_note(int(lost.sum())))
        volume = replace(volume.with_mask(volume.inside & ~lost), notes=(*volume.notes, note))
    require_valid(volume.with_mask(volume.grid(reading.components).mask), "--repair")
    return volume


def read_grid(reading: Reading, settings: Settings, progress: Progress) -> OfVolume:
    """Return the domain of the tensors that `read_volume` reads."""
    volume = read_volume(reading, progress)
    return domain_of_volume(volume, settings, reading.image)


def without_element(volume: TensorVolume) -> Bool[np.ndarray, "*shape"]:
    """Mark the voxels of the mask that belong to no element, which the computation leaves out."""
    return volume.inside & (label_nodes(volume.inside, (False,) * volume.dimension)[0] == 0)


def outside_note(count: int) -> str:
    """Return a note about voxels of the mask that belong to no element."""
    return (
        f"{count} voxels of the mask are left out, because they belong to no element; an element is a cube (in a slice "
        "a square) of adjacent voxels of the mask"
    )


def read(reading: Reading, progress: Progress, ask: Callable[[str], None] | None = None) -> TensorVolume:
    """Read or fit the tensors, and apply the options for the slice, the mask and the repair.

    Questions about the frame or unit go to `ask` or become warnings.
    """
    with progress.stage("reading", str(reading.file)):
        volume, mask = _load(reading)
        if mask is not None and mask.shape == volume.shape:
            volume, mask = volume.with_mask(mask), None
        if mask is None:  # the background would distort the checks of units and frames
            volume = _without_filling(volume, reading, progress)
        volume = _reviewed(volume, reading, progress.warn if ask is None else ask)
        if reading.slice is not None:
            volume = sliced(volume, *reading.slice)
        if mask is not None:  # the mask may have the shape of the slice
            if mask.shape != volume.shape:
                raise ValueError(f"--mask: got shape {mask.shape}; expected the shape of the tensors, {volume.shape}")
            volume = volume.with_mask(mask)
        if reading.erode:
            left = erode(volume.inside, reading.erode)
            note = f"erode: {int(volume.inside.sum() - left.sum())} voxels at the boundary of the mask are left out"
            volume = replace(volume.with_mask(left), notes=(*volume.notes, note))
        volume = _repaired(volume, reading)
    for note in volume.notes:
        progress.note(with_option(note))
    return volume


def sliced(volume: TensorVolume, axis: str, index: int) -> TensorVolume:
    """Return a slice of a volume; errors begin with the option ``--slice``."""
    try:
        return volume.slice(axis, index)
    except ValueError as error:
        raise ValueError(f"--slice: {error}") from error


def _load(reading: Reading) -> tuple[TensorVolume, np.ndarray | None]:
    """Return the volume, and the mask of ``--mask`` unless the volume has this mask already."""
    require_reading_options(reading)
    if reading.bval is None or reading.bvec is None:
        spacing = reading.spacing[0] if reading.spacing is not None and len(reading.spacing) == 1 else reading.spacing
        files = [reading.file, *reading.others] if reading.others else reading.file
        more = {name: getattr(reading, name) for name in ("frame", "array", "confidence", "unit")}
        volume = read_tensors(files, reading.order, spacing=spacing, **more)
        return volume, None if reading.mask is None else read_mask(reading.mask, volume.affine)
    noise: Literal["residuals"] | None = "residuals" if reading.noise == "residuals" else None
    of: Any = {"unit": reading.unit, "noise": noise, "bvec_frame": reading.bvec_frame or "fsl"}
    return fit_dwi(reading.file, reading.bval, reading.bvec, reading.mask, reading.b_max, **of), None


def _without_filling(volume: TensorVolume, reading: Reading, progress: Progress) -> TensorVolume:
    """Exclude the background if ``--background outside`` is given; without the option, warn of a background.

    Zero tensors are always background, except with ``--positive``: zero is a valid stress.
    """
    if volume.mask is not None and reading.background is not None:
        progress.note(f"--background {reading.background} has no effect, because the volume has a mask")
    if reading.positive is None or reading.background == "outside":
        volume = without_background(volume)
    found = None if reading.background == "inside" else find_background(volume)
    if found is None:
        return volume
    if reading.background is None:
        progress.warn(f"{found[1]}. Pass --mask or --background outside, or --background inside to include them")
        return volume
    note = found[1].replace("count as inside", "are left out, as asked")
    return replace(volume.with_mask(~found[0]), notes=(*volume.notes, note))


def _reviewed(volume: TensorVolume, reading: Reading, ask: Callable[[str], None]) -> TensorVolume:
    """Ask questions about a wrong frame or unit; return the volume with a note about its fibres."""
    if reading.positive is not None:  # the tensors, such as stresses, are not diffusion tensors
        return volume
    volume, asked = reviewed(volume)
    for question in asked:
        if reading.strict_unit and not volume.unit and question == unit_question(volume):
            raise ValueError(
                f"{reading.file}: {question}. The tensors of all subjects must have the same unit. If the "
                "numbers are in mm²/s, pass --unit mm2/s, or add a column named unit to the table or, for bids, "
                "Units to the sidecar of the file"
            )
        ask(question)
    return volume


def _repaired(volume: TensorVolume, reading: Reading) -> TensorVolume:
    if reading.positive is not None:
        if reading.repair is not None:
            raise ValueError("--positive, --repair: got both, but --positive leaves nothing to repair. Leave one out")
        try:
            return positive_tensors(volume, *reading.positive)
        except ValueError as error:
            raise ValueError(f"--positive: {str(error).removeprefix('number: ')}") from error
    if reading.repair is None:
        return volume
    volume = repair_tensors(volume, *reading.repair)
    return volume if volume.repair["voxels"] else replace(volume, notes=(*volume.notes, "repair: none was needed"))
