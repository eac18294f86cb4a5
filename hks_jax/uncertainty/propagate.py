"""From noise of tensors to noise of results."""

import math
import os
from collections.abc import Callable
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import real_array, require_count, require_number
from hks_jax.domain import spd
from hks_jax.storage import load_npz, write_npz
from hks_jax.traced import is_traced
from hks_jax.uncertainty.noise import TensorNoise
from hks_jax.uncertainty.result import Uncertainty
from hks_jax.uncertainty.smoothing import smooth_tensors

Method = Literal["auto", "resample", "linear", "exact"]

_SIGNS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
"""The corners of a tetrahedron: those of the cube that have an even number of minus signs."""
_BALANCED = len(_SIGNS)
"""How many noisy maps are one sample: as many as such corners."""
_LEAST = 8
"""Noisy maps from which bias and departure from linearity can be estimated."""
_SCALE = 0.5
"""The size of the noise that is added to the measured tensors, which have some already, relative to the true one."""
_FLOOR = 0.01
"""The floor of eigenvalues of indefinite noisy tensors, as a share of the mean eigenvalue."""
_LOUD = 3.0
"""The deviation of a component over the mean diffusivity, its median over the nodes, that no measurement has."""


class _Moments(eqx.Module):
    """Sums over balanced maps: of their linear parts' squares, and mean and squared deviations of their even parts."""

    n: Array
    odd: Any
    even: Any
    spread: Any
    indefinite: Array

    @jax.jit
    def add(self, found: Any, even: Any, indefinite: Array) -> "_Moments":
        """Return the moments with four maps more (Welford 1962)."""
        n = self.n + 1
        odd = jax.tree.map(lambda s, f: s + jnp.mean(f**2, axis=0), self.odd, found)
        mean = jax.tree.map(lambda mean, e: mean + (e - mean) / n, self.even, even)
        spread = jax.tree.map(lambda s, e, old, new: s + (e - old) * (e - new), self.spread, even, self.even, mean)
        return _Moments(n, odd, mean, spread, self.indefinite + indefinite)


# Four maps y at D + sδ, with noise δ = (±η₁ ± η₂ ± η₃)/√3 at the corners of a tetrahedron of independent η, each of
# which δ has the covariance Σ of η. The δ add up to zero, so that the mean of y less the value is of second order,
# s² times the bias, for any η. To second order y₁ + y₂ − y₃ − y₄ = 4sJη₁/√3, and likewise for η₂ and η₃: four maps
# are three samples of the noise, where two antithetic pairs are two. The mean of four has a third of the variance that
# a quadratic form of one δ has, which is what is beyond linear.
@jax.jit
def _parts(maps: list[Any], value: Any) -> tuple[Any, Any]:
    """Return the noise Jη (3, …) that four maps are made of, and their even part: the bias, on average."""

    def linear(*y: Array) -> Array:
        signs = jnp.asarray(_SIGNS.T * (math.sqrt(3) / (4 * _SCALE)), y[0].dtype)
        return jnp.tensordot(signs, jnp.stack(y), 1, precision=jax.lax.Precision.HIGHEST)

    return (
        jax.tree.map(linear, *maps),
        jax.tree.map(lambda v, *y: (sum(y) / _BALANCED - v) / _SCALE**2, value, *maps),
    )


