"""Plots of the stored results, for the pages that show them; `tables` writes them when the results change."""

import hashlib
import math
from collections.abc import Callable

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tables import PICTURES, RESULTS, load, rows_of, text

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
    axes.set_xticks(sizes, [text(n, 2) for n in sizes])
    axes.set_xticks([], minor=True)
    axes.set(xlabel="nodes $N$", ylabel="seconds, 100 pairs, compilation apart")
    legend(axes)


def derivatives(figure: Figure) -> None:
    """Relative error of the gradient against the perturbation of a symmetric field, for each derivative rule."""
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
    """Ratio of the dense solver's time to that of shift-invert, against the number of unknowns."""
    axes = figure.subplots()
    rows = rows_of("solvers")
    for colour, k in zip(COLOURS, sorted({row["k"] for row in rows}), strict=False):
        points = sorted((row["unknowns"], row["ratio"]) for row in rows if row["k"] == k)
        axes.loglog(*np.transpose(points), "o-", color=colour, label=f"k = {k}")
    sizes = sorted({row["unknowns"] for row in rows})
    axes.axhline(1, color="0.4", linewidth=1)
    axes.set_xticks(sizes, [text(n, 2) for n in sizes])
    axes.set_xticks([], minor=True)
    axes.set(xlabel="unknowns", ylabel="time, dense / shift-invert")
    legend(axes)


def inverse(figure: Figure) -> None:
    """Loss against steps for four fits, and the error against the weight of a penalty."""
    left, right = figure.subplots(1, 2)
    rows = load("inverse")["rows"]
    for colour, row in zip(COLOURS, rows["recover"], strict=False):
        name = f"{row['parametrisation']}, {text(row['nodes'], 2)}, " + (
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


def source(name: str) -> str:
    """Return the source of a plot, as it stands in its file."""
    digest = hashlib.sha256((RESULTS / f"{name}.json").read_bytes()).hexdigest()
    return f"benchmarks/results/{name}.json, SHA-256 {digest}"


def is_current(name: str) -> bool:
    """Tell whether a plot was made from the results as they are."""
    path = PICTURES / f"{name}.svg"
    return path.exists() and source(name) in path.read_text(encoding="utf-8")


def write(name: str) -> None:
    """Draw a plot anew."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    with rc_context(STYLE):
        figure = Figure(figsize=(8, 3.6), layout="constrained", facecolor="white")
        PLOTS[name](figure)
        figure.savefig(PICTURES / f"{name}.svg", metadata={"Date": None, "Source": source(name)})
