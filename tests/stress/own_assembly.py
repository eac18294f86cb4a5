"""Another assembly on grids, cell by cell with NumPy, and other eigensolvers: what the library must agree with."""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg

_DENSE = 1000


@dataclass(frozen=True)
class Form:
    """What is assembled: the tensors' meaning, the fields of the operator, and the rules of integration."""

    fick: bool = False  # the tensors are D, and the volume element is dx
    logarithms: bool = False  # interpolate logarithms of tensors
    lumped: bool = False
    cancelling: bool = False
    potential: np.ndarray | None = None  # at the nodes
    density: np.ndarray | None = None  # at the nodes


class Spectrum(NamedTuple):
    """The eigenvalues of a problem, and squares of its eigenfunctions at all nodes, (k, *shape)."""

    values: np.ndarray
    squares: np.ndarray


Sides = tuple[tuple[str, str], ...]


def spectrum(
    tensors: np.ndarray, spacing: tuple[float, ...], inside: np.ndarray, sides: Sides, rim: str, form: Form, k: int
) -> Spectrum:
    """Return the k lowest eigenpairs, or all of a small problem; `sides` are "neumann", "dirichlet" or "periodic"."""
    shape, d = inside.shape, inside.ndim
    wraps = [low == "periodic" for low, _ in sides]
    corners = np.array(list(product((0, 1), repeat=d)))
    cells = list(product(*[range(n if wrap else n - 1) for n, wrap in zip(shape, wraps, strict=True)]))
    numbers = np.ravel_multi_index(tuple(np.moveaxis((np.array(cells)[:, None] + corners) % shape, -1, 0)), shape)
    active = inside.ravel()[numbers].all(axis=1)
    touched = np.bincount(numbers[active].ravel(), minlength=inside.size)
    around = np.bincount(numbers.ravel(), minlength=inside.size)
    free = touched > 0
    if rim == "dirichlet":
        free &= touched == around
    nodes = np.stack(np.unravel_index(np.arange(inside.size), shape))
    for axis, conditions in enumerate(sides):
        for end, condition in zip((0, shape[axis] - 1), conditions, strict=True):
            free &= (nodes[axis] != end) | (condition != "dirichlet")
    K, M = _assembled(tensors.reshape(-1, d, d).astype(float), numbers[active], corners, np.array(spacing), form)
    sums = np.asarray(M.sum(axis=1)).ravel()
    if form.lumped:
        M = sp.diags(sums).tocsr()
    K, M = K[free][:, free], M[free][:, free]
    if free.sum() <= _DENSE:
        values, vectors = scipy.linalg.eigh(K.toarray(), M.toarray())
    else:
        least = 0.0 if form.potential is None else min(form.potential.min(), 0.0)
        below = least - 1e-3 * K.diagonal().sum() / M.diagonal().sum()
        start = np.random.default_rng(0).standard_normal(K.shape[0])
        values, vectors = scipy.sparse.linalg.eigsh(K, k, M, sigma=below, tol=1e-14, v0=start)
    if form.cancelling:
        vectors = (vectors + (M @ vectors) / sums[free, None]) / 2
    squares = np.zeros((len(values), inside.size))
    squares[:, free] = vectors.T**2
    squares[:, touched == 0] = np.nan
    order = np.argsort(values)
    return Spectrum(values[order], squares[order].reshape(-1, *shape))


def largest(spectrum: Spectrum, tensors: np.ndarray, spacing: tuple[float, ...], fick: bool) -> float:
    """Return λ_max, or a number of its order for a spectrum that lacks it."""
    if len(spectrum.values) > 100:
        return float(np.abs(spectrum.values[[0, -1]]).max())
    conductivity = tensors if fick else np.linalg.inv(tensors)
    return 12 * float(np.linalg.eigvalsh(conductivity / np.multiply.outer(spacing, spacing)).max())


def _assembled(
    tensors: np.ndarray, numbers: np.ndarray, corners: np.ndarray, spacing: np.ndarray, form: Form
) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """Return the matrices on all nodes; (E, 2^d) numbers are the nodes at the corners of each cell."""
    n, gauss = len(corners), 1 / np.sqrt(3)
    at_corners = _mapped(np.log, tensors)[numbers] if form.logarithms else tensors[numbers]
    K, M = np.zeros((2, len(numbers), n, n))
    samples = []
    for corner in corners:
        h, _ = _shapes((2 * corner - 1) * gauss, corners, spacing)
        sample = np.einsum("i,eiab->eab", h, at_corners)
        samples.append((_mapped(np.exp, sample) if form.logarithms else sample, h))
    # The points of the stiffness depend on the mean of the metric over the Gauss points of a cell.
    metric = sum(np.linalg.inv(T) if form.fick else T for T, _ in samples) / n
    points = _cancelling(metric * np.outer(spacing, spacing)) if form.cancelling else np.full(len(metric), gauss)
    of_mass = np.sqrt(2 / 3) if form.cancelling else gauss
    for corner, (T, h) in zip(corners, samples, strict=True):
        volume = np.full(len(T), spacing.prod() / n) * (1 if form.fick else np.sqrt(np.linalg.det(T)))
        if form.density is not None:
            volume = volume * (form.density.ravel()[numbers] @ h)
        conductivity = T if form.fick else np.linalg.inv(T)
        signs = 2 * corner - 1
        _, dh = _shapes(signs * points[:, None], corners, spacing)
        at_mass, _ = _shapes(signs * of_mass, corners, spacing)
        K += np.einsum("e,eia,eab,ejb->eij", volume, dh, conductivity, dh, optimize=True)
        each = np.multiply.outer(volume, np.outer(at_mass, at_mass))
        M += each
        if form.potential is not None:
            K += (form.potential.ravel()[numbers] @ h)[:, None, None] * each
    rows, columns = np.repeat(numbers, n, axis=1).ravel(), np.tile(numbers, (1, n)).ravel()
    size = (len(tensors),) * 2
    return tuple(sp.csr_matrix((each.ravel(), (rows, columns)), size) for each in (K, M))


def _shapes(x: np.ndarray, corners: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the multilinear shape functions at a point of [−1, 1]^d, and their gradients in coordinates."""
    factors = (1 + (2 * corners - 1) * x[..., None, :]) / 2
    slopes = (2 * corners - 1) / spacing
    axes = range(len(spacing))
    gradients = [slopes[:, a] * np.prod(np.delete(factors, a, axis=-1), axis=-1) for a in axes]
    return factors.prod(axis=-1), np.stack(gradients, axis=-1)


def _mapped(function: np.ufunc, tensors: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(tensors)
    return np.einsum("...ia,...a,...ja->...ij", vectors, function(values), vectors)


def _cancelling(S: np.ndarray) -> np.ndarray:
    """Return the points at which the mean error of plane waves vanishes; phases are normal with the covariance S."""
    B, axes = np.linalg.inv(S), range(S.shape[-1])

    def moment(a: int, b: int, c: int, e: int) -> np.ndarray:
        return S[:, a, b] * S[:, c, e] + S[:, a, c] * S[:, b, e] + S[:, a, e] * S[:, b, c]

    rest, slope = np.zeros((2, len(S)))
    for a, b in product(axes, repeat=2):
        own = moment(a, a, a, a) if a == b else 2 * (moment(a, b, a, a) + moment(a, b, b, b))
        rest += B[:, a, b] * (sum(moment(a, b, c, c) for c in axes) - own) / 12
        slope += B[:, a, b] * sum(moment(a, b, c, c) for c in axes if c not in (a, b))
    return np.sqrt(np.clip(1 - 4 * rest / slope, 0.01, 1.0))
