"""Table 1: the HKS of a bumpy torus from its pulled-back metric and from its surface."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from signature import signature

from hks_jax.domain.examples import bumpy_torus_field, bumpy_torus_mesh

TIME = 1.0
REFERENCE_SIZE = 400
REFERENCE_PAIRS = 300
# At t = 1 the pairs beyond k = 200 have factors exp(−λt) < 1e-5; the smallest difference in the quick table is 5e-3.
QUICK_PAIRS = 200
STORED = Path(__file__).with_name("bumpy_torus_p1_400x400_k300_t1.npy")
SYMMETRY = 10  # cos 10u has ten periods around the torus

PAPER = {50: 0.384, 100: 0.0760, 200: 0.00920, 400: 0.00075}
INDEPENDENT = {50: 0.0580, 100: 0.0223, 200: 0.0056, 400: 0.00085}


class Row(NamedTuple):
    """One line of the table; the fields are the columns of the CSV file."""

    nodes_per_axis: int
    eigenpairs: int
    paper: float
    independent: float
    nodal: float
    area_weighted: float


def make(full: bool, echo: Callable[[str], None]) -> dict[str, str]:
    """Return a dictionary from file names to Table 1 in Markdown and as comma-separated values."""
    k = REFERENCE_PAIRS if full else QUICK_PAIRS
    if full:
        echo(f"{REFERENCE_PAIRS} eigenpairs of the surface with {REFERENCE_SIZE}² vertices")
        reference = computed_reference()
    else:
        reference = stored_reference()
    rows = []
    for n in PAPER if full else (50, 100, 200):
        echo(f"{k} eigenpairs of the metric on {n}² nodes")
        rows.append(row(n, k, reference))
    lines = [",".join(map(str, each)) + "\n" for each in (Row._fields, *rows)]
    return {"table1.md": markdown(rows, computed=full), "table1.csv": "".join(lines)}


def row(n: int, k: int, reference: Float[np.ndarray, "m m"]) -> Row:
    """Compare the HKS of the metric on n² nodes with a reference on m² nodes, where n divides m."""
    (values,) = signature(bumpy_torus_field(n), [TIME], k, boundary="periodic")
    fine = interpolate_periodic(values, len(reference) // n)
    area = np.sqrt(np.linalg.det(np.asarray(bumpy_torus_field(len(reference)).tensors)))
    nodal, weighted = (relative_difference(fine, reference, w) for w in (np.ones_like(area), area))
    return Row(n, k, PAPER[n], INDEPENDENT[n], nodal, weighted)


def relative_difference(
    values: Float[np.ndarray, "*shape"], reference: Float[np.ndarray, "*shape"], weights: Float[np.ndarray, "*shape"]
) -> float:
    """Return the relative L² difference √(Σ w (values − reference)² / Σ w reference²) for the weights w."""
    return math.sqrt(np.sum(weights * (values - reference) ** 2) / np.sum(weights * reference**2))


def interpolate_periodic(values: Float[np.ndarray, "n n"], factor: int) -> Float[np.ndarray, "m m"]:
    """Return the bilinear interpolant of periodic nodal values on a grid that is `factor` times as fine."""
    weight = np.arange(factor) / factor
    for axis in (0, 1):
        coarse = np.moveaxis(values, axis, 0)[:, None]
        following = np.roll(coarse, -1, axis=0)
        fine = (1 - weight)[:, None] * coarse + weight[:, None] * following
        values = np.moveaxis(fine.reshape(-1, fine.shape[-1]), 0, axis)
    return values


def computed_reference(k: int = REFERENCE_PAIRS) -> Float[np.ndarray, "400 400"]:
    """Compute the HKS of the bumpy torus as a surface of 400² vertices, which takes minutes."""
    (values,) = signature(bumpy_torus_mesh(REFERENCE_SIZE), [TIME], k)
    return values.reshape(REFERENCE_SIZE, REFERENCE_SIZE)


def stored_reference() -> Float[np.ndarray, "400 400"]:
    """Read a stored result of `computed_reference` in float32, which `store_reference` writes."""
    return np.tile(np.load(STORED).astype(np.float64), (SYMMETRY, 1))


def store_reference(values: Float[np.ndarray, "400 400"], path: Path) -> None:
    """Write one of the ten equal periods of the result of `computed_reference` to a file in float32."""
    np.save(path, values[: REFERENCE_SIZE // SYMMETRY].astype(np.float32))


def markdown(rows: list[Row], computed: bool) -> str:
    """Return Table 1 in Markdown, with explanations of its columns."""
    origin = "computed in this run" if computed else "read from a file; a full run computes the surface's HKS"
    lines = [
        "# Table 1: HKS of a bumpy torus at t = 1, metric against surface",
        "",
        "| nodes | eigenpairs | the paper | independent | **nodal** | area-weighted |",
        "| ---: | ---: | ---: | ---: | ---: | ---: |",
        *(
            f"| {r.nodes_per_axis}² | {r.eigenpairs} | {r.paper:.5f} | {r.independent:.5f} "
            f"| **{r.nodal:.5f}** | {r.area_weighted:.5f} |"
            for r in rows
        ),
        "",
        "Relative L² difference between the HKS of the pulled-back metric (bilinear elements on a periodic grid)",
        f"and of the surface (linear triangles, {REFERENCE_SIZE}² vertices, {REFERENCE_PAIRS} eigenpairs), at the",
        "surface's vertices; coarser results are interpolated bilinearly.",
        "",
        "- *the paper*: as printed by Zobel, Reininghaus and Hotz, who do not state their norm or interpolation.",
        "- *independent*: the same method implemented with SciPy only, in the nodal norm.",
        "- *nodal*: √(Σ (h − r)² / Σ r²) over the vertices, with h from the metric and r from the surface.",
        "  Compare the column *nodal* with the columns *the paper* and *independent*.",
        "- *area-weighted*: the same norm with the area element √|T| as weight, which is an integral over the surface.",
        "",
        f"The surface's HKS was {origin}.",
    ]
    return "\n".join(lines) + "\n"
