"""Fit diffusion tensors to diffusion-weighted images, and find an installed example brain."""

import importlib.metadata
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_number
from hks_jax.io import nifti
from hks_jax.io.masks import mask_on
from hks_jax.io.tensor_order import Matrices, indices, pack, to_voxel_axes, unpack
from hks_jax.io.units import MM2_PER_S, UNITS, Unit, b_value_question, median_mean_diffusivity, unknown_unit
from hks_jax.io.volume import TensorVolume, digest, placed
from hks_jax.naming import argument
from hks_jax.optional import optional
from hks_jax.storage import reading

_LENGTH = 0.05
"""The largest difference of a direction's length from 1 that is attributed to rounding."""
_SEEN = 0.01
"""The least ratio of a residual's variance to the variance of the noise for which the residual is used."""
_UNKNOWNS = 7
"""The unknowns of a voxel: six components of the tensor, and the logarithm of the unweighted signal."""
_DETERMINED = 0.05
"""The least singular value of the design matrix, with b-values relative to the largest, for which unknowns count as
determined. At this value, noise of 1 % in the signals changes the tensor by 0.2 divided by the largest b-value."""
_UNWEIGHTED = 0.02
"""The b-value, relative to the largest, up to which an image needs no direction: it then counts as unweighted."""
_TENSOR_MODEL = 1500.0
"""The b-value, in s/mm², up to which a tensor describes the signal of living tissue."""
_FOR_MASK = 50.0
"""The b-value, in s/mm², up to which images serve to find the brain."""
_AT_ONCE = 10_000
"""The number of voxels that are fitted at once, which limits the memory."""
_FAINT = 1e-8
"""The least weight of a measured signal in a voxel, relative to the voxel's largest."""


class ExampleBrain(NamedTuple):
    """Paths to the files of a diffusion-weighted scan of a brain."""

    images: Path
    bval: Path
    bvec: Path
    mask: Path


def find_example_brain() -> ExampleBrain | None:
    """Return the files of the brain in the PyPI wheel ``mdt`` (104 × 104 × 2 voxels of 2 mm), None without the wheel.

    The scan has 13 images at b = 0, 30 at 1000 and 60 at 2000 s/mm². Install ``mdt`` 1.2.7 (licence LGPL-3.0-or-later)
    with ``--no-deps``. The function reads only the metadata of the wheel, without importing the wheel.

    Examples:
        >>> brain = hj.io.find_example_brain()
        >>> brain is None or brain.images.exists()
        True
    """
    stem = "b1k_b2k_example_slices_24_38"
    names = (f"{stem}.nii.gz", "b1k_b2k.bval", "b1k_b2k.bvec", f"{stem}_mask.nii.gz")
    try:
        files = importlib.metadata.files("mdt") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    paths = {file.name: Path(str(file.locate())) for file in files if Path(str(file.locate())).is_file()}
    return ExampleBrain(*(paths[name] for name in names)) if paths.keys() >= set(names) else None


