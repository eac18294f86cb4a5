"""Observations of a target signature at nodes and times, and their comparison with predictions."""

import dataclasses
import math
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import StaticArray
from hks_jax.checks import checked_times, require_number, require_real
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.pencil import AnyPencil
from hks_jax.fem.space import FunctionSpace
from hks_jax.inverse.signature import SIGNATURES, Signature
from hks_jax.inverse.unknowns import named

Loss = Callable[[Array, Array], Array]


# A lambda here would prevent the pickling of fits.
def _log_ratio(predicted: Array, target: Array) -> Array:
    return jnp.log(predicted) - jnp.log(target)


def _relative(predicted: Array, target: Array) -> Array:
    return predicted / target - 1


_ZERO = 1e-6
"""The largest eigenvalue of constants in a target, relative to the last eigenvalue."""
_ROUNDING = 100
"""The relative rounding error of a signature in units of ε; no step of a fit can reduce such errors reliably."""
LOSSES: dict[str, Loss] = {"log": _log_ratio, "relative": _relative, "absolute": operator.sub}


@dataclasses.dataclass(frozen=True)
class Data:
    """The kind, the weights and the noise of the target of `hks_jax.fit_metric`.

    Attributes:
        signature: ``"hks"``, ``"heat-trace"``, ``"eigenvalues"`` (the lowest), the result of `wave_kernel`, or a
            function that maps `Eigenpairs` to an array of the target's shape.
        loss: ``"log"`` (differences of logarithms), ``"relative"``, ``"absolute"``, or a function that maps flat
            predicted and target values to residuals.
        weights: numbers ≥ 0 that broadcast to the target's shape; 0 at unobserved entries, where the target may be NaN.
        noise: the standard deviation of the residuals; 0.01 means 1 % for the loss ``"log"``. The fit stops when the
            misfit reaches the level of the noise (the discrepancy principle), which regularises the fit.
        deviation: the standard deviation of the target's noise in the target's unit, broadcast to its shape, for
            example from `hks_jax.uncertainty`. The weights are divided by the square of the deviation, and by default
            `noise` follows from the deviation. The fit ignores correlations of the noise between entries.

    Raises:
        ValueError: if the signature or loss is unknown, if the noise is not positive, or if a loss function has a
            deviation.

    Examples:
        >>> lengths = hj.inverse.Data(signature="eigenvalues")
        >>> scaled = hj.inverse.Free(lambda s: s * field.tensors, jnp.array(1.1))
        >>> print(hj.fit_metric(field, pairs.eigenvalues, None, scaled, data=lengths).values.round(3))
        [1.]
    """

    signature: str | Signature | Callable[[Eigenpairs], Array] = "hks"
    loss: str | Loss = "log"
    weights: Any = None
    noise: float | None = None
    deviation: Any = None

    def __post_init__(self) -> None:
        """Check the settings that do not depend on the target."""
        if not callable(self.signature) and not isinstance(self.signature, Signature):
            named("signature", self.signature, SIGNATURES, "wave_kernel(sigma), or a function of eigenpairs")
        if not callable(self.loss):
            named("loss", self.loss, LOSSES, "or a function of predicted and target values")
        elif self.deviation is not None:
            raise ValueError("deviation: got a value with a function as loss; use weights and noise instead")
        if self.noise is not None:
            require_number("noise", self.noise)
        for name in ("weights", "deviation"):
            require_real(name, getattr(self, name))


