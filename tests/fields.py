"""Fields that several test modules use."""

import numpy as np

import hks_jax as hj


def random_spd(rng: np.random.Generator, shape: tuple[int, ...], spread: float = 1.0) -> np.ndarray:
    """Random SPD tensors of the given node shape, eigenvalues within exp(±spread)."""
    d = len(shape)
    frames = np.linalg.qr(rng.standard_normal((*shape, d, d)))[0]
    values = np.exp(rng.uniform(-spread, spread, (*shape, d)))
    return np.einsum("...ia,...a,...ja->...ij", frames, values, frames)


def flat(shape: tuple[int, ...], lengths: tuple[float, ...], periodic: tuple[bool, ...] = (False, False, False)):
    """The Euclidean metric on a box; periodic axes have the length as their period."""
    spacing = [a / (n if wraps else n - 1) for a, n, wraps in zip(lengths, shape, periodic, strict=False)]
    d = len(shape)
    return hj.TensorField(hj.Grid(shape, spacing), np.broadcast_to(np.eye(d), (*shape, d, d)))
