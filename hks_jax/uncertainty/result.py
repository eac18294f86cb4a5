"""The estimated error of a number or a map."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from hks_jax.checks import require_number
from hks_jax.uncertainty.significance import discoveries, normal_score

BEYOND = 0.02
"""Confidence intervals are reliable if the median of `beyond_linear` over a map is at most this number."""
INDEFINITE = 0.02
"""Confidence intervals are reliable if noise makes at most this share of the tensors indefinite."""
_CORRECTED = 0.05
"""The value of `beyond_linear` at which half of the bias is corrected."""


class Uncertainty(eqx.Module):
    """The value of a function of measured tensors, with its standard deviation and bias due to noise.

    The attributes ``value``, ``null``, ``deviation``, ``bias``, ``bias_error``, ``beyond_linear`` and ``smear`` have
    the structure of the function's result: an array, or a pytree of arrays.

    Attributes:
        value: the value of the function for the measured tensors.
        null: the value of the function for constant tensors, the mean of the measured tensors.
        deviation: the standard deviation of the value due to noise.
        bias: the mean of the function over the noise, minus the value without noise.
        bias_error: the standard deviation of ``bias``, which is estimated from few draws.
        beyond_linear: the part of the variance of second order in the noise, divided by the part of first order.
        smear: the change of the value if the smoothed tensors are smoothed once more, an estimate of the change that
            smoothing causes; None without smoothing.
        indefinite: the share of the measured tensors that a sample of the noise, added as a whole, makes indefinite.
        raised: the share of the noisy tensors whose diffusivity in some direction was raised to a fraction of the
            measured one (see ``floor`` of `uncertainty`), because the noise is too large there.
        sampling_error: the relative standard deviation of ``deviation``; 0 if ``deviation`` is exact to first order.
        method: ``"resample"``, ``"linear"`` or ``"exact"``.
        draws: the number of noisy tensor fields at which the function was evaluated.
        freedom: the degrees of freedom of ``deviation``, limited by `TensorNoise.freedom`; infinite if it is exact.
        samples: the number of degrees of freedom of the estimate ``beyond_linear``.
    """

    value: Any
    null: Any
    deviation: Any
    bias: Any
    bias_error: Any
    beyond_linear: Any
    smear: Any
    indefinite: Float[Array, ""]
    raised: Float[Array, ""]
    sampling_error: float = eqx.field(static=True)
    method: str = eqx.field(static=True)
    draws: int = eqx.field(static=True)
    freedom: float = eqx.field(static=True)
    samples: int = eqx.field(static=True)

    def __repr__(self) -> str:
        shapes = jax.tree.map(jnp.shape, self.value)
        return f"Uncertainty({shapes}, {self.method}, {self.draws} draws, deviation ± {self.sampling_error:.0%})"

    @property
    def _correction(self) -> Any:
        """The part of the bias that is corrected."""
        return jax.tree.map(self._correction_of, self.deviation, self.bias, self.bias_error, self.beyond_linear)

    # Let β be the true bias, b its estimate with the standard deviation e, and c the part of b that is subtracted. The
    # mean square error of the bias, (1 − c)²β² + c²e², is least for c = β²/(β² + e²), and β² + e² is the mean of b².
    # The estimate b also varies with the noise of the measured tensors. To leading order, the relative variance of b
    # is proportional to `beyond_linear`, but the effect on the corrected value can have either sign. With the factor
    # 1/(1 + (beyond/0.05)²) and the limit |cb| ≤ s, the correction increased the root mean square error by at most 3 %
    # on all tested maps, while the correction of the whole bias increased it by up to 78 %.
    def _correction_of(self, deviation: Array, bias: Array, error: Array, beyond: Array) -> Array:
        b, e = (jnp.nanmean(_maps(jnp.where(deviation > 0, x**2, jnp.nan)), axis=1) for x in (bias, error))
        known = jnp.isfinite(b) & (b > 0)
        share = jnp.where(known, jnp.maximum(1 - e / jnp.where(known, b, 1), 0), 0)
        share /= 1 + jnp.where(known, self._beyond(deviation, beyond) / _CORRECTED, 0) ** 2
        reduced = bias * share.reshape(deviation.shape[:1] + (1,) * (deviation.ndim - 1))
        return jnp.clip(reduced, -deviation, deviation)

    def _beyond(self, deviation: Array, beyond: Array) -> Array:
        """Return the median of `beyond_linear` over each map, without the effect of few draws."""
        # The median of an estimate from few draws is below its mean, by this factor.
        factor = float(scipy.special.fdtri(self.samples, min(self.freedom, 1e6), 0.5))
        return jnp.nanmedian(_maps(jnp.where(deviation > 0, beyond, jnp.nan)), axis=1) / factor

    @property
    def corrected(self) -> Any:
        """The value minus a part of its bias.

        The estimated bias has errors. The part that is subtracted is nearly the whole bias of a map if `bias` is much
        larger than `bias_error` and the noise acts linearly. It is half of the bias if `beyond_linear` is 5 % in the
        median over the map, less if `beyond_linear` is larger, and never more than the standard deviation. On maps of
        grids and of a sphere with 1 to 20 % noise, the root mean square error of the corrected value was at most 3 %
        larger than the error of the value, and up to a third smaller.
        """
        return jax.tree.map(jnp.subtract, self.value, self._correction)

    @property
    def _width(self) -> Any:
        """The standard deviation of the error of `corrected`: due to noise, and due to the bias that is left."""

        def of(s: Array, b: Array, e: Array, shift: Array) -> Array:
            # The part c of the bias is shift/b. The bias (1 − c)β is left, and the correction has the error ce.
            share = jnp.where(b != 0, shift / jnp.where(b != 0, b, 1), 0)
            left = (1 - share) ** 2 * jnp.maximum(b**2 - e**2, 0)
            return jnp.sqrt(s**2 + (share * e) ** 2 + left)

        return jax.tree.map(of, self.deviation, self.bias, self.bias_error, self._correction)

    def interval(self, level: float = 0.95) -> tuple[Any, Any]:
        """Return the lower and the upper ends of intervals that contain the true value with probability `level`.

        The centre of an interval is the corrected value. The width of an interval follows from Student's distribution
        with `freedom` degrees of freedom, and includes the error of the correction and the bias that is not corrected.
        The errors must be normally distributed (see `trusted`).
        """
        require_number("level", level, 1)
        quantile = float(scipy.special.stdtrit(min(self.freedom, 1e6), 0.5 + level / 2))
        half, centre = jax.tree.map(lambda w: quantile * w, self._width), self.corrected
        return jax.tree.map(jnp.subtract, centre, half), jax.tree.map(jnp.add, centre, half)

    def z(self, reference: Any = None) -> Any:
        """Return the distance of the value from a reference, as a standard normal number if noise alone causes it.

        Noise alone causes |z| > 1.96 with a probability of 5 %, and |z| > 2 with 4.6 %. The distance |z| exceeds 1.96
        where the reference is outside `interval(0.95)`. The score z is the quantile of the standard normal
        distribution that has the same probability as (corrected − reference)/width by Student's distribution.

        By default, the reference is `null`, the value for constant tensors on the same domain. On a grid, the metric of
        constant tensors is flat. The value for constant tensors contains the same errors due to the spacing and to few
        eigenpairs as the measured value, and the same effects of the boundary. Therefore, these errors and effects do
        not count as signal. On a mesh, constant tensors in space do not change the shape of the mesh, so z shows
        the effect of the tensors and not of the shape.

        Args:
            reference: a number, or an array or pytree that broadcasts to the value. With 1 for 4πt·HKS, the value in
                flat space, the discretisation error at small t counts as signal. If the tensors refer to another basis
                at each cell, their mean has no meaning; pass the value of the function for other tensors.
        """
        if reference is None:
            reference = self.null
        elif jax.tree_util.treedef_is_leaf(jax.tree.structure(reference)):
            reference = jax.tree.map(lambda _: reference, self.value)

        def of(value: Array, width: Array, reference: Any) -> Array:
            return normal_score((value - reference) / width, self.freedom)

        return jax.tree.map(of, self.corrected, self._width, reference)

    def discoveries(self, rate: float = 0.05, reference: Any = None) -> Any:
        """Return where the value differs from the reference, at a given false discovery rate (bool arrays).

        Of the nodes that are declared on a map, at most the share `rate` is expected to be due to noise alone, by the
        method of Benjamini and Hochberg (1995). If all nodes of a map have only noise, the method declares any node
        with a probability of at most `rate`. Each entry of the first axis of a value with more than one axis is a map;
        a value with one axis is one map. In simulations with noise that is correlated between nodes, the false
        discovery rate was below `rate`. With 8 draws, only large differences are found among hundreds of nodes, because
        standard deviations are uncertain; use 32 draws.

        Args:
            rate: the share of false discoveries, between 0 and 1.
            reference: see `z`.
        """
        require_number("rate", rate, 1)

        def of(z: Array) -> Array:
            return discoveries(_maps(z) if z.ndim > 1 else z.reshape(1, -1), rate).reshape(z.shape)

        return jax.tree.map(of, self.z(reference))

    @property
    def trusted(self) -> Any:
        """Whether the intervals are reliable: one bool for each number, or for each entry of the first axis of maps.

        Intervals are reliable if `beyond_linear` is at most 2 % in the median over the map, the bias is at most the
        standard deviation in the median, and noise makes at most 2 % of the tensors indefinite.
        """

        def of(deviation: Array, bias: Array, beyond: Array) -> Array:
            share = _maps(jnp.abs(bias / jnp.where(deviation > 0, deviation, jnp.nan)))
            small = (self._beyond(deviation, beyond) <= BEYOND) & (jnp.nanmedian(share, axis=1) <= 1)
            return (small & (self.indefinite <= INDEFINITE)).reshape(deviation.shape[:1])

        return jax.tree.map(of, self.deviation, self.bias, self.beyond_linear)

    @property
    def signal_to_noise(self) -> Any:
        """The signal-to-noise ratio √((V − N)/N) for each entry of the value's first axis, for example for each time.

        V is the variance over the nodes of the corrected value minus the value for constant tensors (`null`), and N is
        the mean variance of the noise over the nodes.
        """
        return self.signal_to_noise_at(True)

    def signal_to_noise_at(self, nodes: Any) -> Any:
        """Return `signal_to_noise` over the given nodes, for example nodes with little influence of the boundary.

        Args:
            nodes: bool array that broadcasts to the shape of the value; if it is False everywhere, or if the value is a
                number or one number for each t, the ratio is NaN.
        """

        def of(value: Array, null: Array, width: Array) -> Array:
            axes = tuple(range(1, value.ndim))
            if not axes:  # numbers, which have no variance over nodes
                return jnp.full(value.shape, jnp.nan, value.dtype)
            signal, width = (jnp.where(nodes, each, jnp.nan) for each in (value - null, width))
            noise = jnp.nanmean(width**2, axis=axes)
            return jnp.sqrt(jnp.maximum(jnp.nanvar(signal, axis=axes) - noise, 0) / noise)

        return jax.tree.map(of, self.corrected, self.null, self._width)

    def messages(self) -> list[str]:
        """Return warnings about the accuracy of these numbers, as sentences."""
        if (share := float(self.indefinite)) > INDEFINITE:
            return [
                f"intervals are not reliable, because noise makes {share:.2%} of the tensors indefinite. Smooth the "
                "tensors (smoothing=, or hks-jax smooth), or leave the noisiest nodes out of the mask"
            ]
        found = []
        if (share := float(self.raised)) > 0:
            found.append(
                f"deviations are too small at and beside {share:.2%} of the nodes, where noise is as large as the "
                "diffusivity. Leave the noisiest nodes out of the mask"
            )
        claimed = np.concatenate([np.asarray(each).ravel() for each in jax.tree.leaves(self.trusted)])
        if claimed.all():
            return found
        return [
            *found,
            f"intervals are not reliable for {int((~claimed).sum())} of {claimed.size} numbers or maps: the effect of "
            "noise is not linear, or the bias exceeds the deviation (see `trusted`). Only a part of the bias is "
            "corrected there. Smooth the tensors (smoothing=, or hks-jax smooth)",
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
        size = jax.tree.map(jnp.divide, self.bias, self.deviation)
        part = jax.tree.map(jnp.divide, self._correction, self.bias)
        for name, each in (
            ("bias divided by deviation", size),
            ("corrected part of the bias", part),
            ("beyond linear", self.beyond_linear),
        ):
            values = np.concatenate([np.asarray(leaf).ravel() for leaf in jax.tree.leaves(each)])
            values = values[np.isfinite(values)]
            if values.size:
                low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
                lines.append(f"{name}: {middle:.3g} (90 % of the values: {low:.3g} to {high:.3g})")
        return "\n".join([*lines, *self.messages()])


def _maps(array: Array) -> Array:
    """Return the array with one row for each map, or for each number of an array with at most one axis."""
    return array.reshape(len(array) if array.ndim > 1 else array.size, -1)
