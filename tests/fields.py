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


def turning(nodes: np.ndarray, ratio: float, rate: float) -> np.ndarray:
    """Eigenvalues (ratio, 1), in 3D (ratio, 1, √ratio), turned by rate·(2x + y), in 3D after a tilt by rate·(z − x)."""
    d = nodes.shape[-1]
    frame = _rotation(rate * (2 * nodes[..., 0] + nodes[..., 1]), 0, 1, d)
    if d == 3:
        frame = frame @ _rotation(rate * (nodes[..., 2] - nodes[..., 0]), 1, 2, d)
    return np.einsum("...ia,a,...ja->...ij", frame, [ratio, 1.0, np.sqrt(ratio)][:d], frame)


def _rotation(angle: np.ndarray, a: int, b: int, d: int) -> np.ndarray:
    matrix = np.broadcast_to(np.eye(d), (*angle.shape, d, d)).copy()
    matrix[..., a, a] = matrix[..., b, b] = np.cos(angle)
    matrix[..., a, b], matrix[..., b, a] = -np.sin(angle), np.sin(angle)
    return matrix
