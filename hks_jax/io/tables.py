"""Read and write tables as BIDS defines them: tab-separated, n/a for missing values, columns described in JSON."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hks_jax.io.json_files import write_json
from hks_jax.storage import atomic_path, reading

MISSING = "n/a"


def write_table(
    path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]], about: Mapping[str, Any] | None = None
) -> list[Path]:
    """Write a table and, if `about` is given, a JSON file beside it; return the paths.

    Both files are written atomically. The JSON file is written last, so if it exists, the table exists too.
    """
    written = [path]
    with atomic_path(path) as temporary, open(temporary, "w", encoding="utf-8", newline="") as stream:
        stream.write("\t".join(columns) + "\n")
        stream.writelines("\t".join(map(cell, row)) + "\n" for row in rows)
    if about is not None:
        written.append(write_json(path.with_suffix(".json"), about))
    return written


def cell(value: Any) -> str:
    """Return a value as text without tabs. Floats have nine digits; None, NaN, infinity and ``""`` become ``n/a``."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return MISSING
    return f"{value:.9g}" if isinstance(value, float) else " ".join(str(value).split()) or MISSING


def read_table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table with a header; cells are separated by commas in a ``.csv`` file, otherwise by tabs.

    Empty rows are left out, and so are cells that are empty or ``n/a``.
    """
    separator = "," if path.name.lower().endswith(".csv") else "\t"
    with reading(path, "a table in UTF-8") as file, open(file, encoding="utf-8-sig", newline="") as stream:
        lines = [[word.strip() for word in line] for line in csv.reader(stream, delimiter=separator)]
    lines = [line for line in lines if any(line)]
    header, rows = (lines[0], lines[1:]) if lines else ([], [])
    if not rows or not all(header) or len(set(header)) < len(header):
        raise ValueError(
            f"{file}: got the columns {', '.join(header) or 'none'} and {len(rows)} rows; expected a header of "
            f"different names, separated by {'commas' if separator == ',' else 'tabs'}, and at least one row"
        )
    if len(header) == 1 and " " in header[0]:
        raise ValueError(f"{file}: got one column named {header[0]!r}; expected columns separated by tabs")
    for number, row in enumerate(rows, 2):
        if len(row) > len(header):
            raise ValueError(f"{file}: got {len(row)} cells in row {number}; expected {len(header)}, as in the header")
    return [{k: v for k, v in zip(header, row, strict=False) if v and v.lower() != MISSING} for row in rows]
