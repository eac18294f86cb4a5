"""Several devices: batches shared out, and space cut into slabs. docs/devices.md says what is exchanged."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from hks_jax.checks import require_count, require_number, require_real
from hks_jax.fem.halo import Slabs as Slabs
from hks_jax.fem.halo import checked_mesh
from hks_jax.fem.stencil import Stencil
from hks_jax.linear.chebyshev import chebyshev_heat_coefficients, chebyshev_recurrence, gershgorin, least_degree
from hks_jax.traced import is_traced


def map_fields(function: Callable[[Any], Any], batch: Any, mesh: Mesh) -> Any:
    """Apply a function to each entry of a batch, every device to its share, one entry after another.

    Nothing is exchanged. Differentiable where the function is. Called again with the same function object, it is not
    compiled again.

    Args:
        function: of one entry, such as ``lambda T: hj.hks(hj.eigenpairs(hj.TensorField(grid, T), k, solver="dense"),
            times)``; traceable.
        batch: arrays (n, …), a pytree of them.
        mesh: devices along one axis.

    Returns:
        What ``jax.lax.map(function, batch)`` would: arrays (n, …). They stay where they were computed if n is a
        multiple of the number of devices; otherwise every device has them whole.

    Raises:
        ValueError: arrays of different lengths, or none; a mesh with several axes.
    """
    mesh = checked_mesh(mesh)
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(batch)}
    if len(lengths) != 1 or lengths & {(), (0,)}:
        raise ValueError(f"batch: got leading axes {sorted(lengths)}; expected arrays of the same length, at least 1")
    return _map(function, batch, mesh)


@partial(jax.jit, static_argnames=("function", "mesh"))
def _map(function: Callable[[Any], Any], batch: Any, mesh: Mesh) -> Any:
    n, spec = jax.tree.leaves(batch)[0].shape[0], PartitionSpec(mesh.axis_names[0])
    # Copies of the last entry fill the shares up: of zeros, a function might make NaN, or an endless loop.
    filled = jax.tree.map(lambda x: x[jnp.minimum(jnp.arange(-(-n // mesh.size) * mesh.size), n - 1)], batch)
    share = jax.shard_map(
        lambda own: jax.lax.map(function, own), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
    )
    return jax.tree.map(lambda x: x[:n], share(filled))


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

    For fields that outgrow a device. The Chebyshev expansion needs one stencil product a degree, and with it the
    exchange of one plane of nodes with each neighbour; all times come from the same products.

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
    for name, given in (("columns", columns), ("times", times)):
        require_real(name, given)
    times = jnp.asarray(times, columns.dtype)
    if times.ndim != 1:
        raise ValueError(f"times: got shape {times.shape}; expected (n_times,)")
    require_number("tolerance", tolerance, 1)
    if degree is not None:
        require_count("degree", degree)
    top = gershgorin(stiffness, _inverse(lumped))
    if degree is None:
        if is_traced((top, times)):
            raise ValueError("degree: not given, and the matrices or times are traced; expected a number")
        if times.size and not float(jnp.min(times)) >= 0:
            raise ValueError(f"times: got {times}; expected no negative ones")
        degree = least_degree(float(jnp.max(times, initial=0)) * float(top) / 2, tolerance)
    return chebyshev_series(slabs, stiffness, lumped, columns, top, chebyshev_heat_coefficients(times, top, degree))


@partial(jax.jit, static_argnames="slabs")
def chebyshev_series(
    slabs: Slabs,
    stiffness: Float[Array, "offsets *padded"],
    lumped: Float[Array, "*padded"],
    columns: Float[Array, "*padded b"],
    top: Float[Array, ""],
    series: Float[Array, "m terms"],
) -> Float[Array, "m *padded b"]:
    """Return Σₙ seriesₘₙ Tₙ(2D⁻¹K/top − 1) columns, ``top`` a bound on the spectrum of D⁻¹K, degree at least 1.

    The arrays are as in `heat_columns`. Linear in series and columns; differentiable.
    """

    def share(stiffness: Array, lumped: Array, x: Array, top: Array, series: Array) -> Array:
        scaled = Stencil((2 / top) * stiffness * _inverse(lumped), slabs.periodic, slabs).of_columns()

        def add(n: Any, y: Array, total: Array) -> Array:
            return total + jnp.multiply.outer(series[:, n], y)

        start = jnp.multiply.outer(jnp.zeros_like(series[:, 0]), x)
        return chebyshev_recurrence(lambda y: scaled(y) - y, x, series.shape[1] - 1, start, add)[2]

    everywhere = PartitionSpec()
    specs = slabs.spec(1), slabs.spec(0), slabs.spec(0), everywhere, everywhere
    return jax.shard_map(share, mesh=slabs.mesh, in_specs=specs, out_specs=slabs.spec(1))(
        stiffness, lumped, columns, top, series
    )


def _inverse(lumped: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return D⁻¹, 0 at nodes that are not free."""
    return jnp.where(lumped > 0, 1 / jnp.where(lumped > 0, lumped, 1), 0)