def fit_dwi(
    path: str | os.PathLike[str],
    bval: str | os.PathLike[str],
    bvec: str | os.PathLike[str],
    mask: str | os.PathLike[str] | Bool[np.ndarray, "*shape"] | None = None,
    b_max: float | None = None,
    *,
    bvec_frame: Literal["fsl", "voxel", "world"] = "fsl",
    unit: Unit | None = None,
    noise: float | Literal["residuals"] | None = None,
) -> TensorVolume:
    """Fit diffusion tensors to diffusion-weighted images by weighted least squares on log signals.

    The unknowns of a voxel are the tensor and the unweighted signal. The fit needs images of at least two b-values, but
    none at b = 0. A signal that is not finite or not positive was not measured, and has no weight in the fit.

    Args:
        path: a NIfTI image (nx, ny, nz, n).
        bval: a text file of the n b-values, in s/mm² unless `unit` is given.
        bvec: a text file of the n gradient directions, 3 × n or n × 3. Directions must have length 1, except for images
            with at most 2 % of the largest b-value, which count as unweighted if their direction has another length.
        mask: a file (see `read_mask`) or a bool array (nx, ny, nz). Tensors outside the mask are zero. If `mask` is
            None, DIPY's median_otsu finds the brain in the mean of the images with b ≤ 50, or with the lowest b-value.
        b_max: the largest b-value used, in s/mm², or None for all. The tensor model is valid for b ≲ 1000–1500 s/mm².
            An `AccuracyWarning` reports larger b-values, unless diffusion is so slow that they are small for it.
        bvec_frame: the axes along which the gradient directions are given. ``"fsl"``, for files of dcm2niix and FSL,
            means the voxel axes, where the first axis is reversed if the affine's determinant is positive. ``"voxel"``
            means the voxel axes. ``"world"`` means the scanner's axes, as in MRtrix.
        unit: a unit of diffusivity whose reciprocal is the unit of the b-values: ``"m2/s"`` for b-values in s/m²,
            ``"um2/ms"`` for b-values in ms/µm². None means mm²/s.
        noise: the standard deviation of the images' noise, in the images' unit, from which the tensors' covariance is
            computed. ``"residuals"`` estimates the deviation in each voxel from the residuals of the fit (n − 7 degrees
            of freedom), and records the contribution of each image to the noise of the tensors (`TensorVolume.modes`,
            24 bytes for each voxel and image). If `noise` is None, no covariance is computed.

    Returns:
        Tensors along the voxel axes, in mm²/s, as the fit gives them: some may not be positive definite, mostly at the
        boundary of the mask (see `erode` and `repair_tensors`). If `noise` is given, the volume also describes the
        noise of the tensors to first order (`TensorVolume.noise`). Notes list the b-values, count the signals that were
        not measured, and count the voxels inside the mask that are left out because the others do not determine the
        tensor.

    Raises:
        ImportError: nibabel is missing, or DIPY without a mask.
        FileNotFoundError: a file does not exist.
        ValueError: the numbers of images, b-values and directions differ; the b-values have another unit; a direction
            of a weighted image does not have length 1; the b-values and directions do not determine a tensor; the mask
            has another shape; there are too few images for an estimate of the noise; all residuals of a voxel are zero;
            an image has no positive signal inside the mask.

    Examples:
        >>> files = [folder / name for name in ("dwi.nii", "dwi.bval", "dwi.bvec")]
        >>> volume = hj.io.fit_dwi(*files, mask=np.ones((2, 2, 2), bool))
        >>> print(volume.tensors[0, 0, 0].diagonal().round(6))  # mm²/s
        [0.001 0.001 0.001]
    """
    name, table = os.fspath(path), f"{os.fspath(bval)}, {os.fspath(bvec)}"
    image, voxels = nifti.load(name)
    affine, _ = nifti.affine_in_mm(name, image)
    b, directions = np.atleast_1d(_numbers(bval).squeeze()), np.atleast_2d(_numbers(bvec, may_be_nan=True))
    if directions.shape[-1] != 3 or directions.shape == (3, 3) != (b.size, 3):
        directions = directions.T
    if len(image.shape) != 4 or b.shape != (image.shape[-1],) or directions.shape != (b.size, 3):
        raise ValueError(
            f"path, bval, bvec: got an image of shape {image.shape}, {b.size} b-values and directions of shape "
            f"{directions.shape}; expected an image (nx, ny, nz, n), n b-values and directions (n, 3)"
        )
    if b.min() < 0:
        raise ValueError(f"{os.fspath(bval)}: got the b-value {b.min():g}; expected numbers from 0")
    if unit not in (None, *UNITS):
        raise ValueError(unknown_unit(unit))
    if b_max is not None:
        require_number("b_max", b_max, inclusive=True)
    if question := b_value_question(float(b.max()), unit or "mm2/s"):
        raise ValueError(f"{os.fspath(bval)}: {question}")
    b = b / UNITS[unit or "mm2/s"]
    used = np.full(b.size, True) if b_max is None else b <= b_max
    if not used.any():
        raise ValueError(f"b_max: got {b_max}, which leaves no image; the b-values begin at {b.min():g}. Raise it")
    all_images, images, b, directions = b.size, np.flatnonzero(used), b[used], directions[used]
    b, directions, remarks = _directed(os.fspath(bvec), b, directions, images)
    largest = float(b.max()) or 1.0
    design = _design(b / largest, directions)  # the unknown components are multiplied by the largest b-value
    _require_determined(table, design, b, b_max)
    if noise == "residuals" and b.size <= _UNKNOWNS:
        raise ValueError(
            f'noise: got "residuals" with {b.size} images, but a tensor and the unweighted signal are {_UNKNOWNS} '
            f"unknowns; expected at least {_UNKNOWNS + 1} images, and 15 for an estimate with an error of 25 %. Give "
            "the standard deviation of the noise as a number"
        )
    signal = voxels[..., used]
    inside, found = _inside(name, mask, signal, design, b, images, _UNKNOWNS + (noise == "residuals"), affine)
    data = signal[inside].astype(np.float64)
    tensors, pieces = np.zeros((*inside.shape, 3, 3)), []
    for start in range(0, len(data), _AT_ONCE):
        fit = _least_squares(data[start : start + _AT_ONCE], design)
        pieces.append(fit.unknowns[:, :6] / largest)
    tensors[inside] = unpack(np.concatenate(pieces), "nifti")
    covariance = modes = None
    if noise is not None:
        covariance, modes = _covariance(data, inside, design, largest, noise, bvec_frame, affine)
    notes = [
        f"weighted least-squares fit to {b.size} of {all_images} images ({_shells(b)} s/mm²)",
        *remarks,
        *found,
        *nifti.placement_notes(image),
    ]
    if bvec_frame != "fsl":
        notes.append(f"gradient directions read along the {bvec_frame} axes; tensors transformed to the voxel axes")
    if noise is not None:
        left = f"the fit's residuals, with {b.size - _UNKNOWNS} degrees of freedom in each voxel"
        known = left if noise == "residuals" else f"the stated noise of the images, {noise:g}"
        notes.append(f"covariances of the tensors computed from {known}")
    fitted = Matrices(tensors, "fit", None)
    volume = placed(name, fitted, bvec_frame, affine, mask=inside, unit=MM2_PER_S, covariance=covariance, modes=modes)
    _warn_of_large_b(largest, volume)
    return replace(volume, notes=tuple(notes), digest=digest(name))


