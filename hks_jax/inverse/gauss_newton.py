"""Gauss–Newton with Levenberg–Marquardt damping, matrix-free: products with J and Jᵀ, and conjugate gradients."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx  # type: ignore[import-untyped]
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from hks_jax.checks import require_count, require_number
from hks_jax.inverse.smoothing import Euclidean, InnerProduct, Preconditioner
from hks_jax.inverse.unknowns import Values
from hks_jax.linear.orthogonal_residuals import orthogonal_conjugate_gradients

_TIGHTER, _LONGER = 30, 3
"""By what the linear systems are solved more exactly before a fit counts as converged."""
_FREE = 0.01
"""What part of a step's curvature may be damping if the step is to tell how far the solution is."""


def remaining_change(last: Array, before: Array) -> Array:
    """Return the larger of the last step and of what would still follow if the last two began a geometric series."""
    ratio = last / jnp.where(before > 0, before, jnp.inf)
    ratio = jnp.where(before > 0, ratio, jnp.inf)
    return jnp.where(ratio < 1, last * jnp.maximum(1, ratio / jnp.where(ratio < 1, 1 - ratio, 1)), jnp.inf)


class _State(eqx.Module):
    """What is known at the last accepted unknowns.

    Attributes:
        values: the unknowns.
        f_info: the linearisation there.
        gradient: the gradient.
        change: the size of the last step, in tolerances.
        damped: B in the direction of that step over the curvature that it saw: times μ, the part of damping.
        tight: whether the linear systems are solved more exactly.
        done: whether no step is needed any more.
    """

    values: Values
    f_info: Any
    gradient: Values
    change: Float[Array, ""]
    damped: Float[Array, ""]
    tight: Bool[Array, ""]
    done: Bool[Array, ""]


class DampedDescent(optx.AbstractDescent[Values, Any, _State]):
    """Solves (JᵀJ + μB) δ = −Jᵀr, with B an inner product of the unknowns and μ = damping / step size.

    The conjugate gradients stop early: far from the solution more digits would be lost on the linearisation. Their
    result is a descent direction whenever they stop.

    Attributes:
        tolerance: what the unknowns still change, relative and absolute, when no further step is computed.
        damping: μ at step size 1.
        inner_product: B.
        inner_tolerance: reduction of the residual, in the norm of the preconditioner's inverse.
        inner_steps: at most so many products with JᵀJ.
        preconditioner: of the conjugate gradients.
    """

    tolerance: Float[Array, ""]
    damping: Float[Array, ""]
    inner_product: InnerProduct
    inner_tolerance: Float[Array, ""]
    inner_steps: Int[Array, ""]
    preconditioner: Preconditioner

    def init(self, y: Values, f_info_struct: Any) -> _State:
        """Return a state of the right shape."""
        far, no = jnp.asarray(jnp.inf, y.dtype), jnp.zeros((), bool)
        return _State(y, _empty(f_info_struct), jnp.zeros_like(y), far, far, no, no)

    def query(self, y: Values, f_info: Any, state: _State) -> _State:
        """Return the gradient Jᵀr with the linearisation, and what the step that led here tells."""
        step = y - state.values
        change = optx.rms_norm(step / (self.tolerance * (1 + jnp.abs(y))))
        moved, curvature = change > 0, -jnp.vdot(step, state.gradient)
        damped = jnp.vdot(step, self.inner_product.apply(step)) / jnp.where(curvature > 0, curvature, 1)
        damped = jnp.where(moved & (curvature > 0), damped, jnp.inf)
        settled = moved & (remaining_change(change, state.change) < 1)
        change = jnp.where(moved, change, jnp.inf)
        return _State(y, f_info, f_info.compute_grad(), change, damped, state.tight | settled, state.tight & settled)

    def done(self, step_size: Array, state: _State) -> Bool[Array, ""]:
        """Tell whether the unknowns have converged, and not only been held by damping."""
        return state.done & (self.damping / step_size * state.damped < _FREE)

    def step(self, step_size: Array, state: _State) -> tuple[Values, optx.RESULTS]:
        """Return the step δ."""
        done = self.done(step_size, state)
        step = jax.lax.cond(done, lambda: jnp.zeros_like(state.gradient), lambda: self._solve(step_size, state))
        fine = jnp.all(jnp.isfinite(step))
        return step, optx.RESULTS.where(fine, optx.RESULTS.successful, optx.RESULTS.nonlinear_divergence)

    def _solve(self, step_size: Array, state: _State) -> Values:
        jacobian, gradient = state.f_info.jac, state.gradient
        adjoint, damping = jacobian.transpose(), self.damping / step_size

        def normal(x: Array) -> Array:
            x = x.reshape(gradient.shape)
            return jnp.ravel(adjoint.mv(jacobian.mv(x)) + damping * self.inner_product.apply(x))

        def precondition(r: Array) -> Array:
            return jnp.ravel(self.preconditioner.precondition(r.reshape(gradient.shape), damping))

        tolerance = jnp.where(state.tight, self.inner_tolerance / _TIGHTER, self.inner_tolerance)
        steps = jnp.where(state.tight, _LONGER * self.inner_steps, self.inner_steps)
        solution, _ = orthogonal_conjugate_gradients(normal, precondition, jnp.ravel(gradient), tolerance, steps)
        return -solution.reshape(gradient.shape)


