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
from hks_jax.inverse.conformal import InnerProduct, Preconditioner
from hks_jax.inverse.unknowns import Values
from hks_jax.linear.conjugate_gradients import conjugate_gradients

_Options = dict[str, Any]
_Tags = frozenset[object]

_TIGHTER, _LONGER = 30, 3
"""The factors of the accuracy and of the number of products in the linear systems of steps that may be the last."""
_ACCEPTED, _GOOD, _SHRINKING = 0.01, 0.5, 0.25
"""The shares of the predicted reduction that accept a step and reduce damping; the step size's factor otherwise."""
_FREE = 0.01
"""The largest share of damping in a step's curvature at which the step estimates the distance to the solution."""


def remaining_change(last: Array, before: Array) -> Array:
    """Return the last step or, if larger, the sum of the future steps in a geometric series with the last two."""
    ratio = jnp.where(before > 0, last / before, jnp.inf)
    return jnp.where(ratio < 1, last * jnp.maximum(1, ratio / (1 - ratio)), jnp.inf)


class _State(eqx.Module):
    """The state of the descent at the last accepted unknowns."""

    values: Values  # the unknowns
    gradient: Values  # the gradient
    promised: Float[Array, ""]  # the linearised change of half the sum of squares by the last step
    change: Float[Array, ""]  # the size of the last accepted step, in tolerances
    damped: Float[Array, ""]  # xᵀBx of that step over its curvature; times μ, the share of damping
    tight: Bool[Array, ""]  # whether the linear systems are solved more exactly
    done: Bool[Array, ""]  # whether the descent has converged


def begun(y: Values) -> _State:
    """Return the state before any unknowns are accepted."""
    far, no = jnp.asarray(jnp.inf, y.dtype), jnp.zeros((), bool)
    return _State(y, jnp.zeros_like(y), jnp.zeros((), y.dtype), far, far, no, no)


class _Progress(eqx.Module):
    """The state of the solver."""

    first: Bool[Array, ""]  # whether no step has been accepted
    trial: Values  # the unknowns to be evaluated next
    step_size: Float[Array, ""]  # 1/μ, relative to the first
    linearised: Any  # residuals and Jacobian at the last accepted unknowns
    aux: Any  # the auxiliary output of the residuals there
    descent: _State  # the state of the descent there
    finite: Bool[Array, ""]  # whether the last step is finite


def _linearise(fn: Callable, values: Values, args: Any) -> tuple[Any, Any]:
    """Return residuals with their linearisation, and their auxiliary output."""
    residual, product, aux = jax.linearize(lambda v: fn(v, args), values, has_aux=True)
    jacobian = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: values))
    return optx.FunctionInfo.ResidualJac(residual, jacobian), aux


def _empty(structure: Any) -> Any:
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, structure)


