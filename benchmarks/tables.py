"""Tables of the stored results, written into the pages that show them.

    python benchmarks/tables.py            writes the tables, and the plots whose results have changed
    python benchmarks/tables.py --check    names pages that differ from the results, and fails (a test does the same)

README.md, the pages in docs/ and those in benchmarks/ hold comments that name their content, up to
``<!-- end -->``:

    <!-- measured: machine FILE -->                          the machine, and the file
    <!-- measured: table FILE[/PART] COLUMN COLUMN … -->     one line per row of the results
    <!-- measured: table FILE ROWS | COLUMNS | VALUE -->     values of one column in the rows and columns of others
    <!-- measured: overview PROBLEM PROBLEM … -->            several programs on problems of several files, 64²/100
    <!-- measured: plot NAME -->                             one of `plots.PLOTS`

A column written ``nodes³`` is that of cubes, ``nodes²`` that of squares: 64³ and 512² are the same number. Among the
columns ``NAME=PATTERN,PATTERN…`` chooses rows by their entry as one reads it; ``*`` and ``?`` stand for any characters,
spaces and commas included.
"""

import json
import math
import os
import re
import sys
from contextlib import suppress
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PICTURES = ROOT / "docs" / "images" / "measured"

HEADINGS = {
    "seconds": "seconds",
    "first_call_s": "first call, s",
    "first_s": "first, s",
    "cached_s": "cached, s",
    "later_s": "later, s",
    "another_spacing_s": "another spacing, s",
    "mask_s": "with a mask, s",
    "another_mask_s": "another mask, s",
    "first_step_s": "first step, s",
    "step_s": "a step, s",
    "processor_s": "of all processors, s",
    "numpy_s": "NumPy's product, s",
    "maps_MB": "maps, MB",
    "compilation_s": "compilation, s",
    "first_call_s_ratio": "ratio",
    "seconds_ratio": "ratio",
    "peak_GB": "peak memory, GB",
    "vectors_filtered": "vectors filtered",
    "stored_GB": "vectors stored, GB",
    "all_to_all_GB": "vectors sent, GB",
    "halo_GB": "planes sent, GB",
    "dense_s": "dense, s",
    "shift_invert_s": "shift-invert, s",
    "value_s": "value, s",
    "value_first_s": "value, first call, s",
    "gradient_s": "gradient, s",
    "gradient_first_s": "gradient, first call, s",
    "gflop_a_pole": "Gflop a pole",
    "value_and_gradient_s": "with gradient, s",
    "factorise_s": "factorise, s",
    "solve_s": "solve, s",
    "solve_8_s": "solve 8, s",
    "log_determinant_s": "log det, s",
    "log_determinant_and_gradient_s": "with gradient, s",
    "backward_error": "backward error",
    "directional_error": "error of a directional derivative",
    "worst_residual": "worst residual",
    "fields_per_second": "fields a second",
    "t_in_h2": "t/h²",
    "relative_error": "relative error",
    "seconds_before": "before",
    "processor_ratio": "ratio, of all processors",
    "launches_before": "before",
    "waits": "waits of the host",
    "busy_s": "device busy, s",
    "span_s": "first to last launch, s",
    "waits_before": "before",
    "peak_GB_before": "before",
    "maps_claimed": "claimed",
    "in_68_claimed": "claimed in 68 %",
    "in_95_claimed": "claimed in 95 %",
    "in_68_all": "all in 68 %",
    "in_95_all": "all in 95 %",
    "worst_68": "farthest from 68 %",
    "uncorrected": "value ± σ",
    "least_ms": "least time, ms",
    "least_ms_before": "before",
}
GRIDS = "derivatives problem=*²,*³"
OVERVIEW: list[tuple[str, list[str], list[str]]] = [
    ("SciPy", [f"{file} solver=eigsh??SuperLU seconds" for file in ("eigensolvers", "volumes")], []),
    ("SLEPc", ["eigensolvers solver=SLEPc??slicing??PETSc* seconds"], []),
    ("hks_jax, first call", [f"{GRIDS} value_first_s"], [f"{GRIDS} gradient_first_s"]),
    ("later calls", [f"{GRIDS} value_s"], [f"{GRIDS} value_and_gradient_s"]),
    *(
        (head, [f"accelerator_h200 way=host-driven {column}"], [f"accelerator_h200 way=gradient* {column}"])
        for head, column in (("on a GPU, first call", "first_call_s"), ("later calls", "seconds"))
    ),
]
"""The columns of an overview: where the seconds of a signature may be, and those of a signature with its gradient."""
POWERS = {"²": 2, "³": 3}
MARKED = re.compile(r"<!-- measured: (.*?) -->(?:\n\n(?:(?!<!-- measured).)*?<!-- end -->)?", re.DOTALL)


