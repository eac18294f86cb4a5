"""The automatic choice of an eigensolver, for `eigenpairs`, fits and the command line."""

from collections.abc import Callable

import jax
import numpy as np

from hks_jax.compilation import is_concrete_on_cpu
from hks_jax.eigen.adjoints.factorised_adjoint import FactorisedAdjoint
from hks_jax.eigen.filter.chebyshev_filter import ChebyshevFilter
from hks_jax.eigen.lanczos.block_lanczos import BlockLanczos
from hks_jax.eigen.shift_invert.shift_invert import ShiftInvert
from hks_jax.eigen.solver import Dense, Eigensolver
from hks_jax.fem.pencil import AnyPencil, Pencil
from hks_jax.fem.stencil import StencilOperator

SOLVERS: dict[str, Callable[[], Eigensolver]] = {
    solver.name: solver for solver in (Dense, ShiftInvert, BlockLanczos, ChebyshevFilter)
}

_SMALL = 1500
"""The largest number n of unknowns for which the dense solver, which takes O(n³) time, is chosen."""

# The choice is between shift-invert and a solver in JAX, called ``ours``: the Chebyshev filter on grids in 3D or in
# float32, otherwise block Lanczos. A solver in JAX takes about five seconds to compile at any size. So for n·k up to 5
# million, one solver is the fastest in the first call, and another solver in later calls. For each solver,
# benchmarks/first_answer/automatic.py divides the time of its first call by the shortest first call of all solvers, and
# likewise for later calls. The choice minimises the larger of the two ratios, except for small volumes in float32. In
# float32, block Lanczos also factorises in float32; so it searches repeatedly, and leaves some pairs unconverged.
_LARGE, _LARGE_IN_SINGLE = 800_000, 5_000_000
"""The least n·k (unknowns times pairs) for which a solver in JAX is chosen: in general, and for 2D grids in float32."""
_LARGE_FOR_ONE = 3_000_000
"""The least n·k for which block Lanczos has the shortest first call in float64 on 2D grids and on surfaces."""


def choose_solver(solver: str | Eigensolver, pencil: Pencil, k: int) -> Eigensolver:
    """Return the solver with the given name.

    ``"auto"`` chooses by the pencil's size, k and dtype. On an accelerator or for traced values (`jax.jit`,
    `jax.vmap`), ``"auto"`` never chooses shift-invert, because shift-invert runs on the host.

    Raises:
        ValueError: the name is unknown.
    """
    if isinstance(solver, Eigensolver):
        return solver
    if solver == "auto":
        return _automatic(pencil, k)
    if not isinstance(solver, str) or solver not in SOLVERS:
        raise ValueError(
            f'solver: got {solver!r}; expected "auto", {", ".join(f"{name!r}" for name in SOLVERS)} or a solver object'
        )
    return SOLVERS[solver]()


def choose_solvers(solver: str | Eigensolver, pencil: AnyPencil, k: int) -> list[tuple[Eigensolver, ...]]:
    """Return the solver of each problem, and the one that is tried next if the first leaves doubt.

    The problems of a doubled domain share the k eigenpairs.
    """
    share = -(-k // len(pencil.parts))
    solvers: list[tuple[Eigensolver, ...]] = []
    for part in pencil.parts:
        first = choose_solver(solver, part, share)
        # Without a lower bound of the spectrum, shift-invert may fail, for example if k cuts a large multiplet.
        unsafe = solver == "auto" and isinstance(first, ShiftInvert) and not part.bounded
        solvers.append((first, BlockLanczos()) if unsafe else (first,))
    return solvers


def choose_for_similar(pencil: AnyPencil, k: int) -> Eigensolver:
    """Return the solver that ``"auto"`` chooses for the first of many similar pencils: never a solver on the host."""
    part, share = pencil.parts[0], -(-k // len(pencil.parts))
    return Dense() if _is_small(part, share) else _in_jax(part, share)


def choose_for_one(pencil: AnyPencil, k: int) -> Eigensolver:
    """Return the solver with the shortest first call, for a process that computes the eigenpairs of one domain."""
    part, share = pencil.parts[0], -(-k // len(pencil.parts))
    usual, matrices = choose_solver("auto", part, share), (part.stiffness, part.mass)
    planar = isinstance(usual, BlockLanczos) and part.space.dimension != 3 and is_concrete_on_cpu(matrices)
    return ShiftInvert() if planar and part.space.n_dof * share < _LARGE_FOR_ONE else usual


def choose_for_fit(pencil: AnyPencil, k: int) -> Eigensolver:
    """Return the solver that ``"auto"`` chooses in a fit.

    A fit multiplies many vectors by every Jacobian. The linear solver of block Lanczos reuses its factorisations in all
    products with one Jacobian. Values are traced in a fit, so the solver must not run on the host.
    """
    n, fitting = pencil.space.n_dof, BlockLanczos(adjoint=FactorisedAdjoint(1e-5, solves=20))
    return fitting if n > _SMALL and k + 20 <= fitting.max_pairs(n) else Dense()


def _is_small(pencil: Pencil, k: int) -> bool:
    return pencil.space.n_dof <= max(_SMALL, 4 * k - 1)


def _in_jax(pencil: Pencil, k: int) -> Eigensolver:
    exact, laplacian = pencil.stiffness.dtype == np.float64, pencil.measured and pencil.bounded
    # In 3D factorisations have much fill-in, and in float32 they lose too many digits.
    volume = pencil.space.dimension == 3
    matrix_free = laplacian and isinstance(pencil.stiffness, StencilOperator) and (volume or not exact)
    candidates = ([ChebyshevFilter()] if matrix_free else []) + [BlockLanczos()]
    # The driver computes one additional pair.
    return next((solver for solver in candidates if k < solver.max_pairs(pencil.space.n_dof)), Dense())


def _automatic(pencil: Pencil, k: int) -> Eigensolver:
    n, volume = pencil.space.n_dof, pencil.space.dimension == 3
    if _is_small(pencil, k):
        return Dense()
    exact, laplacian = pencil.stiffness.dtype == np.float64, pencil.measured and pencil.bounded
    ours = _in_jax(pencil, k)
    if not is_concrete_on_cpu(jax.lax.stop_gradient((pencil.stiffness, pencil.mass))):
        return ours
    if not laplacian:
        return ShiftInvert() if n * k < _LARGE else ours
    # Shift-invert computes in float64, also for float32 matrices.
    suited = ChebyshevFilter if volume or not exact else BlockLanczos
    large = _LARGE if exact or volume else _LARGE_IN_SINGLE
    return ours if isinstance(ours, suited) and n * k >= large else ShiftInvert()
