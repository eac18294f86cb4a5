"""What limits eigenpairs, in sentences."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Float


@runtime_checkable
class Solved(Protocol):
    """Eigenpairs, and what is known of their quality; concrete."""

    @property
    def eigenvalues(self) -> Float[Array, " k"]:
        """Ascending; NaN where none was found."""

    @property
    def residuals(self) -> Float[Array, " k"]:
        """Relative."""

    @property
    def converged(self) -> Bool[Array, " k"]:
        """Whether they are small enough."""

    @property
    def unconfirmed(self) -> Bool[Array, ""]:
        """Whether the certificate ends before the last eigenvalue."""

    @property
    def complete_below(self) -> Float[Array, ""]:
        """Where it ends."""

    @property
    def solver_name(self) -> str:
        """The method."""


def messages(pairs: Solved, kept: int, cut: int, other: str) -> list[str]:
    """Say what limits the pairs; empty if nothing does.

    Args:
        pairs: the pairs.
        kept: how many of them, the first, are the truncated spectrum.
        cut: how many of the last that are kept belong to a multiple eigenvalue that goes on beyond them; 0 if none.
        other: what to use if not fewer pairs.
    """
    values, bad = np.asarray(pairs.eigenvalues), ~np.asarray(pairs.converged)
    sentences, last = [], values[kept - 1]
    if bad.any():
        missing, worst = int(np.isnan(values).sum()), np.nanmax(np.asarray(pairs.residuals)[bad], initial=0.0)
        sentences.append(
            f"{int(bad.sum())} of {values.size} eigenpairs did not converge ({missing} of them not found, worst "
            f"relative residual of the others {worst:.1e}) with the {pairs.solver_name} solver. "
            f"Use float64, fewer pairs, or {other}"
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
