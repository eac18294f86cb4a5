"""Tables and plots of the benchmarks' stored results, made anew whenever the site is built: they cannot drift.

In benchmarks/README.md stand, to be replaced,

    <!-- measured: machine FILE -->                          what it was measured on, and the file
    <!-- measured: table FILE[/PART] COLUMN COLUMN … -->     one line per row of the results
    <!-- measured: table FILE ROWS | COLUMNS | VALUE -->     values of one column in the rows and columns of others
    <!-- measured: plot FILE -->                             one of PLOTS
    <!-- measured: others -->                                every file that the page names nowhere, whole
"""

import io
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
RESULTS = BENCHMARKS / "results"

HEADINGS = {
    "seconds": "seconds",
    "first_call_s": "first call, s",
    "compilation_s": "compilation, s",
    "peak_GB": "peak memory, GB",
    "dense_s": "dense, s",
    "shift_invert_s": "shift-invert, s",
    "value_s": "value, s",
    "value_first_s": "value, first call, s",
    "gradient_s": "gradient, s",
    "gradient_first_s": "gradient, first call, s",
    "gflop_a_pole": "Gflop a pole",
    "value_and_gradient_s": "with gradient, s",
    "directional_error": "error of a directional derivative",
    "worst_residual": "worst residual",
    "fields_per_second": "fields a second",
    "t_in_h2": "t/h²",
    "relative_error": "relative error",
}


def section(request: str) -> str:
    """Return what a marker asks for, as Markdown.

    Raises:
        ValueError: a request of another kind.
    """
    kind, _, rest = request.partition(" ")
    if kind == "machine":
        return machine(rest)
    if kind == "table":
        name, _, columns = rest.partition(" ")
        return pivot(name, columns) if "|" in columns else table(rows_of(name), columns.split())
    if kind == "plot":
        return f"![{PLOTS[rest].__doc__}](images/measured/{rest}.svg)"
    if kind == "others":
        return "\n\n".join(whole(name) for name in others())
    raise ValueError(f"measured: got {request!r}; expected machine, table, plot or others")


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


def machine(name: str) -> str:
    """Return what a result was measured on, and a link to it."""
    content = load(name)
    on, versions = content["machine"], content["versions"]
    note = f" {content['note'][0].upper()}{content['note'][1:]}." if "note" in content else ""
    return (
        f"*{on['processor']}, {on['cores']} cores, {on['device']}; JAX {versions['jax']},"
        f" hks_jax {versions['hks_jax']}: [{name}.json](benchmarks/results/{name}.json).{note}*"
    )


def text(value: Any, column: str = "") -> str:
    """Return a number as one reads it: three digits, and squares as squares."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "—" if value is None else "NaN"
    if column in ("nodes", "unknowns") and isinstance(value, int) and math.isqrt(value) ** 2 == value:
        return f"{math.isqrt(value)}²"
    if isinstance(value, float):
        if value and abs(value) < 1e-2:
            return re.sub(r"e-0?", "e-", f"{value:.2g}" if abs(value) > 1e-3 else f"{value:.1e}").replace(".0e", "e")
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, list):
        return " × ".join(text(v) for v in value)
    return str(value)


def heading(column: str) -> str:
    """Return a column's name as one reads it."""
    return HEADINGS.get(column, column.replace("_", " ").replace(".", ": "))


