"""What limits eigenpairs, in sentences."""

from typing import Any

import numpy as np


def messages(pairs: Any, kept: int, cut: int, other: str) -> list[str]:
    """Say what limits the pairs; empty if nothing does.

    Args:
        pairs: `Eigenpairs`, concrete.
        kept: how many of them, the first, are the truncated spectrum.
        cut: how many of the last that are kept belong to a multiple eigenvalue that goes on beyond them; 0 if none.
        other: what to use if not fewer pairs.
    """
    values, bad = np.asarray(pairs.eigenvalues), ~np.asarray(pairs.converged)
    sentences, last = [], values[kept - 1]
    if bad.any():
        missing, worst = int(np.isnan(values).sum()), np.nanmax(np.asarray(pairs.residuals)[bad], initial=0.0)
        found = f", worst relative residual of the others {worst:.1e}" if missing < bad.sum() else ""
        better = "" if values.dtype == np.float64 else "float64, "
        sentences.append(
            f"{int(bad.sum())} of {values.size} eigenpairs did not converge ({missing} of them not found{found}) with "
            f"the {pairs.solver_name} solver. Use {better}fewer pairs, or {other}"
        )
    if bool(pairs.unconfirmed):
        bound = float(pairs.complete_below)
        where = f"below {last:.6g}" if np.isnan(bound) else f"between {bound:.6g} and {last:.6g}"
        sentences.append(
            f"the {pairs.solver_name} solver could not confirm that it missed no eigenvalue {where}. Use slightly more "
            f"or fewer pairs, or {other}"
        )
    if cut:
        remedy = f"Take k = {kept - cut} or a larger one" if cut < kept else "Take a larger k"
        sentences.append(
            f"k = {kept} cuts a multiple eigenvalue: its last {cut} pair(s), at λ = {last:.6g}, have equals beyond k, "
            f"and which of them are among the k is arbitrary. {remedy}"
        )
    return sentences
