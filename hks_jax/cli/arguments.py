"""How the command line writes slices, voxels, repairs, boundaries and times."""

import math
from argparse import ArgumentTypeError
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool

from hks_jax.domain.components import active_elements, element_nodes, rim_nodes
from hks_jax.domain.tensor_checks import MAPS, PositiveMap
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, normalise_boundary
from hks_jax.io.repair import REPAIRS, Repair


class Times(NamedTuple):
    """Explicit times, or the number of automatic ones."""

    explicit: tuple[float, ...]
    automatic: int


DEFAULT_TIMES = Times((), 6)
DEFAULT_K = {2: 200, 3: 100}
"""Eigenpairs by dimension. A volume's factorisations cost so much more that fewer pairs take as long."""
RESOLVED = {2: 4.6, 3: 5.7}
"""λ_k·t, by dimension, from which on the pairs beyond k are 1 % of the signature (see `hks_jax.truncation`)."""
LAST = 2 * math.log(10.0)
"""λ₁·t at the last of the automatic times: all but the constant has decayed to 1 %, and a picture still shows it."""


def parse_slice(text: str) -> tuple[str, int]:
    """Read ``z=14``."""
    axis, _, index = text.partition("=")
    if axis not in ("x", "y", "z") or not index.isdecimal():
        raise ArgumentTypeError(f"got {text!r}; expected an axis and an index from 0, such as z=14")
    return axis, int(index)


def parse_repair(text: str) -> tuple[Repair, float | None]:
    """Read ``clip``, ``mask``, ``nearest``, or one of them with a floor, ``clip:1e-4``."""
    name, colon, number = text.partition(":")
    floor = _number(number) if colon else None
    if name not in REPAIRS or not (floor is None or 0 < floor < math.inf):
        raise ArgumentTypeError(f"got {text!r}; expected {', '.join(REPAIRS)}, or one with a floor, such as clip:1e-4")
    return cast(Repair, name), floor


def parse_positive(text: str) -> tuple[PositiveMap, float]:
    """Read ``exp:2e6`` or ``shift:5e6``."""
    name, _, number = text.partition(":")
    value = _number(number)
    if name not in MAPS or not math.isfinite(value) or (name == "exp" and value <= 0):
        raise ArgumentTypeError(
            f"got {text!r}; expected exp:S for exp(T/S), or shift:C for T + C·I, with a number in the tensors' units, "
            "such as exp:2e6"
        )
    return cast(PositiveMap, name), value


def parse_weight(text: str) -> float:
    """Read a positive number."""
    if not 0 < (weight := _number(text)) < math.inf:
        raise ArgumentTypeError(f"got {text!r}; expected a positive number")
    return weight


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def parse_numbers(text: str) -> tuple[float, ...]:
    """Read finite numbers between commas; none where there is anything else."""
    numbers = tuple(map(_number, text.split(",")))
    return numbers if all(map(math.isfinite, numbers)) else ()


def parse_voxel(text: str) -> tuple[int, int, int]:
    """Read ``64,64,14``."""
    words = text.split(",")
    if len(words) != 3 or not all(word.isdecimal() for word in words):
        raise ArgumentTypeError(f"got {text!r}; expected three indices from 0, such as 64,64,14")
    return int(words[0]), int(words[1]), int(words[2])


def parse_boundary(text: str) -> BoundarySpec:
    """Read ``neumann``; ``neumann,periodic`` (one per axis); ``neumann:dirichlet,periodic`` (low side, high side)."""
    entries = []
    for entry in text.split(","):
        low, colon, high = entry.partition(":")
        entries.append((low, high) if colon else low)
    return entries[0] if len(entries) == 1 and isinstance(entries[0], str) else tuple(entries)


def parse_times(words: list[str] | None) -> Times:
    """Read numbers, separated by spaces or commas, or ``auto``, ``auto:8``.

    Raises:
        ValueError: anything else.
    """
    if words is None:
        return DEFAULT_TIMES
    pieces = [piece for word in words for piece in word.split(",") if piece]
    if len(pieces) == 1 and pieces[0].split(":")[0] == "auto":
        _, colon, count = pieces[0].partition(":")
        if not colon:
            return DEFAULT_TIMES
        if count.isdecimal() and int(count) >= 1:
            return Times((), int(count))
        pieces = [pieces[0]]
    times = tuple(map(_number, pieces))
    if not times or not all(0 < t < float("inf") for t in times):
        raise ValueError(f"--times: got {' '.join(words)!r}; expected positive numbers, or auto, or auto:N")
    return Times(tuple(sorted(times)), 0)


NATURAL, MEAN = "neumann", "mean"


def default_boundary(inside: Bool[np.ndarray, "*shape"]) -> tuple[str, str]:
    """Return the boundary that suits a domain, and why: the mean where it has a mask, whose rim else covers all.

    Args:
        inside: the nodes of the domain.
    """
    if inside.all():
        return NATURAL, "the domain has no mask"
    every_axis = (False,) * inside.ndim
    elements = active_elements(inside, every_axis)
    free = element_nodes(elements, every_axis) & ~rim_nodes(elements, every_axis)
    if not free[(slice(1, -1),) * inside.ndim].any():  # the Dirichlet half leaves the grid's sides out, too
        return NATURAL, "the mask is so thin that all of it is rim, and the mean needs voxels off it"
    return MEAN, f"the domain has a mask; --boundary {NATURAL} leaves its rim natural"


def n_problems(boundary: BoundarySpec, dimension: int) -> int:
    """Return how many eigenproblems share the pairs that are computed: two under the mean."""
    return len(doubled_problems(normalise_boundary(boundary, dimension)))


def recorded_boundary(settings: Mapping[str, Any]) -> BoundarySpec | None:
    """Return the boundary that settings read from JSON name, if they do: its lists are tuples."""

    def tuples(value: Any) -> Any:
        return tuple(map(tuples, value)) if isinstance(value, list) else value

    boundary: BoundarySpec | None = tuples(settings.get("boundary"))
    return boundary


def unreached_sides(inside: Bool[np.ndarray, "*shape"], boundary: BoundarySpec) -> list[str]:
    """Say which conditions have no effect, because the mask does not reach the side of the grid that they are for."""
    warned = []
    *axes, rim = normalise_boundary(boundary, inside.ndim)
    on_rim = {
        "neumann": 'the mask\'s own rim is natural (Neumann); "dirichlet-rim" and "mean" take it in',
        "dirichlet": 'the mask\'s own rim has "dirichlet"',
        "mean": 'the mask\'s own rim has "mean"',
    }[rim[0]]
    for axis, (name, conditions) in enumerate(zip("xyz", axes, strict=False)):
        for index, condition in zip((0, -1), conditions, strict=True):
            if condition not in ("neumann", rim[0]) and not np.take(inside, index, axis).any():
                warned.append(
                    f'boundary: "{condition}" has no effect at the {"low" if index == 0 else "high"} side of {name}, '
                    f"which the mask does not reach; {on_rim}"
                )
    return warned
