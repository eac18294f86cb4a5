"""Regularisers, which select one of several solutions that explain the data of a fit.

Each penalty is half a weighted mean of squares over the domain, so a fit remains a least squares problem.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.checks import require_number
from hks_jax.domain import spd
from hks_jax.domain.tensor_field import TensorField
from hks_jax.inverse.unknowns import Unknowns, Values


class Regulariser(eqx.Module):
    """A penalty on the unknowns or on the field: half the weighted mean square of `deviations` over the nodes.

    Attributes:
        weight: the factor of the penalty.
    """

    weight: eqx.AbstractVar[float]

    def __check_init__(self) -> None:
        """Check the weight."""
        require_number("weight", self.weight, inclusive=True)

    def residuals(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, " m"]:
        """Return the residuals; half the sum of their squares is the penalty."""
        deviations = self.deviations(unknowns, values, field)
        return jnp.sqrt(self.weight / int(field.grid.inside.sum())) * deviations.ravel()

    @abstractmethod
    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return the quantities whose squares the penalty adds up."""


class H1(Regulariser):
    """The penalty ½ weight · mean |∇p|² of the parameters p, such as the tensor's logarithm, in coordinate units.

    Examples:
        >>> smooth = [hj.inverse.H1(1.0)]
        >>> hj.fit_metric(field, hj.hks(pairs, [0.5]), [0.5], "conformal", regularisers=smooth).loss < 1e-6
        True
    """

    weight: float

    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return the slopes of the parameters along the grid's edges."""
        return unknowns.slopes(values)


class TotalVariation(Regulariser):
    """The penalty weight · mean (√(|∇p|² + ε²) − ε), which preserves sharp edges in the parameters p.

    Attributes:
        weight: the factor of the penalty.
        epsilon: the slope ε per coordinate unit below which parameters count as smooth.

    Examples:
        >>> smooth = [hj.inverse.TotalVariation(1.0)]
        >>> hj.fit_metric(field, hj.hks(pairs, [0.5]), [0.5], "conformal", regularisers=smooth).loss < 1e-6
        True
    """

    weight: float
    epsilon: float = 0.1

    def __check_init__(self) -> None:
        """Check the threshold."""
        require_number("epsilon", self.epsilon)

    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return the parameters' gradients at the nodes, scaled so that half the square is √(|∇p|² + ε²) − ε."""
        gradient = unknowns.slopes(values)
        square = jnp.sum(gradient**2, axis=(0, 1), keepdims=True)
        # For the gradient's norm s, 2/(√(s² + ε²) + ε) equals 2(√(s² + ε²) − ε)/s² without cancellation.
        return gradient * jnp.sqrt(2 / (jnp.sqrt(square + self.epsilon**2) + self.epsilon))


def _on(field: TensorField, prior: TensorField) -> Float[Array, "*shape d d"]:
    """Return the tensors of a prior inside the mask of a fitted field, and the identity elsewhere."""
    if prior.grid.shape != field.grid.shape or (field.grid.inside & ~prior.grid.inside).any():
        raise ValueError(f"prior: got a field on {prior.grid}; expected tensors at all nodes inside {field.grid}")
    return spd.identity_outside(prior.domain_tensors, field.grid.inside)


class LogDeterminant(Regulariser):
    """The penalty ½ weight · mean (log |T| − log |T₀|)², where T₀ is `prior`; it preserves the volume element.

    Examples:
        >>> scaled = hj.inverse.Free(lambda s: s * field.tensors, jnp.ones(1), field)
        >>> values = jnp.array([1.1])
        >>> residuals = hj.inverse.LogDeterminant(1.0, field).residuals(scaled, values, scaled.field(values))
        >>> round(float(residuals @ residuals / 2), 4)  # (2 log 1.1)²/2
        0.0182
    """

    weight: float
    prior: TensorField

    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return the differences of the logarithms of the determinants."""
        return jnp.log(spd.determinant(field.domain_tensors) / spd.determinant(_on(field, self.prior)))


class Prior(Regulariser):
    """The penalty ½ weight · mean ‖log T − log T₀‖² on the log-Euclidean distance to the tensors T₀ of `prior`.

    Examples:
        >>> scaled = hj.inverse.Free(lambda s: s * field.tensors, jnp.ones(1), field)
        >>> values = jnp.array([1.1])
        >>> residuals = hj.inverse.Prior(1.0, field).residuals(scaled, values, scaled.field(values))
        >>> round(float(residuals @ residuals / 2), 4)  # (log 1.1)²
        0.0091
    """

    weight: float
    prior: TensorField

    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return log T − log T₀."""
        return spd.log(field.domain_tensors) - spd.log(_on(field, self.prior))
