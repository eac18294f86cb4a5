"""Figure 4: constant eigenvalues, varying eigenvectors: the HKS sees how the integral lines bend."""

from collections.abc import Callable

from matplotlib.figure import Figure

from hks_jax import plot
from hks_jax.domain.examples import figure4_fields
from hks_jax.paper.signature import continued_signature

TIME = 0.01
STRIP = 0.28  # heat falls to exp(−STRIP²/t) = exp(−8); the circles' and spirals' centre is further out
QUICK, FULL = 47, 201  # nodes per axis


def make(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return the figure."""
    n = FULL if full else QUICK
    fields = figure4_fields(n)
    fig = plot.new_figure(3.6 * len(fields) + 0.6, 7.2)
    tops, bottoms = fig.subplots(2, len(fields), sharex=True, sharey=True)
    for top, bottom, (name, field) in zip(tops, bottoms, fields.items(), strict=True):
        echo(f"figure4: {name}, {n}² nodes")
        values = continued_signature(field, TIME, STRIP)
        plot.integral_lines(top, field, "minor", density=0.7, colors="tab:orange", linewidths=0.5)
        plot.integral_lines(top, field, "major", density=0.7, colors="black")
        plot.scalar_image(bottom, values, field.grid, least_range=0.1, interpolation="bilinear")
        plot.integral_lines(bottom, field, "major", density=0.7, colors="white", alpha=0.7)
        top.set_title(name)
        bottom.set_xlabel("$u_1$")
    tops[0].set_ylabel("major (black), minor lines\n$u_2$")
    bottoms[0].set_ylabel(rf"$4\pi t\,\mathrm{{HKS}}(t)$ at $t$ = {TIME:g}" + "\n$u_2$")
    fig.suptitle("Constant eigenvalues, turning eigenvectors: the first three fields are flat, the others are not")
    return fig
