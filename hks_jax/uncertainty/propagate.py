"""Propagation of the noise of tensors to functions of the tensors."""

import math
import os
import time
import warnings
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array

from hks_jax.accuracy import AccuracyWarning, warn_of_accuracy
from hks_jax.arrays import nan_is_meant
from hks_jax.checks import real_array, require_count, require_number
from hks_jax.domain import spd
from hks_jax.eigen.solver import Status
from hks_jax.storage import load_npz, write_npz
from hks_jax.traced import is_traced
from hks_jax.uncertainty.noise import TensorNoise
from hks_jax.uncertainty.result import Uncertainty
from hks_jax.uncertainty.smoothing import smooth_tensors

Method = Literal["auto", "resample", "linear", "exact"]

_SIGNS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
"""The corners of a regular tetrahedron: the corners of the cube with an even number of minus signs."""
_BALANCED = len(_SIGNS)
"""The number of noisy tensor fields in one balanced sample, one for each corner of the tetrahedron."""
LEAST = 8
"""The least number of noisy tensor fields for estimates of the bias and of the variance's second-order part."""
_SCALE = 0.5
"""The factor s of samples of the noise. It is less than 1, because the measured tensors already contain noise."""
_LOUD = 3.0
"""The upper limit for the noise: the standard deviation relative to the mean diffusivity, in the median over nodes."""


class _Moments(eqx.Module):
    """Sums over balanced samples: squared first-order changes of the value; mean and spread of second-order changes."""

    n: Array
    odd: Any
    even: Any
    spread: Any
    indefinite: Array
    raised: Array

    @jax.jit
    def add(self, found: Any, even: Any, indefinite: Array, raised: Array) -> "_Moments":
        """Return the moments after one more balanced sample (Welford 1962)."""
        n = self.n + 1
        odd = jax.tree.map(lambda s, f: s + jnp.mean(f**2, axis=0), self.odd, found)
        mean = jax.tree.map(lambda mean, e: mean + (e - mean) / n, self.even, even)
        spread = jax.tree.map(lambda s, e, old, new: s + (e - old) * (e - new), self.spread, even, self.even, mean)
        return _Moments(n, odd, mean, spread, self.indefinite + indefinite, self.raised + raised)


# Let η₁, η₂, η₃ be independent samples of noise with the covariance Σ. The four sums δ = (±η₁ ± η₂ ± η₃)/√3 with an
# even number of minus signs form a tetrahedron and add up to zero; each δ has the covariance Σ. Let y₁, …, y₄ be the
# function's values at D + sδ, where D are the measured tensors and s is `_SCALE`. Because the δ add up to zero, the
# mean of the y minus the value at D is of second order in δ, and has the expectation s² times the bias. To first order
# in δ, y₁ + y₂ − y₃ − y₄ is 4sJη₁/√3 with the Jacobian J of the function. Similar sums give Jη₂ and Jη₃, and thus three
# samples of the error. The mean of a quadratic form over the four δ has a third of the variance of the form at one δ.
@jax.jit
def _parts(maps: list[Any], value: Any) -> tuple[Any, Any]:
    def linear(*y: Array) -> Array:
        signs = jnp.asarray(_SIGNS.T * (math.sqrt(3) / (4 * _SCALE)), y[0].dtype)
        return jnp.tensordot(signs, jnp.stack(y), 1, precision=jax.lax.Precision.HIGHEST)

    return (
        jax.tree.map(linear, *maps),
        jax.tree.map(lambda v, *y: (sum(y) / _BALANCED - v) / _SCALE**2, value, *maps),
    )


