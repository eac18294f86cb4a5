"""Heat on a grid cut into slabs: polynomials in D⁻¹K, D the lumped mass, for fields that outgrow a device.

The Chebyshev expansion of exp(−tD⁻¹K) needs one stencil product a degree, and with it the exchange of one plane of
nodes with each neighbour; all times come from the same products.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import ive

from hks_jax.fem.halo import Slabs
from hks_jax.traced import is_traced


def heat_columns(
    slabs: Slabs,
    stiffness: Float[Array, "offsets *padded"],
    lumped: Float[Array, "*padded"],
    columns: Float[Array, "*padded b"],
    times: Any,
    tolerance: float = 1e-8,
    degree: int | None = None,
) -> Float[Array, "n_times *padded b"]:
    """Return exp(−tD⁻¹K) applied to columns, for each time. Sources D⁻¹eᵢ give columns of the heat kernel.

    Args:
        slabs: how the grid is cut.
        stiffness: K, ``slabs.split(pencil.stiffness.coefficients, 1)``.
        lumped: D, the row sums of the mass, ``slabs.split(...)``; 0 at nodes that are not free.
        columns: nodal, the column innermost, ``slabs.split(...)``.
        times: (n_times,), not negative.
        tolerance: bounds the truncation error of the expansion, relative to the columns, in the norm of D.
        degree: of the polynomial; None: what the tolerance needs. To be given where the matrices or times are traced.

    Returns:
        Laid out as the columns; ``slabs.join(result, 1)`` cuts the padding off.

    Raises:
        ValueError: arrays that are not from `Slabs.split`, bad times or tolerance, traced arrays without a degree.
    """
    slabs.check("stiffness", stiffness, 1)
    slabs.check("lumped", lumped, 0)
    slabs.check("columns", columns, 0)
    times = jnp.asarray(times, columns.dtype)
    if times.ndim != 1:
        raise ValueError(f"times: got shape {times.shape}; expected (n_times,)")
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: got {tolerance}; expected between 0 and 1")
    top = _gershgorin(stiffness, lumped)
    if degree is None:
        if is_traced((top, times)):
            raise ValueError("degree: not given, and the matrices or times are traced; expected a number")
        if times.size and not float(jnp.min(times)) >= 0:
            raise ValueError(f"times: got {times}; expected no negative ones")
        degree = _degree(float(jnp.max(times, initial=0)) * float(top), tolerance)
    return chebyshev_series(slabs, stiffness, lumped, columns, top, _heat_series(times, top, degree))


@partial(jax.jit, static_argnames="slabs")
def chebyshev_series(
    slabs: Slabs,
    stiffness: Float[Array, "offsets *padded"],
    lumped: Float[Array, "*padded"],
    columns: Float[Array, "*padded b"],
    top: Float[Array, ""],
    series: Float[Array, "m degree+1"],
) -> Float[Array, "m *padded b"]:
    """Return Σₙ seriesₘₙ Tₙ(2D⁻¹K/top − 1) columns, ``top`` a bound on the spectrum of D⁻¹K, degree at least 1.

    The arrays are as in `heat_columns`. Linear in series and columns; differentiable.
    """

    def share(stiffness: Array, lumped: Array, x: Array, top: Array, series: Array) -> Array:
        inverse = jnp.where(lumped > 0, 1 / jnp.where(lumped > 0, lumped, 1), 0)
        matrix = (2 / top) * stiffness * inverse

        def add(total: Array, row: Array, y: Array) -> Array:
            return total + jnp.multiply.outer(row, y)

        def step(state: tuple[Array, Array, Array], row: Array) -> tuple[tuple[Array, Array, Array], None]:
            before, y, total = state
            following = 2 * (slabs.local_product(matrix, y) - y) - before
            return (y, following, add(total, row, following)), None

        first = slabs.local_product(matrix, x) - x
        total = add(jnp.multiply.outer(series[:, 0], x), series[:, 1], first)
        return jax.lax.scan(step, (x, first, total), series[:, 2:].T)[0][2]

    everywhere = jax.sharding.PartitionSpec()
    specs = slabs.spec(1), slabs.spec(0), slabs.spec(0), everywhere, everywhere
    return jax.shard_map(share, mesh=slabs.mesh, in_specs=specs, out_specs=slabs.spec(1))(
        stiffness, lumped, columns, top, series
    )


@jax.jit
def _gershgorin(stiffness: Float[Array, "offsets *shape"], lumped: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Return a bound on the spectrum of D⁻¹K that no field escapes."""
    sums = jnp.sum(jnp.abs(stiffness), axis=0)
    return jnp.max(jnp.where(lumped > 0, sums / jnp.where(lumped > 0, lumped, 1), 0))


@partial(jax.jit, static_argnames="degree")
def _heat_series(times: Float[Array, " m"], top: Float[Array, ""], degree: int) -> Float[Array, "m degree+1"]:
    """Return the Chebyshev coefficients of exp(−tλ) on [0, top], by the cosine transform of its samples."""
    samples = 2 * degree + 16
    angles = (np.arange(samples) + 0.5) * (np.pi / samples)
    weights = np.cos(np.outer(angles, np.arange(degree + 1))) * (2 / samples)
    weights[:, 0] /= 2
    values = jnp.exp(-times[:, None] * top * jnp.asarray((1 + np.cos(angles)) / 2, times.dtype))
    return jnp.matmul(values, jnp.asarray(weights, times.dtype), precision="highest")


def _degree(extent: float, tolerance: float) -> int:
    """Return from where on the coefficients 2e^(−z) Iₙ(z), z = extent/2, add up to less than the tolerance."""
    z = extent / 2
    # They fall like exp(−n²/2z) up to n ≈ z, and faster beyond.
    most = math.ceil(2 * math.sqrt(z * math.log(8 / tolerance)) + 4 * math.log(8 / tolerance) + 8)
    tails = np.cumsum(2 * ive(np.arange(most + 1), z)[::-1])[::-1]
    return max(1, int(np.argmax(tails <= tolerance)))