def uncertainty(
    function: Callable[[Array], Any],
    tensors: Any,
    noise: TensorNoise,
    *,
    method: Method = "auto",
    draws: int = 8,
    smoothing: float = 0.0,
    seed: int = 0,
    compiled: bool = True,
    progress: Callable[[str], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    each: Callable[[Any], None] | None = None,
) -> Uncertainty:
    """Compute what noise of measured tensors does to a function of them: its standard deviation, and its bias.

        def signature(D):
            field = hj.TensorField.from_diffusion(grid, D, metric="inverse")
            return hj.hks(hj.eigenpairs(field, k=150), times, normalisation="flat")

        bars = hj.uncertainty(signature, D, hj.TensorNoise.relative(D, 0.1))
        bars.deviation, bars.bias, bars.interval(0.95), bars.z(1.0), bars.summary()

    Noise δ is drawn four at a time, which add up to zero, and maps are computed of D + δ/2: their differences are
    linear in the noise to second order, and their mean less the value, four times, is the bias. Half the noise, because
    measured tensors have a whole one already: that of full size on top of it would exaggerate what is beyond linear.
    Four maps are three samples: a deviation is sure to 29 % of itself by default, to 8 % with 100 draws.

    Args:
        function: maps tensors (*shape, d, d) to an array, or to a pytree of arrays; JAX must be able to trace it,
            unless `compiled` is false. Times and energies should be fixed, not chosen by its eigenpairs.
        tensors: (*shape, d, d) as measured, at nodes or cells; positive definite where there is noise.
        noise: theirs: see `TensorNoise`.
        method: ``"resample"``: all by maps of noisy tensors. ``"exact"``: one reverse product for each number that the
            function returns, gᵀΣg. ``"linear"``: as many products with one linearisation as there are draws. These two
            take eight maps besides, for the bias and for what is beyond linear. ``"auto"``: exact if the function
            returns no more numbers than there are draws, else resampling: a product with the Jacobian of a signature
            takes as long as one or two signatures.
        draws: how many maps of noisy tensors (or products, of ``"linear"``), 8 or more; the next multiple of four.
        smoothing: of the tensors before the function sees them, log-Euclidean, the standard deviation of the Gaussian
            in coordinate units (`smooth_tensors`); the noise must know its grid.
        seed: of the draws.
        compiled: whether to compile the function, once, for all draws. False for what cannot be traced: it is then
            called as it is.
        progress: called with a short text after every four maps.
        checkpoint: a file to write after every four maps. If it is there already, resampling goes on from it.
        each: called with every sample of the noise, three for four maps, of the structure of the value: what
            covariances, or errors of means over regions, can be made of. Not again for those of a checkpoint.

    Returns:
        Value, deviation and bias, and how sure they are. Under `jit` it works with a method that is named. The
        deviation of ``"exact"`` is differentiable with respect to the noise: which measurement would reduce it most.

    Raises:
        ValueError: tensors and noise that do not fit each other, in shape or in unit; a function that cannot be traced;
            a checkpoint of another computation.

    Warns:
        AccuracyWarning: noise that makes tensors indefinite, or is beyond linear: intervals are not claimed there.
    """
    measured = real_array("tensors", tensors)
    _check(measured, noise, method, draws, smoothing)

    def smoothed(D: Array) -> Array:
        return smooth_tensors(noise.grid, D, smoothing) if noise.grid is not None and smoothing else D

    # The function itself where it can be: what is compiled of it then serves other calls, too.
    whole = (lambda D: function(smoothed(D))) if smoothing else function
    run = jax.jit(whole) if compiled else whole
    try:
        value = run(measured)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        raise ValueError(
            "function: it looks at values, and cannot be traced by JAX; pass compiled=False, or let it choose nothing "
            'by them, as hks(…, method="auto") does'
        ) from error
    if method == "auto":
        if is_traced((measured, noise.covariance)):
            raise ValueError('method: "auto" is for known values; under jit name "resample", "linear" or "exact"')
        size = sum(leaf.size for leaf in jax.tree.leaves(value))
        method = "exact" if compiled and size <= draws else "resample"
    samples = -(-draws // _BALANCED) if method == "resample" else _LEAST // _BALANCED
    moments = _sampled(run, value, measured, noise, seed, samples, progress, checkpoint, each)
    variance = jax.tree.map(lambda odd: odd / samples, moments.odd)
    spread = jax.tree.map(lambda s: s / (samples - 1), moments.spread)
    freedom: float = samples * (_BALANCED - 1)
    if method != "resample":
        freedom = math.inf if method == "exact" else draws
        rule = _exact if method == "exact" else partial(_linear, draws=draws)
        variance = rule(whole, measured, noise, seed)
    freedom = 1 / (1 / freedom + 1 / noise.freedom) if min(freedom, noise.freedom) < math.inf else math.inf
    smear = None
    if smoothing:
        smear = jax.tree.map(jnp.subtract, run(smoothed(measured)), value)
    result = Uncertainty(
        value,
        jax.tree.map(jnp.sqrt, variance),
        moments.even,
        jax.tree.map(lambda s: jnp.sqrt(s / samples), spread),
        jax.tree.map(lambda s, t: (_BALANCED - 1) * s / jnp.where(t > 0, t, 1), spread, variance),
        smear,
        moments.indefinite / (_BALANCED * samples),
        0.0 if math.isinf(freedom) else 1 / math.sqrt(2 * freedom),
        method,
        _BALANCED * samples,
        float(freedom),
        samples - 1,
    )
    if not is_traced(jax.lax.stop_gradient(variance)):
        for message in result.messages():
            warn_of_accuracy(message)
    return result


def _check(measured: Array, noise: TensorNoise, method: str, draws: int, smoothing: float) -> None:
    """Raise ValueError for tensors and noise that do not belong together, and for bad settings."""
    if not isinstance(noise, TensorNoise):
        raise TypeError(f"noise: got {type(noise).__name__}; expected hks_jax.TensorNoise")
    if method not in get_args(Method):
        raise ValueError(f"method: got {method!r}; expected one of {', '.join(get_args(Method))}")
    require_count("draws", draws, _LEAST)
    require_number("smoothing", smoothing, inclusive=True)
    if smoothing and noise.grid is None:
        raise ValueError("smoothing: got a length, but the noise has no grid; give TensorNoise the grid of the tensors")
    d = noise.dimension
    if measured.shape != (*noise.covariance.shape[:-2], d, d):
        raise ValueError(
            f"noise: got a covariance of shape {noise.covariance.shape} for tensors of shape {measured.shape}; "
            "expected (*shape, m, m) for (*shape, d, d), m = d(d+1)/2"
        )
    if is_traced((measured, noise.covariance)):
        return
    mean = np.trace(np.asarray(measured), axis1=-2, axis2=-1) / d
    variance = np.trace(np.asarray(noise.covariance), axis1=-2, axis2=-1) / noise.covariance.shape[-1]
    noisy = (variance > 0) & (mean > 0)
    if not noisy.any():
        raise ValueError("noise: it is zero wherever the tensors are positive; nothing has an error bar")
    level = float(np.median(np.sqrt(variance[noisy]) / mean[noisy]))
    if not 1e-6 < level < _LOUD:
        raise ValueError(
            f"noise: its deviation is {level:.3g} of the mean diffusivity (the median over the nodes), which no scan "
            "has. Is the covariance in the squared unit of the tensors? Are the tensors diffusivities, not metrics?"
        )


def _positive(measured: Array, noisy: Array) -> tuple[Array, Array]:
    """Return noisy tensors with the eigenvalues of indefinite ones raised, and their share of the nodes.

    Nodes whose tensor is not positive definite without noise, as outside a mask, do not count.
    """
    valid = jnp.isfinite(spd.positive_or_nan(measured)).all(axis=(-2, -1))
    bad = valid & ~jnp.isfinite(spd.positive_or_nan(noisy)).all(axis=(-2, -1))

    def raised(noisy: Array) -> Array:
        values, vectors = spd.eigh(noisy)
        floor = _FLOOR * jnp.trace(measured, axis1=-2, axis2=-1)[..., None] / measured.shape[-1]
        higher = jnp.einsum("...ia,...a,...ja->...ij", vectors, jnp.maximum(values, floor), vectors)
        return jnp.where(bad[..., None, None], higher, noisy)

    share = jnp.sum(bad, dtype=measured.dtype) / jnp.maximum(jnp.sum(valid, dtype=measured.dtype), 1)
    return jax.lax.cond(bad.any(), raised, lambda noisy: noisy, noisy), share


def _white(noise: TensorNoise, seed: Any, index: Any, dtype: Any) -> Array:
    """Return one of the draws: the numbers that the noise is made of."""
    key = jax.random.fold_in(jax.random.key(seed), index)
    return jax.random.normal(key, noise.white_shape, dtype)


@jax.jit
def _four(measured: Array, noise: TensorNoise, seed: Any, index: Any) -> tuple[list[Array], Array]:
    """Return tensors with noise that adds up to zero, and the share that whole noise makes indefinite, in all four."""
    each = jnp.stack([noise.tensors(_white(noise, seed, 3 * index + i, measured.dtype)) for i in range(3)])
    changes = jnp.tensordot(
        jnp.asarray(_SIGNS / math.sqrt(3), each.dtype), each, 1, precision=jax.lax.Precision.HIGHEST
    )
    lost = jnp.stack([_positive(measured, measured + change)[1] for change in changes])
    return [_positive(measured, measured + _SCALE * change)[0] for change in changes], lost.sum()


def _sampled(
    run: Callable[[Array], Any],
    value: Any,
    measured: Array,
    noise: TensorNoise,
    seed: int,
    samples: int,
    progress: Callable[[str], None] | None,
    checkpoint: str | os.PathLike[str] | None,
    each: Callable[[Any], None] | None,
) -> _Moments:
    """Return the moments of four maps each."""
    nothing = jax.tree.map(jnp.zeros_like, value)
    none = jnp.zeros((), measured.dtype)
    moments = _Moments(none, nothing, nothing, nothing, none)

    def step(index: Any, moments: _Moments) -> _Moments:
        noisy, lost = _four(measured, noise, seed, index)
        found, even = _parts([run(one) for one in noisy], value)
        if each is not None:
            for i in range(len(_SIGNS[0])):
                each(jax.tree.map(itemgetter(i), found))
        return moments.add(found, even, lost)

    if is_traced(value):
        return jax.lax.fori_loop(0, samples, step, moments)
    mark, first = "", 0
    if checkpoint is not None:
        from hks_jax.inverse.checkpoint import fingerprint  # fits are slow to import

        mark = fingerprint(value, _four(measured, noise, seed, 0))
        if Path(checkpoint).exists():
            moments, first = _load(checkpoint, mark, moments)
    for index in range(first, samples):
        moments = jax.block_until_ready(step(index, moments))
        if progress is not None:
            progress(f"{_BALANCED * (index + 1)} of {_BALANCED * samples} noisy maps")
        if checkpoint is not None:
            arrays = {f"arr_{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(moments))}
            write_npz(checkpoint, {**arrays, "mark": mark}, compressed=False)
    return moments


def _load(path: str | os.PathLike[str], mark: str, like: _Moments) -> tuple[_Moments, int]:
    """Read moments, and how many samples they are of."""
    data = load_npz(path)
    if str(data.get("mark")) != mark:
        raise ValueError(
            f"checkpoint: {path} is of another computation (another function, tensors, noise or seed), or no "
            "checkpoint; give another name, or remove it"
        )
    leaves, structure = jax.tree.flatten(like)
    read = [jnp.asarray(data[f"arr_{i}"], leaf.dtype) for i, leaf in enumerate(leaves)]
    moments = jax.tree.unflatten(structure, read)
    return moments, int(moments.n)


def _exact(function: Callable[[Array], Any], D: Array, noise: TensorNoise, seed: int) -> Any:
    """Return gᵀΣg for every number, by reverse products."""

    @jax.jit
    def squares(D: Array, noise: TensorNoise) -> Any:
        value, pull = jax.vjp(function, D)
        flat, unravel = ravel_pytree(value)
        back = jax.linear_transpose(noise.tensors, _white(noise, seed, 0, D.dtype))
        ones = jnp.eye(flat.size, dtype=flat.dtype)
        return unravel(jax.lax.map(lambda one: jnp.sum(back(*pull(unravel(one)))[0] ** 2), ones))

    return squares(D, noise)


def _linear(function: Callable[[Array], Any], D: Array, noise: TensorNoise, seed: int, draws: int) -> Any:
    """Return the mean of (Jδ)² over draws."""
    value, push = jax.linearize(jax.jit(function), D)

    @jax.jit
    def mean(push: Any, noise: TensorNoise) -> Any:
        def add(total: Any, index: Array) -> tuple[Any, None]:
            product = push(noise.tensors(_white(noise, seed, index, D.dtype)))
            return jax.tree.map(lambda t, p: t + p**2 / draws, total, product), None

        return jax.lax.scan(add, jax.tree.map(jnp.zeros_like, value), jnp.arange(draws))[0]

    return mean(push, noise)
