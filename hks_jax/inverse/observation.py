"""What is observed: a target signature, where and when, and how a prediction is compared with it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.checks import checked_times, require_number, require_real
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.space import FunctionSpace
from hks_jax.signatures.hks import hks_of_pairs
from hks_jax.signatures.kernels import heat_trace, wks
from hks_jax.static_array import StaticArray

Signature = Callable[[Eigenpairs], Array]
Loss = Callable[[Array, Array], Array]

LOSSES: dict[str, Loss] = {
    "log": lambda predicted, target: jnp.log(predicted) - jnp.log(target),
    "relative": lambda predicted, target: predicted / target - 1,
    "absolute": lambda predicted, target: predicted - target,
}
SIGNATURES = ("hks", "wks", "heat-trace", "eigenvalues")


class Observation(eqx.Module):
    """The observed entries of a target.

    Attributes:
        target: (m,) their values.
        root_weights: (m,) the square roots of their weights, which add up to one.
        times: the times, energies, or None.
        sigma: the width of a wave kernel signature, or None.
        shape: of the whole target.
        entries: which of the flat target's entries they are.
        signature: one of `SIGNATURES`, or a function of the eigenpairs.
        loss: one of `LOSSES`, or a function of predicted and target (m,) to residuals (m,).
    """

    target: Float[Array, " m"]
    root_weights: Float[Array, " m"]
    times: Float[Array, " n_times"] | None
    sigma: Float[Array, ""] | None
    shape: tuple[int, ...] = eqx.field(static=True)
    entries: StaticArray = eqx.field(static=True)
    signature: str | Signature = eqx.field(static=True)
    loss: str | Loss = eqx.field(static=True)

    def predict(self, pairs: Eigenpairs) -> Array:
        """Return the whole signature."""
        if callable(self.signature):
            return self.signature(pairs)
        if self.signature == "hks":
            return hks_of_pairs(pairs, self.times)
        if self.signature == "wks":
            return wks(pairs, self.times, self.sigma)
        if self.signature == "heat-trace":
            return heat_trace(pairs, self.times)
        return pairs.eigenvalues[: self.shape[0]]  # there may be spare ones

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
    signature: str | Signature,
    loss: str | Loss,
    sigma: Any,
    space: FunctionSpace,
    dtype: Any,
) -> Observation:
    """Check what is given and return the observation; see `hks_jax.fit_metric` for the arguments.

    Raises:
        ValueError: an unknown signature or loss; a target, times or weights of the wrong shape; values that are NaN or,
            for a loss that needs it, not positive, at observed entries; nothing observed.
    """
    if not callable(signature) and signature not in SIGNATURES:
        names = ", ".join(map(repr, SIGNATURES))
        raise ValueError(f"signature: got {signature!r}; expected {names}, or a function of eigenpairs")
    if not callable(loss) and loss not in LOSSES:
        names = ", ".join(map(repr, LOSSES))
        raise ValueError(f"loss: got {loss!r}; expected {names}, or a function of predicted and target values")
    for name, given in (("target", target), ("times", times), ("weights", weights)):
        require_real(name, given)
    values = np.asarray(target, np.float64)
    nodal = (signature in ("hks", "wks")) if not callable(signature) else False
    if signature in ("hks", "heat-trace"):
        times = checked_times("times", times, dtype)
    elif signature == "wks":
        if sigma is None:
            raise ValueError("sigma: got None; expected the width of the wave kernel signature, as for `wks`")
        require_number("sigma", sigma)
        times, sigma = jnp.asarray(times, dtype), jnp.asarray(sigma, dtype)
    else:
        times = None
    expected: tuple[int, ...] | None = None
    if times is not None:
        expected = (times.size, *space.node_shape) if nodal else (times.size,)
    if (expected is not None and values.shape != expected) or (signature == "eigenvalues" and values.ndim != 1):
        what = {"eigenvalues": "(m,), the lowest ones ascending", "heat-trace": f"(n_times,) = {expected}"}
        wanted = what.get(str(signature), f"(n_times, *grid.shape) = {expected}")
        raise ValueError(f"target: got shape {values.shape}; expected {wanted}")

    observed = np.broadcast_to(space.free, values.shape) if nodal else np.ones(values.shape, dtype=bool)
    if signature == "eigenvalues":
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
        sigma=sigma if signature == "wks" else None,
        shape=values.shape,
        entries=StaticArray(entries),
        signature=signature,
        loss=loss,
    )


def weigh(target: Any, weights: Any, deviation: Any, loss: str | Loss) -> tuple[np.ndarray, float]:
    """Return the weights that a stated deviation of the target makes, and the deviation of a residual in their mean.

    Raises:
        ValueError: deviations of another shape, or not positive where the target is known; a loss that is a function.
    """
    if callable(loss):
        raise ValueError("deviation: it cannot be taken through a loss that is a function; give weights and noise")
    require_real("deviation", deviation)
    values = np.asarray(target, np.float64)
    given = _checked_weights(weights, values.shape)
    try:
        size = np.broadcast_to(np.asarray(deviation, np.float64), values.shape)
    except ValueError:
        raise ValueError(
            f"deviation: got shape {np.shape(deviation)}; expected one that broadcasts to the target's {values.shape}"
        ) from None
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
    array = np.ones(shape) if weights is None else np.asarray(weights, np.float64)
    try:
        array = np.broadcast_to(array, shape)
    except ValueError:
        raise ValueError(
            f"weights: got shape {array.shape}; expected one that broadcasts to the target's {shape}, such as "
            "(*grid.shape) for nodes or (n_times, 1, 1) for times"
        ) from None
    if not (np.isfinite(array) & (array >= 0)).all():
        raise ValueError("weights: got negative, infinite or NaN ones; expected numbers ≥ 0 (0: not observed)")
    return array


def _check_values(values: np.ndarray, used: np.ndarray, positive: bool) -> None:
    finite = np.isfinite(values)
    for bad, what in ((used & ~finite, "NaN or infinite"), (used & finite & (values <= 0), "not positive")):
        if bad.any() and (positive or what != "not positive"):
            first = tuple(int(i) for i in np.argwhere(bad)[0])
            raise ValueError(
                f"target: {int(bad.sum())} of {int(used.sum())} observed values are {what} (the first at {first}: "
                f"{values[first]:.4g}). Give them the weight 0, take their nodes out of the mask, or correct them"
            )
