"""Nodal arrays padded by the nodes beyond their sides, and grids that are cut into one slab per device."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh
from jaxtyping import Array, Float

from hks_jax.compilation import library_of


def with_rim(x: Any, periodic: tuple[bool, ...], first: int = 0) -> Any:
    """Pad x by one node at both ends of axis ``first`` and the axes after it: periodically, or by zeros."""
    for axis, wraps in enumerate(periodic, start=first):
        widths = [(1, 1) if a == axis else (0, 0) for a in range(x.ndim)]
        x = library_of(x).pad(x, widths, mode="wrap" if wraps else "constant")
    return x


def neighbours(x: Any, dimension: int) -> Iterator[Any]:
    """Yield x, shifted by each of 3^d offsets along its first d = ``dimension`` axes; x is padded along these axes."""
    after = (0,) * (x.ndim - dimension)
    shape = [n - 2 if axis < dimension else n for axis, n in enumerate(x.shape)]
    for start in product((0, 1, 2), repeat=dimension):
        start = (*start, *after)
        end = [s + n for s, n in zip(start, shape, strict=True)]
        yield x[tuple(map(slice, start, end))] if library_of(x) is np else jax.lax.slice(x, start, end)


def side_by_side(coefficients: Float[Array, "offsets *shape"]) -> Float[Array, " entries"]:
    """Return the coefficients in one row, node by node, which halves the time of a product."""
    # For a result with several axes, XLA could choose another order in memory.
    return jnp.moveaxis(coefficients, 0, -1).reshape(-1)


def product_with_rim(
    coefficients: Float[Array, "offsets *shape"],
) -> Callable[[Float[Array, "*rimmed b"]], Float[Array, "*shape b"]]:
    """Return the function that applies a stencil to columns that `with_rim` has padded."""
    shape, together = coefficients.shape[1:], side_by_side(coefficients)

    def apply(x: Float[Array, "*rimmed b"]) -> Float[Array, "*shape b"]:
        of_nodes = together.reshape(*shape, -1)
        y = jnp.zeros((), x.dtype)
        for o, shifted in enumerate(neighbours(x, len(shape))):
            y = y + of_nodes[..., o, None] * shifted
        return y

    return apply


def checked_mesh(mesh: Any) -> Mesh:
    """Return a mesh of devices with one axis; XLA chooses the sharding of arrays whose sharding is not given."""
    if not isinstance(mesh, Mesh) or len(mesh.axis_names) != 1:
        got = f"the axes {mesh.axis_names}" if isinstance(mesh, Mesh) else type(mesh).__name__
        raise ValueError(
            f'mesh: got {got}; expected a jax.sharding.Mesh with one axis, such as jax.make_mesh((8,), ("devices",))'
        )
    return Mesh(mesh.devices, mesh.axis_names, axis_types=(AxisType.Auto,))


@jax.tree_util.register_static
@dataclass(frozen=True)
class Slabs:
    """A grid whose first axis is divided into slabs of equal thickness, one slab for each device; static and hashable.

    If the axis does not divide evenly, the last slabs are padded with zeros, which are coupled to no node.

    Attributes:
        mesh: the devices along one axis, in the order of the slabs.
        shape: the number of nodes along each axis of the grid.
        periodic: for each axis, whether it is periodic.

    Raises:
        ValueError: a mesh with several axes.
    """

    mesh: Mesh
    shape: tuple[int, ...]
    periodic: tuple[bool, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "mesh", checked_mesh(self.mesh))

    @property
    def name(self) -> str:
        """The name of the mesh's axis."""
        return self.mesh.axis_names[0]

    @property
    def thickness(self) -> int:
        """The number of nodes of a slab along the first axis."""
        return -(-self.shape[0] // self.mesh.size)

    @property
    def padded_shape(self) -> tuple[int, ...]:
        """The shape of all slabs together."""
        return (self.thickness * self.mesh.size, *self.shape[1:])

    def join(self, x: Array, axis: int = 0) -> Array:
        """Remove the padding of all slabs together. If there was padding, every device holds the whole result."""
        return jax.lax.slice_in_dim(x, 0, self.shape[0], axis=axis)

    # The methods below are called inside `shard_map`, on the slab of one device.

    def with_halo(self, x: Float[Array, "*slab b"]) -> Float[Array, "*rimmed b"]:
        """Return the slab with the adjacent planes of the neighbouring slabs, padded along the other axes."""
        last, planes = divmod(self.shape[0] - 1, self.thickness)
        up = [(i, i + 1) for i in range(last)]
        down = [(i + 1, i) for i in range(last)]
        top = jax.lax.slice_in_dim(x, -1, None, axis=0)
        place: int | Array = self.thickness + 1
        if self.periodic[0]:
            up, down = [*up, (last, 0)], [*down, (0, last)]
            if planes + 1 < self.thickness:
                # In the last slab that has nodes, the plane above is placed right after the nodes, before the padding.
                is_last = jax.lax.axis_index(self.name) == last
                top = jnp.where(is_last, jax.lax.slice_in_dim(x, planes, planes + 1, axis=0), top)
                place = jnp.where(is_last, planes + 2, place)
        below = jax.lax.ppermute(top, self.name, up)
        above = jax.lax.ppermute(jax.lax.slice_in_dim(x, 0, 1, axis=0), self.name, down)
        x = jnp.pad(x, [(1, 1)] + [(0, 0)] * (x.ndim - 1))
        x = jax.lax.dynamic_update_slice_in_dim(x, below, 0, axis=0)
        x = jax.lax.dynamic_update_slice_in_dim(x, above, place, axis=0)
        return with_rim(x, self.periodic[1:], first=1)

    def own(self, x: Array, axis: int = 0) -> Array:
        """Return this device's slab of an array that every device holds as a whole."""
        missing = self.padded_shape[0] - self.shape[0]
        padded = jnp.pad(x, [(0, missing if a == axis else 0) for a in range(x.ndim)])
        start = jax.lax.axis_index(self.name) * self.thickness
        return jax.lax.dynamic_slice_in_dim(padded, start, self.thickness, axis=axis)

    def total(self, x: Any) -> Any:
        """Return the sum over all devices."""
        return jax.lax.psum(x, self.name)
