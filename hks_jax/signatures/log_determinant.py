"""The zeta-regularised determinant of a Laplacian."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_number
from hks_jax.eigen.eigenpairs import Eigenpairs, require_pairs
from hks_jax.linear.divided_differences import gauss
from hks_jax.signatures.times import dimension_of, positive_range, volume_of
from hks_jax.signatures.truncation import truncation
from hks_jax.traced import is_traced

_FIRST = 18.0
"""The least product of the last eigenvalue and the time T. Each further eigenvalue λ contributes E₁(λT) < 1e-9."""
_TIMES, _PER_DOUBLING = 12, 2
"""The number of times T that are tried, and the number of steps from a time T to the time 2T."""
_DOUBTFUL = 0.01
"""The estimated error above which a warning is issued."""
_SMALL, _TERMS, _NODES = 2.0, 20, 32
"""The largest argument of E₁ for the series, its number of terms, and the number of quadrature points otherwise."""


class LogDeterminant(NamedTuple):
    """The logarithm of a zeta-regularised determinant.

    Attributes:
        value: log det′ Δ.
        error: an estimate of the discretisation error and of omitted terms of the heat trace; constant in derivatives.
        time: the time T, up to which the heat trace is computed from its coefficients, and beyond which from
            eigenvalues; constant in derivatives.
    """

    value: Float[Array, ""]
    error: Float[Array, ""]
    time: Float[Array, ""]


def heat_coefficients(
    pairs: Eigenpairs,
    euler_characteristic: float,
    boundary_length: Any = 0.0,
    corners: Sequence[float] = (),
    condition: Literal["neumann", "dirichlet"] = "neumann",
) -> Float[Array, " 3"]:
    """Return a₀, a₁, a₂ of the heat trace Σ exp(−λᵢt) ~ a₀/t + a₁/√t + a₂ of a surface (Kac 1966; McKean, Singer 1967).

    With area V, boundary length L, Euler characteristic χ and corner angles θ, the coefficients are a₀ = V/4π, a₁ =
    ±L/8√π (+ for Neumann conditions) and a₂ = χ/6 + Σ (π − θ)²/24πθ.

    Args:
        pairs: the result of `eigenpairs` in 2D. Under "mirror" and "mean", V is the area of the doubled domain.
        euler_characteristic: χ, which is 2 for a sphere, 0 for a torus, and 1 for a disc or a square.
        boundary_length: L, in the units of the metric.
        corners: the inner angles θ of the boundary's corners, in radians; for a square, four times π/2.
        condition: the condition on the whole boundary.

    Raises:
        ValueError: if the domain is not a surface of known area, if an angle is outside (0, 2π], or if a density or
            Fick's operator changes the volume element, with which a₂ has further terms.

    Examples:
        >>> square = hj.eigenpairs(hj.TensorField(field.grid, np.tile(np.eye(2), (9, 9, 1, 1))), k=4)
        >>> found = hj.heat_coefficients(square, 1, boundary_length=4.0, corners=[np.pi / 2] * 4)
        >>> np.allclose(found, [1 / (4 * np.pi), 4 / (8 * np.pi**0.5), 1 / 4])
        True
    """
    if dimension_of(require_pairs(pairs), "the heat trace") != 2:
        raise ValueError("pairs: got a 3D domain; expected 2D. Pass your own a₀, a₁, a₂, a₃ to `log_determinant`")
    angles = np.asarray(corners, float)
    if not ((angles > 0) & (angles <= 2 * math.pi)).all():
        raise ValueError(f"corners: got {corners}; expected inner angles in radians, above 0 and at most 2π")
    if condition not in ("neumann", "dirichlet"):
        raise ValueError(f'condition: got {condition!r}; expected "neumann" or "dirichlet"')
    require_number("euler_characteristic", euler_characteristic, above=-math.inf)
    require_number("boundary_length", boundary_length, inclusive=True)
    area = volume_of(pairs, "the heat trace")
    first = pairs.problems[0].pencil
    if first.weighted_volume is not None or first.has_potential:
        raise ValueError(
            "pairs: got an operator with a potential, or whose volume element is not that of its metric (Fick's, or "
            "with a density); expected a Laplace–Beltrami operator, whose a₂ is known. Pass your own coefficients to "
            "`log_determinant`"
        )
    length = jnp.asarray(boundary_length, area.dtype) * (1 if condition == "neumann" else -1)
    constant = euler_characteristic / 6 + float(((math.pi - angles) ** 2 / (24 * math.pi * angles)).sum())
    known = area / (4 * math.pi), length / (8 * math.sqrt(math.pi)), jnp.asarray(constant, area.dtype)
    return jnp.stack(known)


# Let Z(t) be the heat trace in d dimensions, n₀ the number of zero eigenvalues and T > 0. The zeta function satisfies
#
#     Γ(s) ζ(s) = ∫₀^∞ t^(s−1) (Z(t) − n₀) dt,    Z(t) ~ Σⱼ aⱼ t^pⱼ,    pⱼ = (j − d)/2.
#
# From 0 to T each power of the expansion of Z is integrated and continued analytically; from T to ∞ each exponential
# exp(−λᵢt) of Z is integrated. With 1/Γ(s) = s + γs² + … the derivative of ζ at zero is
#
#     −log det′ = ζ′(0) = (a_d − n₀) (log T + γ) + Σ_{j≠d} aⱼ T^pⱼ/pⱼ + Σ E₁(λᵢT).
#
# The omitted terms of the expansion cause the error ∫₀^T (Z − Σⱼ aⱼ t^pⱼ) dt/t, a sum of powers of T. Richardson
# extrapolation from the values at T, 2T, 4T, … removes the powers that `extrapolate` lists.
def log_determinant(
    pairs: Eigenpairs, coefficients: Any, *, extrapolate: Sequence[float] = (), time: Any = None
) -> LogDeterminant:
    """Compute log det′ Δ = −ζ′(0), where ζ(s) = Σ λᵢ^(−s) is the sum over the positive eigenvalues.

    Up to a time T, the expansion of the heat trace at small times replaces the eigenvalues that are not computed. The
    result is differentiable with respect to the eigenvalues and the coefficients. A small T requires many pairs, and a
    fine grid: linear elements with spacing h in 2D cause an error of about a₀h²/16T².

    Args:
        pairs: the lowest eigenpairs, from `eigenpairs`.
        coefficients: at least a₀, …, a_d of the heat trace ~ Σⱼ aⱼ t^((j−d)/2), as from `heat_coefficients` for d = 2.
        extrapolate: the next powers of t in the expansion, with unknown coefficients: (1, 2) on a closed curved
            surface, (0.5, 1) with a curved boundary, none on flat tori and polygons.
        time: T, a positive number in (metric length)²; by default the time with the least estimated error.

    Raises:
        ValueError: if there are fewer than d + 1 coefficients, if a power or the time is not positive, if an eigenvalue
            is negative or none is positive, or if the dimension is not known.

    Warns:
        AccuracyWarning: if the estimated error exceeds 0.01.

    Examples:
        >>> m = 4 * np.pi**2 * np.arange(-4, 5) ** 2  # of a circle of length 1
        >>> K = np.diag(np.add.outer(m, m).ravel())  # of the flat torus, all up to 4π² · 20
        >>> torus = hj.eigenpairs(hj.sparse_pencil(K, dimension=2, volume=1.0), k=69)
        >>> round(float(hj.log_determinant(torus, hj.heat_coefficients(torus, 0)).value), 3)  # 4 log η(i)
        -1.055
    """
    d, dtype = dimension_of(require_pairs(pairs), "the determinant"), pairs.eigenvalues.dtype
    a = jnp.asarray(coefficients, dtype)
    if a.ndim != 1 or a.size <= d:
        raise ValueError(f"coefficients: got shape {a.shape}; expected at least {d + 1} coefficients, a₀ to a_{d}")
    powers = np.asarray(extrapolate, float)
    if powers.ndim != 1 or not (powers > 0).all() or len(set(powers)) != powers.size:
        raise ValueError(
            f"extrapolate: got {extrapolate}; expected a list of distinct positive powers of t, as (0.5, 1)"
        )
    if time is not None:
        require_number("time", time)
        if jnp.ndim(time):
            raise ValueError(f"time: got shape {jnp.shape(time)}; expected one time T")
    if not is_traced(pairs.eigenvalues) and (np.asarray(pairs.eigenvalues) < 0).any():
        raise ValueError(f"pairs: got the eigenvalue {float(pairs.eigenvalues[0]):.4g}; expected none below zero")
    _, last = jax.lax.stop_gradient(positive_range(pairs))
    steps = 2.0 ** (np.arange(_TIMES) / _PER_DOUBLING)
    times = _FIRST / last * jnp.asarray(steps, dtype) if time is None else jnp.asarray(time, dtype)[None]
    # For each of m times T, values are computed at T, √2T, 2T, …. Extrapolations from T, √2T, 2T differ by the error.
    count = powers.size + 1
    doublings = 2.0 ** (np.arange(2 * count + 1) / 2)
    values = _at(pairs, a, d, times[:, None] * jnp.asarray(doublings, dtype)[None])
    # The weights of the values at T, 2T, 4T, … add up to 1, and cancel the powers of T in `extrapolate`.
    weights = np.linalg.solve(2.0 ** np.outer(np.append(0, powers), np.arange(count)), np.eye(count)[0])
    levels = [values[:, i : i + 2 * count : 2] @ jnp.asarray(weights, dtype) for i in range(3)]
    rest = jnp.maximum(jnp.abs(levels[0] - levels[1]), jnp.abs(levels[0] - levels[2]))
    # Errors grow with T. A difference is small by accident where its sign changes, so the one before it counts too.
    rest = jnp.maximum(rest, jnp.pad(rest, (1, 0), mode="edge")[:-1])
    # With linear elements the trace has the relative error d h²/16t, three times the error of the signature at a node.
    bias = 3 * truncation(pairs, times).resolution_bias * jnp.abs(a[0]) * times ** (-d / 2) / (d / 2 + 1)
    errors = jax.lax.stop_gradient(rest + jnp.where(jnp.isfinite(bias), bias, 0))
    best = jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.inf))
    result = LogDeterminant(levels[0][best], errors[best], times[best])
    known = jax.lax.stop_gradient(result)
    if not is_traced(known) and not float(known.error) <= _DOUBTFUL:
        warn_of_accuracy(
            f"pairs: log det′ = {float(known.value):.4g} has the estimated error {float(known.error):.2g}. Use a "
            "finer grid, more pairs or more coefficients, or list the next powers of t in `extrapolate`"
        )
    return result


@partial(jax.jit, static_argnums=2)
def _at(pairs: Eigenpairs, a: Float[Array, " m"], d: int, times: Float[Array, "*n"]) -> Float[Array, "*n"]:
    positive = pairs.kept & (pairs.eigenvalues > 0)
    known = jnp.where(positive, pairs.eigenvalues, 1)
    terms = jax.vmap(lambda value: exponential_integral(value * times), out_axes=-1)(known)
    tails = jnp.sum(jnp.where(positive, terms, 0), axis=-1)
    null = jnp.sum(pairs.kept & (pairs.eigenvalues == 0), dtype=a.dtype)
    powers = (np.arange(a.size) - d) / 2
    terms = sum(a[j] * times**p / p for j, p in enumerate(powers) if p != 0)
    return -((a[d] - null) * (jnp.log(times) + np.euler_gamma) + terms + tails)


@jax.custom_jvp
def exponential_integral(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return E₁(x) = ∫₁^∞ exp(−xu) du/u for x > 0; JAX's function takes much longer to compile and to run."""
    near, far = jnp.minimum(x, _SMALL), jnp.maximum(x, _SMALL)
    series, term = -np.euler_gamma - jnp.log(near), -jnp.ones_like(x)
    for k in range(1, _TERMS + 1):
        term = term * -near / k
        series += term / k
    # The substitution u = 1/v maps the integral to the interval from 0 to 1.
    integral = sum(w / v * jnp.exp(-far / v) for v, w in zip(*gauss(_NODES), strict=True))
    return jnp.where(x < _SMALL, series, integral)


@exponential_integral.defjvp
def _exponential_integral_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (change,) = primals, tangents
    return exponential_integral(x), -jnp.exp(-x) / x * change
