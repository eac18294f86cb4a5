"""Reading tensor volumes."""

import math
import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from hks_jax.checks import require_number
from hks_jax.io import components, nifti
from hks_jax.io.formats import format_of
from hks_jax.io.masks import read_mask
from hks_jax.io.repair import Repair, repair_tensors
from hks_jax.io.tensor_order import Frame, Order
from hks_jax.io.units import Unit, in_mm2_per_s
from hks_jax.io.volume import TensorVolume, as_mask, digest


def read_tensors(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    order: Order | None = None,
    mask: str | os.PathLike[str] | Bool[np.ndarray, "*shape"] | None = None,
    *,
    frame: Frame | None = None,
    array: str | None = None,
    spacing: float | Sequence[float] | None = None,
    confidence: float = 0.5,
    repair: Repair | None = None,
    unit: Unit | None = None,
) -> TensorVolume:
    """Read a field of diffusion tensors.

    A file that leaves the order of components or their axes open is refused with the choices named.

    NIfTI (``.nii``, ``.nii.gz``): a symmetric-matrix image, (nx, ny, nz, 1, 6) with intent code 1005, whose components
    are xx xy yy xz yz zz; or any (nx, ny, nz, 6) or (nx, ny, nz, 1, 6) image whose `order` is given, because
    programs differ. The distance between voxels is that of the affine. Lengths are in mm: those of files that declare
    another unit, as NIfTI and NRRD can, are converted, and a note says so. A BIDS sidecar beside the image is heeded
    where it has ``OrientationEncoding``: `frame` by its Reference, and the order of its Type "tensor".

    Six NIfTI images, one for each component, as BIDS's ``param-txx`` … ``param-tzz``, DSI Studio and ANTs have them:
    all six, or one, whose siblings are found by its name.

    MRtrix (``.mif``, ``.mif.gz``): the six components of its dwi2tensor, along the scanner's axes.

    NRRD (``.nrrd``, ``.nhdr``): an axis of any of the format's kinds of matrix, 2D or 3D, symmetric or whole, masked or
    not, at any place; or an axis of six (in the plane three) components whose `order` is given. The measurement frame
    is heeded. The affine's axes are right, anterior, superior where the file's space is patient-based.

    VTK (``.vti``, structured points in ``.vtk``): tensors of nine or six components at the points or cells, along the
    axes of space; and a mask of this name. Tensors without components across an image one voxel thick are 2×2.

    npz: the array ``tensors`` (nx, ny, 2, 2) or (nx, ny, nz, 3, 3), array axis a being coordinate a and tensor index a,
    or six (in the plane three) components whose order is given; and, optional, ``spacing`` (d,) = 1, ``origin`` (d,)
    = 0, ``mask`` (*shape,), ``affine`` (4, 4), ``order``, ``frame``. npy: the tensors alone.

    Args:
        path: the file, or six.
        order: ``"nifti"`` (xx xy yy xz yz zz), ``"fsl"`` (xx xy xz yy yz zz), ``"mrtrix"`` (xx yy zz xy xz yz) or
            ``"vtk"`` (xx yy zz xy yz xz); None: as the file declares. Not for whole matrices.
        mask: a file (see `read_mask`) or a bool array of the volume's shape; None: the file's own, or no mask.
        frame: the axes along which the file's components are: ``"voxel"``; ``"fsl"`` (voxel axes, the first reversed
            where the affine's determinant is positive); ``"world"`` (the axes of the file's space); ``"measurement"``
            (NRRD's measurement frame). None: what the file declares, or what the order's programs write: voxel axes
            for ``"nifti"``, ``"fsl"``, and ``"world"`` for ``"mrtrix"``, ``"vtk"``; for NumPy's files voxel axes.
        array: the name of the tensors' array in an npz or VTK file, where there are several.
        spacing: for NumPy's files without one.
        confidence: voxels of NRRD's masked kinds are inside where their confidence is larger.
        repair: what to do with tensors inside the mask that are not positive definite: see `repair_tensors`. None:
            nothing; a metric made of them is refused.
        unit: of the tensors, ``"mm2/s"``, ``"um2/ms"`` (10⁻³ mm²/s), ``"um2/s"``, ``"cm2/s"`` or ``"m2/s"``: they are
            converted to mm²/s. None: the numbers are taken as they are.

    Returns:
        The tensors along the voxel axes. What about them gives reason to doubt frame or unit, `questions` asks.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unreadable or unknown kind of file; an order or a frame that is not declared; shapes that
            disagree; tensors that `repair` cannot mend.
        ImportError: an optional library is missing; says what to install.
    """
    require_number("confidence", confidence, above=-math.inf)
    if not isinstance(path, str | os.PathLike):
        if array is not None or spacing is not None:
            raise ValueError("array, spacing: they are for NumPy's and VTK's files; leave them out for six images")
        volume = components.read_tensors(list(path), order, frame)
    else:
        name, reader = os.fspath(path), format_of(path)
        if array is not None and "array" not in reader.options:
            raise ValueError(f"array: got {array!r}; only npz and VTK files have arrays by name")
        if spacing is not None and "spacing" not in reader.options:
            raise ValueError(f"spacing: {name} has its own; only NumPy's files may need one")
        if reader is nifti.FORMAT and components.is_one_of_six(path):
            volume = components.read_tensors(components.siblings(path), order, frame)
        else:
            given = {"array": array, "spacing": spacing, "confidence": confidence}
            volume = reader.read_tensors(name, order, frame, **{option: given[option] for option in reader.options})
            if not name.lower().endswith(".nhdr"):  # which is a header alone, and says nothing of the data beside it
                volume = replace(volume, digest=digest(name))
    if unit is not None:
        volume = in_mm2_per_s(volume, unit)
    if mask is not None:
        inside = as_mask("mask", mask) if isinstance(mask, np.ndarray) else read_mask(mask, volume.affine)
        if inside.shape != volume.shape:
            raise ValueError(f"mask: got shape {inside.shape}; expected the tensors' shape {volume.shape}")
        volume = volume.with_mask(inside)
    return volume if repair is None else repair_tensors(volume, repair)
