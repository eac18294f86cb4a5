"""A reproduction of the paper: Table 1, Figures 1 to 6, and its remark on the triangle inequality.

    python benchmarks/paper/reproduce.py [--full] [--only table1 figure3 ...] [-o FOLDER]

V. Zobel, J. Reininghaus, I. Hotz: “Visualization of Two-Dimensional Symmetric Positive Definite Tensor Fields Using the
Heat Kernel Signature”, Topological Methods in Data Analysis and Visualization III, 2014.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import figures
import jax
import table1
import triangles
from matplotlib.figure import Figure

from hks_jax import plot

Echo = Callable[[str], None]

ITEMS: dict[str, Callable[[bool, Echo], Figure | dict[str, str]]] = {
    "table1": table1.make,
    "figure1": figures.figure1,
    "figure2": figures.figure2,
    "figure3": figures.figure3,
    "figure4": figures.figure4,
    "figure5": figures.figure5,
    "figure6": figures.figure6,
    "triangles": triangles.make,
}
"""The function that makes each table or figure; it returns a figure, or a dictionary from file names to texts,
which is empty if the figure's data are not installed."""


def run(output: Path, full: bool, names: list[str], echo: Echo = print) -> list[Path]:
    """Write tables and figures of these names into a folder, which is created if necessary; return the files' paths."""
    output.mkdir(parents=True, exist_ok=True)
    written = []
    for number, name in enumerate(names, 1):

        def say(text: str, place: str = f"[{number}/{len(names)}] {name}:") -> None:
            echo(f"{place} {text}")

        start = time.perf_counter()
        made = ITEMS[name](full, say)
        paths = [output / file for file in (made if isinstance(made, dict) else (f"{name}.png",))]
        if isinstance(made, Figure):
            plot.save_figure(made, paths[0])
        else:
            for path, text in zip(paths, made.values(), strict=True):
                path.write_text(text, encoding="utf-8")
        if paths:
            say(f"{', '.join(str(path) for path in paths)} ({time.perf_counter() - start:.0f} s)")
        written += paths
    return written


def main() -> None:
    """Read the command line, and write tables and figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="the sizes of the paper, which take longer")
    parser.add_argument("--only", nargs="+", choices=ITEMS, default=list(ITEMS), metavar="NAME", help=", ".join(ITEMS))
    parser.add_argument("-o", "--output", type=Path, default=Path("paper"), metavar="FOLDER")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    run(arguments.output, arguments.full, arguments.only)


if __name__ == "__main__":
    main()
