"""The forms of the Laplace–Beltrami operator, for scikit-fem to assemble."""

from collections.abc import Callable

import numpy as np
import skfem


def laplace_beltrami(metric: Callable) -> tuple[skfem.BilinearForm, skfem.BilinearForm]:
    """Stiffness and mass; the metric (…, d, d) at quadrature points is a function of the form's parameters."""

    @skfem.BilinearForm
    def stiffness(u, v, w):
        T = metric(w)
        weight = np.sqrt(np.linalg.det(T))[..., None, None] * np.linalg.inv(T)
        return np.einsum("a...,...ab,b...->...", u.grad, weight, v.grad)

    @skfem.BilinearForm
    def inertia(u, v, w):
        return np.sqrt(np.linalg.det(metric(w))) * u * v

    return stiffness, inertia
