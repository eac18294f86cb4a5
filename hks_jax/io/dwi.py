"""Fit diffusion tensors to diffusion-weighted images by DIPY, and find an installed example brain."""

import importlib.metadata
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hks_jax.checks import require_number
from hks_jax.io import nifti
from hks_jax.io.masks import mask_on
from hks_jax.io.tensor_order import Matrices, pack, to_voxel_axes, unpack
from hks_jax.io.units import MM2_PER_S, UNITS, Unit, b_value_question
from hks_jax.io.volume import TensorVolume, digest, placed
from hks_jax.optional import optional
from hks_jax.storage import existing, reading

_LENGTH = 0.05
"""The largest difference of a direction's length from 1 that is attributed to rounding."""
_SEEN = 0.01
"""The least ratio of a residual's variance to the variance of the noise for which the residual is used."""


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
    """Fit diffusion tensors to diffusion-weighted images by weighted least squares on log signals (DIPY's TensorModel).

    Args:
        path: a NIfTI image (nx, ny, nz, n). Voxels with a NaN or infinite signal are left out.
        bval: a text file of the n b-values, in s/mm² unless `unit` is given.
        bvec: a text file of the n gradient directions, 3 × n or n × 3. Directions must have length 1, except at b = 0.
        mask: a file (see `read_mask`) or a bool array (nx, ny, nz). Tensors outside the mask are zero. If `mask` is
            None, DIPY's median_otsu finds the brain in the mean of the unweighted images.
        b_max: the largest b-value used, in s/mm², or None for all. The tensor model is valid for b ≲ 1000–1500 s/mm².
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
        Tensors along the voxel axes, in mm²/s. If `noise` is given, the volume also describes the noise of the tensors
        to first order (`TensorVolume.noise`). DIPY raises eigenvalues that are not positive to about 1e-9 mm²/s. A note
        reports the number of voxels with raised eigenvalues; most lie at the boundary of the mask, see `erode`.

    Raises:
        ImportError: DIPY or nibabel is missing.
        FileNotFoundError: a file does not exist.
        ValueError: the numbers of images, b-values and directions differ; the b-values have another unit; a direction
            of a weighted image does not have length 1; the mask has another shape; there are too few images for the
            fit, or for an estimate of the noise; all residuals of a voxel are zero; there is no signal.

    Examples:
        >>> files = [folder / name for name in ("dwi.nii", "dwi.bval", "dwi.bvec")]
        >>> volume = hj.io.fit_dwi(*files, mask=np.ones((2, 2, 2), bool))
        >>> print(volume.tensors[0, 0, 0].diagonal().round(6))  # mm²/s
        [0.001 0.001 0.001]
    """
    dti, gradients = optional("dipy.reconst.dti"), optional("dipy.core.gradients")
    name = os.fspath(path)
    image = nifti.load(name)
    affine, _ = nifti.affine_in_mm(name, image)
    b, directions = np.atleast_1d(_numbers(bval).squeeze()), np.atleast_2d(_numbers(bvec, may_be_nan=True))
    if directions.shape[-1] != 3 or directions.shape == (3, 3) != (b.size, 3):
        directions = directions.T
    if len(image.shape) != 4 or b.shape != (image.shape[-1],) or directions.shape != (b.size, 3):
        raise ValueError(
            f"path, bval, bvec: got an image of shape {image.shape}, {b.size} b-values and directions of shape "
            f"{directions.shape}; expected an image (nx, ny, nz, n), n b-values and directions (n, 3)"
        )
    if question := b_value_question(float(b.max()), unit or "mm2/s"):
        raise ValueError(f"{os.fspath(bval)}: {question}")
    b = b / UNITS[unit or "mm2/s"]
    used = np.full(b.size, True) if b_max is None else b <= b_max
    threshold = max(50.0, float(b.min()))
    weighted = int((used & (b > threshold)).sum())
    if weighted < 6 or weighted == used.sum():
        raise ValueError(
            f"b_max: got {b_max}, which leaves {weighted} weighted and {int(used.sum()) - weighted} unweighted images; "
            "expected at least 6 weighted images and 1 unweighted image. Raise the limit"
        )
    directions, remarks = _of_length_one(os.fspath(bvec), directions, used & (b > threshold))
    signal = nifti.voxels(name, image)[..., used]
    inside, found = _inside(name, mask, signal, b[used] <= threshold, affine)
    table = gradients.gradient_table(b[used], bvecs=directions[used], b0_threshold=threshold)
    fit = dti.TensorModel(table).fit(signal, mask=inside)
    fitted = Matrices(np.where(inside[..., None, None], fit.quadratic_form, 0.0), "fit", None)
    covariance = modes = None
    if noise is not None:
        covariance, modes = _covariance(signal, inside, dti.design_matrix(table), noise, bvec_frame, affine)
    clipped = int((inside & (fit.evals[..., -1] < 1e-8)).sum())
    notes = [
        f"weighted least-squares fit to {int(used.sum())} of {b.size} images (b ≤ {b[used].max():g} s/mm²)",
        *remarks,
        *found,
        *nifti.placement_notes(image),
    ]
    if bvec_frame != "fsl":
        notes.append(f"gradient directions read along the {bvec_frame} axes; tensors transformed to the voxel axes")
    if noise is not None:
        left = f"the fit's residuals, with {int(used.sum()) - 7} degrees of freedom in each voxel"
        known = left if noise == "residuals" else f"the stated noise of the images, {noise:g}"
        notes.append(f"covariances of the tensors computed from {known}")
    if clipped:
        notes.append(f"{clipped} of {int(inside.sum())} fits are not positive definite; DIPY clips their eigenvalues")
    volume = placed(name, fitted, bvec_frame, affine, mask=inside, unit=MM2_PER_S, covariance=covariance, modes=modes)
    return replace(volume, notes=tuple(notes), digest=digest(name))


