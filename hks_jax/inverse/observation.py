"""What is observed: a target signature, where and when, and how a prediction is compared with it."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import StaticArray
from hks_jax.checks import checked_times, require_number, require_real
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.space import FunctionSpace
from hks_jax.signatures.hks import hks
from hks_jax.signatures.kernels import heat_trace, wks

Function = Callable[[Eigenpairs], Array]
Loss = Callable[[Array, Array], Array]

LOSSES: dict[str, Loss] = {
    "log": lambda predicted, target: jnp.log(predicted) - jnp.log(target),
    "relative": lambda predicted, target: predicted / target - 1,
    "absolute": lambda predicted, target: predicted - target,
}


@dataclasses.dataclass(frozen=True)
class Signature:
    """A kind of signature."""

    name: str  # what `fit_metric` calls it; empty for a function of the user's
    # Takes eigenpairs, times, the width of a wave kernel, the number of entries; a user's takes the eigenpairs alone.
    function: Callable[..., Array]
    symbol: str = ""  # "t": it depends on times of the flow of heat; "e": on energies; empty: on the eigenpairs alone
    at_nodes: bool = False  # whether it has a value for each node


SIGNATURES = {
    each.name: each
    for each in (
        Signature("hks", lambda pairs, times, *_: hks(pairs, times), "t", at_nodes=True),
        Signature("wks", lambda pairs, energies, sigma, _: wks(pairs, energies, sigma), "e", at_nodes=True),
        Signature("heat-trace", lambda pairs, times, *_: heat_trace(pairs, times), "t"),
        Signature("eigenvalues", lambda pairs, _, __, count: pairs.eigenvalues[:count]),  # there may be spare ones
    )
}


class Observation(eqx.Module):
    """The observed entries of a target."""

    target: Float[Array, " m"]  # their values
    root_weights: Float[Array, " m"]  # the square roots of their weights, which add up to one
    times: Float[Array, " n_times"] | None  # the times, energies, or None
    sigma: Float[Array, ""] | None  # the width of a wave kernel signature, or None
    shape: tuple[int, ...] = eqx.field(static=True)  # of the whole target
    entries: StaticArray = eqx.field(static=True)  # which of the flat target's entries they are
    signature: Signature = eqx.field(static=True)  # its kind
    loss: str | Loss = eqx.field(static=True)  # one of `LOSSES`, or a function of predicted and target to residuals

    def predict(self, pairs: Eigenpairs) -> Array:
        """Return the whole signature."""
        beside = (self.times, self.sigma, self.shape[0]) if self.signature.name else ()
        return self.signature.function(pairs, *beside)

    def residuals(self, pairs: Eigenpairs) -> Float[Array, " m"]:
        """Return the residuals, half of whose sum of squares is the misfit."""
        return self.compare(self.predict(pairs))

    def compare(self, predicted: Array) -> Float[Array, " m"]:
        """Return the residuals of a whole signature."""
        loss = self.loss if callable(self.loss) else LOSSES[self.loss]
        return self.root_weights * loss(predicted.reshape(-1)[self.entries.value], self.target)


def observe(
    target: Any,
    times: Any,
    weights: Any,
    signature: str | Function,
    loss: str | Loss,
    sigma: Any,
    space: FunctionSpace,
    dtype: Any,
) -> Observation:
    """Check what is given and return the observation; see `hks_jax.fit_metric` for the arguments."""
    if not callable(signature) and signature not in SIGNATURES:
        names = ", ".join(map(repr, SIGNATURES))
        raise ValueError(f"signature: got {signature!r}; expected {names}, or a function of eigenpairs")
    kind = Signature("", signature) if callable(signature) else SIGNATURES[signature]
    if not callable(loss) and loss not in LOSSES:
        names = ", ".join(map(repr, LOSSES))
        raise ValueError(f"loss: got {loss!r}; expected {names}, or a function of predicted and target values")
    for name, given in (("target", target), ("times", times), ("weights", weights)):
        require_real(name, given)
    values = np.asarray(target, np.float64)
    if kind.symbol == "e":
        if sigma is None:
            raise ValueError("sigma: got None; expected the width of the wave kernel signature, as for `wks`")
        require_number("sigma", sigma)
        times, sigma = jnp.asarray(times, dtype), jnp.asarray(sigma, dtype)
    else:
        times, sigma = checked_times(times, dtype) if kind.symbol else None, None
    nodes = space.node_shape if kind.at_nodes else ()
    expected = None if times is None else (times.size, *nodes)
    if (expected is not None and values.shape != expected) or (kind.name == "eigenvalues" and values.ndim != 1):
        what = "(n_times, *grid.shape)" if kind.at_nodes else "(n_times,)"
        wanted = "(m,), the lowest ones ascending" if expected is None else f"{what} = {expected}"
        raise ValueError(f"target: got shape {values.shape}; expected {wanted}")

    observed = np.broadcast_to(space.free, values.shape) if kind.at_nodes else np.ones(values.shape, dtype=bool)
    if kind.name == "eigenvalues":
        observed = observed & (np.arange(values.size) >= space.n_null)  # zero whatever the metric is
    share = _checked_weights(weights, values.shape) * observed
    used = share > 0
    if not used.any():
        raise ValueError("weights: all are zero inside the domain; expected some observed entries")
    _check_values(values, used, positive=loss in ("log", "relative"))
    entries = np.flatnonzero(used)
    share = share.ravel()[entries]
    return Observation(
        target=jnp.asarray(values.ravel()[entries], dtype),
        root_weights=jnp.asarray(np.sqrt(share / share.sum()), dtype),
        times=times,
        sigma=sigma,
        shape=values.shape,
        entries=StaticArray(entries),
        signature=kind,
        loss=loss,
    )


def stages_of(
    whole: Observation, weights: Any, shape: tuple[int, ...], count: int, build: Callable[[Any], Observation]
) -> list[Observation]:
    """Return the observation of each stage: the largest times first."""
    if count == 1 or whole.signature.symbol != "t":
        return [whole]
    assert whole.times is not None
    order = np.argsort(-np.asarray(whole.times))
    base = np.broadcast_to(np.ones(()) if weights is None else np.asarray(weights, float), shape)
    stages = []
    for stage in range(1, count):
        used = np.zeros(shape[0], dtype=bool)
        used[order[: math.ceil(shape[0] * stage / count)]] = True
        stages.append(build(base * used.reshape(-1, *[1] * (len(shape) - 1))))
    return [*stages, whole]


def weigh(target: Any, weights: Any, deviation: Any, loss: str | Loss) -> tuple[np.ndarray, float]:
    """Return the weights that a stated deviation of the target makes, and the deviation of a residual in their mean."""
    if callable(loss):
        raise ValueError("deviation: it cannot be taken through a loss that is a function; give weights and noise")
    require_real("deviation", deviation)
    values = np.asarray(target, np.float64)
    given = _checked_weights(weights, values.shape)
    size = _broadcast("deviation", deviation, values.shape)
    used = (given > 0) & np.isfinite(values)
    if (bad := used & ~(np.isfinite(size) & (size > 0))).any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"deviation: {int(bad.sum())} of {int(used.sum())} are not positive numbers (the first at {first}: "
            f"{size[first]:.4g}); expected one for every observed value. Give others the weight 0"
        )
    of_residuals = np.where(used, size if loss == "absolute" else size / np.abs(values), 1.0)
    weighed = np.where(used, given / of_residuals**2, 0.0)
    return weighed, float(np.sqrt(np.sum(given, where=used) / np.sum(weighed)))


def _checked_weights(weights: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.ones(shape) if weights is None else _broadcast("weights", weights, shape)
    if not (np.isfinite(array) & (array >= 0)).all():
        raise ValueError("weights: got negative, infinite or NaN ones; expected numbers ≥ 0 (0: not observed)")
    return array


def _broadcast(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        return np.broadcast_to(np.asarray(values, np.float64), shape)
    except ValueError:
        raise ValueError(
            f"{name}: got shape {np.shape(values)}; expected one that broadcasts to the target's {shape}, such as "
            "(*grid.shape) for nodes or (n_times, 1, 1) for times"
        ) from None


def _check_values(values: np.ndarray, used: np.ndarray, positive: bool) -> None:
    finite = np.isfinite(values)
    for bad, what in ((used & ~finite, "NaN or infinite"), (used & finite & (values <= 0), "not positive")):
        if bad.any() and (positive or what != "not positive"):
            first = tuple(int(i) for i in np.argwhere(bad)[0])
            raise ValueError(
                f"target: {int(bad.sum())} of {int(used.sum())} observed values are {what} (the first at {first}: "
                f"{values[first]:.4g}). Give them the weight 0, take their nodes out of the mask, or correct them"
            )
