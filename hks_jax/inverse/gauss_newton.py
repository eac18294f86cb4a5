"""A matrix-free Gauss–Newton method with Levenberg–Marquardt damping and conjugate gradients."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx  # type: ignore[import-untyped]
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from hks_jax.checks import require_count, require_number
from hks_jax.inverse.conformal import ConformalInformation, InnerProduct
from hks_jax.inverse.unknowns import Values
from hks_jax.linear.conjugate_gradients import conjugate_gradients

_Options = dict[str, Any]
_Tags = frozenset[object]

_TIGHTER, _LONGER = 30, 3
"""The linear system of a possible last step is solved 30 times more accurately, in up to 3 times as many iterations."""
_ACCEPTED, _GOOD, _SHRINKING = 0.01, 0.5, 0.25
"""A step is accepted if it achieves 1 % of the predicted reduction of the misfit. Damping decreases if a step achieves
half of the predicted reduction, and increases fourfold if a step is rejected."""
_FREE = 0.01
"""The solver converges only if damping contributes less than 1 % of the curvature along the last step."""


class _State(eqx.Module):
    first: Bool[Array, ""]  # whether the initial unknowns have not been evaluated yet
    trial: Values  # the trial point: the unknowns to be evaluated next
    finite: Bool[Array, ""]  # whether the last step is finite
    step_size: Float[Array, ""]  # the initial damping, divided by the current damping μ
    linearised: Any  # the residuals and the Jacobian at the last accepted unknowns
    aux: Any  # the auxiliary output of the residuals at the last accepted unknowns
    gradient: Values  # the gradient at the last accepted unknowns
    promised: Float[Array, ""]  # the predicted change of half the sum of squares at the trial point
    change: Float[Array, ""]  # the size of the last accepted step, relative to the tolerance
    damped: Float[Array, ""]  # the damping's share of the curvature along the last accepted step, divided by μ
    tight: Bool[Array, ""]  # whether linear systems are solved accurately enough for a last step
    done: Bool[Array, ""]  # whether the last accepted steps satisfy the tolerance


def _linearise(fn: Callable, values: Values, args: Any) -> tuple[Any, Any]:
    # Compiled as a whole, the function has the same constants in every linearisation.
    residual, product, aux = jax.linearize(lambda v: eqx.filter_jit(fn)(v, args), values, has_aux=True)
    jacobian = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: values))
    return optx.FunctionInfo.ResidualJac(residual, jacobian), aux


def _empty(structure: Any) -> Any:
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, structure)


class GaussNewton(optx.AbstractLeastSquaresSolver[Values, Any, Any, _State]):
    """The default solver of `hks_jax.fit_metric`.

    For the residuals r with the Jacobian J, a step δ satisfies (JᵀJ + μB) δ = −Jᵀr, where B is an inner product of the
    unknowns and μ is the damping. Conjugate gradients solve the linear system for δ roughly, because far from the
    solution the linearisation error exceeds the algebraic error. Conjugate gradient iterates are descent directions.

    The solver's settings are arrays, so a compiled step works for all values of the settings.

    Args:
        tolerance: the relative and absolute change of the unknowns (root mean square) at which the solver stops.
        damping: the damping μ of the first step, relative to the scale of the data.
        growth: the divisor of the damping μ after a step that achieves more than half of the predicted reduction.
        inner_product: the inner product B, in whose norm steps are damped.
        inner_tolerance: the relative residual of conjugate gradients, divided by 30 if the step may be the last.
        inner_steps: the maximum number of products with JᵀJ in a step, multiplied by 3 if the step may be the last.
        preconditioner: the preconditioner of the conjugate gradients, by default the inner product B.

    Examples:
        >>> import optimistix
        >>> solution = optimistix.least_squares(lambda x, _: x**2 - 2, hj.inverse.GaussNewton(), jnp.ones(1))
        >>> round(float(solution.value[0]), 3)
        1.414
    """

    rtol: Float[Array, ""]  # type: ignore[assignment]
    atol: Float[Array, ""]  # type: ignore[assignment]
    norm: Callable[[Any], Array]
    growth: Float[Array, ""]
    damping: Float[Array, ""]
    inner_product: InnerProduct
    inner_tolerance: Float[Array, ""]
    inner_steps: Int[Array, ""]
    preconditioner: InnerProduct | ConformalInformation

    def __init__(
        self,
        tolerance: float | Array = 1e-4,
        damping: float | Array = 1e-4,
        growth: float | Array = 10.0,
        inner_product: InnerProduct | None = None,
        inner_tolerance: float | Array = 1e-2,
        inner_steps: int = 120,
        preconditioner: InnerProduct | ConformalInformation | None = None,
    ) -> None:
        require_number("tolerance", tolerance)
        require_number("damping", damping, inclusive=True)
        require_number("growth", growth, above=1)
        require_number("inner_tolerance", inner_tolerance, 1)
        require_count("inner_steps", inner_steps)
        self.rtol = self.atol = jnp.asarray(tolerance)
        self.norm, self.growth, self.damping = optx.rms_norm, jnp.asarray(growth), jnp.asarray(damping)
        self.inner_tolerance, self.inner_steps = jnp.asarray(inner_tolerance), jnp.asarray(inner_steps)
        self.inner_product = inner_product or InnerProduct()
        self.preconditioner = preconditioner or self.inner_product

    def accepted(self, y: Values, state: _State) -> _State:
        """Return the state after the step from the unknowns y to the trial point, still with the gradient at y."""
        step = state.trial - y
        change = optx.rms_norm(step / (self.rtol * (1 + jnp.abs(state.trial))))
        moved, curvature = change > 0, -jnp.vdot(step, state.gradient)
        damped = jnp.vdot(step, self.inner_product.apply(step)) / jnp.where(curvature > 0, curvature, 1)
        damped = jnp.where(moved & (curvature > 0), damped, jnp.inf)
        # The distance to the solution is estimated by the last step or, if larger, a geometric series of future steps.
        ratio = change / state.change
        settled = moved & (ratio < 1) & (change * jnp.maximum(1, ratio / (1 - ratio)) < 1)
        # The next step may be the last if the ratio of the last two steps predicts that it is below the tolerance.
        near = moved & jnp.isfinite(state.change) & (change**2 < state.change)
        change = jnp.where(moved, change, jnp.inf)
        tight, done = state.tight | near | settled, state.tight & settled
        return dataclasses.replace(state, change=change, damped=damped, tight=tight, done=done)

    def _done(self, state: _State) -> Bool[Array, ""]:
        """Return whether the steps satisfy the tolerance, and are not small merely because of damping."""
        return state.done & (self.damping / state.step_size * state.damped < _FREE)

    # For the residuals r and the Jacobian J, let g = Jᵀr be the gradient. Conjugate gradients find an approximate
    # solution x of (JᵀJ + μB) x = g with the damping μ and the inner product B, so that the residual g − (JᵀJ + μB) x
    # is orthogonal to x. Therefore the linearisation predicts that the step δ = −x changes half the sum of squares by
    #
    #     ½|r + Jδ|² − ½|r|² = −gᵀx + ½ xᵀJᵀJx = −½ (gᵀx + μ xᵀBx).
    def _next(self, y: Values, state: _State, needed: bool | Bool[Array, ""]) -> _State:
        """Return the state with the gradient at the unknowns y and with the next trial point (y after convergence)."""
        jacobian, residual, shape = state.linearised.jac, state.linearised.residual, y.shape
        adjoint, damping = jacobian.transpose(), self.damping / state.step_size

        # The compiled program contains J and Jᵀ only once, because the Jacobian dominates the compilation time.
        def normal(x: Array, first: Bool[Array, ""]) -> tuple[Array, float]:
            x = x.reshape(shape)
            image = adjoint.mv(jax.lax.cond(first, lambda: residual, lambda: jacobian.mv(x)))
            return (image + damping * self.inner_product.apply(x)).reshape(-1, 1), 0.0  # x = 0 at first

        def precondition(r: Array) -> Array:
            return self.preconditioner.precondition(r.reshape(shape), damping).reshape(-1, 1)

        tolerance = jnp.where(state.tight, self.inner_tolerance / _TIGHTER, self.inner_tolerance)
        most = jnp.where(state.tight, _LONGER * self.inner_steps, self.inner_steps)
        most = jnp.where(needed & ~self._done(state), most, 0)
        like = y.reshape(-1, 1)
        solution = conjugate_gradients(normal, precondition, like, tolerance[None], most=most, orthogonal=True)
        x, gradient = solution.x.reshape(shape), solution.rhs.reshape(shape)
        promised = -(jnp.vdot(gradient, x) + damping * jnp.vdot(x, self.inner_product.apply(x))) / 2
        # A stationary point is a solution, but a step of size zero does not count as convergence.
        stationary = jnp.all(gradient == 0)
        done, damped = state.done | stationary, jnp.where(stationary, 0, state.damped)
        found = {"trial": y - x, "finite": jnp.all(jnp.isfinite(x)), "gradient": gradient, "promised": promised}
        return dataclasses.replace(state, **found, done=done, damped=damped)

    def init(
        self, fn: Callable, y: Values, args: Any, options: _Options, f_struct: Any, aux_struct: Any, tags: _Tags
    ) -> _State:
        """Return the initial state, whose trial point is the initial unknowns ``y``."""
        structure, _ = eqx.filter_eval_shape(_linearise, fn, y, args)
        known = _empty(structure), _empty(aux_struct), jnp.zeros_like(y)
        yes, (zero, one, far) = jnp.asarray(True), jnp.asarray([0, 1, jnp.inf], y.dtype)
        return _State(yes, y, yes, one, *known, zero, far, far, ~yes, ~yes)

    def step(
        self, fn: Callable, y: Values, args: Any, options: _Options, state: _State, tags: _Tags
    ) -> tuple[Values, _State, Any]:
        """Accept or reject the trial point, choose the next one, and return the unknowns and the auxiliary output.

        Conjugate gradients for the next trial point take most of a step's time, and are skipped if the function
        ``options["enough"]`` returns true for the auxiliary output.
        """
        linearised, aux = _linearise(fn, state.trial, args)
        # Jaxprs are compared by identity, so each new state keeps the jaxpr of the previous state.
        linearised = eqx.combine(
            eqx.filter(linearised, eqx.is_array), eqx.filter(state.linearised, eqx.is_array, inverse=True)
        )
        change = linearised.as_min() - state.linearised.as_min()
        accept = state.first | (change <= _ACCEPTED * state.promised)
        good = ~state.first & (change < _GOOD * state.promised) & (state.promised < 0)
        step_size = state.step_size * jnp.where(good, self.growth, jnp.where(accept, 1, _SHRINKING))

        accepted = dataclasses.replace(self.accepted(y, state), linearised=linearised, aux=aux)
        before, static = eqx.partition((y, state), eqx.is_array)
        after = eqx.filter((state.trial, accepted), eqx.is_array)
        y, state = eqx.combine(jax.lax.cond(accept, lambda: after, lambda: before), static)
        state = dataclasses.replace(state, first=jnp.asarray(False), step_size=step_size)
        needed = ~options["enough"](state.aux) if "enough" in options else True
        state = self._next(y, state, needed)
        return y, state, state.aux

    def terminate(
        self, fn: Callable, y: Values, args: Any, options: _Options, state: _State, tags: _Tags
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Return whether the unknowns have converged, and whether the last step is finite."""
        successful, not_finite = optx.RESULTS.successful, optx.RESULTS.nonlinear_divergence
        return self._done(state), optx.RESULTS.where(state.finite, successful, not_finite)

    def postprocess(self, fn: Callable, y: Values, aux: Any, *args: Any, **settings: Any) -> tuple[Values, Any, dict]:
        """Return the unknowns and the auxiliary output unchanged."""
        return y, aux, {}