# In a voxel, let y be the log signals, X the design matrix, β the vector of unknowns, and W the diagonal matrix of the
# signals that an unweighted fit predicts. Weighted least squares minimise ‖W(y − Xβ)‖². If the noise has the variance
# σ², a log signal has the variance σ²/w² to first order, where w is the predicted signal. The estimate of the unknowns
# therefore has the covariance σ²(XᵀW²X)⁻¹, with the design matrix X and the predicted signals W. The estimate of σ² is
# the sum of squared residuals of the signals, divided by the number of images minus the number of unknowns (Koay,
# Chang, Pierpaoli and Basser 2007). The signal residual r of an image changes the unknowns by (XᵀW²X)⁻¹xwr, where x is
# the image's row of the design matrix X, and w is its predicted signal. The residual r has the variance σ²(1 − h),
# where h = w²xᵀ(XᵀW²X)⁻¹x is the leverage of the image. So the scaled residual r/√(1 − h) has the variance σ² of the
# noise (MacKinnon and White 1985, HC2). A sample of the noise has one random factor for each image, which preserves
# correlations between voxels.
def _covariance(
    signal: Float[np.ndarray, "nx ny nz n"],
    inside: Bool[np.ndarray, "nx ny nz"],
    design: Float[np.ndarray, "n 7"],
    noise: float | Literal["residuals"],
    frame: str,
    affine: Float[np.ndarray, "4 4"],
) -> tuple[Float[np.ndarray, "nx ny nz 6 6"], Float[np.ndarray, "nx ny nz n 6"] | None]:
    """Return the covariance of the components xx xy yy xz yz zz along the voxel axes; it is zero outside the mask.

    If `noise` is ``"residuals"``, also return the contribution of each image to the components' noise; otherwise None.
    """
    data = np.asarray(signal[inside], np.float64)
    positive = data[data > 0]
    y = np.log(np.maximum(data, positive.min() if positive.size else 1.0))
    weights = np.exp(2 * y @ (design @ np.linalg.pinv(design)))
    information = np.einsum("vn,na,nb->vab", weights, design, design, optimize=True)
    inverse = np.linalg.inv(information)
    if noise == "residuals":
        freedom = design.shape[0] - design.shape[1]
        if freedom < 1:
            raise ValueError(
                f'noise: got "residuals" with {design.shape[0]} images, but a tensor and the unweighted signal are '
                f"{design.shape[1]} unknowns; expected at least {design.shape[1] + 1} images, and 15 for an estimate "
                "with an error of 25 %. Give the standard deviation of the noise as a number"
            )
        # Residuals of the signals are used, because logarithms of small signals have large errors.
        fitted = np.exp(np.einsum("na,vab,vb->vn", design, inverse, (weights * y) @ design, optimize=True))
        left = data - fitted
        variance = np.sum(left**2, axis=1) / freedom
        if (zero := variance <= 1e-20 * weights.mean(axis=1)).any():
            raise ValueError(
                f'noise: got "residuals", which are zero in {int(zero.sum())} of {len(zero)} voxels; expected images '
                "with noise. Leave these voxels out of the mask, or give the standard deviation of the noise"
            )
    else:
        require_number("noise", noise)
        variance = np.full(len(data), float(noise) ** 2)
    turned = pack(to_voxel_axes(unpack(np.eye(6), "nifti"), frame, affine), "nifti").T
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


