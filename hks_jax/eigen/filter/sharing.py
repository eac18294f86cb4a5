"""How the vectors of a subspace lie on several devices, and the two exchanges between the ways that they can lie.

Filters want whole functions, a few on each device; Rayleigh–Ritz wants all functions on a part of the grid. Between
rounds vectors lie in slabs, (m, nodes of the slab) on each device. For the filters, blocks of rows are dealt out in
turn, since the low ones converge first: device i of p has the blocks i, i + p, i + 2p, ….

``slabs`` is None on a single device: then nothing is exchanged.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from hks_jax.fem.halo import Slabs

EVERYWHERE = PartitionSpec()


def shared(slabs: Slabs | None, function: Callable, in_specs: Any, out_specs: Any) -> Callable:
    """Return the function as run by every device on its share."""
    if slabs is None:
        return function
    # Loops of different lengths, and results that are the same on all devices, are more than the check can follow.
    return jax.shard_map(function, mesh=slabs.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def replicate(mesh: Mesh | None, tree: Any) -> Any:
    """Return the arrays with a copy on every device."""
    return tree if mesh is None else jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, EVERYWHERE))(tree)


def own_blocks(slabs: Slabs | None, count: int) -> Int[Array, " own"]:
    """Return the numbers of the blocks of rows, of ``count``, that this device filters."""
    if slabs is None:
        return jnp.arange(count)
    return jax.lax.axis_index(slabs.name) + slabs.mesh.size * jnp.arange(count // slabs.mesh.size)


def to_own_rows(slabs: Slabs | None, block: int, x: Float[Array, "m slab"]) -> Float[Array, "own nodes"]:
    """Return this device's blocks of rows, whole, of the vectors in slabs."""
    if slabs is None:
        return x
    m, width = x.shape
    dealt = x.reshape(-1, slabs.mesh.size, block, width)
    whole = jax.lax.all_to_all(dealt, slabs.name, 1, 3, tiled=True)
    return whole.reshape(m // slabs.mesh.size, -1)[:, : math.prod(slabs.shape)]


def to_slabs(slabs: Slabs | None, block: int, rows: Float[Array, "own nodes"]) -> Float[Array, "m slab"]:
    """Return all vectors on this device's slab."""
    if slabs is None:
        return rows
    missing = math.prod(slabs.padded_shape) - rows.shape[1]
    whole = jnp.pad(rows, ((0, 0), (0, missing))).reshape(-1, 1, block, rows.shape[1] + missing)
    dealt = jax.lax.all_to_all(whole, slabs.name, 3, 1, tiled=True)
    return dealt.reshape(rows.shape[0] * slabs.mesh.size, -1)


def total(slabs: Slabs | None, tree: Any) -> Any:
    """Return sums over all devices."""
    return tree if slabs is None else slabs.total(tree)


def first_of(slabs: Slabs | None, x: Array) -> Array:
    """Return what the first device has: devices of different kinds need not round alike."""
    return x if slabs is None else slabs.total(jnp.where(jax.lax.axis_index(slabs.name) == 0, x, 0))
