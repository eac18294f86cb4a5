"""Gauss–Newton with Levenberg–Marquardt damping, matrix-free: products with J and Jᵀ, and conjugate gradients."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx  # type: ignore[import-untyped]
import optimistix as optx
from jaxtyping import Array, Bool, Float

from hks_jax.inverse.smoothing import Euclidean, InnerProduct
from hks_jax.inverse.unknowns import Values

_SCALE = 2.0**40
"""lineax's conjugate gradients stop when both the residual and the last change are small. With a right-hand side of
length one and an operator so large that no change matters, the residual alone decides."""


class _State(eqx.Module):
    """The last accepted unknowns, the linearisation and the gradient there, and whether no step is needed any more."""

    values: Values
    f_info: Any
    gradient: Values
    done: Bool[Array, ""]


class DampedDescent(optx.AbstractDescent[Values, Any, _State]):
    """Solves (JᵀJ + μB) δ = −Jᵀr, with B an inner product of the unknowns and μ = damping / step size.

    The conjugate gradients, preconditioned with B⁻¹, stop early: far from the solution more digits would be lost on the
    linearisation. Their result is a descent direction whenever they stop.

    Attributes:
        tolerance: the relative and absolute change of unknowns and residuals at which no further step is computed.
        damping: μ at step size 1.
        inner_product: B.
        inner_tolerance: reduction of the linear residual.
        inner_steps: at most so many products with JᵀJ.
    """

    tolerance: float
    damping: Float[Array, ""]
    inner_product: InnerProduct
    inner_tolerance: float
    inner_steps: int

    def init(self, y: Values, f_info_struct: Any) -> _State:
        """Return a state of the right shape."""
        empty = jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, f_info_struct
        )
        return _State(y, empty, jnp.zeros_like(y), jnp.zeros((), bool))

    def query(self, y: Values, f_info: Any, state: _State) -> _State:
        """Return the gradient Jᵀr with the linearisation."""
        still = self._small(y - state.values, y)
        still &= self._small(f_info.residual - state.f_info.residual, f_info.residual)
        return _State(y, f_info, f_info.compute_grad(), still)

    def _small(self, change: Array, values: Array) -> Bool[Array, ""]:
        return optx.rms_norm(change / (self.tolerance * (1 + jnp.abs(values)))) < 1

    def step(self, step_size: Array, state: _State) -> tuple[Values, optx.RESULTS]:
        """Return the step δ."""
        step = jax.lax.cond(state.done, lambda: jnp.zeros_like(state.gradient), lambda: self._solve(step_size, state))
        fine = jnp.all(jnp.isfinite(step))
        return step, optx.RESULTS.where(fine, optx.RESULTS.successful, optx.RESULTS.nonlinear_divergence)

    def _solve(self, step_size: Array, state: _State) -> Values:
        jacobian, gradient = state.f_info.jac, state.gradient
        adjoint = jacobian.transpose()
        damping = self.damping / step_size

        def normal(x: Values) -> Values:
            return _SCALE * (adjoint.mv(jacobian.mv(x)) + damping * self.inner_product.apply(x))

        structure = jax.eval_shape(lambda: gradient)
        semidefinite = lx.positive_semidefinite_tag
        operator = lx.FunctionLinearOperator(normal, structure, semidefinite)
        preconditioner = lx.FunctionLinearOperator(self.inner_product.solve, structure, semidefinite)
        size = jnp.linalg.norm(gradient)
        scaled = gradient / jnp.where(size > 0, size, 1)
        found = lx.linear_solve(
            operator,
            scaled,
            lx.CG(0.0, self.inner_tolerance, optx.two_norm, stabilise_every=None, max_steps=self.inner_steps),
            options={"preconditioner": preconditioner},
            throw=False,
        )
        return -size * _SCALE * found.value


def _silent(**_: Any) -> None:
    pass


class GaussNewton(optx.AbstractGaussNewton[Values, Any, Any]):
    """The default solver of `hks_jax.fit_metric`.

    Args:
        tolerance: the relative and absolute change of unknowns and residuals (root mean square) at which it stops.
        damping: μ of the first step, relative to the scale of the data.
        growth: by what μ is divided after a step that kept what the linearisation promised.
        inner_product: in which steps are small.
        inner_tolerance: reduction of the linear residual in each step.
        inner_steps: at most so many products with JᵀJ in each step.
    """

    rtol: float
    atol: float
    norm: Callable[[Any], Array]
    descent: DampedDescent
    search: optx.ClassicalTrustRegion
    verbose: Callable[..., None]

    def __init__(
        self,
        tolerance: float = 1e-4,
        damping: float | Array = 1e-4,
        growth: float = 10.0,
        inner_product: InnerProduct | None = None,
        inner_tolerance: float = 3e-2,
        inner_steps: int = 120,
    ) -> None:
        self.rtol = self.atol = tolerance
        self.norm = optx.rms_norm
        self.descent = DampedDescent(
            tolerance, jnp.asarray(damping), inner_product or Euclidean(), inner_tolerance, inner_steps
        )
        self.search = optx.ClassicalTrustRegion(high_cutoff=0.5, high_constant=growth)
        self.verbose = _silent
