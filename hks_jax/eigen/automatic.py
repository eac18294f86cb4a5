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
# float32, otherwise block Lanczos. A solver in JAX takes many seconds to compile at any size, and uses all cores, while
# shift-invert uses one. So for n·k (unknowns times pairs) up to 5 million, shift-invert has the shortest first call and
# the other solver, on free cores, the shortest later calls: see benchmarks/first_answer/automatic.py.
_LARGE = 800_000
"""The least n·k from which on later calls of shift-invert take much longer than those of ``ours``."""
_LARGE_UNDER_JIT = 2_000_000
"""The least n·k, except in 3D, for which ``ours`` is chosen under `jit`, where it takes twice as long to compile."""
_LARGE_FOR_COMMAND = 5_000_000
"""The least n·k, except in 3D, for which ``ours`` takes the least processor time in a process with few domains."""


def choose_solver(solver: str | Eigensolver, pencil: Pencil, k: int) -> Eigensolver:
    """Return the solver with the given name.

    ``"auto"`` chooses by the pencil's size, k and dtype. On accelerators, and under `jax.jit` with several devices or a
    cache of compiled programs, ``"auto"`` never chooses shift-invert, because shift-invert runs on the host.

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


def choose_for_command(pencil: AnyPencil, k: int) -> Eigensolver:
    """Return the solver that ``"auto"`` chooses in a command, whose processor time counts, compilation included."""
    part, share = pencil.parts[0], -(-k // len(pencil.parts))
    usual = choose_solver("auto", part, share)
    planar = part.space.dimension != 3 and part.stiffness.dtype == np.float64 and jax.default_backend() == "cpu"
    few = planar and part.space.n_dof * share < _LARGE_FOR_COMMAND
    return ShiftInvert() if few and isinstance(usual, BlockLanczos) else usual


def choose_for_fit(pencil: AnyPencil, k: int) -> Eigensolver:
    """Return the solver that ``"auto"`` chooses in a fit, where values are traced.

    A fit multiplies many vectors by every Jacobian, so the linear solver of derivatives is one that reuses its
    factorisations in all products with one Jacobian.
    """
    n, adjoint = pencil.space.n_dof, FactorisedAdjoint(1e-5, solves=20)
    if n <= _SMALL or k + 20 > BlockLanczos().max_pairs(n):
        return Dense()
    return (ShiftInvert if _calls_host(pencil.parts[0], k) else BlockLanczos)(adjoint=adjoint)


def _calls_host(pencil: Pencil, k: int) -> bool:
    """Return whether a program under `jax.jit` calls the host for eigenpairs.

    With several devices, XLA might call the host on each of them. JAX cannot store such a program in a cache. Without a
    lower bound of the spectrum, the host may leave doubt, and under `jit` a second solver cannot follow.
    """
    small = pencil.space.n_dof * k < (_LARGE if pencil.space.dimension == 3 else _LARGE_UNDER_JIT)
    alone = jax.default_backend() == "cpu" and jax.device_count() == 1
    return small and pencil.bounded and alone and not jax.config.values["jax_compilation_cache_dir"]


def _in_jax(pencil: Pencil, k: int) -> Eigensolver:
    exact, laplacian = pencil.stiffness.dtype == np.float64, pencil.measured and pencil.bounded
    # In 3D factorisations have much fill-in, and in float32 they lose too many digits.
    volume = pencil.space.dimension == 3
    matrix_free = laplacian and isinstance(pencil.stiffness, StencilOperator) and (volume or not exact)
    candidates = ([ChebyshevFilter()] if matrix_free else []) + [BlockLanczos()]
    # `pairs_of_pencil` computes one additional pair.
    return next((solver for solver in candidates if k < solver.max_pairs(pencil.space.n_dof)), Dense())


def _automatic(pencil: Pencil, k: int) -> Eigensolver:
    n, planar = pencil.space.n_dof, pencil.space.dimension != 3
    if n <= max(_SMALL, 4 * k - 1):
        return Dense()
    exact, laplacian = pencil.stiffness.dtype == np.float64, pencil.measured and pencil.bounded
    ours, by_callback = _in_jax(pencil, k), _calls_host(pencil, k)
    if not is_concrete_on_cpu(jax.lax.stop_gradient((pencil.stiffness, pencil.mass))):
        if not by_callback:
            return ours
        # In later calls, derivatives in JAX are twice as fast as on the host; in 3D and in float32, they are not.
        return ShiftInvert(adjoint=FactorisedAdjoint()) if exact and planar else ShiftInvert()
    if not laplacian:
        return ShiftInvert() if n * k < _LARGE else ours
    # On tetrahedra and on float32 surfaces, `ours` is block Lanczos but not suited, so that shift-invert is chosen.
    # In float32, block Lanczos factorises in float32; so it searches repeatedly, and leaves some pairs unconverged.
    suited = BlockLanczos if planar and exact else ChebyshevFilter
    large = _LARGE if exact or not planar else _LARGE_FOR_COMMAND
    return ours if isinstance(ours, suited) and n * k >= large else ShiftInvert()
