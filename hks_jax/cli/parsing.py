"""Parse the values of options: slices, voxels, repairs, boundary conditions, times and folders.

A parser of one option is a type for argparse, and raises ArgumentTypeError with the expected form.
"""

import math
import os
import re
from argparse import ArgumentTypeError
from pathlib import Path
from typing import Any, NamedTuple

from hks_jax.domain.tensor_checks import MAPS
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.io.repair import REPAIRS


def _unexpected(text: str, expected: str) -> ArgumentTypeError:
    return ArgumentTypeError(f"got {text!r}; expected {expected}")


def _numbers(text: str) -> tuple[float, ...]:
    """Return finite numbers separated by commas, or an empty tuple for any other text."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        return ()
    return numbers if all(map(math.isfinite, numbers)) else ()


def axis_and_index(text: str) -> tuple[str, int]:
    """Parse ``z=14``."""
    if (found := re.fullmatch(r"([xyz])=(\d+)", text)) is None:
        raise _unexpected(text, "an axis and an index from 0, such as z=14")
    return found[1], int(found[2])


def voxel(text: str) -> tuple[int, ...]:
    """Parse ``64,64,14``."""
    if not re.fullmatch(r"\d+,\d+,\d+", text):
        raise _unexpected(text, "three indices from 0, such as 64,64,14")
    return tuple(map(int, text.split(",")))


def point(text: str) -> tuple[float, ...]:
    """Parse two or three coordinates."""
    if len(numbers := _numbers(text)) not in (2, 3):
        raise _unexpected(text, "coordinates, such as 1.5,2")
    return numbers


def quantiles(text: str) -> tuple[float, ...]:
    """Parse two ascending quantiles."""
    numbers = _numbers(text)
    if len(numbers) != 2 or not 0 <= numbers[0] < numbers[1] <= 1:
        raise _unexpected(text, "two numbers from 0 to 1, such as 0.01,0.99")
    return numbers


def colour_range(text: str) -> str | tuple[float, ...]:
    """Parse ``own``, ``shared``, or two ascending numbers."""
    numbers = _numbers(text)
    if text not in ("own", "shared") and (len(numbers) != 2 or numbers[0] >= numbers[1]):
        raise _unexpected(text, "own, shared, or two ascending numbers LOW,HIGH")
    return numbers or text


def weight(text: str) -> float:
    """Parse a positive number."""
    numbers = _numbers(text)
    if len(numbers) != 1 or numbers[0] <= 0:
        raise _unexpected(text, "a positive number")
    return numbers[0]


def repair(text: str) -> tuple[str, float | None]:
    """Parse ``clip``, or ``clip:1e-4`` with a floor."""
    name, colon, number = text.partition(":")
    floor = _numbers(number)
    if name not in REPAIRS or (colon and (len(floor) != 1 or floor[0] <= 0)):
        raise _unexpected(text, f"{', '.join(REPAIRS)}, or one with a floor, such as clip:1e-4")
    return name, floor[0] if colon else None


def positive_map(text: str) -> tuple[str, float]:
    """Parse ``exp:S`` with a positive scale S, or ``shift:C``."""
    name, _, number = text.partition(":")
    numbers = _numbers(number)
    if name not in MAPS or len(numbers) != 1 or (name == "exp" and numbers[0] <= 0):
        how = "exp:S for exp(T/S), or shift:C for T + C·I"
        raise _unexpected(text, f"{how}, with a number in the tensors' units, such as exp:2e6")
    return name, numbers[0]


def boundary_conditions(text: str) -> BoundarySpec:
    """Parse ``neumann``, ``neumann,periodic`` (one per axis) or ``neumann:dirichlet,periodic`` (low:high sides)."""
    entries: list[Any] = [tuple(one.split(":", 1)) if ":" in one else one for one in text.split(",")]
    return text if entries == [text] else tuple(entries)


class Times(NamedTuple):
    """Explicit times, or the number of automatic times."""

    explicit: tuple[float, ...]
    automatic: int


def parse_times(words: list[str] | None) -> Times:
    """Parse numbers separated by spaces or commas, or ``auto``, or ``auto:8``; raise ValueError for other words."""
    text = ",".join(piece for word in words or ["auto"] for piece in word.split(",") if piece)
    if auto := re.fullmatch(r"auto(?::0*([1-9]\d*))?", text):
        return Times((), int(auto[1] or 6))
    times = _numbers(text)
    if not times or min(times) <= 0:
        raise ValueError(f"--times: got {' '.join(words or ())!r}; expected positive numbers, or auto, or auto:N")
    return Times(tuple(sorted(times)), 0)


def folder(text: str) -> Path:
    """Return a path if it is a writable folder, or if such a folder can be created."""
    try:
        nearest = next(place for place in (Path(text), *Path(text).absolute().parents) if place.exists())
    except OSError as error:  # a folder that may not be read, or a name that is too long
        raise ArgumentTypeError(f"{error}. Choose another folder") from error
    if not nearest.is_dir():
        raise ArgumentTypeError(f"got the file {nearest}; expected a folder, or a path that does not exist")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ArgumentTypeError(f"the folder {nearest} is not writable. Choose another folder")
    return Path(text)


def file_in_folder(text: str) -> Path:
    """Return the path of a file if its folder is writable, or can be created."""
    return folder(str(Path(text).parent)) / Path(text).name
