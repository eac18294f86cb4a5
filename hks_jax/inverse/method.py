"""What the least squares problem of a fit is solved with."""

from typing import Any

import jax.numpy as jnp
import optimistix as optx

from hks_jax.inverse.conformal import conformal_information
from hks_jax.inverse.gauss_newton import GaussNewton
from hks_jax.inverse.optimise import Optimiser
from hks_jax.inverse.parametrisation import Conformal
from hks_jax.inverse.problem import Problem
from hks_jax.inverse.smoothing import Euclidean, InnerProduct, Preconditioner, Smoothing, smoothing
from hks_jax.inverse.truncated import observed_times
from hks_jax.inverse.unknowns import Nodal, Unknowns

OPTIMISERS = ("gauss-newton", "lbfgs", "bfgs")


def choose_inner_product(unknowns: Unknowns, smoothness: float | None, noise: float | None) -> InnerProduct:
    """Return that in which steps are small, of a given smoothness; see `hks_jax.fit_metric` for its default."""
    if not isinstance(unknowns, Nodal):
        return Euclidean()
    grid = unknowns.init.grid
    if smoothness is None:
        extent = max(h * (n - 1) for h, n in zip(grid.spacing, grid.shape, strict=True))
        smoothness = 0.1 * extent if unknowns.smooth or noise is not None else 0.0
    return smoothing(grid, smoothness, unknowns.init.domain_tensors.dtype)


def choose_optimiser(
    given: str | Optimiser,
    problem: Problem,
    tolerance: float,
    noise: float | None,
    inner_product: InnerProduct,
    step_size: float = 1.0,
) -> Optimiser:
    """Return the solver that a name stands for.

    Args:
        given: one of `OPTIMISERS`, or a solver.
        problem: what it is for.
        tolerance: see `hks_jax.fit_metric`.
        noise: the same.
        inner_product: in which steps are small.
        step_size: where damping begins, relative to where it does by default.

    Raises:
        ValueError: an unknown name.
    """
    if given == "gauss-newton":
        # Against noise small steps: the misfit must not fall far below what the noise explains.
        damping, growth = (1e-4, 10.0) if noise is None else (1e-2, 3.0)
        preconditioner = _preconditioner(problem, inner_product)
        return GaussNewton(tolerance, damping / step_size, growth, inner_product, preconditioner=preconditioner)
    if given in ("lbfgs", "bfgs"):
        kind: Any = optx.LBFGS if given == "lbfgs" else optx.BFGS
        traced = jnp.asarray(tolerance)  # a static one would compile every stage anew
        return kind(traced, traced, optx.rms_norm)
    if isinstance(given, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        return given
    names = ", ".join(map(repr, OPTIMISERS))
    raise ValueError(
        f"optimiser: got {given!r}; expected {names}, or a least squares solver or minimiser of optimistix"
    )


def _preconditioner(problem: Problem, inner_product: InnerProduct) -> Preconditioner:
    """Return what resembles JᵀJ where that is known, else the inner product."""
    unknowns, observation = problem.unknowns, problem.observation
    if isinstance(unknowns, Nodal) and isinstance(unknowns.parametrisation, Conformal):
        rough = isinstance(inner_product, Smoothing) and inner_product.factor is None
        if rough and observation.signature == "hks" and not problem.regularisers:
            return conformal_information(unknowns, inner_product, jnp.asarray(observed_times(observation)))
    return inner_product