class GaussNewton(optx.AbstractLeastSquaresSolver[Values, Any, Any, _Progress]):
    """The default solver of `hks_jax.fit_metric`.

    Its steps δ solve (JᵀJ + μB) δ = −Jᵀr, where B is an inner product of the unknowns and μ = damping / step size. The
    conjugate gradients stop early, because far from the solution the linearisation error exceeds the algebraic error.
    They return a descent direction whenever they stop.

    The settings are arrays, so a step that is compiled for some values works for all.

    Args:
        tolerance: the relative and absolute change of the unknowns (root mean square) at which the solver stops; see
            `Search`.
        damping: the damping μ of the first step, relative to the scale of the data.
        growth: the divisor of μ after a step that reduces the misfit as much as its linearisation predicts.
        inner_product: the inner product B, in whose norm steps are damped.
        inner_tolerance: the reduction of the linear residual in a step; 30 times smaller if it may be the last.
        inner_steps: the maximum number of products with JᵀJ in a step; three times larger if it may be the last.
        preconditioner: the preconditioner of the conjugate gradients; B by default.

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
    preconditioner: Preconditioner

    def __init__(
        self,
        tolerance: float | Array = 1e-4,
        damping: float | Array = 1e-4,
        growth: float | Array = 10.0,
        inner_product: InnerProduct | None = None,
        inner_tolerance: float | Array = 1e-2,
        inner_steps: int = 120,
        preconditioner: Preconditioner | None = None,
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
        """Return the state after an accepted step to new unknowns; the next step computes the gradient there."""
        step = y - state.values
        change = optx.rms_norm(step / (self.rtol * (1 + jnp.abs(y))))
        moved, curvature = change > 0, -jnp.vdot(step, state.gradient)
        damped = jnp.vdot(step, self.inner_product.apply(step)) / jnp.where(curvature > 0, curvature, 1)
        damped = jnp.where(moved & (curvature > 0), damped, jnp.inf)
        settled = moved & (remaining_change(change, state.change) < 1)
        # The next step may be the last: it is below the tolerance if the steps keep shrinking at this rate.
        near = moved & jnp.isfinite(state.change) & (change**2 < state.change)
        change = jnp.where(moved, change, jnp.inf)
        tight, done = state.tight | near | settled, state.tight & settled
        return _State(y, state.gradient, state.promised, change, damped, tight, done)

    def _done(self, step_size: Array, state: _State) -> Bool[Array, ""]:
        """Return whether the unknowns have converged and are not merely held by damping."""
        return state.done & (self.damping / step_size * state.damped < _FREE)

    # If g = Jᵀr and (JᵀJ + μB) x = g − ρ, conjugate gradients make the residual ρ orthogonal to x. So for δ = −x
    #
    #     ½|r + Jδ|² − ½|r|² = −gᵀx + ½ xᵀJᵀJx = −½ (gᵀx + μ xᵀBx).
    def _next(
        self, step_size: Array, linearised: Any, state: _State, needed: bool | Bool[Array, ""]
    ) -> tuple[Values, _State]:
        """Return the step δ, or zero after convergence, and the state with the gradient and the predicted reduction."""
        jacobian, residual, shape = linearised.jac, linearised.residual, state.values.shape
        adjoint, damping = jacobian.transpose(), self.damping / step_size

        # The program contains J and Jᵀ only once, because they dominate the compilation time.
        def normal(x: Array, first: Bool[Array, ""]) -> tuple[Array, float]:
            x = x.reshape(shape)
            image = adjoint.mv(jax.lax.cond(first, lambda: residual, lambda: jacobian.mv(x)))
            return (image + damping * self.inner_product.apply(x)).reshape(-1, 1), 0.0  # x = 0 at first

        def precondition(r: Array) -> Array:
            return self.preconditioner.precondition(r.reshape(shape), damping).reshape(-1, 1)

        tolerance = jnp.where(state.tight, self.inner_tolerance / _TIGHTER, self.inner_tolerance)
        most = jnp.where(state.tight, _LONGER * self.inner_steps, self.inner_steps)
        most = jnp.where(needed & ~self._done(step_size, state), most, 0)
        column = state.values.reshape(-1, 1)
        solution = conjugate_gradients(normal, precondition, column, tolerance[None], most=most, orthogonal=True)
        x, gradient = solution.x.reshape(shape), solution.rhs.reshape(shape)
        promised = -(jnp.vdot(gradient, x) + damping * jnp.vdot(x, self.inner_product.apply(x))) / 2
        # A stationary point needs no step; a step of size zero would show no convergence.
        stationary = jnp.all(gradient == 0)
        done, damped = state.done | stationary, jnp.where(stationary, 0, state.damped)
        return -x, dataclasses.replace(state, gradient=gradient, promised=promised, done=done, damped=damped)

    def init(
        self, fn: Callable, y: Values, args: Any, options: _Options, f_struct: Any, aux_struct: Any, tags: _Tags
    ) -> _Progress:
        """Return the state before the first step, which evaluates ``y``."""
        structure, _ = eqx.filter_eval_shape(_linearise, fn, y, args)
        yes, one = jnp.asarray(True), jnp.ones((), y.dtype)
        return _Progress(yes, y, one, _empty(structure), _empty(aux_struct), begun(y), yes)

    def step(
        self, fn: Callable, y: Values, args: Any, options: _Options, state: _Progress, tags: _Tags
    ) -> tuple[Values, _Progress, Any]:
        """Accept or reject the trial, and choose the next; return the unknowns and the auxiliary output.

        Choosing the next trial is most of the work. It is skipped if the option ``"enough"``, a function of that
        output, is true.
        """
        linearised, aux = _linearise(fn, state.trial, args)
        # Traces are compared by identity, so the trace of the state is used in all states.
        linearised = eqx.combine(
            eqx.filter(linearised, eqx.is_array), eqx.filter(state.linearised, eqx.is_array, inverse=True)
        )
        promised = state.descent.promised
        change = linearised.as_min() - state.linearised.as_min()
        accept = state.first | (change <= _ACCEPTED * promised)
        good = ~state.first & (change < _GOOD * promised) & (promised < 0)
        step_size = state.step_size * jnp.where(good, self.growth, jnp.where(accept, 1, _SHRINKING))

        before, static = eqx.partition((y, state.linearised, state.aux, state.descent), eqx.is_array)
        taken = state.trial, linearised, aux, self.accepted(state.trial, state.descent)
        now = jax.lax.cond(accept, lambda: eqx.filter(taken, eqx.is_array), lambda: before)
        values, linearised, aux, descent = eqx.combine(now, static)
        needed = ~options["enough"](aux) if "enough" in options else True
        step, descent = self._next(step_size, linearised, descent, needed)
        no, finite = jnp.asarray(False), jnp.all(jnp.isfinite(step))
        return values, _Progress(no, values + step, step_size, linearised, aux, descent, finite), aux

    def terminate(
        self, fn: Callable, y: Values, args: Any, options: _Options, state: _Progress, tags: _Tags
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Return whether the unknowns have converged, and whether the last step is finite."""
        successful, not_finite = optx.RESULTS.successful, optx.RESULTS.nonlinear_divergence
        return self._done(state.step_size, state.descent), optx.RESULTS.where(state.finite, successful, not_finite)

    def postprocess(
        self,
        fn: Callable,
        y: Values,
        aux: Any,
        args: Any,
        options: _Options,
        state: _Progress,
        tags: _Tags,
        result: Any,
    ) -> tuple[Values, Any, dict[str, Any]]:
        """Return the unknowns and the auxiliary output unchanged."""
        return y, aux, {}
