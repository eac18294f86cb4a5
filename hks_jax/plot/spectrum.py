"""Spectra against Weyl's law."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.weyl import weyl_count
from hks_jax.plot.figure import SMALL


def spectrum(
    ax: Axes,
    pairs: Eigenpairs,
    domain: TensorField | SimplicialMesh | None = None,
    *,
    remainder: bool = False,
    unit: str = "",
    **kwargs: Any,
) -> list[Line2D]:
    """Draw the number N(λ) of eigenvalues up to λ, and Weyl's law for it.

    Args:
        ax: the axes to draw on.
        pairs: from `eigenpairs`; those not kept are left out.
        domain: the field or the mesh that the pairs are of, for the law's second term, that of the boundary; None: the
            law's first term alone.
        remainder: draw N(λ) less the law: without a trend, unless eigenvalues are missing (it falls) or the grid is too
            coarse for the last of them (likewise: the eigenvalues of finite elements are too large).
        unit: the unit of λ.
        **kwargs: passed to `Axes.plot` for N.

    Returns:
        The lines: N, the law with the boundary where `domain` is given, and the law's first term.

    Raises:
        ValueError: a domain that the pairs are not of.
    """
    values = np.asarray(pairs.eigenvalues, np.float64)[np.asarray(pairs.kept)]
    # Each step from its foot to its top.
    steps = np.repeat(values, 2)
    count = np.repeat(np.arange(values.size + 1.0), 2)[1:-1]
    fine = np.linspace(0, values[-1], 400)
    bulk = "area" if pairs.space.dimension == 2 else "volume"

    def level(x: np.ndarray) -> np.ndarray | float:
        return weyl_count(pairs, x, domain) if remainder else 0.0

    style = {"color": "#21918c", "linewidth": 1.2, "label": r"$N(\lambda)$", **kwargs}
    lines = ax.plot(steps, count - level(steps), **style)
    if domain is not None:
        law = weyl_count(pairs, fine, domain) - level(fine)
        lines += ax.plot(fine, law, color="black", linewidth=0.9, label="Weyl's law")
    law = weyl_count(pairs, fine) - level(fine)
    lines += ax.plot(fine, law, "--", color="0.5", linewidth=0.9, label=f"Weyl's law, {bulk} alone")
    ax.set_xlim(0, 1.02 * fine[-1])
    ax.set_xlabel(rf"$\lambda${' in ' * bool(unit)}{unit}")
    ax.set_ylabel(r"$N(\lambda)$ less Weyl's law" if remainder else r"$N(\lambda)$")
    ax.ticklabel_format(useMathText=True)
    ax.tick_params(labelsize=SMALL)
    ax.grid(visible=True, linewidth=0.4, alpha=0.5)
    ax.legend(fontsize=SMALL, frameon=False)
    return lines