@nan_is_meant
def uncertainty(
    function: Callable[[Array], Any],
    tensors: Any,
    noise: TensorNoise,
    *,
    method: Method = "auto",
    draws: int = 8,
    smoothing: float = 0.0,
    seed: int | Array = 0,
    compiled: bool = True,
    progress: Callable[[str], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    each: Callable[[Any], None] | None = None,
    floor: float = 0.01,
) -> Uncertainty:
    """Compute the standard deviation and the bias of a function of measured tensors due to their noise.

        def signature(D):
            field = hj.TensorField.from_diffusion(grid, D, metric="inverse")
            return hj.hks(hj.eigenpairs(field, k=150), times, normalisation="flat")

        bars = hj.uncertainty(signature, D, hj.TensorNoise.relative(D, 0.1))
        bars.deviation, bars.bias, bars.interval(0.95), bars.z(), bars.discoveries(0.05), bars.summary()

    Samples δ of the noise are drawn in groups of four that add up to zero, and the function is evaluated at D + δ/2,
    where D are the measured tensors. The differences of the four values of a group give three samples of the error of
    the value at D, and the mean of the four values gives the bias. Half of δ is added, because D already contains
    noise: the whole sample δ would exaggerate second-order effects. The relative error of a standard deviation is
    29 % with 8 draws, and 8 % with 100 draws.

    The function is also evaluated at constant tensors, the mean of the measured tensors over the nodes inside the
    noise's grid at which maps of the result are finite. The constant tensors are the null hypothesis of
    `Uncertainty.z`.

    Args:
        function: maps tensors (*shape, d, d) to an array, or to a pytree of arrays. JAX must be able to trace the
            function, unless `compiled` is false. Times and energies should be fixed, and not depend on the eigenpairs.
        tensors: (*shape, d, d), the measured tensors at nodes or cells; positive definite at nodes with noise.
        noise: the noise of the tensors (see `TensorNoise`).
        method: ``"resample"`` evaluates the function at noisy tensors. ``"exact"`` computes the first-order variance of
            each number of the result by one reverse-mode product. ``"linear"`` multiplies `draws` samples of the noise
            by the Jacobian. ``"exact"`` and ``"linear"`` also evaluate the function at eight noisy tensor fields, for
            the bias and the second-order variance. ``"auto"`` chooses ``"exact"`` if the result has at most `draws`
            numbers, or else ``"resample"``, because a product with the Jacobian of a signature takes as long as
            computing one or two signatures.
        draws: the number of noisy tensor fields (products for ``"linear"``), at least 8; rounded up to multiples of 4.
        smoothing: the standard deviation, in coordinate units, of a Gaussian that smooths the tensors before the
            function is evaluated (see `smooth_tensors`); the noise must have a grid. 0 for no smoothing.
        seed: the seed of the random numbers.
        compiled: whether to compile the function once for all draws; if false, the function is called as it is.
        progress: a function that is called with a short text after each noisy tensor field. The attribute
            ``seconds_left`` of the text is the estimated remaining time.
        checkpoint: a file that is written after every four noisy tensor fields. If it exists, resampling continues.
        each: a function that is called with each sample of the value's error (three for every four noisy tensor
            fields), for example to compute covariances. With a checkpoint, the file contains these samples, and the
            function is called again for them when resampling continues.
        floor: the least diffusivity of a noisy tensor in any direction, as a fraction of the measured one. Where noise
            takes more, the tensor is raised (`Uncertainty.raised`), and standard deviations are too small there. A
            larger number such as 0.5 saves time in volumes, whose eigensolver is slow if tensors are nearly singular.

    Returns:
        The value with its standard deviation, its bias and their accuracy. Under `jit`, `method` must not be
        ``"auto"``. With ``"exact"``, the standard deviation is differentiable with respect to the noise.

    Raises:
        ValueError: The tensors and the noise differ in shape or unit; the function cannot be traced; or the checkpoint
            belongs to another computation.

    Warns:
        AccuracyWarning: if intervals are not reliable, because noise makes tensors indefinite or acts nonlinearly.

    Examples:
        >>> noise = hj.TensorNoise.relative(field.tensors, 0.1)
        >>> bars = hj.uncertainty(lambda D: D[4, 4, 0, 0], field.tensors, noise)
        >>> print(bars.deviation.round(3))  # 0.1 · tr D/2
        0.25
    """
    measured = real_array("tensors", tensors)
    _check(measured, noise, method, draws, smoothing, floor)

    def smoothed(D: Array) -> Array:
        return smooth_tensors(noise.grid, D, smoothing) if noise.grid is not None and smoothing else D

    # Without smoothing, the function itself is passed to `jit`, so that later calls reuse its compilation.
    whole = (lambda D: function(smoothed(D))) if smoothing else function
    run = jax.jit(whole) if compiled else whole
    try:
        value = run(measured)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        raise ValueError(
            "function: got a function of concrete values, which JAX cannot trace; expected a traceable function. "
            "Pass compiled=False, or avoid choices by values, as in hks_auto"
        ) from error
    if method == "auto":
        if is_traced((measured, noise.covariance)):
            raise ValueError('method: got "auto" for traced arrays; expected "resample", "linear" or "exact" under jit')
        size = sum(leaf.size for leaf in jax.tree.leaves(value))
        method = "exact" if compiled and size <= draws else "resample"
    samples = -(-draws // _BALANCED) if method == "resample" else LEAST // _BALANCED
    moments = _sampled(run, value, measured, noise, seed, samples, progress, checkpoint, each, floor)
    if checkpoint is not None:  # which may have more samples
        samples = int(moments.n)
    variance = jax.tree.map(lambda odd: odd / samples, moments.odd)
    spread = jax.tree.map(lambda s: s / (samples - 1), moments.spread)
    freedom: float = samples * (_BALANCED - 1)
    if method == "exact":
        freedom, variance = math.inf, _exact(whole, measured, noise)
    elif method == "linear":
        freedom, variance = draws, _linear(whole, measured, noise, seed, draws)
    freedom = 1 / (1 / freedom + 1 / noise.freedom) if min(freedom, noise.freedom) < math.inf else math.inf
    smear = jax.tree.map(jnp.subtract, run(smoothed(measured)), value) if smoothing else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AccuracyWarning)  # eigenvalues of constant tensors are often multiple
        null = run(_constant(measured, noise, value))
    result = Uncertainty(
        value,
        null,
        jax.tree.map(jnp.sqrt, variance),
        moments.even,
        jax.tree.map(lambda s: jnp.sqrt(s / samples), spread),
        jax.tree.map(lambda s, t: (_BALANCED - 1) * s / jnp.where(t > 0, t, 1), spread, variance),
        smear,
        moments.indefinite / (_BALANCED * samples),
        moments.raised / (_BALANCED * samples),
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


def _check(measured: Array, noise: TensorNoise, method: str, draws: int, smoothing: float, floor: float) -> None:
    if not isinstance(noise, TensorNoise):
        raise TypeError(f"noise: got {type(noise).__name__}; expected hks_jax.TensorNoise")
    if method not in get_args(Method):
        raise ValueError(f"method: got {method!r}; expected one of {', '.join(get_args(Method))}")
    require_count("draws", draws, LEAST)
    require_number("smoothing", smoothing, inclusive=True)
    require_number("floor", floor)
    if floor >= 1:
        raise ValueError(f"floor: got {floor:g}; expected a fraction below 1")
    if smoothing and noise.grid is None:
        raise ValueError("smoothing: got a length, but the noise has no grid. Pass the tensors' grid to TensorNoise")
    d = noise.dimension
    if measured.shape != (*noise.covariance.shape[:-2], d, d):
        raise ValueError(
            f"noise: got a covariance of shape {noise.covariance.shape} for tensors of shape {measured.shape}; "
            "expected (*shape, m, m) for (*shape, d, d), where m = d(d+1)/2"
        )
    if is_traced((measured, noise.covariance)):
        return
    mean = np.trace(np.asarray(measured), axis1=-2, axis2=-1) / d
    variance = np.trace(np.asarray(noise.covariance), axis1=-2, axis2=-1) / noise.covariance.shape[-1]
    noisy = (variance > 0) & (mean > 0)
    if not noisy.any():
        raise ValueError("noise: got zero at all nodes with positive tensors; expected noise at one node or more")
    level = float(np.median(np.sqrt(variance[noisy]) / mean[noisy]))
    if not 1e-6 < level < _LOUD:
        raise ValueError(
            f"noise: got a standard deviation of {level:.3g} times the mean diffusivity (median over the nodes); "
            f"expected 1e-6 to {_LOUD:g}. Pass diffusivities, not metrics, and a covariance in their squared unit"
        )


# Where noise is as large as the smallest eigenvalue, a noisy tensor may be indefinite or nearly singular. A nearly
# singular tensor isolates its node from the neighbours, so that a mode of this node appears among the lowest ones, and
# the eigensolver takes many times as long. With D = LLᵀ, the noisy tensor N is at least cD in any direction if and only
# if N − cD is positive semidefinite, or all eigenvalues of L⁻¹NL⁻ᵀ are at least c. Smaller ones are raised to c.
def _floored(measured: Array, noisy: Array, floor: Any) -> tuple[Array, Array]:
    """Raise the diffusivity of noisy tensors to a fraction of the measured one; also return the share that changed."""
    valid = spd.is_positive(measured)
    low = valid & ~spd.is_positive(noisy - floor * measured)

    def raised(noisy: Array) -> Array:
        chosen = low[..., None, None]
        root = spd.cholesky(jnp.where(chosen, measured, jnp.eye(measured.shape[-1], dtype=measured.dtype)))
        half = solve_triangular(root, jnp.where(chosen, noisy, 0), lower=True)
        values, vectors = spd.eigh(solve_triangular(root, jnp.swapaxes(half, -1, -2), lower=True))
        axes = jnp.einsum("...ij,...ja->...ia", root, vectors, precision="highest")
        higher = jnp.einsum("...ia,...a,...ja->...ij", axes, jnp.maximum(values, floor), axes, precision="highest")
        return jnp.where(chosen, higher, noisy)

    return jax.lax.cond(low.any(), raised, lambda noisy: noisy, noisy), _share(low, valid, measured.dtype)


def _share(chosen: Array, of: Array, dtype: Any) -> Array:
    return jnp.sum(chosen, dtype=dtype) / jnp.maximum(jnp.sum(of, dtype=dtype), 1)


def _constant(measured: Array, noise: TensorNoise, value: Any) -> Array:
    """Return the tensors with their mean in place of each positive tensor (see `uncertainty`)."""
    positive, shape = spd.is_positive(measured), measured.shape[:-2]
    counted = positive if noise.grid is None else positive & noise.grid.inside
    for leaf in jax.tree.leaves(value):
        if leaf.shape[leaf.ndim - len(shape) :] == shape:
            counted &= jnp.isfinite(leaf).reshape(-1, *shape).any(axis=0)
    weights = counted[..., None, None]
    nodes = tuple(range(len(shape)))
    total = jnp.sum(jnp.where(weights, measured, 0), axis=nodes)
    mean = total / jnp.maximum(jnp.sum(weights, axis=nodes, dtype=measured.dtype), 1)
    return jnp.where(positive[..., None, None] & counted.any(), jnp.broadcast_to(mean, measured.shape), measured)


def _white(noise: TensorNoise, seed: Any, index: Any, dtype: Any) -> Array:
    key = jax.random.fold_in(jax.random.key(seed), index)
    return jax.random.normal(key, noise.white_shape, dtype)


@jax.jit
def _four(measured: Array, noise: TensorNoise, seed: Any, index: Any, floor: Any) -> tuple[list[Array], Array, Array]:
    """Return four noisy fields, the sum of the shares of tensors that the full noise makes indefinite in each, and the
    sum of the shares of tensors that `_floored` changes in each."""
    each = jnp.stack([noise.tensors(_white(noise, seed, 3 * index + i, measured.dtype)) for i in range(3)])
    changes = jnp.tensordot(
        jnp.asarray(_SIGNS / math.sqrt(3), each.dtype), each, 1, precision=jax.lax.Precision.HIGHEST
    )
    valid = spd.is_positive(measured)
    lost = jnp.stack([_share(valid & ~spd.is_positive(measured + change), valid, measured.dtype) for change in changes])
    noisy, raised = zip(*(_floored(measured, measured + _SCALE * change, floor) for change in changes), strict=True)
    return list(noisy), lost.sum(), jnp.stack(raised).sum()


def _sampled(
    run: Callable[[Array], Any],
    value: Any,
    measured: Array,
    noise: TensorNoise,
    seed: int | Array,
    samples: int,
    progress: Callable[[str], None] | None,
    checkpoint: str | os.PathLike[str] | None,
    each: Callable[[Any], None] | None,
    floor: float,
) -> _Moments:
    nothing = jax.tree.map(jnp.zeros_like, value)
    none = jnp.zeros((), measured.dtype)
    moments = _Moments(none, nothing, nothing, nothing, none, none)

    def step(index: Any, moments: _Moments, run: Callable[[Array], Any] = run) -> tuple[_Moments, Any]:
        noisy, lost, raised = _four(measured, noise, seed, index, floor)
        found, even = _parts([run(one) for one in noisy], value)
        return moments.add(found, even, lost, raised), found

    def tell(found: Any) -> None:
        if each is not None:
            for i in range(len(_SIGNS[0])):
                each(jax.tree.map(itemgetter(i), found))

    if is_traced(value):
        return jax.lax.fori_loop(0, samples, lambda index, moments: step(index, moments)[0], moments)
    mark, first = "", 0
    stored: list[Any] = []
    if checkpoint is not None:
        from hks_jax.inverse.checkpoint import fingerprint  # this import is slow

        mark = fingerprint(value, _four(measured, noise, seed, 0, floor), each is None)
        if Path(checkpoint).exists():
            data = load_npz(checkpoint)
            if str(data.get("mark")) != mark:
                raise ValueError(
                    f"checkpoint: {checkpoint} belongs to another computation, or is not a checkpoint; expected one of "
                    "the same function, tensors, noise and seed. Pass another path, or remove the file"
                )
            moments = ravel_pytree(moments)[1](jnp.asarray(data["moments"]))
            first, stored = int(moments.n), list(data["samples"])
            three = jax.tree.map(lambda v: jnp.stack([v] * len(_SIGNS[0])), value)
            for sample in stored:
                tell(ravel_pytree(three)[1](jnp.asarray(sample)))
    counted = _Counted(run, _BALANCED * first, _BALANCED * samples, progress)
    for index in range(first, samples):
        moments, found = jax.block_until_ready(step(index, moments, counted))
        tell(found)
        if checkpoint is not None:
            stored += [ravel_pytree(found)[0]] * (each is not None)
            content = {"moments": ravel_pytree(moments)[0], "samples": np.array(stored), "mark": mark}
            write_npz(checkpoint, content, compressed=False)
    return moments


class _Counted:
    """A function that tells after each call how many of its calls have ended, and the time that the others will take.

    The estimate includes one more call, that for constant tensors.
    """

    def __init__(
        self, function: Callable[[Array], Any], done: int, total: int, progress: Callable[[str], None] | None
    ) -> None:
        self._function, self._progress = function, progress
        self._first, self._done, self._total, self._begin = done, done, total, time.perf_counter()

    def __call__(self, tensors: Array) -> Any:
        value = jax.block_until_ready(self._function(tensors))
        self._done += 1
        if self._progress is not None:
            each = (time.perf_counter() - self._begin) / (self._done - self._first)
            left = each * (self._total - self._done + 1)
            self._progress(Status(f"{self._done} of {self._total} noisy maps", left))
        return value


def _exact(function: Callable[[Array], Any], D: Array, noise: TensorNoise) -> Any:
    """Return the variance gᵀΣg of each number of the result, by one reverse-mode product for its gradient g."""

    @jax.jit
    def squares(D: Array, noise: TensorNoise) -> Any:
        value, pull = jax.vjp(function, D)
        flat, unravel = ravel_pytree(value)
        back = jax.linear_transpose(noise.tensors, jax.ShapeDtypeStruct(noise.white_shape, D.dtype))
        ones = jnp.eye(flat.size, dtype=flat.dtype)
        return unravel(jax.lax.map(lambda one: jnp.sum(back(*pull(unravel(one)))[0] ** 2), ones))

    return squares(D, noise)


def _linear(function: Callable[[Array], Any], D: Array, noise: TensorNoise, seed: int | Array, draws: int) -> Any:
    """Return the mean of (Jδ)² over draws δ of the noise, where J is the Jacobian of the function."""
    value, push = jax.linearize(jax.jit(function), D)

    @jax.jit
    def mean(push: Any, noise: TensorNoise) -> Any:
        def add(total: Any, index: Array) -> tuple[Any, None]:
            product = push(noise.tensors(_white(noise, seed, index, D.dtype)))
            return jax.tree.map(lambda t, p: t + p**2 / draws, total, product), None

        return jax.lax.scan(add, jax.tree.map(jnp.zeros_like, value), jnp.arange(draws))[0]

    return mean(push, noise)
