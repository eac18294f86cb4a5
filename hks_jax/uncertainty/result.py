"""What is known of a number's or a map's error."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import fdtri, stdtrit

from hks_jax.checks import require_number

BEYOND = 0.02
"""The share of the variance beyond linear, its median over the nodes, from which on intervals are not claimed."""
INDEFINITE = 0.02
"""The share of tensors made indefinite by noise from which on they are not."""


class Uncertainty(eqx.Module):
    """The value of a function of measured tensors, and what noise does to it.

    All of ``value``, ``deviation``, ``bias``, ``bias_error`` and ``beyond_linear`` have the structure of what the
    function returns: an array, or a pytree of them.

    Attributes:
        value: of the tensors as measured.
        deviation: the standard deviation that noise gives it.
        bias: the mean over noise less the value without: what noise adds to it on average.
        bias_error: the standard deviation of that estimate, from few draws.
        beyond_linear: the variance of second order in the noise, over that of first order.
        smear: with smoothing, the change by smoothing once more: an estimate of the blur of the map.
            Else None.
        indefinite: the share of tensors that noise of its full size makes indefinite.
        sampling_error: the relative standard deviation of ``deviation``, from few draws; 0 if it is exact.
        method: ``"resample"``, ``"linear"`` or ``"exact"``.
        draws: how many maps of noisy tensors were computed.
        freedom: the degrees of freedom of the deviation, those of the noise included; infinite if it is exact.
        samples: the degrees of freedom of `beyond_linear`.
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
        """Return one line."""
        shapes = jax.tree.map(jnp.shape, self.value)
        return f"Uncertainty({shapes}, {self.method}, {self.draws} draws, deviation to {self.sampling_error:.0%})"

    @property
    def corrected(self) -> Any:
        """The value less its bias."""
        return jax.tree.map(jnp.subtract, self.value, self.bias)

    def interval(self, level: float = 0.95) -> tuple[Any, Any]:
        """Return the lower and the upper ends of intervals that hold the true value with a probability.

        They lie around the corrected value, and are wider the fewer draws there were (Student's distribution).
        Normal errors are assumed: see `trusted`.
        """
        require_number("level", level, 1)
        quantile = float(stdtrit(min(self.freedom, 1e6), 0.5 + level / 2))
        half = jax.tree.map(lambda s, b: quantile * jnp.sqrt(s**2 + b**2), self.deviation, self.bias_error)
        return jax.tree.map(jnp.subtract, self.corrected, half), jax.tree.map(jnp.add, self.corrected, half)

    def z(self, reference: Any = 0.0) -> Any:
        """Return how many standard deviations the value is from a reference, such as 1 for 4πt·HKS: of flat space."""
        return jax.tree.map(lambda v, s: (v - reference) / s, self.value, self.deviation)

    @property
    def trusted(self) -> Any:
        """Where intervals are claimed: bool, for each number, or for each entry of the first axis of maps, as a time.

        They are where `beyond_linear` is at most 2 % and the bias at most the deviation, in the median over the map,
        and noise makes at most two tensors in a hundred indefinite.
        """

        def of(deviation: Array, bias: Array, beyond: Array) -> Array:
            maps = (len(deviation) if deviation.ndim > 1 else deviation.size, -1)
            share = jnp.abs(bias / jnp.where(deviation > 0, deviation, jnp.nan)).reshape(maps)
            second = jnp.where(deviation > 0, beyond, jnp.nan).reshape(maps)
            # Estimates from few draws are below their mean more often than not: by the median of their distribution.
            limit = BEYOND * float(fdtri(self.samples, min(self.freedom, 1e6), 0.5))
            small = (jnp.nanmedian(second, axis=1) <= limit) & (jnp.nanmedian(share, axis=1) <= 1)
            return (small & (self.indefinite <= INDEFINITE)).reshape(deviation.shape[:1])

        return jax.tree.map(of, self.deviation, self.bias, self.beyond_linear)

    @property
    def signal_to_noise(self) -> Any:
        """How much a map varies in space over its noise, for each entry of the first axis: a time, say.

        The measured map's own variance over the nodes, less the mean variance of the noise, which it contains, over
        the latter; the root of that.
        """
        return self.signal_to_noise_at(True)

    def signal_to_noise_at(self, nodes: Any) -> Any:
        """Return the signal to noise over some nodes, such as those that no boundary reaches: NaN where there is none.

        Args:
            nodes: bool, of the shape of the value, or one that is broadcast to it.
        """

        def of(value: Array, deviation: Array) -> Array:
            axes = tuple(range(1, value.ndim))
            value, deviation = (jnp.where(nodes, each, jnp.nan) for each in (value, deviation))
            noise = jnp.nanmean(deviation**2, axis=axes)
            return jnp.sqrt(jnp.maximum(jnp.nanvar(value, axis=axes) - noise, 0) / noise)

        return jax.tree.map(of, self.value, self.deviation)

    def messages(self) -> list[str]:
        """Return what to know before these numbers are used, in sentences."""
        if (share := float(self.indefinite)) > INDEFINITE:
            return [
                f"noise makes {share:.2%} of the tensors indefinite, so that no intervals are claimed. Smooth the "
                "tensors (smoothing=), or leave the noisiest nodes out of the mask"
            ]
        claimed = np.concatenate([np.asarray(each).ravel() for each in jax.tree.leaves(self.trusted)])
        if claimed.all():
            return []
        return [
            f"intervals are not claimed for {int((~claimed).sum())} of {claimed.size} numbers or maps: noise is beyond "
            "linear there, or the bias exceeds the deviation (see `trusted`). Smooth the tensors (smoothing=)"
        ]

    def summary(self) -> str:
        """Say in a few lines what was computed, and how far it can be trusted."""
        how = {
            "exact": "deviations exact to first order, by reverse products",
            "linear": "deviations by random directions of one linearisation",
            "resample": "deviations of maps of noisy tensors",
        }[self.method]
        sure = f", each to {self.sampling_error:.0%}" if self.sampling_error else ""
        lines = [f"{how}{sure}; {self.draws} noisy maps"]
        share = jax.tree.map(jnp.divide, self.bias, self.deviation)
        for name, each in (("bias over deviation", share), ("beyond linear", self.beyond_linear)):
            values = np.concatenate([np.asarray(leaf).ravel() for leaf in jax.tree.leaves(each)])
            values = values[np.isfinite(values)]
            if values.size:
                low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
                lines.append(f"{name}: {middle:.3g} (90 % of the values: {low:.3g} to {high:.3g})")
        return "\n".join([*lines, *self.messages()])
