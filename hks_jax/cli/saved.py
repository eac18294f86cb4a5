"""A result as ``hks-jax`` saved it, for the commands that draw, explore, tabulate and fit it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hks_jax.domain.grid import Grid
from hks_jax.io.volume import as_mask
from hks_jax.npz import load_npz

NAMES = ("hks", "curvature")


class Place(NamedTuple):
    """Where a grid lies in space: the affine of its volume, the axis that a slice cuts, and what indices become."""

    affine: np.ndarray | None
    slice_axis: int | None
    world: np.ndarray | None

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray], dimension: int) -> "Place":
        """Return where the grid of a saved result lies."""
        affine, slice_axis = arrays.get("affine"), None if dimension == 3 else int(arrays.get("slice_axis", 2))
        world = None if affine is None else affine[:3, [a for a in range(4) if a != slice_axis]]
        return cls(affine, slice_axis, world)


class About(NamedTuple):
    """What the result says of its origin."""

    settings: dict[str, Any]
    title: str
    unit: str
    cut: str
    k: int | None

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "About":
        """Return what a saved result says."""
        record = json.loads(str(arrays["provenance"])) if "provenance" in arrays else {}
        settings = record.get("settings") or {}
        # Fitted tensors are in mm²/s, and their grids in mm.
        seconds = record.get("order") == "fit" and settings.get("metric") == "inverse"
        k = len(arrays["eigenvalues"]) if "eigenvalues" in arrays else None
        cuts = [
            note.partition(":")[0].removeprefix("slice ") for note in record.get("notes", ()) if "slice " in note[:6]
        ]
        return cls(settings, Path(record.get("source") or "").name, "s" if seconds else "", "".join(cuts[-1:]), k)


class Saved(NamedTuple):
    """A result on a grid.

    Attributes:
        values: (n_times, *shape).
        times: (n_times,), or None for a result without.
        grid: the grid, with the mask.
        place: where the grid lies in space.
        arrays: all that is in the file, by name.
    """

    values: Float[np.ndarray, "n_times *shape"]
    times: Float[np.ndarray, " n_times"] | None
    grid: Grid
    place: Place
    arrays: Mapping[str, np.ndarray]


def read_saved(path: Path, name: str | None = None, over_times: bool = False) -> Saved:
    """Read a result on a grid.

    Args:
        path: the npz.
        name: the array; None: the first of `NAMES` that is there.
        over_times: whether it must be a signature over times.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no npz; arrays that are missing or of shapes that disagree.
    """
    arrays = load_npz(path)
    chosen = name or next((n for n in NAMES if n in arrays), " or ".join(NAMES))
    needed = (chosen, *["times"] * over_times, "spacing", "origin")
    if lacking := [n for n in needed if n not in arrays]:
        raise ValueError(
            f"{path}: got the arrays {', '.join(sorted(arrays)) or 'none'}; expected {', '.join(needed)}, as "
            f"'hks-jax hks' and 'hks-jax curvature' write them. Add {', '.join(lacking)}"
        )
    values, spacing = np.asarray(arrays[chosen]), np.atleast_1d(arrays["spacing"])
    if values.dtype.kind not in "fiu" or values.ndim - spacing.size not in (0, 1) or spacing.size not in (2, 3):
        raise ValueError(
            f"{path}: got {chosen} of shape {values.shape}, dtype {values.dtype}, and spacing of shape "
            f"{spacing.shape}; expected real numbers, one per node or (n_times, *shape)"
        )
    times = None
    if over_times or values.ndim > spacing.size:
        times = np.asarray(arrays.get("times", np.arange(len(values))), dtype=np.float64)
        if times.shape != values.shape[:1] or values.ndim == spacing.size:
            raise ValueError(
                f"{path}: got {chosen} of shape {values.shape} and times of shape {times.shape}; expected "
                "(n_times, *shape) and (n_times,)"
            )
    shape, mask = values.shape[values.ndim - spacing.size :], arrays.get("mask")
    mask = None if mask is None else as_mask(f"{path}: mask", mask)
    grid = Grid(shape, spacing.tolist(), arrays["origin"].tolist(), mask, "all")
    place = Place.of(arrays, grid.dimension)
    return Saved(values.reshape(-1, *grid.shape).astype(np.float64), times, grid, place, arrays)
