"""Figure 5: isolated degenerate points of index −2 … 3."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

from hks_jax import plot
from hks_jax.domain.examples import degenerate_point_field
from hks_jax.paper.signature import continued_signature

TIME = 0.25
STRIP = 0.7  # at least 1.6 in metric length: heat falls to exp(−1.6²/t) and less
QUICK, FULL = 41, 201
INDICES = tuple(Fraction(n, 2) for n in (-4, -3, -2, -1, 1, 2, 3, 4, 5, 6))


def figure5(output: Path, full: bool, echo: Callable[[str], None]) -> list[Path]:
    """Write ``figure5.png``."""
    n = FULL if full else QUICK
    fig = plot.new_figure(16, 6.6)
    panels = fig.subplots(2, 5, sharex=True, sharey=True)
    for ax, index in zip(panels.flat, INDICES, strict=True):
        field = degenerate_point_field(float(index), n)
        echo(f"figure5: index {index}, {n}² nodes")
        values = continued_signature(field, TIME, STRIP)
        plot.scalar_image(ax, values, field.grid, least_range=0.01, interpolation="bilinear")
        plot.integral_lines(ax, field, density=0.8, colors="white", linewidths=0.6, alpha=0.8)
        ax.set_title(f"index {str(index).replace('-', '−')}")
    fig.suptitle(f"Degenerate points: HKS at $t$ = {TIME:g} and lines of the major eigenvector")
    return [plot.save_figure(fig, output / "figure5.png")]
