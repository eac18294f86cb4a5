"""An analytic brain-like slice of diffusion tensors, for demonstrations without data."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

GREY, WHITE, FLUID = 0.8e-3, (1.7e-3, 0.3e-3), 3.0e-3
"""Diffusivities in mm²/s: grey matter; white matter along and across the fibres; cerebrospinal fluid."""

FIELD_OF_VIEW = (160.0, 190.0, 130.0)
"""Millimetres, left–right, back–front, down–up."""


def phantom(
    shape: Sequence[int] = (96, 112),
) -> tuple[Float[np.ndarray, "*shape d d"], Bool[np.ndarray, "*shape"], tuple[float, ...]]:
    """Return diffusion tensors of a phantom that looks like an axial slice through a brain, or a stack of them.

    A folded rind of grey matter, white matter with the arch of a corpus callosum, an arc of fibres on either side, a
    crossing of the two, and two ventricles.

    Args:
        shape: number of voxels, 2 (left–right, back–front) or 3 (and down–up) axes.

    Returns:
        tensors (*shape, d, d) in mm²/s, SPD everywhere; mask (*shape); spacing per axis in mm.
    """
    d = len(shape)
    if d not in (2, 3):
        raise ValueError(f"shape: got {tuple(shape)}; expected 2 or 3 axes")
    axes = [np.linspace(-1, 1, n) for n in shape]
    x, y, *third = np.meshgrid(*axes, indexing="ij")
    z = third[0] if third else np.zeros_like(x)
    # Higher and lower slices through an ellipsoid are smaller ones.
    shrink = np.sqrt(np.clip(1 - 0.8 * z**2, 0.1, None))
    x, y = x / shrink, y / shrink

    radius, angle = np.hypot(x / 0.86, y / 0.9), np.arctan2(y, x)
    mask = radius < 1
    folds = 0.84 + 0.045 * np.sin(14 * angle) + 0.03 * np.sin(9 * angle + 1)
    fissure = _ridge(x, 0.03) * _step(np.abs(y) - 0.42, 0.05)
    white = _step(folds - radius, 0.035) * (1 - fissure)
    deep = _blob(np.abs(x) - 0.27, y + 0.1, 0.1, 0.17)  # grey nuclei beside the ventricles
    white *= 1 - deep
    ventricles = _blob(np.abs(x) - 0.12 - 0.1 * y**2, y - 0.05, 0.055, 0.3)

    # Fibre directions as weighted dyads, so that crossings average and signs do not matter.
    callosum = sum(_ridge(np.hypot(x / 0.62, (y - end) / 0.3) - 1, 0.14) * _step(side * (y - end), 0.05)
                   for end, side in ((0.38, -1), (-0.32, 1)))  # fmt: skip
    middle = _blob(x, y - 0.38 + 0.28, 0.3, 0.08) + _blob(x, y + 0.32 - 0.28, 0.3, 0.08)
    arcs = _ridge(np.hypot(x / 0.6, y / 0.72) - 1, 0.12)
    radial = np.arctan2(y / 0.81, x / 0.74)
    bundles = [
        (callosum + middle, np.arctan2(-0.9 * x * np.sign(y), 0.35)),
        (1.5 * arcs, radial + np.pi / 2),
        (0.25 * np.ones_like(x), radial),
    ]
    total = sum(weight for weight, _ in bundles)
    tensors = GREY * np.broadcast_to(np.eye(d), (*x.shape, d, d))
    fibres = np.zeros_like(tensors)
    for weight, direction in bundles:
        v = np.stack([np.cos(direction), np.sin(direction), 0 * direction][:d], axis=-1)
        dyad = WHITE[1] * np.eye(d) + (WHITE[0] - WHITE[1]) * v[..., :, None] * v[..., None, :]
        fibres += (weight / total)[..., None, None] * dyad
    tensors = _mix(tensors, fibres, white)
    tensors = _mix(tensors, FLUID * np.eye(d), np.clip(ventricles + 0.5 * fissure, 0, 1))
    return tensors, mask, tuple(extent / (n - 1) for extent, n in zip(FIELD_OF_VIEW, shape, strict=False))


def _step(x: np.ndarray, width: float) -> np.ndarray:
    return 0.5 * (1 + np.tanh(x / width))


def _ridge(x: np.ndarray, width: float) -> np.ndarray:
    return np.exp(-((x / width) ** 2))


def _blob(x: np.ndarray, y: np.ndarray, a: float, b: float) -> np.ndarray:
    return _step(1 - np.hypot(x / a, y / b), 0.15)


def _mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return a + weight[..., None, None] * (b - a)