class _Progress(eqx.Module):
    """The state of the solver.

    Attributes:
        first: whether no step was taken yet.
        trial: the unknowns to be looked at next.
        step_size: 1/μ, relative to the first.
        search: what the search keeps, which is its own affair.
        linearised: residuals and Jacobian at the last accepted unknowns.
        aux: what the residuals tell beside, there.
        descent: what the descent knows, there.
        result: whether all is finite.
    """

    first: Bool[Array, ""]
    trial: Values
    step_size: Float[Array, ""]
    search: Any
    linearised: Any
    aux: Any
    descent: _State
    result: optx.RESULTS


def _linearise(fn: Callable, values: Values, args: Any) -> tuple[Any, Any]:
    """Return residuals with the products with their Jacobian, and what they tell beside."""
    residual, product, aux = jax.linearize(lambda v: fn(v, args), values, has_aux=True)
    jacobian = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: values))
    return optx.FunctionInfo.ResidualJac(residual, jacobian), aux


def _empty(structure: Any) -> Any:
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, structure)


class GaussNewton(optx.AbstractLeastSquaresSolver[Values, Any, Any, _Progress]):
    """The default solver of `hks_jax.fit_metric`.

    Its settings are arrays: steps compiled for some serve all others.

    Args:
        tolerance: what the unknowns still change, relative and absolute (root mean square), when it stops; see
            `hks_jax.fit_metric`.
        damping: μ of the first step, relative to the scale of the data.
        growth: by what μ is divided after a step that kept what the linearisation promised.
        inner_product: B, in which steps are small.
        inner_tolerance: reduction of the linear residual in each step; the last steps go 30 times further.
        inner_steps: at most so many products with JᵀJ in each step; in the last steps three times as many.
        preconditioner: of the conjugate gradients; B by default.
    """

    rtol: Float[Array, ""]  # type: ignore[assignment]
    atol: Float[Array, ""]  # type: ignore[assignment]
    norm: Callable[[Any], Array]
    descent: DampedDescent
    search: optx.ClassicalTrustRegion

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
        self.norm = optx.rms_norm
        inner_product = inner_product or Euclidean()
        self.descent = DampedDescent(
            self.rtol,
            jnp.asarray(damping),
            inner_product,
            jnp.asarray(inner_tolerance),
            jnp.asarray(inner_steps),
            preconditioner or inner_product,
        )
        self.search = optx.ClassicalTrustRegion(high_cutoff=0.5, high_constant=jnp.asarray(growth))

    def init(
        self,
        fn: Callable,
        y: Values,
        args: Any,
        options: dict[str, Any],
        f_struct: Any,
        aux_struct: Any,
        tags: frozenset[object],
    ) -> _Progress:
        """Return the state before the first step, in which ``y`` is looked at."""
        structure, _ = eqx.filter_eval_shape(_linearise, fn, y, args)
        return _Progress(
            jnp.asarray(True),
            y,
            jnp.ones((), y.dtype),
            self.search.init(y, structure),
            _empty(structure),
            _empty(aux_struct),
            self.descent.init(y, structure),
            optx.RESULTS.successful,  # type: ignore[arg-type]
        )

    def step(
        self, fn: Callable, y: Values, args: Any, options: dict[str, Any], state: _Progress, tags: frozenset[object]
    ) -> tuple[Values, _Progress, Any]:
        """Look at the trial, take it or not, and choose the next; return the unknowns and what is told of them."""
        linearised, aux = _linearise(fn, state.trial, args)
        # Traces are compared by identity: the one of the state stands for all.
        linearised = eqx.combine(
            eqx.filter(linearised, eqx.is_array), eqx.filter(state.linearised, eqx.is_array, inverse=True)
        )
        step_size, accept, search_result, search = self.search.step(
            state.first, y, state.trial, state.linearised, linearised, state.search
        )
        before, static = eqx.partition((y, state.linearised, state.aux, state.descent), eqx.is_array)

        def taken() -> Any:
            descent = self.descent.query(state.trial, linearised, state.descent)
            return eqx.filter((state.trial, linearised, aux, descent), eqx.is_array)

        values, linearised, aux, descent = eqx.combine(jax.lax.cond(accept, taken, lambda: before), static)
        step, result = self.descent.step(step_size, descent)
        result = optx.RESULTS.where(search_result == optx.RESULTS.successful, result, search_result)
        no = jnp.asarray(False)
        return values, _Progress(no, values + step, step_size, search, linearised, aux, descent, result), aux

    def terminate(
        self, fn: Callable, y: Values, args: Any, options: dict[str, Any], state: _Progress, tags: frozenset[object]
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Tell whether the unknowns have converged."""
        return self.descent.done(state.step_size, state.descent), state.result

    def postprocess(
        self,
        fn: Callable,
        y: Values,
        aux: Any,
        args: Any,
        options: dict[str, Any],
        state: _Progress,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[Values, Any, dict[str, Any]]:
        """Return the unknowns and what is told of them as they are."""
        return y, aux, {}
