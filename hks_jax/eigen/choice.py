"""Which solver "auto" stands for: the one policy, for `eigenpairs`, fits and the command line."""

from collections.abc import Callable

import jax
import numpy as np

from hks_jax.eigen.complement.factorised import FactorisedAdjoint
from hks_jax.eigen.dense import Dense
from hks_jax.eigen.filter.chebyshev_filter import ChebyshevFilter
from hks_jax.eigen.host.shift_invert import ShiftInvert
from hks_jax.eigen.lanczos.block_lanczos import BlockLanczos
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.operators import StencilOperator
from hks_jax.fem.pencil import MirrorPencil, Pencil
from hks_jax.traced import is_traced

SOLVERS: dict[str, Callable[[], Eigensolver]] = {
    solver.name: solver for solver in (Dense, ShiftInvert, BlockLanczos, ChebyshevFilter)
}

_SMALL = 1500
"""Unknowns up to which all pairs at once are affordable: n³ whatever k is, and nothing can be missed."""

# Seconds of the processor for the first call in a process, compilation included, and for those that follow; float64,
# random anisotropic tensors, two cores that did other work too (which leaves ratios right to some 30 %):
#
#   nodes/pairs   n·k     shift-invert    ours, compiled
#   64²/50        0.2 M   3.5    0.7      13     0.4    block Lanczos
#   64²/100       0.4 M   7.3    1.8      12     0.8
#   128²/50       0.8 M   10     7        15     1.0
#   96²/100       0.9 M   12     2.7      15     3
#   128²/100      1.6 M   20     5        16     2.3
#   96²/200       1.8 M   17     7.7      17     1.9
#   surface/100   0.6 M   9      4.3      17     2.7    (6400 vertices)
#   16³/50        0.2 M   5.5    1.5      17     1.9    Chebyshev filter
#   20³/100       0.8 M   20     13       23     6.4
#
# In float32 block Lanczos factorises in float32, which costs it several searches: at 128²/100 it needs 13 s. The filter
# needs 4 s (the first time 24).
_LARGE, _LARGE_IN_3D = 1_000_000, 800_000
"""Unknowns times pairs from which on JAX's solvers win, or nearly, even if they have to be compiled first."""


def choose_solver(solver: str | Eigensolver, pencil: Pencil, k: int) -> Eigensolver:
    """Return the solver that a name stands for.

    ``"auto"`` chooses by the pencil's size, k and dtype. Where values are traced (`jax.jit`, `jax.vmap`) or on an
    accelerator it never chooses shift-invert, which runs on the host.

    Raises:
        ValueError: an unknown name.
    """
    if isinstance(solver, Eigensolver):
        return solver
    if solver == "auto":
        return _automatic(pencil, k)
    if solver not in SOLVERS:
        raise ValueError(
            f'solver: got {solver!r}; expected "auto", {", ".join(f"{name!r}" for name in SOLVERS)} or a solver object'
        )
    return SOLVERS[solver]()


def choose_for_fit(pencil: Pencil | MirrorPencil, k: int) -> Eigensolver:
    """Return what ``"auto"`` stands for in a fit, where one linearisation serves many products with the Jacobian.

    Factorisations serve them all, which the filter does not have; and as fits are traced, none runs on the host.
    """
    n, fitting = pencil.space.n_dof, BlockLanczos(adjoint=FactorisedAdjoint(1e-5, solves=20))
    return fitting if n > _SMALL and k + 20 <= fitting.max_pairs(n) else Dense()


def _automatic(pencil: Pencil, k: int) -> Eigensolver:
    n, volume = pencil.space.n_dof, pencil.space.dimension == 3
    if n <= _SMALL or 4 * k > n:
        return Dense()
    exact = pencil.stiffness.dtype == np.float64
    # In 3D factorisations fill in, and in float32 they lose too many digits.
    matrix_free = isinstance(pencil.stiffness, StencilOperator) and (volume or not exact)
    ours: Eigensolver = ChebyshevFilter() if matrix_free and k < ChebyshevFilter().max_pairs(n) else BlockLanczos()
    if k >= ours.max_pairs(n):  # one pair more is computed
        ours = Dense()
    if is_traced(jax.lax.stop_gradient(pencil)) or jax.default_backend() != "cpu":
        return ours
    # The host's solver has float64 for float32 matrices too.
    if volume:
        return ours if isinstance(ours, ChebyshevFilter) and n * k >= _LARGE_IN_3D else ShiftInvert()
    return ours if exact and isinstance(ours, BlockLanczos) and n * k >= _LARGE else ShiftInvert()
