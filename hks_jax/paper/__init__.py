"""A reproduction of the paper: Table 1, Figures 1 to 6, and its remark on the triangle inequality.

V. Zobel, J. Reininghaus, I. Hotz: “Visualization of Two-Dimensional Symmetric Positive Definite Tensor Fields Using the
Heat Kernel Signature”, Topological Methods in Data Analysis and Visualization III, 2014.
"""

import time
from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from hks_jax import plot
from hks_jax.paper import figures, table1, triangles
from hks_jax.storage import atomic_path

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
"""The function that makes each table or figure; it returns a figure, or a dictionary from file names to texts."""


def run(output: Path, full: bool = False, only: list[str] | None = None, echo: Echo = print) -> list[Path]:
    """Write the paper's table and figures, and counts of violated triangle inequalities; return the files' paths.

    Args:
        output: the directory, which is created if necessary.
        full: whether to use the paper's sizes (many minutes) instead of small sizes (a minute or two).
        only: a selection of ``"table1"``, ``"figure1"`` … ``"figure6"``, ``"triangles"``; by default all.
        echo: a function that receives progress messages, each a line of text.

    Raises:
        ValueError: if a name in `only` is unknown.
    """
    names = list(ITEMS) if only is None else list(only)
    unknown = [name for name in names if name not in ITEMS]
    if unknown:
        raise ValueError(f"only: got {', '.join(map(repr, unknown))}; expected names from {', '.join(ITEMS)}")
    output = Path(output)
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
                with atomic_path(path) as temporary:
                    temporary.write_text(text, encoding="utf-8")
        seconds = time.perf_counter() - start
        say(f"{', '.join(str(path) for path in paths)} ({seconds:.0f} s)")
        written += paths
    return written
