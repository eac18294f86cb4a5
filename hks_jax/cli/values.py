"""Parse the values of options: slices, voxels, repairs, boundary conditions, times and folders."""

import math
import os
import re
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from hks_jax.domain.tensor_checks import MAPS
from hks_jax.eigen.automatic import SOLVERS
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.io import ORDERS, UNITS
from hks_jax.io.repair import REPAIRS


def _reader(expected: str, read: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return a parser that applies `read` to a text; if the result is None, the parser's error states `expected`."""

    def parse(text: str) -> Any:
        if (value := read(text)) is None:
            raise ArgumentTypeError(f"got {text!r}; expected {expected}")
        return value

    return parse


def _numbers(text: str) -> tuple[float, ...]:
    """Return finite numbers separated by commas, or an empty tuple for any other text."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        return ()
    return numbers if all(map(math.isfinite, numbers)) else ()


def _repair(text: str) -> tuple[str, float | None] | None:
    name, colon, number = text.partition(":")
    floor = _numbers(number) if colon else (None,)
    return (name, floor[0]) if name in REPAIRS and len(floor) == 1 and (floor[0] is None or floor[0] > 0) else None


def _positive(text: str) -> tuple[str, float] | None:
    name, _, number = text.partition(":")
    values = _numbers(number)
    return (name, values[0]) if name in MAPS and len(values) == 1 and (name != "exp" or values[0] > 0) else None


def parse_boundary(text: str) -> BoundarySpec:
    """Parse ``neumann``, ``neumann,periodic`` (one per axis) or ``neumann:dirichlet,periodic`` (low:high sides)."""
    entries: list[Any] = [tuple(one.split(":", 1)) if ":" in one else one for one in text.split(",")]
    return text if entries == [text] else tuple(entries)


class Times(NamedTuple):
    """Explicit times, or the number of automatic times."""

    explicit: tuple[float, ...]
    automatic: int


def parse_times(words: list[str] | None) -> Times:
    """Parse numbers separated by spaces or commas, or ``auto``, or ``auto:8``."""
    text = ",".join(piece for word in words or ["auto"] for piece in word.split(",") if piece)
    if auto := re.fullmatch(r"auto(?::0*([1-9]\d*))?", text):
        return Times((), int(auto[1] or 6))
    times = _numbers(text)
    if not times or min(times) <= 0:
        raise ValueError(f"--times: got {' '.join(words or ())!r}; expected positive numbers, or auto, or auto:N")
    return Times(tuple(sorted(times)), 0)


def parse_folder(text: str) -> Path:
    """Return a path if it is a writable folder, or if such a folder can be created."""
    try:
        nearest = next(folder for folder in (Path(text), *Path(text).absolute().parents) if folder.exists())
    except OSError as error:  # a folder that may not be read, or a name that is too long
        raise ArgumentTypeError(f"{error}. Choose another folder") from error
    if not nearest.is_dir():
        raise ArgumentTypeError(f"got the file {nearest}; expected a folder, or a path that does not exist")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ArgumentTypeError(f"the folder {nearest} is not writable. Choose another folder")
    return Path(text)


KINDS: dict[str, Callable[[str], Any] | Iterable[str]] = {
    **dict.fromkeys(("FILE", "RESULT", "SUBJECTS", "TARGET"), Path),
    **dict.fromkeys(("OUT", "DIR"), parse_folder),
    **dict.fromkeys(("TABLE", "PAGE", "PICTURE"), lambda text: parse_folder(str(Path(text).parent)) / Path(text).name),
    **dict.fromkeys(("N", "K"), int),
    **dict.fromkeys(("H", "C", "B", "DPI", "SIGMA", "LENGTH"), float),
    "AXIS=N": _reader(
        "an axis and an index from 0, such as z=14",
        lambda text: (found[1], int(found[2])) if (found := re.fullmatch(r"([xyz])=(\d+)", text)) else None,
    ),
    "I,J,K": _reader(
        "three indices from 0, such as 64,64,14",
        lambda text: tuple(map(int, text.split(","))) if re.fullmatch(r"\d+,\d+,\d+", text) else None,
    ),
    "X,Y": _reader("coordinates, such as 1.5,2", lambda text: x if len(x := _numbers(text)) in (2, 3) else None),
    "Q,Q": _reader(
        "two numbers from 0 to 1, such as 0.01,0.99",
        lambda text: x if len(x := _numbers(text)) == 2 and 0 <= x[0] < x[1] <= 1 else None,
    ),
    "R": _reader(
        "own, shared, or two ascending numbers LOW,HIGH",
        lambda t: t if t in ("own", "shared") else x if len(x := _numbers(t)) == 2 and x[0] < x[1] else None,
    ),
    "WEIGHT": _reader("a positive number", lambda text: x[0] if len(x := _numbers(text)) == 1 and x[0] > 0 else None),
    "HOW[:FLOOR]": _reader(f"{', '.join(REPAIRS)}, or one with a floor, such as clip:1e-4", _repair),
    "HOW:NUMBER": _reader(
        "exp:S for exp(T/S), or shift:C for T + C·I, with a number in the tensors' units, such as exp:2e6", _positive
    ),
    "CONDITION": parse_boundary,
    **{"ORDER": ORDERS, "UNIT": UNITS, "SOLVER": ("auto", *SOLVERS)},
}
"""For each word in the table of options, the parser of its values or the allowed values; other words allow any text."""