class Observation(eqx.Module):
    """The observed entries of a target."""

    target: Float[Array, " m"]  # the observed values
    root_weights: Float[Array, " m"]  # the square roots of weights that add up to one
    times: Float[Array, " n_times"] | None  # the times, energies, or None
    signature: Signature  # the kind of signature
    shape: tuple[int, ...] = eqx.field(static=True)  # the shape of the whole target
    entries: StaticArray = eqx.field(static=True)  # the indices of the observed entries in the flat target
    loss: Loss = eqx.field(static=True)  # maps predicted and target values to residuals

    def predict(self, pairs: Eigenpairs) -> Array:
        """Return the whole signature."""
        values = self.signature.predict(pairs, self.times)
        return values[: self.shape[0]] if self.signature.lowest else values  # complete multiplets may add eigenvalues

    def pairs_needed(self, k: int | None, pencil: AnyPencil, field: TensorField) -> int:
        """Return the number of eigenpairs to compute: k, or enough for the observed times."""
        times = None if self.times is None else self.observed_times
        return self.shape[0] if self.signature.lowest else self.signature.pairs_needed(k, times, pencil, field)

    def residuals(self, pairs: Eigenpairs) -> Float[Array, " m"]:
        """Return the residuals; half the sum of their squares is the misfit."""
        return self.compare(self.predict(pairs))

    def compare(self, predicted: Array) -> Float[Array, " m"]:
        """Return the residuals of a predicted signature; raise ValueError if it has another shape than the target."""
        if predicted.shape != self.shape:
            raise ValueError(
                f"target: got shape {self.shape}, but the signature of the fitted metric has the shape "
                f"{predicted.shape}; expected equal shapes. Check the function that computes the signature, and the "
                "grid of `Free` unknowns"
            )
        return self.root_weights * self.loss(predicted.reshape(-1)[self.entries.value], self.target)

    @property
    def rounding_misfit(self) -> Float[Array, ""]:
        """The misfit of a signature with rounding errors only, in the units of the loss."""
        rounded = self.target * (1 + _ROUNDING * jnp.finfo(self.target.dtype).eps)
        return jnp.sum((self.root_weights * self.loss(rounded, self.target)) ** 2) / 2

    def truncation_misfit(self, pairs: Eigenpairs) -> Float[Array, ""]:
        """Estimate the misfit between the metric's signatures from k and from all eigenpairs.

        The estimate is half the weighted sum of squares of the missing pairs' contributions to the residuals, and zero
        for signatures that the k pairs define.
        """
        if self.signature.left_out is None:
            return jnp.zeros(())
        pairs = jax.lax.stop_gradient(pairs)
        predicted, share = self.predict(pairs), self.signature.left_out(pairs, self.times)
        return jnp.sum((self.compare(predicted / (1 - share)) - self.compare(predicted)) ** 2) / 2

    @property
    def observed_times(self) -> Float[np.ndarray, " m"]:
        """The time of each observed entry."""
        assert self.times is not None
        return np.asarray(self.times)[self.entries.value // math.prod(self.shape[1:])]

    def stages(self, count: int) -> list["Observation"]:
        """Return the observations of successive stages, which start with the largest times and end with all times."""
        if self.signature.left_out is None:
            return [self]
        times, stages = self.observed_times, []
        levels = np.unique(times)[::-1]
        for stage in range(1, count):
            kept = np.flatnonzero(times >= levels[math.ceil(len(levels) * stage / count) - 1])
            root, entries = self.root_weights[kept], StaticArray(self.entries.value[kept])
            root = root / jnp.linalg.norm(root)
            stages.append(dataclasses.replace(self, target=self.target[kept], root_weights=root, entries=entries))
        return [*stages, self]


def observe(target: Any, times: Any, data: Data, space: FunctionSpace, dtype: Any) -> tuple[Observation, float | None]:
    """Check the target; return the observation and, if known, the standard deviation of the residuals."""
    signature: Any = data.signature
    if not isinstance(signature, Signature):
        signature = SIGNATURES[signature] if isinstance(signature, str) else Signature(signature)
    for name, given in (("target", target), ("times", times)):
        require_real(name, given)
    values = np.asarray(target, np.float64)
    if signature.symbol == "e" and times is None:
        raise ValueError("times: got None; expected energies (n_energies,) for a wave kernel signature")
    if signature.symbol == "t":
        times = checked_times(times, dtype)
    else:
        times = jnp.asarray(times, dtype) if signature.symbol else None
    nodes = space.node_shape if signature.at_nodes else ()
    expected = None if times is None else (times.size, *nodes)
    if (expected is not None and values.shape != expected) or (signature.lowest and values.ndim != 1):
        what = "(n_times, *grid.shape)" if signature.at_nodes else "(n_times,)"
        wanted = "(m,), the lowest eigenvalues in ascending order" if expected is None else f"{what} = {expected}"
        raise ValueError(f"target: got shape {values.shape}; expected {wanted}")

    given = np.ones(values.shape) if data.weights is None else _broadcast("weights", data.weights, values.shape)
    if not (np.isfinite(given) & (given >= 0)).all():
        raise ValueError("weights: got negative, infinite or NaN weights; expected numbers ≥ 0 (0: not observed)")
    used = (given > 0) & (space.free if signature.at_nodes else True)
    if signature.lowest:
        constants = np.arange(values.size) < space.n_null  # which have the eigenvalue 0 for every metric
        largest = np.max(np.abs(values), initial=0, where=used & np.isfinite(values))
        wrong = used & constants & (np.abs(values) > _ZERO * largest)
        remedy = f"The target begins with {space.n_null} zeros, one for the constants of each component"
        _refuse("target", values, wrong, used, "not zero, although they are eigenvalues of constants", remedy)
        descending = np.zeros(values.shape, bool)
        descending[used] = np.diff(values[used], prepend=-np.inf) < 0
        _refuse("target", values, descending, used, "less than the value before", "Sort the eigenvalues")
        used &= ~constants
    if not used.any():
        raise ValueError("weights: got only zeros inside the domain; expected a positive weight at some entry")
    remedy = "Correct the invalid values, give them the weight 0, or remove their nodes from the mask"
    _refuse("target", values, used & ~np.isfinite(values), used, "NaN or infinite", remedy)
    if data.loss in ("log", "relative"):
        _refuse("target", values, used & (values <= 0), used, "not positive", remedy)
    share, noise = _weights(values, given, used, data)
    entries = np.flatnonzero(used)
    observation = Observation(
        target=jnp.asarray(values.ravel()[entries], dtype),
        root_weights=jnp.asarray(np.sqrt(share / share.sum()), dtype),
        times=times,
        signature=signature,
        shape=values.shape,
        entries=StaticArray(entries),
        loss=LOSSES[data.loss] if isinstance(data.loss, str) else data.loss,
    )
    return observation, noise


def _weights(
    values: np.ndarray, given: np.ndarray, used: np.ndarray, data: Data
) -> tuple[Float[np.ndarray, " m"], float | None]:
    """Return the used weights divided by the squared deviations, and the residuals' standard deviation or None."""
    given, noise = given[used], data.noise
    if data.deviation is None:
        return given, noise
    size = _broadcast("deviation", data.deviation, values.shape)
    remedy = "Expected a positive number for every observed value; set the weight of other values to 0"
    _refuse("deviation", size, used & ~(np.isfinite(size) & (size > 0)), used, "not positive numbers", remedy)
    weights = given / (size[used] / (1 if data.loss == "absolute" else values[used])) ** 2
    return weights, float(np.sqrt(given.sum() / weights.sum())) if noise is None else noise


def _broadcast(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        return np.broadcast_to(np.asarray(values, np.float64), shape)
    except ValueError:
        raise ValueError(
            f"{name}: got shape {np.shape(values)}; expected a shape that broadcasts to the target's {shape}, such as "
            "(*grid.shape) for nodes or (n_times, 1, 1) for times"
        ) from None


def _refuse(name: str, values: np.ndarray, bad: np.ndarray, used: np.ndarray, what: str, remedy: str) -> None:
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name}: got {int(bad.sum())} of {int(used.sum())} observed values that are {what} (the first is "
            f"{values[first]:.4g} at {first}). {remedy}"
        )