def _warn_of_large_b(largest: float, volume: TensorVolume) -> None:
    """Warn of b-values at which the signal of tissue is not that of a tensor; slow diffusion allows larger b-values."""
    mean = median_mean_diffusivity(volume)
    if largest > _TENSOR_MODEL and largest * mean > 1:
        warn_of_accuracy(
            f"tensors are fitted to images up to b = {largest:g} s/mm², but a tensor describes the signal of tissue "
            f"only for b ≲ {_TENSOR_MODEL:g} s/mm²; at larger b-values, diffusivities are underestimated. If the scan "
            f"has images at lower b-values, pass {argument('b_max', int(_TENSOR_MODEL))}"
        )


def _shells(b: Float[np.ndarray, " n"]) -> str:
    """Return the numbers of images by b-value, such as "2 at b = 0, 30 at b = 995 … 1005", or the range of b-values."""
    b = np.sort(b)
    shells = np.split(b, np.flatnonzero(np.diff(b) > np.maximum(20.0, 0.05 * b[:-1])) + 1)
    if len(shells) > 6:
        return f"b = {b[0]:g} … {b[-1]:g}"
    return ", ".join(f"{s.size} at b = {s[0]:g}" + f" … {s[-1]:g}" * bool(s[0] < s[-1]) for s in shells)