def _of_length_one(
    name: str, directions: Float[np.ndarray, "n 3"], weighted: Bool[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], list[str]]:
    """Return unit directions for weighted images and zero for other images, and a note about lengths other than 1."""
    lengths = np.linalg.norm(directions, axis=1)
    bad = weighted & ~(np.abs(lengths - 1) <= _LENGTH)
    if bad.any():
        first = int(np.argmax(bad))
        raise ValueError(
            f"{name}: got {int(bad.sum())} directions of weighted images without length 1, the first for image "
            f"{first} (from 0), {directions[first].tolist()}, of length {lengths[first]:.4g}; expected length 1. "
            "Divide each direction by its length. If the length encodes the gradient's strength, also multiply the "
            "b-value by its square. Leave out images of unknown direction"
        )
    rounded = weighted & (np.abs(lengths - 1) > 1e-3)
    unit = np.where(weighted[:, None], directions / np.where(weighted, lengths, 1.0)[:, None], 0.0)
    if not rounded.any():
        return unit, []
    low, high = lengths[rounded].min(), lengths[rounded].max()
    return unit, [f"{int(rounded.sum())} directions were divided by their lengths, {low:.4g} to {high:.4g}"]


def _inside(
    name: str,
    mask: str | os.PathLike[str] | np.ndarray | None,
    signal: Float[np.ndarray, "nx ny nz n"],
    unweighted: Bool[np.ndarray, " n"],
    affine: Float[np.ndarray, "4 4"],
) -> tuple[Bool[np.ndarray, "nx ny nz"], list[str]]:
    """Return the given or computed mask without voxels whose signal is not finite, and notes about the mask."""
    notes, finite = [], np.isfinite(signal)
    if mask is None:
        # Resampling can produce NaN outside the brain; here NaN is replaced by zero signal.
        with np.errstate(invalid="ignore"):  # median_otsu divides by zero if its median filter returns zeros
            mean = np.where(finite, signal, 0.0)[..., unweighted].mean(axis=-1)
            _, brain = optional("dipy.segment.mask").median_otsu(mean)
        if not brain.any():
            raise ValueError("mask: DIPY's median_otsu finds no brain in the unweighted images. Pass a mask")
        inside = brain.astype(bool)
        notes.append(f"no mask given: DIPY's median_otsu finds {int(inside.sum())} voxels in the unweighted images")
    else:
        inside = mask_on(signal.shape[:3], affine, mask)
    usable = inside & finite.all(axis=-1)
    if inside.any() and not usable.any():
        whole = [str(n) for n in np.flatnonzero(~finite[inside].any(axis=0))]
        which = f"the used images {', '.join(whole)} (from 0) have" if whole else "in each voxel, some image has"
        raise ValueError(f"{name}: {which} no finite signal inside the mask; expected numbers. Leave such images out")
    if lost := int((inside & ~usable).sum()):
        notes.append(f"{lost} of {int(inside.sum())} voxels inside are left out: a signal there is NaN or infinite")
    return usable, notes


def _numbers(path: str | os.PathLike[str], *, may_be_nan: bool = False) -> Float[np.ndarray, "..."]:
    file = existing(path)
    with reading(file, "a table of numbers"), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # NumPy warns if a table is empty
        numbers = np.loadtxt(file, dtype=np.float64)
        if not numbers.size or not (may_be_nan or np.isfinite(numbers).all()):
            raise ValueError("got no numbers, or NaN or infinite ones; expected finite numbers")
    return numbers
