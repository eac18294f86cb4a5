"""Gauss–Newton with Levenberg–Marquardt damping, matrix-free: products with J and Jᵀ, and conjugate gradients."""

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
"""The factors of exactness and of the number of products in linear systems of steps that may be the last."""
_ACCEPTED, _GOOD, _SHRINKING = 0.01, 0.5, 0.25
"""The shares of the promised reduction for which a step is taken, and damping falls; the factor after a worse step."""
_FREE = 0.01
"""The largest share of damping in a step's curvature for which the step measures the distance to the solution."""


def remaining_change(last: Array, before: Array) -> Array:
    """Return the last step, or the sum of the steps to come if it is larger, were the last two a geometric series."""
    ratio = jnp.where(before > 0, last / before, jnp.inf)
    return jnp.where(ratio < 1, last * jnp.maximum(1, ratio / (1 - ratio)), jnp.inf)


class _State(eqx.Module):
    """The descent's knowledge at the last accepted unknowns."""

    values: Values  # the unknowns
    gradient: Values  # the gradient
    promised: Float[Array, ""]  # the change of half the sum of squares by the last step from there, linearised
    change: Float[Array, ""]  # the size of the step that led there, in tolerances
    damped: Float[Array, ""]  # B along that step over the curvature that it saw: times μ, the part of damping
    tight: Bool[Array, ""]  # whether the linear systems are solved more exactly
    done: Bool[Array, ""]  # whether no step is needed any more


def begun(y: Values) -> _State:
    """Return the state before any unknowns were accepted."""
    far, no = jnp.asarray(jnp.inf, y.dtype), jnp.zeros((), bool)
    return _State(y, jnp.zeros_like(y), jnp.zeros((), y.dtype), far, far, no, no)


class _Progress(eqx.Module):
    """The state of the solver."""

    first: Bool[Array, ""]  # whether no step was taken yet
    trial: Values  # the unknowns to be looked at next
    step_size: Float[Array, ""]  # 1/μ, relative to the first
    linearised: Any  # residuals and Jacobian at the last accepted unknowns
    aux: Any  # the residuals' further output, there
    descent: _State  # the descent's knowledge, there
    finite: Bool[Array, ""]  # whether the last step is


def _linearise(fn: Callable, values: Values, args: Any) -> tuple[Any, Any]:
    """Return residuals with the products with their Jacobian, and their further output."""
    residual, product, aux = jax.linearize(lambda v: fn(v, args), values, has_aux=True)
    jacobian = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: values))
    return optx.FunctionInfo.ResidualJac(residual, jacobian), aux


def _empty(structure: Any) -> Any:
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, structure)


class GaussNewton(optx.AbstractLeastSquaresSolver[Values, Any, Any, _Progress]):
    """The default solver of `hks_jax.fit_metric`.

    Its steps δ solve (JᵀJ + μB) δ = −Jᵀr, with B an inner product of the unknowns and μ = damping / step size. The
    conjugate gradients stop early: far from the solution more digits would be lost on the linearisation. Their result
    is a descent direction whenever they stop.

    Its settings are arrays: steps compiled for some serve all others.

    Args:
        tolerance: of the change of the unknowns, relative and absolute (root mean square), at which it stops; see
            `Search`.
        damping: μ of the first step, relative to the scale of the data.
        growth: the divisor of μ after a step that reduces the misfit as far as its linearisation promised.
        inner_product: B, in which steps are small.
        inner_tolerance: reduction of the linear residual in each step; steps that may be the last go 30 times further.
        inner_steps: the most products with JᵀJ in each step; in steps that may be the last three times as many.
        preconditioner: of the conjugate gradients; B by default.
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
        """Return the state at new unknowns, from the step that led there; the next step computes their gradient."""
        step = y - state.values
        change = optx.rms_norm(step / (self.rtol * (1 + jnp.abs(y))))
        moved, curvature = change > 0, -jnp.vdot(step, state.gradient)
        damped = jnp.vdot(step, self.inner_product.apply(step)) / jnp.where(curvature > 0, curvature, 1)
        damped = jnp.where(moved & (curvature > 0), damped, jnp.inf)
        settled = moved & (remaining_change(change, state.change) < 1)
        # The next step may be the last: if steps go on to shrink like this, it is below the tolerance.
        near = moved & jnp.isfinite(state.change) & (change**2 < state.change)
        change = jnp.where(moved, change, jnp.inf)
        tight, done = state.tight | near | settled, state.tight & settled
        return _State(y, state.gradient, state.promised, change, damped, tight, done)

    def _done(self, step_size: Array, state: _State) -> Bool[Array, ""]:
        """Tell whether the unknowns have converged, and not only been held by damping."""
        return state.done & (self.damping / step_size * state.damped < _FREE)

    # With g = Jᵀr and (JᵀJ + μB) x = g − ρ, conjugate gradients make the residual ρ orthogonal to x. So for δ = −x
    #
    #     ½|r + Jδ|² − ½|r|² = −gᵀx + ½ xᵀJᵀJx = −½ (gᵀx + μ xᵀBx).
    def _next(
        self, step_size: Array, linearised: Any, state: _State, needed: bool | Bool[Array, ""]
    ) -> tuple[Values, _State]:
        """Return the step δ, zero if none is needed, and the state with the gradient and the promised reduction."""
        jacobian, residual, shape = linearised.jac, linearised.residual, state.values.shape
        adjoint, damping = jacobian.transpose(), self.damping / step_size

        # J and Jᵀ stand in the program once: they take most of the compilation.
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
        """Return the state before the first step, in which ``y`` is looked at."""
        structure, _ = eqx.filter_eval_shape(_linearise, fn, y, args)
        yes, one = jnp.asarray(True), jnp.ones((), y.dtype)
        return _Progress(yes, y, one, _empty(structure), _empty(aux_struct), begun(y), yes)

    def step(
        self, fn: Callable, y: Values, args: Any, options: _Options, state: _Progress, tags: _Tags
    ) -> tuple[Values, _Progress, Any]:
        """Take the trial or not, and choose the next; return the unknowns and the residuals' further output.

        Computing the next is most of the work. It is left out where the option ``"enough"``, a function of that output,
        says that the unknowns will do.
        """
        linearised, aux = _linearise(fn, state.trial, args)
        # Traces are compared by identity: the one of the state stands for all.
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
        """Tell whether the unknowns have converged."""
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
        """Return the unknowns and the further output as they are."""
        return y, aux, {}
