"""Computations on several devices: batches, and grids cut into slabs. docs/devices.md describes the communication."""

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
    """Apply a function to each entry of a batch; every device processes its share of the entries sequentially.

    The devices do not communicate. The result is differentiable if the function is. Repeated calls with the same
    function object compile it only once.

    Args:
        function: a traceable function of one entry, such as ``lambda T: hj.hks(hj.eigenpairs(hj.TensorField(grid, T),
            k, solver="dense"), times)``.
        batch: a pytree of arrays (n, …).
        mesh: a mesh of devices along one axis.

    Returns:
        The result of ``jax.lax.map(function, batch)``, a pytree of arrays (n, …). If n is a multiple of the number of
        devices, each device keeps its share of the entries; otherwise every device has all entries.

    Raises:
        ValueError: if arrays have different lengths, if the batch is empty, or if the mesh has several axes.

    Examples:
        >>> area = lambda T: hj.assemble(hj.TensorField(field.grid, T)).volume
        >>> fields = jnp.stack([field.tensors, 9 * field.tensors])
        >>> print(hj.devices.map_fields(area, fields, jax.make_mesh((1,), ("devices",))).round(1))
        [ 2. 18.]
    """
    mesh = checked_mesh(mesh)
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(batch)}
    if len(lengths) != 1 or lengths & {(), (0,)}:
        raise ValueError(f"batch: got arrays of lengths {sorted(lengths)}; expected arrays of the same length n ≥ 1")
    return _map(function, batch, mesh)


@partial(jax.jit, static_argnames=("function", "mesh"))
def _map(function: Callable[[Any], Any], batch: Any, mesh: Mesh) -> Any:
    n, spec = jax.tree.leaves(batch)[0].shape[0], PartitionSpec(mesh.axis_names[0])
    # Padding copies the last entry, because for zeros the function might return NaN or not terminate.
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
    """Return exp(−tD⁻¹K) x for each time t and column x, where K is the stiffness and D is the lumped mass.

    If x is D⁻¹ times a unit vector, the result is a column of the heat kernel. Use this function for fields that exceed
    the memory of one device. Each degree of the Chebyshev expansion takes one product with K; for this product,
    neighbouring devices exchange one plane of nodes. The products with K are computed once for all times.

    Args:
        slabs: the partition of the grid.
        stiffness: the stiffness matrix K, ``slabs.split(pencil.stiffness.coefficients, 1)``.
        lumped: the row sums D of the mass matrix, ``slabs.split(...)``; 0 at nodes that are not free.
        columns: nodal values x; the last axis is the index of the column. ``slabs.split(...)`` makes this array.
        times: (n_times,) nonnegative times.
        tolerance: a bound on the truncation error of the expansion, relative to the columns, in the norm of D.
        degree: the polynomial's degree, by default the least that satisfies the tolerance; required if arrays are
            traced.

    Returns:
        The columns exp(−tD⁻¹K) x, in the layout of ``columns``. ``slabs.join(result, 1)`` removes the padding.

    Raises:
        ValueError: arrays are not from `Slabs.split`, times or tolerance are invalid, or arrays are traced without a
            degree.

    Examples:
        >>> slabs = hj.devices.Slabs(jax.make_mesh((1,), ("devices",)), (9, 9), (False, False))
        >>> pencil, one = hj.assemble(field, mass="lumped"), slabs.split(jnp.ones((9, 9, 1)))
        >>> K, D = slabs.split(pencil.stiffness.coefficients, 1), slabs.split(pencil.mass.diagonal().reshape(9, 9))
        >>> print(hj.devices.heat_columns(slabs, K, D, one, [0.5]).mean().round(3))  # a constant does not change
        1.0
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
            raise ValueError("degree: got None with traced matrices or times; expected an integer")
        if times.size and not float(jnp.min(times)) >= 0:
            raise ValueError(f"times: got {times}; expected nonnegative numbers")
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
    """Return the Chebyshev series Σₙ cₘₙ Tₙ(2D⁻¹K/λ − 1) x for each row m of coefficients c and each column x.

    The matrix c is ``series``, with at least two columns, and Tₙ is the Chebyshev polynomial of degree n. The number
    λ = ``top`` is an upper bound of the spectrum of D⁻¹K. The matrices K and D and the layout of the arrays are
    as in `heat_columns`. The result is linear in the series and in the columns, and differentiable.

    Examples:
        >>> slabs = hj.devices.Slabs(jax.make_mesh((1,), ("devices",)), (9, 9), (False, False))
        >>> pencil, one = hj.assemble(field, mass="lumped"), slabs.split(jnp.ones((9, 9, 1)))
        >>> K, D = slabs.split(pencil.stiffness.coefficients, 1), slabs.split(pencil.mass.diagonal().reshape(9, 9))
        >>> print(hj.devices.chebyshev_series(slabs, K, D, one, jnp.array(300.0), jnp.array([[1.0, 0.5]])).mean())
        0.5
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
    return jnp.where(lumped > 0, 1 / jnp.where(lumped > 0, lumped, 1), 0)
