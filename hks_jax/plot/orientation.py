"""Which side of a picture is left: arrays turned so that their axes run as nearly as they can along those of space."""

from collections.abc import Sequence
from itertools import permutations
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Real
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from hks_jax.domain.grid import Grid

View = Literal["neurological", "radiological"]
LETTERS = ("LR", "PA", "IS")
"""What lies at the low and the high end of the axes of space: left and right, back and front, foot and head."""


class Orientation(NamedTuple):
    """How the axes of an array run in space, and so how its picture is turned.

    The picture does not depend on the order in which the voxels are stored. Of left to right, back to front and foot to
    head, its horizontal axis is the earlier and its vertical axis the later; letters at its edges say which. Under the
    radiological view left and right change sides.

    Attributes:
        axes: for each axis of the picture, the array's axis.
        turned: for each axis of the picture, whether the array's axis runs against it.
        ends: for each axis of the picture, the letters of its low and its high end.
        origin: for each axis of the picture, the coordinate of the array's first node. For voxels along the axes of
            space these are the coordinates of space; for oblique voxels, coordinates along their own axes.
        view: ``"neurological"``, left is on the left; or ``"radiological"``, left is on the right.
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
        """Return the orientation of a volume, or of a slice of it.

        Args:
            affine: (4, 4), voxel indices to coordinates that grow to the right, the front and the top, as NIfTI's do.
            slice_axis: the axis that a slice cuts; None for a volume.
            view: ``"neurological"`` or ``"radiological"``.

        Raises:
            ValueError: an affine of another shape, singular or not finite; another axis or view.
        """
        matrix = np.asarray(affine, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) == 0:
            raise ValueError(f"affine: got shape {matrix.shape}; expected (4, 4), finite, of three independent axes")
        if slice_axis not in (None, 0, 1, 2):
            raise ValueError(f"slice_axis: got {slice_axis}; expected 0, 1, 2, or None for a volume")
        if view not in get_args(View):
            raise ValueError(f"view: got {view!r}; expected one of {', '.join(get_args(View))}")
        steps = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)

        def nearness(order: tuple[int, ...]) -> tuple[float, ...]:
            """Return how near the axes lie to those of space; where that decides nothing, where they point."""
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
        """Return the grid of the picture for the grid of the array."""
        if grid.dimension != len(self.axes):
            raise ValueError(f"orientation: it is one of {len(self.axes)} axes, and the grid has {grid.dimension}")
        spacing = np.take(grid.spacing, self.axes)
        last = spacing * (np.take(grid.shape, self.axes) - 1)
        origin = np.array(self.origin) - np.where(self.turned, last, 0.0)
        mask = None if grid.mask is None else self.array(grid.mask)
        return Grid(np.take(grid.shape, self.axes).tolist(), spacing.tolist(), origin.tolist(), mask, "all")

    def array(self, values: Any) -> Any:
        """Return an array (*shape,) or (n_times, *shape), masked or not, as the picture has it."""
        array = np.asanyarray(values)
        before = array.ndim - len(self.axes)
        array = array.transpose(*range(before), *(before + a for a in self.axes))
        return np.flip(array, tuple(before + a for a, turn in enumerate(self.turned) if turn))

    def tensors(self, values: Real[ArrayLike, "*shape d d"]) -> Real[np.ndarray, "*turned d d"]:
        """Return tensors (*shape, d, d) as the picture has them, their components along its axes."""
        signs = np.where(self.turned, -1, 1)
        components = np.moveaxis(np.asarray(values), (-2, -1), (0, 1))[np.ix_(self.axes, self.axes)]
        return np.moveaxis(self.array(components), (0, 1), (-2, -1)) * np.outer(signs, signs)

    def node(self, node: Sequence[int], shape: Sequence[int]) -> tuple[int, ...]:
        """Return the indices in the picture of a node of the array, whose shape is given."""
        turned = zip(self.axes, self.turned, strict=True)
        return tuple(shape[a] - 1 - node[a] if turn else node[a] for a, turn in turned)

    def letter(self, ax: Axes, plane: tuple[int, int] = (0, 1)) -> None:
        """Write the letters at the edges of a picture of two axes, and turn it round under the radiological view."""
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
