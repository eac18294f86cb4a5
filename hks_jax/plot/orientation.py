"""The orientation of images: arrays are turned so that their axes are as close as possible to the axes of space."""

from collections.abc import Sequence
from itertools import permutations
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Real
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField

View = Literal["neurological", "radiological"]
LETTERS = ("LR", "PA", "IS")
"""The letters of the low and high ends of the space axes: left and right, back and front, foot and head."""


class Orientation(NamedTuple):
    """The directions of an array's axes in space, which determine how its image is turned.

    The image does not depend on the storage order of the voxels. The axis left–right is horizontal, and the axis
    foot–head is vertical. The axis back–front is vertical in axial slices and horizontal in sagittal slices. Letters at
    the edges of the image name the directions. The radiological view is mirrored.

    Attributes:
        axes: the array's axis for each axis of the image.
        turned: whether each axis of the image is a reversed axis of the array.
        ends: the letters of the low and the high end of each axis of the image, such as ``"LR"``.
        origin: the coordinate of the array's first node, for each axis of the image. The coordinates are space
            coordinates for voxels along the axes of space, and coordinates along the voxel axes for oblique voxels.
        view: ``"neurological"`` (left is on the left) or ``"radiological"`` (left is on the right).

    Examples:
        >>> hj.plot.Orientation.of(np.diag([-2.0, 2.0, 2.0, 1.0])).turned  # the first axis runs to the left
        (True, False, False)
    """

    axes: tuple[int, ...]
    turned: tuple[bool, ...]
    ends: tuple[str, ...]
    origin: tuple[float, ...]
    view: View = "neurological"

    @classmethod
    def of(
        cls, affine: Real[ArrayLike, "4 4"], slice_axis: int | None = None, *, view: View = "neurological"
    ) -> "Orientation":
        """Return the orientation of a volume or of one of its slices.

        Args:
            affine: (4, 4), maps voxel indices to coordinates that increase to the right, front and top, as in NIfTI.
            slice_axis: the axis perpendicular to the slice; None for a volume.
            view: ``"neurological"`` or ``"radiological"``.

        Raises:
            ValueError: if the affine has another shape, is singular or not finite, or if axis or view are unknown.
        """
        matrix = np.asarray(affine, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) == 0:
            raise ValueError(f"affine: got shape {matrix.shape}; expected a finite (4, 4) matrix with independent axes")
        if slice_axis not in (None, 0, 1, 2):
            raise ValueError(f"slice_axis: got {slice_axis}; expected 0, 1, 2, or None for a volume")
        if view not in get_args(View):
            raise ValueError(f"view: got {view!r}; expected one of {', '.join(get_args(View))}")
        steps = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)

        def nearness(order: tuple[int, ...]) -> tuple[float, ...]:
            """Return the sum of cosines between array axes and space axes and, to break ties, all cosines."""
            cosines = np.diag(steps[:, order])
            return tuple(np.round([np.abs(cosines).sum(), *(steps[:, order] * np.sign(cosines)).ravel()], 6).tolist())

        axes = max(permutations(range(3)), key=nearness)
        signs = np.where(np.diag(steps[:, axes]) < 0, -1.0, 1.0)
        origin = signs * (steps[:, axes].T @ matrix[:3, 3])
        kept = [a for a in range(3) if axes[a] != slice_axis]
        return cls(
            tuple(axes[a] - (slice_axis is not None and axes[a] > slice_axis) for a in kept),
            tuple(bool(signs[a] < 0) for a in kept),
            tuple(LETTERS[a] for a in kept),
            tuple(float(origin[a]) + 0.0 for a in kept),
            view,
        )

    def grid(self, grid: Grid) -> Grid:
        """Return the array's grid, with its axes in the order and direction of the image's axes."""
        if grid.dimension != len(self.axes):
            raise ValueError(f"orientation: got {len(self.axes)} axes; expected {grid.dimension}, as for the grid")
        spacing = np.take(grid.spacing, self.axes)
        last = spacing * (np.take(grid.shape, self.axes) - 1)
        origin = np.array(self.origin) - np.where(self.turned, last, 0.0)
        mask = None if grid.mask is None else self.array(grid.mask)
        return Grid(np.take(grid.shape, self.axes).tolist(), spacing.tolist(), origin.tolist(), mask, "all")

    def array(self, values: Any) -> Any:
        """Return an array (*shape,) or (n_times, *shape), masked or not, transposed and flipped as the image."""
        array = np.asanyarray(values)
        before = array.ndim - len(self.axes)
        array = array.transpose(*range(before), *(before + a for a in self.axes))
        return np.flip(array, tuple(before + a for a, turn in enumerate(self.turned) if turn))

    def tensors(self, values: Real[ArrayLike, "*shape d d"]) -> Real[np.ndarray, "*turned d d"]:
        """Return tensors (*shape, d, d) with nodes and components along the axes of the image."""
        signs = np.where(self.turned, -1, 1)
        components = np.moveaxis(np.asarray(values), (-2, -1), (0, 1))[np.ix_(self.axes, self.axes)]
        return np.moveaxis(self.array(components), (0, 1), (-2, -1)) * np.outer(signs, signs)

    def field(self, field: TensorField) -> TensorField:
        """Return a tensor field in the order of the image, with components along its axes."""
        return field.with_tensors(self.tensors(field.tensors), self.grid(field.grid))

    def node(self, node: Sequence[int], shape: Sequence[int]) -> tuple[int, ...]:
        """Return a node's indices in the image from its indices in an array of the given shape."""
        turned = zip(self.axes, self.turned, strict=True)
        return tuple(shape[a] - 1 - node[a] if turn else node[a] for a, turn in turned)

    def letter(self, ax: Axes, plane: tuple[int, int] = (0, 1)) -> None:
        """Write the anatomical letters (L, R, …) at an image's edges; mirror the image for the radiological view."""
        horizontal, vertical = (self.ends[a] for a in plane)
        left, right, bottom, top = *horizontal, *vertical
        if self.view == "radiological" and horizontal == LETTERS[0]:
            ax.xaxis.set_inverted(True)
            left, right = right, left
        for letter, x, y in ((left, 0.0, 0.5), (right, 1.0, 0.5), (bottom, 0.5, 0.0), (top, 0.5, 1.0)):
            inwards = (4 * np.sign(0.5 - x), 4 * np.sign(0.5 - y))
            ax.annotate(
                letter,
                (x, y),
                inwards,
                xycoords="axes fraction",
                textcoords="offset points",
                horizontalalignment={0.0: "left", 0.5: "center", 1.0: "right"}[x],
                verticalalignment={0.0: "bottom", 0.5: "center", 1.0: "top"}[y],
                fontsize="small",
                fontweight="bold",
                path_effects=[withStroke(linewidth=2, foreground="white")],
            )