def grid_of(head: list[str], body: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def table(rows: list[dict[str, Any]], columns: list[str]) -> str:
    """Return a table of some columns.

    Raises:
        ValueError: a column that no row has.
    """
    for column in columns:
        if not any(column in row for row in rows):
            raise ValueError(f"measured: no row has {column!r}; there are {', '.join(rows[0])}")
    body = [[text(row.get(column), column) for column in columns] for row in rows]
    return grid_of([heading(column) for column in columns], body)


def pivot(name: str, request: str) -> str:
    """Return one column's values in the rows and columns of others."""
    left, top, value = (part.split() for part in request.split("|"))
    rows = rows_of(name)
    tops = list(dict.fromkeys(row[top[0]] for row in rows))
    lines = list(dict.fromkeys(tuple(row[c] for c in left) for row in rows))
    cells = {(tuple(row[c] for c in left), row[top[0]]): row for row in rows}
    body = []
    for line in lines:
        found = [cells.get((line, t), {}) for t in tops]
        shown = [row.get("not_run") or text(row.get(value[0])) for row in found]
        body.append([*(text(v, c) for v, c in zip(line, left, strict=True)), *shown])
    return grid_of([*(heading(c) for c in left), *map(str, tops)], body)


def others() -> list[str]:
    """Return the result files that benchmarks/README.md does not name."""
    page = (BENCHMARKS / "README.md").read_text(encoding="utf-8")
    return [p.stem for p in sorted(RESULTS.glob("*.json")) if f"measured: machine {p.stem} -->" not in page]


def whole(name: str) -> str:
    """Return all of a result file, as far as it is rows of numbers and words."""
    rows = load(name)["rows"]
    parts = rows.items() if isinstance(rows, dict) else [("", rows)]
    found = [f"## {name.replace('_', ' ').capitalize()}", machine(name)]
    for title, part in parts:
        part = [flat(row) for row in part]
        columns = list(dict.fromkeys(column for row in part for column in row))
        found += [f"### {heading(title)}"] * bool(title) + [table(part, columns)]
    return "\n\n".join(found)


# --- plots --------------------------------------------------------------------------------------------------

STYLE = {"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "svg.hashsalt": "hks_jax", "lines.markersize": 5}
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c564b")  # Okabe and Ito


def legend(axes: Axes, ordered: bool = True) -> None:
    """Put the legend beside the axes, in the order of the curves' ends if so asked."""
    entries = list(zip(*axes.get_legend_handles_labels(), strict=True))
    if ordered:
        entries.sort(key=lambda entry: -np.ravel(entry[0].get_ydata())[-1])
    handles, labels = zip(*entries, strict=True)
    axes.legend(handles, labels, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)


def eigensolvers(figure: Figure) -> None:
    """Seconds against nodes, for each eigensolver."""
    axes = figure.subplots()
    rows = [row for row in rows_of("eigensolvers") if "seconds" in row and row["k"] == 100]
    for colour, name in zip(COLOURS, dict.fromkeys(row["solver"] for row in rows), strict=False):
        points = sorted((row["nodes"], row["seconds"]) for row in rows if row["solver"] == name)
        nodes, seconds = np.transpose(points)
        exponent = np.polyfit(np.log(nodes), np.log(seconds), 1)[0]
        width = 2.5 if name == "hks_jax" else 1.2
        axes.loglog(nodes, seconds, "o-", color=colour, linewidth=width, label=f"{name}: $N^{{{exponent:.2f}}}$")
    sizes = sorted({row["nodes"] for row in rows})
    axes.set_xticks(sizes, [text(n, "nodes") for n in sizes])
    axes.set_xticks([], minor=True)
    axes.set(xlabel="nodes $N$", ylabel="seconds, 100 pairs, compilation apart")
    legend(axes)


def derivatives(figure: Figure) -> None:
    """Relative error of the gradient against the perturbation of a symmetric field, for each rule."""
    axes = figure.subplots()
    rows = load("derivatives")["accuracy"]
    names = list(dict.fromkeys(name for row in rows for name in row["relative_errors"]))
    places = range(len(rows))
    for colour, marker, name in zip(COLOURS, "os^Dv<>p", names, strict=False):
        errors = [row["relative_errors"].get(name, math.nan) for row in rows]
        axes.semilogy(places, errors, marker, color=colour, label=name, linestyle="-", linewidth=1)
    missing = [name for name in names if any(math.isnan(row["relative_errors"].get(name, 0)) for row in rows)]
    axes.set_xticks(places, [row["field"].replace("noise ", "noise\n") for row in rows])
    note = f"; not a number: {', '.join(missing)}" if missing else ""
    axes.set(xlabel=f"unit metric, and noise on it{note}", ylabel="relative error of the gradient")
    legend(axes, ordered=False)


def solvers(figure: Figure) -> None:
    """Time of the dense solver over that of shift-invert, against the number of unknowns."""
    axes = figure.subplots()
    rows = rows_of("solvers")
    for colour, k in zip(COLOURS, sorted({row["k"] for row in rows}), strict=False):
        points = sorted((row["unknowns"], row["ratio"]) for row in rows if row["k"] == k)
        axes.loglog(*np.transpose(points), "o-", color=colour, label=f"k = {k}")
    sizes = sorted({row["unknowns"] for row in rows})
    axes.axhline(1, color="0.4", linewidth=1)
    axes.set_xticks(sizes, [text(n, "unknowns") for n in sizes])
    axes.set_xticks([], minor=True)
    axes.set(xlabel="unknowns", ylabel="time, dense / shift-invert")
    legend(axes)


def inverse(figure: Figure) -> None:
    """Loss against steps for four fits, and the error against the weight of a penalty."""
    left, right = figure.subplots(1, 2)
    rows = load("inverse")["rows"]
    for colour, row in zip(COLOURS, rows["recover"], strict=False):
        name = f"{row['parametrisation']}, {text(row['nodes'], 'nodes')}, " + (
            f"{row['noise']:.0%} noise" if row["noise"] else "no noise"
        )
        left.semilogy([step["loss"] for step in row["history"]], "o-", color=colour, label=name)
    left.set(xlabel="step", ylabel="loss")
    left.legend(fontsize="small")
    weighted = sorted((row["weight"], row["error"]) for row in rows["curve"] if "weight" in row)
    right.semilogx(*np.transpose(weighted), "o-", color=COLOURS[0], label="with an H1 penalty")
    (stopped,) = (row["error"] for row in rows["curve"] if "weight" not in row)
    right.axhline(stopped, color=COLOURS[1], label="stopped at the noise level")
    right.set(xlabel="weight of the penalty", ylabel="error of the tensors", ylim=(0, None))
    right.legend(fontsize="small")


PLOTS: dict[str, Callable[[Figure], None]] = {
    "eigensolvers": eigensolvers,
    "derivatives": derivatives,
    "solvers": solvers,
    "inverse": inverse,
}


def plots() -> dict[str, bytes]:
    """Return all plots as SVG."""
    found = {}
    for name, draw in PLOTS.items():
        with rc_context(STYLE):
            figure = Figure(figsize=(8, 3.6), layout="constrained")
            draw(figure)
            file = io.BytesIO()
            figure.savefig(file, format="svg", metadata={"Date": None})
        found[name] = file.getvalue()
    return found
