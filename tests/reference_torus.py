"""The heat kernel of a torus of revolution to rounding error, by a Fourier method of its own."""

import numpy as np
from scipy.linalg import eigh


def torus_hks(times: np.ndarray, major: float, minor: float, n: int = 81) -> tuple[np.ndarray, np.ndarray]:
    """Return the tube angles v (n,), n odd, and the HKS there (n_times, n); it does not depend on the other angle.

    With φ = e^{imu} ψ(v) and w = major + minor cos v the eigenproblem is one in v for each m,
    ∫ (w/minor) ψ'χ' + (minor m²/w) ψχ = λ ∫ minor w ψχ, here in trigonometric polynomials on n equidistant nodes.
    """
    v = 2 * np.pi * np.arange(n) / n
    gap = np.subtract.outer(np.arange(n), np.arange(n))
    sine = np.sin(np.pi * gap / n)
    derivative = np.where(gap == 0, 0, 0.5 * (-1.0) ** gap / np.where(gap == 0, 1, sine))
    w = major + minor * np.cos(v)
    mass, hks = np.diag(minor * w * 2 * np.pi / n), np.zeros((len(times), n))
    for m in range(n):
        stiffness = 2 * np.pi / n * (derivative.T * (w / minor) @ derivative + np.diag(minor * m**2 / w))
        values, modes = eigh(stiffness, mass)
        twice = 1 if m == 0 else 2
        hks += twice / (2 * np.pi) * np.exp(-np.outer(times, values)) @ (modes**2).T
    return v, hks
