"""Regularisers: the preferences of a fit where the data leave a choice.

Each is half a weighted mean of squares over the domain, given by its residuals: least squares solvers need these.
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
    """A penalty on the unknowns or on the field: half the weighted sum of the squares of `deviations` over the nodes.

    Attributes:
        weight: the factor of the penalty.
    """

    weight: eqx.AbstractVar[float]

    def __check_init__(self) -> None:
        """Check the weight."""
        require_number("weight", self.weight, inclusive=True)

    def residuals(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, " m"]:
        """Return residuals, half of whose sum of squares is the penalty."""
        deviations = self.deviations(unknowns, values, field)
        return jnp.sqrt(self.weight / int(field.grid.inside.sum())) * deviations.ravel()

    @abstractmethod
    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return the numbers that the penalty keeps small."""


class H1(Regulariser):
    """½ weight · mean |∇p|² of the parameters p (the logarithm of the tensor, say), in coordinate units."""

    weight: float

    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return the slopes along the grid's edges."""
        return jnp.concatenate([slopes.ravel() for slopes in unknowns.slopes(values)])


class TotalVariation(Regulariser):
    """weight · mean (√(|∇p|² + ε²) − ε): edges in the parameters p stay sharp.

    Attributes:
        weight: the factor of the penalty.
        epsilon: slopes below it, per coordinate unit, count as smooth.
    """

    weight: float
    epsilon: float = 0.1

    def __check_init__(self) -> None:
        """Check the threshold."""
        require_number("epsilon", self.epsilon)

    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return gradients at the nodes, scaled so that half their square is the penalty."""
        d = field.grid.dimension
        # Differences to the next node along each axis; none beyond the last.
        gradient = jnp.stack(
            [
                jnp.pad(slopes, [(0, 0)] + [(0, int(axis == along)) for axis in range(d)])
                for along, slopes in enumerate(unknowns.slopes(values))
            ]
        )
        square = jnp.sum(gradient**2, axis=(0, 1))
        # 2(√(s² + ε²) − ε)/s², without cancellation.
        return gradient * jnp.sqrt(2 / (jnp.sqrt(square + self.epsilon**2) + self.epsilon))


class LogDeterminant(Regulariser):
    """½ weight · mean (log |T| − log |T₀|)²: the area, or volume, stays."""

    weight: float
    prior: TensorField

    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return the differences of the logarithms of the determinants."""
        return jnp.log(spd.determinant(field.domain_tensors) / spd.determinant(self.prior.domain_tensors))


class Prior(Regulariser):
    """½ weight · mean ‖log T − log T₀‖²: the log-Euclidean distance to another field."""

    weight: float
    prior: TensorField

    def deviations(self, unknowns: Unknowns, values: Values, field: TensorField) -> Float[Array, "..."]:
        """Return log T − log T₀."""
        return spd.log(field.domain_tensors) - spd.log(self.prior.domain_tensors)