def _design(b: Float[np.ndarray, " n"], directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 7"]:
    """Return the matrix from the tensor's components xx xy yy xz yz zz and the log unweighted signal to log signals."""
    rows, columns = np.transpose(indices("nifti", 3))
    double = np.where(rows == columns, 1, 2)  # an off-diagonal component counts twice
    weighted = -b[:, None] * directions[:, rows] * directions[:, columns] * double
    return np.column_stack([weighted, np.ones(b.size)])


def _rank(matrix: Float[np.ndarray, "n m"]) -> int:
    return int((np.linalg.svd(matrix, compute_uv=False) > _DETERMINED).sum())


def _require_determined(
    table: str,
    design: Float[np.ndarray, "n 7"],
    b: Float[np.ndarray, " n"],
    b_max: float | None,
) -> None:
    """Raise ValueError unless the images determine a tensor and the unweighted signal."""
    rank = _rank(design)
    if rank == _UNKNOWNS:
        return
    of_directions = _rank(design[:, :6])  # tables may have directions at b = 0, too
    if 0 < of_directions < 6:
        missing = (
            f"The gradient directions determine {of_directions} of a tensor's 6 components; expected at least six axes "
            "that lie neither in a plane nor on a cone, where opposite directions are the same axis"
        )
    else:
        missing = (
            f"The b-values {b.min():g} to {b.max():g} s/mm² do not separate the mean diffusivity from the unweighted "
            f"signal; expected images of another b-value too, such as b = {0 if b.max() > 100 else 1000}"
        )
    where = table if b_max is None else f"b_max: got {b_max:g}"
    raised = ". Raise the limit, if the scan has such images" * (b_max is not None)
    raise ValueError(
        f"{where}: the {b.size} images ({_shells(b)} s/mm²) determine only {rank} of the {_UNKNOWNS} unknowns, the "
        f"tensor's 6 components and the unweighted signal. {missing}{raised}"
    )


# In a voxel, let y be the log signals, X the design matrix, β the vector of unknowns, and W the diagonal matrix of the
# signals that an unweighted fit predicts. Weighted least squares minimise ‖W(y − Xβ)‖². If the noise has the variance
# σ², a log signal has the variance σ²/w² to first order, where w is the predicted signal. The estimate of the unknowns
# therefore has the covariance σ²(XᵀW²X)⁻¹, with the design matrix X and the predicted signals W. The estimate of σ² is
# the sum of squared residuals of the signals, divided by the number of images minus the number of unknowns (Koay,
# Chang, Pierpaoli and Basser 2007). The signal residual r of an image changes the unknowns by (XᵀW²X)⁻¹xwr, where x is
# the image's row of the design matrix X, and w is its predicted signal. The residual r has the variance σ²(1 − h),
# where h = w²xᵀ(XᵀW²X)⁻¹x is the leverage of the image. So the scaled residual r/√(1 − h) has the variance σ² of the
# noise (MacKinnon and White 1985, HC2). A sample of the noise has one random factor for each image, which preserves
# correlations between voxels. A signal that was not measured has the weight w = 0 in all these formulas.
class _Fit(NamedTuple):
    """The weighted least-squares fits of voxels: β, W² and (XᵀW²X)⁻¹."""

    unknowns: Float[np.ndarray, "v 7"]
    weights: Float[np.ndarray, "v n"]
    inverse: Float[np.ndarray, "v 7 7"]


def _measured(signal: Float[np.ndarray, "*v n"]) -> Bool[np.ndarray, "*v n"]:
    return np.isfinite(signal) & (signal > 0)


def _information(weights: Float[np.ndarray, "v n"], design: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, "v 7 7"]:
    squares = design[:, :, None] * design[:, None, :]
    return np.tensordot(weights, squares, axes=1)


def _least_squares(data: Float[np.ndarray, "v n"], design: Float[np.ndarray, "n 7"]) -> _Fit:
    measured = _measured(data)
    y = np.log(np.where(measured, data, 1.0))

    def solve(weights: Float[np.ndarray, "v n"]) -> Float[np.ndarray, "v 7"]:
        return np.linalg.solve(_information(weights, design), ((weights * y) @ design)[..., None])[..., 0]

    exponent = 2 * solve(measured.astype(np.float64)) @ design.T
    largest = np.where(measured, exponent, -np.inf).max(axis=1, keepdims=True)
    relative = np.where(measured, np.exp(np.clip(exponent - largest, np.log(_FAINT), 0.0)), 0.0)
    scale = np.exp(largest)
    return _Fit(solve(relative), relative * scale, np.linalg.inv(_information(relative, design)) / scale[..., None])


def _covariance(
    data: Float[np.ndarray, "v n"],
    inside: Bool[np.ndarray, "nx ny nz"],
    design: Float[np.ndarray, "n 7"],
    largest: float,
    noise: float | Literal["residuals"],
    frame: str,
    affine: Float[np.ndarray, "4 4"],
) -> tuple[Float[np.ndarray, "nx ny nz 6 6"], Float[np.ndarray, "nx ny nz n 6"] | None]:
    """Return the covariance of the components xx xy yy xz yz zz along the voxel axes; it is zero outside the mask.

    If `noise` is ``"residuals"``, also return the contribution of each image to the components' noise; otherwise None.
    """
    measured, (unknowns, weights, inverse) = _measured(data), _least_squares(data, design)
    if noise == "residuals":
        # Residuals of the signals are used, because logarithms of small signals have large errors.
        left = np.where(measured, data - np.exp(unknowns @ design.T), 0.0)
        variance = np.sum(left**2, axis=1) / (measured.sum(axis=1) - _UNKNOWNS)
        if (zero := variance <= 1e-20 * weights.mean(axis=1)).any():
            raise ValueError(
                f'noise: got "residuals", which are zero in {int(zero.sum())} of {len(zero)} voxels; expected images '
                "with noise. Leave these voxels out of the mask, or give the standard deviation of the noise"
            )
    else:
        require_number("noise", noise)
        variance = np.full(len(data), float(noise) ** 2)
    turned = pack(to_voxel_axes(unpack(np.eye(6), "nifti"), frame, affine), "nifti").T / largest
    covariance = np.zeros((*inside.shape, 6, 6))
    covariance[inside] = turned @ (variance[:, None, None] * inverse[:, :6, :6]) @ turned.T
    if noise != "residuals":
        return covariance, None
    # The noise's standard deviation with a random sign replaces residuals of images that the fit reproduces exactly.
    unseen = np.random.default_rng(0).choice([-1.0, 1.0], data.shape) * np.sqrt(variance)[:, None]
    modes = np.zeros((*inside.shape, len(design), 6), np.float32)
    for i, x in enumerate(design):  # a loop saves memory
        change = inverse @ x * np.sqrt(weights[:, i, None])
        rest = 1 - np.sqrt(weights[:, i]) * (change @ x)
        size = np.where(rest > _SEEN, left[:, i] / np.sqrt(np.maximum(rest, _SEEN)), unseen[:, i])
        modes[inside, i] = size[:, None] * change[:, :6] @ turned.T
    return covariance, modes


def _directed(
    name: str, b: Float[np.ndarray, " n"], directions: Float[np.ndarray, "n 3"], images: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], list[str]]:
    """Return b-values and unit directions, zero for images without a direction, and notes about changed directions."""
    lengths = np.linalg.norm(directions, axis=1)
    directed = np.abs(lengths - 1) <= _LENGTH
    bad = ~directed & (b > _UNWEIGHTED * b.max())
    if bad.any():
        first = int(np.argmax(bad))
        raise ValueError(
            f"{name}: got {int(bad.sum())} directions of weighted images without length 1, the first for image "
            f"{images[first]} (from 0, b = {b[first]:g}), {directions[first].tolist()}, of length {lengths[first]:.4g};"
            " expected length 1. Divide each direction by its length. If the length encodes the gradient's strength, "
            "also multiply the b-value by its square. Leave out images of unknown direction"
        )
    notes = []
    if (vague := ~directed & (b > 0)).any():
        limit = b[vague].max()
        notes.append(
            f"{int(vague.sum())} images without a direction, b ≤ {limit:g}, count as unweighted, which changes "
            f"diffusivities by up to {limit / b.max():.1%}"
        )
    rounded = directed & (b > 0) & (np.abs(lengths - 1) > 1e-3)
    if rounded.any():
        low, high = lengths[rounded].min(), lengths[rounded].max()
        notes.append(f"{int(rounded.sum())} directions were divided by their lengths, {low:.4g} to {high:.4g}")
    unit = np.where(directed[:, None], directions / np.where(directed, lengths, 1.0)[:, None], 0.0)
    return np.where(directed, b, 0.0), unit, notes


