"""A check of the paper's remark that edge lengths in the metric violate the triangle inequality.

Discrete exterior calculus needs the triangle inequality. Diagonals cut the cells of a grid into triangles.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from figures import INDICES
from jaxtyping import Float, Int

from hks_jax.domain.components import active_elements
from hks_jax.domain.examples import bumpy_torus_field, degenerate_point_field, figure3_fields, figure4_fields, phantom
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_checks import MetricChoice
from hks_jax.domain.tensor_field import TensorField

QUICK, FULL = ((51,), (50, 100)), ((201,), (50, 100, 200, 400))  # nodes per axis of the figures' fields and torus
COARSE = 11

Tensors = Float[np.ndarray, "n 2 2"]
Vectors = Float[np.ndarray, "n 2"]


def _norm(tensors: Tensors, edges: Vectors) -> Float[np.ndarray, " n"]:
    return np.sqrt(np.einsum("ni,nij,nj->n", edges, tensors, edges))


def _integrated(a: Tensors, b: Tensors, edges: Vectors) -> Float[np.ndarray, " n"]:
    nodes, weights = np.polynomial.legendre.leggauss(8)
    s = (1 + nodes) / 2
    return np.sum([w / 2 * _norm((1 - r) * a + r * b, edges) for r, w in zip(s, weights, strict=True)], axis=0)


LENGTHS: dict[str, Callable[[Tensors, Tensors, Vectors], Float[np.ndarray, " n"]]] = {
    "midpoint": lambda a, b, edges: _norm((a + b) / 2, edges),
    "mean of the ends": lambda a, b, edges: (_norm(a, edges) + _norm(b, edges)) / 2,
    "integrated": _integrated,
}
"""Rules for the length of an edge from the tensors at its two ends; tensors in between are interpolated linearly."""


class Count(NamedTuple):
    """The violations of the triangle inequality by the edge lengths of a triangulated grid."""

    triangles: int  # the number of triangles
    violating: int  # the triangles with a side longer than the sum of the other two
    vertices: int  # the number of vertices
    no_area: int  # the vertices with a circumcentric dual cell of area ≤ 0; violating triangles do not contribute area


def count(field: TensorField, rule: str, periodic: bool = False) -> Count:
    """Triangulate a field's grid, measure its edges, and count triangles that violate the triangle inequality."""
    grid, (faces, places) = field.grid, _triangles(field.grid, periodic)
    tensors = np.asarray(field.tensors, dtype=np.float64).reshape(-1, 2, 2)
    sides = []
    for i in range(3):  # opposite to corner i
        j, k = (i + 1) % 3, (i + 2) % 3
        sides.append(LENGTHS[rule](tensors[faces[:, j]], tensors[faces[:, k]], places[:, k] - places[:, j]))
    lengths = np.stack(sides, axis=1)
    violating = 2 * lengths.max(axis=1) > lengths.sum(axis=1)
    squared, half = lengths[~violating] ** 2, lengths[~violating].sum(axis=1, keepdims=True) / 2
    area = np.sqrt(half[:, 0] * np.prod(half - lengths[~violating], axis=1))
    # A triangle with the sides a, b, c opposite to the corners A, B, C contributes the area (b² cot B + c² cot C)/8 to
    # the dual cell of the corner A, where cot A = (b² + c² − a²)/(4·area).
    weighted = squared * (squared.sum(axis=1, keepdims=True) - 2 * squared) / (4 * area[:, None])
    cells = np.zeros(len(tensors))
    np.add.at(cells, faces[~violating], (weighted.sum(axis=1, keepdims=True) - weighted) / 8)
    inside = grid.inside.ravel()
    return Count(len(faces), int(violating.sum()), int(inside.sum()), int((cells[inside] <= 0).sum()))


def _triangles(grid: Grid, periodic: bool) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 3 2"]]:
    """Return the nodes and positions of the corners of two triangles for each cell whose nodes are all inside."""
    cells = np.argwhere(active_elements(grid.inside, (periodic,) * 2))
    steps = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    corners = cells[:, None, None] + steps
    nodes = np.ravel_multi_index(tuple(np.moveaxis(corners % grid.shape, -1, 0)), grid.shape)
    return nodes.reshape(-1, 3), (corners * np.asarray(grid.spacing)).reshape(-1, 3, 2)


def fields(full: bool) -> list[tuple[str, TensorField, bool]]:
    """Return the paper's fields and a phantom of a brain, with their names and periodicity."""
    of_figures, of_torus = FULL if full else QUICK
    cases: list[tuple[str, TensorField, bool]] = []
    for n in (COARSE, *of_figures):
        cases += [(f"Fig. 3, {name}, {n}²", field, False) for name, field in figure3_fields(n).items()]
        cases += [(f"Fig. 4, {name}, {n}²", field, False) for name, field in figure4_fields(n).items()]
        cases += [(f"Fig. 5, index {i}, {n}²", degenerate_point_field(float(i), n), False) for i in INDICES]
    cases += [(f"bumpy torus, {n}²", bumpy_torus_field(n), True) for n in of_torus]
    tensors, mask, spacing = phantom()
    metrics: dict[str, MetricChoice] = {"T = D": "tensor", "g = D⁻¹": "inverse"}
    for name, metric in metrics.items():
        field = TensorField.from_diffusion(Grid(mask.shape, spacing, mask=mask, components="largest"), tensors, metric)
        cases.append((f"phantom of a brain, {name}", field, False))
    return cases


def make(full: bool, echo: Callable[[str], None]) -> dict[str, str]:
    """Return a dictionary from the file name to the table of violations in Markdown."""
    echo("edge lengths in the metric, on the paper's fields")
    lines = [
        "# Edge lengths in the metric, and the triangle inequality",
        "",
        "For each rule of edge lengths, the table counts the triangles that violate the triangle inequality.",
        "The last column counts the vertices whose circumcentric dual cell has no positive area for midpoint lengths.",
        "",
        f"| field | triangles | {' | '.join(LENGTHS)} | vertices | without area |",
        "| --- |" + " ---: |" * (len(LENGTHS) + 3),
    ]
    for name, field, periodic in fields(full):
        counts = [count(field, rule, periodic) for rule in LENGTHS]
        wrong = " | ".join(str(c.violating) for c in counts)
        lines.append(f"| {name} | {counts[0].triangles} | {wrong} | {counts[0].vertices} | {counts[0].no_area} |")
    return {"triangles.md": "\n".join(lines) + "\n"}