def pages() -> list[Path]:
    """Return the pages that may show results."""
    return [ROOT / "README.md", *sorted((ROOT / "benchmarks").rglob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]


def filled(page: Path) -> str:
    """Return a page with the content that its comments name."""

    def fill(found: re.Match) -> str:
        return f"<!-- measured: {found[1]} -->\n\n{section(found[1], page)}\n\n<!-- end -->"

    return MARKED.sub(fill, page.read_text(encoding="utf-8"))


def section(request: str, page: Path) -> str:
    """Return the content that a comment names, as Markdown.

    Raises:
        ValueError: a request of another kind.
    """
    kind, _, rest = request.partition(" ")
    if kind == "machine":
        return machine(rest, page)
    if kind == "table":
        name, _, columns = rest.partition(" ")
        return pivot(name, columns) if "|" in columns else table(name, columns.split())
    if kind == "overview":
        return overview(rest.split(), page)
    if kind == "plot":
        return f"![{caption(rest)}]({link(PICTURES / f'{rest}.svg', page)})"
    raise ValueError(f"measured: got {request!r}; expected machine, table, overview or plot")


def link(path: Path, page: Path) -> str:
    """Return the link from a page to a file."""
    return Path(os.path.relpath(path, page.parent)).as_posix()


def caption(plot: str) -> str:
    """Return the sentence that describes a plot: the first of the function that draws it."""
    text = (ROOT / "benchmarks" / "plots.py").read_text(encoding="utf-8")
    found = re.search(rf'^def {plot}\(.*\n    """(.*?)\."""', text, re.MULTILINE)
    if found is None:
        raise ValueError(f"measured: got plot {plot!r}; benchmarks/plots.py has none of that name")
    return found[1]


def load(name: str) -> dict[str, Any]:
    """Return the contents of a result file."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def rows_of(name: str) -> list[dict[str, Any]]:
    """Return the rows of FILE, or of FILE/PART."""
    file, _, part = name.partition("/")
    content = load(file)
    rows = content["rows"]
    if part:
        rows = content[part] if part in content else rows[part]
    return [flat(row) for row in rows]


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row with the entries of dictionaries in it as entries of its own, and the steps of a history counted."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        if name == "history":
            found["steps"] = len(value) - 1
        elif isinstance(value, dict):
            found |= {f"{name}.{inner}": v for inner, v in value.items()}
        else:
            found[name] = value
    return found


def machine(name: str, page: Path) -> str:
    """Return the machine of a result, and a link to it."""
    content = load(name)
    on, versions = content["machine"], content["versions"]
    note = f" {content['note'][0].upper()}{content['note'][1:]}." if "note" in content else ""
    return (
        f"*{on['processor']}, {on['cores']} cores, {on['device']}; JAX {versions['jax']},"
        f" hks_jax {versions['hks_jax']}: [{name}.json]({link(RESULTS / f'{name}.json', page)}).{note}*"
    )


def text(value: Any, power: int = 1) -> str:
    """Return a number as one reads it: three digits, and powers as powers."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "—" if value is None else "NaN"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if value and abs(value) < 1e-2:
            return re.sub(r"e-0?", "e-", f"{value:.2g}" if abs(value) > 1e-3 else f"{value:.1e}").replace(".0e", "e")
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    if isinstance(value, int):
        root = round(value ** (1 / power))
        return f"{value:,}" if power == 1 or root**power != value else f"{root}{'¹²³'[power - 1]}"
    if isinstance(value, list):
        return " × ".join(text(v) for v in value)
    return str(value)


def heading(column: str) -> str:
    """Return a column's name as one reads it."""
    name = column.rstrip("²³")
    return HEADINGS.get(name, name.replace("_", " ").replace(".", ": "))


def entry(row: dict[str, Any], column: str) -> str:
    """Return a row's entry in a column."""
    return text(row.get(column.rstrip("²³")), POWERS.get(column[-1], 1))


def grid_of(head: list[str], body: list[list[str]]) -> str:
    """Return a table in Markdown, numbers flush right."""
    numbers = [all(re.match(r"[\d—]|NaN|not |more ", line[i]) for line in body) for i in range(len(head))]
    lines = [head, ["---:" if right else "---" for right in numbers], *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def chosen(name: str, request: list[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the rows of a result that a request chooses, and the columns that it names.

    Raises:
        ValueError: no row matches.
    """
    filters = [item.split("=", 1) for item in request if "=" in item]
    rows = [
        row
        for row in rows_of(name)
        if all(any(fnmatchcase(entry(row, of), pattern) for pattern in known.split(",")) for of, known in filters)
    ]
    if not rows:
        raise ValueError(f"measured: no row of {name} matches {filters}")
    return rows, [item for item in request if "=" not in item]


def table(name: str, request: list[str]) -> str:
    """Return a table of some columns.

    Raises:
        ValueError: a column that no row has.
    """
    rows, columns = chosen(name, request)
    for column in columns:
        if not any(column.rstrip("²³") in row for row in rows):
            raise ValueError(f"measured: no row of {name} has {column!r}; there are {', '.join(rows[0])}")
    return grid_of([heading(column) for column in columns], [[entry(row, c) for c in columns] for row in rows])


def pivot(name: str, request: str) -> str:
    """Return one column's values in the rows and columns of others."""
    before, (top,), (value,) = (part.split() for part in request.split("|"))
    rows, left = chosen(name, before)
    tops = list(dict.fromkeys(row[top] for row in rows))
    cells: dict[tuple[str, ...], dict[Any, dict[str, Any]]] = {}
    for row in rows:
        cells.setdefault(tuple(entry(row, column) for column in left), {})[row[top]] = row
    body = []
    for line, found in cells.items():
        shown = [found.get(t, {}).get("not_run") or entry(found.get(t, {}), value) for t in tops]
        body.append([*line, *shown])
    return grid_of([*(heading(c) for c in left), *map(str, tops)], body)


def overview(problems: list[str], page: Path) -> str:
    """Return the seconds of a signature, alone and with its gradient, for problems NODES/K, and the results' files."""
    body, used = [], {}
    for problem in problems:
        nodes, k = problem.split("/")
        lines = [f"{nodes} nodes, {k} eigenpairs"], ["the same, with gradient"]
        for _, *column in OVERVIEW:
            for line, places in zip(lines, column, strict=True):
                file, seconds = seconds_of(places, [f"nodes{nodes[-1]}={nodes}", f"k={k}"])
                line.append(seconds)
                used |= {file: load(file)} if file else {}
        body += lines
    devices: dict[str, list[str]] = {}
    for file, content in used.items():
        on, jax = content["machine"], content["versions"]["jax"]
        device = f"{on['processor']}, {on['cores']} cores" if on["device"] == "cpu" else f"GPU {on['device']}"
        devices.setdefault(f"{device}, JAX {jax}", []).append(f"[{file}.json]({link(RESULTS / f'{file}.json', page)})")
    notes = "; ".join(f"{device}: {', '.join(files)}" for device, files in devices.items())
    return f"{grid_of(['seconds', *(name for name, *_ in OVERVIEW)], body)}\n\n*{notes}.*"


def seconds_of(places: list[str], filters: list[str]) -> tuple[str, str]:
    """Return the file and the text of the entry at the first place, FILE COLUMN=PATTERN … COLUMN, that has one."""
    for place in places:
        name, *own, column = place.split()
        with suppress(ValueError):
            (row, *_), _ = chosen(name, [*filters, *own])
            return name, entry(row, column)
    return "", "—"


def named() -> set[str]:
    """Return the result files that some page shows."""
    texts = [page.read_text(encoding="utf-8") for page in pages()]
    return {name for text in texts for name in re.findall(r"<!-- measured: \w+ ([\w-]+)", text)}


def differences() -> list[str]:
    """Return the pages and pictures that differ from the results."""
    from plots import PLOTS, is_current

    found = [f"{page.relative_to(ROOT)}: its tables" for page in pages() if filled(page) != page.read_text("utf-8")]
    found += [f"docs/images/measured/{name}.svg" for name in PLOTS if not is_current(name)]
    unseen = {path.stem for path in RESULTS.glob("*.json")} - named()
    return found + [f"benchmarks/results/{name}.json is shown nowhere" for name in sorted(unseen)]


def main() -> None:
    """Write all tables and plots, or tell which differ."""
    if sys.argv[1:] == ["--check"]:
        if found := differences():
            sys.exit("\n".join(["error: these differ from benchmarks/results/; run `make tables`:", *found]))
        return
    from plots import PLOTS, is_current, write

    for page in pages():
        page.write_text(filled(page), encoding="utf-8")
    for name in PLOTS:
        if not is_current(name):
            write(name)


if __name__ == "__main__":
    main()