def _inside(
    name: str,
    mask: str | os.PathLike[str] | np.ndarray | None,
    signal: Float[np.ndarray, "nx ny nz n"],
    design: Float[np.ndarray, "n 7"],
    b: Float[np.ndarray, " n"],
    images: Int[np.ndarray, " n"],
    needed: int,
    affine: Float[np.ndarray, "4 4"],
) -> tuple[Bool[np.ndarray, "nx ny nz"], list[str]]:
    """Return the given or computed mask without voxels whose signals do not determine a tensor, and notes about it.

    The numbers of the images in the file are `images`, and a voxel needs at least `needed` measured signals.
    """
    notes, measured = [], _measured(signal)
    if mask is None:
        # Resampling can produce NaN outside the brain; here NaN is replaced by zero signal.
        with np.errstate(invalid="ignore"):  # median_otsu divides by zero if its median filter returns zeros
            mean = np.where(measured, signal, 0.0)[..., b <= max(_FOR_MASK, b.min())].mean(axis=-1)
            _, brain = optional("dipy.segment.mask").median_otsu(mean)
        if not brain.any():
            raise ValueError("mask: DIPY's median_otsu finds no brain in the unweighted images. Pass a mask")
        inside = brain.astype(bool)
        notes.append(f"no mask given: DIPY's median_otsu finds {int(inside.sum())} voxels in the unweighted images")
    else:
        inside = mask_on(signal.shape[:3], affine, mask)
        if not inside.any():
            raise ValueError("mask: got a mask without voxels; expected at least one voxel inside")
    present = measured[inside]
    if empty := images[~present.any(axis=0)].tolist():
        raise ValueError(
            f"{name}: the used images {', '.join(map(str, empty))} (from 0) have no positive finite signal inside the "
            "mask; expected positive numbers. Leave such images out"
        )
    determined = present.sum(axis=1) >= needed
    partial = np.flatnonzero(determined & ~present.all(axis=1))
    information = _information(present[partial].astype(np.float64), design)
    determined[partial] = np.linalg.eigvalsh(information)[:, 0] > _DETERMINED**2
    usable = inside.copy()
    usable[inside] = determined
    if not determined.any():
        raise ValueError(
            f"{name}: in none of the {len(present)} voxels inside the mask, the positive finite signals determine a "
            f"tensor, which needs {needed} images. Check the mask, and leave out images without signal"
        )
    if lost := int((~determined).sum()):
        first = tuple(np.argwhere(inside & ~usable)[0].tolist())
        notes.append(
            f"{lost} of {len(present)} voxels inside are left out, the first at {first}: too few of their signals are "
            "positive and finite to determine a tensor"
        )
    absent = ~present[determined]
    if absent.any():
        by_image = absent.sum(axis=0)
        worst = int(np.argmax(by_image))
        first = tuple(np.argwhere(usable)[np.argmax(absent.any(axis=1))].tolist())
        notes.append(
            f"{int(absent.sum())} signals in {int(absent.any(axis=1).sum())} other voxels, the first at {first}, are "
            f"not positive and finite and have no weight; {int((by_image > 0).sum())} images have such signals, image "
            f"{images[worst]} (from 0) most, {int(by_image[worst])}"
        )
    return usable, notes


def _numbers(path: str | os.PathLike[str], *, may_be_nan: bool = False) -> Float[np.ndarray, "..."]:
    with reading(path, "a table of numbers") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # NumPy warns if a table is empty
        numbers = np.loadtxt(file, dtype=np.float64, encoding="utf-8-sig")
        if not numbers.size or not (may_be_nan or np.isfinite(numbers).all()):
            raise ValueError("got no numbers, or NaN or infinite ones; expected finite numbers")
    return numbers
