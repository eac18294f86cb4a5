"""A regular grid in 2D or 3D, with an optional mask."""

import math
import operator
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from hks_jax.arrays import ByKey, StaticArray
from hks_jax.checks import require_real, require_static
from hks_jax.domain.components import active_elements, as_mask, label_nodes
from hks_jax.naming import argument


@jax.tree_util.register_static
class Grid(ByKey):
    """A regular grid of nodes; axis a of arrays belongs to coordinate a.

    A grid is static and hashable: it has no leaves, and `jax.jit`, `jax.grad` and `jax.vmap` treat it as structure.

    Args:
        shape: the number of nodes along each of 2 or 3 axes, at least 2 per axis.
        spacing: the distance between nodes along each axis (or one number for all axes), in coordinate units.
        origin: the coordinates of node (0, …, 0).
        mask: bool array of `shape`, True inside; None is the whole grid. The domain is the union of the elements whose
            nodes are all inside. Results are NaN at nodes outside the domain.
        components: the treatment of a mask with several connected components: ``"raise"`` (default) raises an error
            with their number, ``"largest"`` keeps the one with the most nodes, ``"all"`` keeps all.

    Raises:
        ValueError: a bad shape, spacing, origin or mask; an empty mask; a disconnected mask under ``"raise"``.

    Examples:
        >>> grid = hj.Grid((9, 9), spacing=1 / 8)
        >>> grid.size, grid.extent
        (81, (0.0, 1.0, 0.0, 1.0))
    """

    shape: tuple[int, ...]
    spacing: tuple[float, ...]
    origin: tuple[float, ...]

    def __init__(
        self,
        shape: Sequence[int],
        spacing: float | Sequence[float] | np.ndarray = 1.0,
        origin: float | Sequence[float] | np.ndarray = 0.0,
        mask: Any = None,
        components: Literal["raise", "largest", "all"] = "raise",
    ) -> None:
        self.shape = _checked_shape(shape)
        if len(self.shape) not in (2, 3) or min(self.shape) < 2:
            raise ValueError(f"shape: got {tuple(shape)}; expected 2 or 3 axes with at least 2 nodes each")
        self.spacing = per_axis("spacing", spacing, self.dimension)
        self.origin = per_axis("origin", origin, self.dimension)
        if min(self.spacing) <= 0:
            raise ValueError(f"spacing: got {self.spacing}; expected positive numbers")
        if components not in ("raise", "largest", "all"):
            raise ValueError(f'components: got {components!r}; expected "raise", "largest" or "all"')
        self._mask = None if mask is None else StaticArray(_checked_mask(mask, self.shape, components))

    def __setattr__(self, name: str, value: Any) -> None:
        if "_mask" in vars(self):  # the last attribute that __init__ sets
            raise AttributeError(f"{name}: a grid cannot be changed, because JAX caches programs by it; make another")
        super().__setattr__(name, value)

    @classmethod
    def from_bounds(
        cls,
        lower: float | Sequence[float] | np.ndarray,
        upper: float | Sequence[float] | np.ndarray,
        shape: Sequence[int],
        **kwargs: Any,
    ) -> "Grid":
        """Return the grid whose first node is at `lower` and whose last node is at `upper`.

        Examples:
            >>> hj.Grid.from_bounds(0, 1, (9, 9))
            Grid(shape=(9, 9), spacing=(0.125, 0.125), origin=(0.0, 0.0))
        """
        shape = _checked_shape(shape)
        low, high = per_axis("lower", lower, len(shape)), per_axis("upper", upper, len(shape))
        if any(b <= a for a, b in zip(low, high, strict=True)):
            raise ValueError(f"upper: got {high}; expected more than lower = {low} on every axis")
        spacing = [(b - a) / max(n - 1, 1) for a, b, n in zip(low, high, shape, strict=True)]
        return cls(shape, spacing, low, **kwargs)

    @property
    def dimension(self) -> int:
        """The number of axes d, 2 or 3."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """The number of nodes."""
        return math.prod(self.shape)

    @property
    def mask(self) -> np.ndarray | None:
        """The mask, bool (*shape), or None."""
        return None if self._mask is None else self._mask.value

    @property
    def inside(self) -> np.ndarray:
        """The mask as bool (*shape); True everywhere if the grid has no mask."""
        return np.ones(self.shape, dtype=bool) if self._mask is None else self._mask.value

    @property
    def axes(self) -> tuple[np.ndarray, ...]:
        """The coordinates along each axis."""
        return tuple(o + h * np.arange(n) for n, h, o in zip(self.shape, self.spacing, self.origin, strict=True))

    @property
    def nodes(self) -> Float[np.ndarray, "*shape d"]:
        """The coordinates of the nodes."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1)

    @property
    def extent(self) -> tuple[float, ...]:
        """The coordinates (x_min, x_max, y_min, y_max, …) of the outermost nodes, in the order of `imshow`."""
        return tuple(float(end) for axis in self.axes for end in (axis[0], axis[-1]))

    @cached_property
    def unit(self) -> "Grid":
        """The grid with the same shape and mask, but with spacing 1 and origin 0."""
        unit = Grid(self.shape)
        vars(unit)["_mask"] = self._mask
        return unit

    @cached_property
    def _key(self) -> tuple:
        return (self.shape, self.spacing, self.origin, self._mask)

    def __repr__(self) -> str:
        masked = "" if self.mask is None else f", mask={int(self.mask.sum())} of {self.size} nodes"
        return f"Grid(shape={self.shape}, spacing={self.spacing}, origin={self.origin}{masked})"


