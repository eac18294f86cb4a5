"""Batches of computations on several devices. docs/devices.md describes further ways to use several devices."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from hks_jax.fem.halo import checked_mesh


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
