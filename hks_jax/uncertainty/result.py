"""The estimated error of a number or a map."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from hks_jax.checks import require_number

BEYOND = 0.02
"""Confidence intervals are reliable if the median of `beyond_linear` over a map is at most this number."""
INDEFINITE = 0.02
"""Confidence intervals are reliable if noise makes at most this share of the tensors indefinite."""


class Uncertainty(eqx.Module):
    """The value of a function of measured tensors, with its standard deviation and bias due to noise.

    The attributes ``value``, ``deviation``, ``bias``, ``bias_error``, ``beyond_linear`` and ``smear`` have the
    structure of the function's result: an array, or a pytree of arrays.

    Attributes:
        value: the value of the function for the measured tensors.
        deviation: the standard deviation of the value due to noise.
        bias: the mean of the function over the noise, minus the value without noise.
        bias_error: the standard deviation of ``bias``, which is estimated from few draws.
        beyond_linear: the part of the variance of second order in the noise, divided by the part of first order.
        smear: the change of the value if the smoothed tensors are smoothed once more, an estimate of the change that
            smoothing causes; None without smoothing.
        indefinite: the share of the measured tensors that a sample of the noise, added as a whole, makes indefinite.
        sampling_error: the relative standard deviation of ``deviation``; 0 if ``deviation`` is exact to first order.
        method: ``"resample"``, ``"linear"`` or ``"exact"``.
        draws: the number of noisy tensor fields at which the function was evaluated.
        freedom: the degrees of freedom of ``deviation``, limited by `TensorNoise.freedom`; infinite if it is exact.
        samples: the number of degrees of freedom of the estimate ``beyond_linear``.
    """

    value: Any
    deviation: Any
    bias: Any
    bias_error: Any
    beyond_linear: Any
    smear: Any
    indefinite: Float[Array, ""]
    sampling_error: float = eqx.field(static=True)
    method: str = eqx.field(static=True)
    draws: int = eqx.field(static=True)
    freedom: float = eqx.field(static=True)
    samples: int = eqx.field(static=True)

    def __repr__(self) -> str:
        shapes = jax.tree.map(jnp.shape, self.value)
        return f"Uncertainty({shapes}, {self.method}, {self.draws} draws, deviation ± {self.sampling_error:.0%})"

    @property
    def corrected(self) -> Any:
        """The value minus its bias."""
        return jax.tree.map(jnp.subtract, self.value, self.bias)

    def interval(self, level: float = 0.95) -> tuple[Any, Any]:
        """Return the lower and the upper ends of intervals that contain the true value with probability `level`.

        The centre of an interval is the corrected value. The width of an interval follows from Student's distribution
        with `freedom` degrees of freedom. The errors must be normally distributed (see `trusted`).
        """
        require_number("level", level, 1)
        quantile = float(scipy.special.stdtrit(min(self.freedom, 1e6), 0.5 + level / 2))
        half = jax.tree.map(lambda s, b: quantile * jnp.sqrt(s**2 + b**2), self.deviation, self.bias_error)
        return jax.tree.map(jnp.subtract, self.corrected, half), jax.tree.map(jnp.add, self.corrected, half)

    def z(self, reference: Any = 0.0) -> Any:
        """Return (value − reference)/deviation. For 4πt·HKS, the reference 1 is the value in flat space."""
        return jax.tree.map(lambda v, s: (v - reference) / s, self.value, self.deviation)

    @property
    def trusted(self) -> Any:
        """Whether the intervals are reliable: one bool for each number, or for each entry of the first axis of maps.

        Intervals are reliable if `beyond_linear` is at most 2 % in the median over the map, the bias is at most the
        standard deviation in the median, and noise makes at most 2 % of the tensors indefinite.
        """

        def of(deviation: Array, bias: Array, beyond: Array) -> Array:
            maps = (len(deviation) if deviation.ndim > 1 else deviation.size, -1)
            share = jnp.abs(bias / jnp.where(deviation > 0, deviation, jnp.nan)).reshape(maps)
            second = jnp.where(deviation > 0, beyond, jnp.nan).reshape(maps)
            # The median of an estimate from few draws is below its mean; the limit is multiplied by median/mean.
            limit = BEYOND * float(scipy.special.fdtri(self.samples, min(self.freedom, 1e6), 0.5))
            small = (jnp.nanmedian(second, axis=1) <= limit) & (jnp.nanmedian(share, axis=1) <= 1)
            return (small & (self.indefinite <= INDEFINITE)).reshape(deviation.shape[:1])

        return jax.tree.map(of, self.deviation, self.bias, self.beyond_linear)

    @property
    def signal_to_noise(self) -> Any:
        """The signal-to-noise ratio √((V − N)/N) for each entry of the value's first axis, for example for each time.

        V is the variance of the noisy value over the nodes, and N is the mean variance of the noise over the nodes.
        """
        return self.signal_to_noise_at(True)

    def signal_to_noise_at(self, nodes: Any) -> Any:
        """Return `signal_to_noise` over the given nodes, for example nodes with little influence of the boundary.

        Args:
            nodes: bool array that broadcasts to the shape of the value; if it is False everywhere, the ratio is NaN.
        """

        def of(value: Array, deviation: Array) -> Array:
            axes = tuple(range(1, value.ndim))
            value, deviation = (jnp.where(nodes, each, jnp.nan) for each in (value, deviation))
            noise = jnp.nanmean(deviation**2, axis=axes)
            return jnp.sqrt(jnp.maximum(jnp.nanvar(value, axis=axes) - noise, 0) / noise)

        return jax.tree.map(of, self.value, self.deviation)

    def messages(self) -> list[str]:
        """Return warnings about the accuracy of these numbers, as sentences."""
        if (share := float(self.indefinite)) > INDEFINITE:
            return [
                f"intervals are not reliable, because noise makes {share:.2%} of the tensors indefinite. Smooth the "
                "tensors (smoothing=), or leave the noisiest nodes out of the mask"
            ]
        claimed = np.concatenate([np.asarray(each).ravel() for each in jax.tree.leaves(self.trusted)])
        if claimed.all():
            return []
        return [
            f"intervals are not reliable for {int((~claimed).sum())} of {claimed.size} numbers or maps: the effect of "
            "noise is not linear, or the bias exceeds the deviation (see `trusted`). Smooth the tensors (smoothing=)"
        ]

    def summary(self) -> str:
        """Return a few lines about the method, the accuracy of the standard deviations, the bias and the linearity."""
        how = {
            "exact": "standard deviations by reverse-mode products, exact to first order",
            "linear": "standard deviations from products of one linearisation with random noise",
            "resample": "standard deviations from maps of noisy tensors",
        }[self.method]
        sure = f", with a relative error of {self.sampling_error:.0%}" if self.sampling_error else ""
        lines = [f"{how}{sure}; {self.draws} noisy maps"]
        share = jax.tree.map(jnp.divide, self.bias, self.deviation)
        for name, each in (("bias divided by deviation", share), ("beyond linear", self.beyond_linear)):
            values = np.concatenate([np.asarray(leaf).ravel() for leaf in jax.tree.leaves(each)])
            values = values[np.isfinite(values)]
            if values.size:
                low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
                lines.append(f"{name}: {middle:.3g} (90 % of the values: {low:.3g} to {high:.3g})")
        return "\n".join([*lines, *self.messages()])
