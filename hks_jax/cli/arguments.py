"""How the command line writes slices, voxels, repairs, boundaries and times."""

import math
from argparse import ArgumentTypeError
from typing import NamedTuple, cast

from hks_jax.domain.tensor_checks import MAPS, PositiveMap
from hks_jax.fem.boundary import BoundarySpec
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
    try:
        floor = float(number) if colon else None
    except ValueError:
        floor = math.nan
    if name not in REPAIRS or not (floor is None or 0 < floor < math.inf):
        raise ArgumentTypeError(f"got {text!r}; expected {', '.join(REPAIRS)}, or one with a floor, such as clip:1e-4")
    return cast(Repair, name), floor


def parse_positive(text: str) -> tuple[PositiveMap, float]:
    """Read ``exp:2e6`` or ``shift:5e6``."""
    name, _, number = text.partition(":")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if name not in MAPS or not math.isfinite(value) or (name == "exp" and value <= 0):
        raise ArgumentTypeError(
            f"got {text!r}; expected exp:S for exp(T/S), or shift:C for T + C·I, with a number in the tensors' units, "
            "such as exp:2e6"
        )
    return cast(PositiveMap, name), value


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
    try:
        times = tuple(float(piece) for piece in pieces)
    except ValueError:
        times = ()
    if not times or not all(0 < t < float("inf") for t in times):
        raise ValueError(f"--times: got {' '.join(words)!r}; expected positive numbers, or auto, or auto:N")
    return Times(tuple(sorted(times)), 0)