def _checked_shape(shape: Sequence[int]) -> tuple[int, ...]:
    require_static("shape", shape)
    try:
        return tuple(operator.index(n) for n in shape)
    except TypeError:
        raise ValueError(
            f"shape: got {shape!r}; expected a tuple of 2 or 3 integers, the node counts per axis"
        ) from None


def per_axis(name: str, value: float | Sequence[float] | np.ndarray, dimension: int) -> tuple[float, ...]:
    """Return one finite number per axis; a single given number is used for all axes."""
    require_static(name, value)
    require_real(name, value)
    try:
        values = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: got {value!r}; expected {dimension} numbers, one per axis") from None
    if values.ndim == 0:
        values = np.full(dimension, values)
    if values.shape != (dimension,) or not np.isfinite(values).all():
        raise ValueError(f"{name}: got {value}; expected {dimension} finite numbers, one per axis")
    return tuple(values.tolist())


def _checked_mask(mask: Any, shape: tuple[int, ...], components: str) -> np.ndarray:
    if np.shape(mask) != shape:
        raise ValueError(f"mask: got shape {np.shape(mask)}; expected the grid's shape {shape}")
    array = as_mask("mask", mask)
    if not array.any():
        raise ValueError("mask: no node is inside (the mask is empty); expected True at the nodes of the domain")
    wrapped = (True,) * array.ndim
    if not active_elements(array, wrapped).any():
        raise ValueError(
            f"mask: got {int(array.sum())} nodes inside, but no element has all its {2**array.ndim} nodes inside; "
            "use a thicker mask or a finer grid"
        )
    labels, count = label_nodes(array, (False,) * array.ndim)
    if count > 1 and components != "all":
        sizes = np.bincount(labels.ravel())[1:]
        if components == "raise":
            largest = ", ".join(str(n) for n in np.sort(sizes)[::-1][:5]) + (", …" if count > 5 else "")
            raise ValueError(
                f"mask: got {count} connected components ({largest} nodes); expected one component. "
                f"Pass {argument('components', 'largest')} to keep the largest one, or {argument('components', 'all')} "
                "to keep all, also where a periodic axis joins them"
            )
        array = labels == 1 + int(np.argmax(sizes))
    return array
