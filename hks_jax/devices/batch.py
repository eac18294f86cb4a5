"""Many independent problems, such as the slices of a volume, shared out among devices."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from hks_jax.fem.halo import checked_mesh


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
