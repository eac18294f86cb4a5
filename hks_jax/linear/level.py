"""A level of an elimination tree: fronts of one size, which are independent of each other."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int


class Level(NamedTuple):
    """The fronts of one level: each eliminates its own s nodes, and is coupled to r boundary nodes eliminated later.

    Where a front has fewer, indices are padded with the first number that is out of range.

    Attributes:
        own: (fronts, s) the degrees of freedom eliminated.
        boundary: (fronts, r) the places of the boundary nodes among the (fronts, s + r) nodes of the level above.
        children: (c, fronts, s + r) the places of the front's nodes among the (fronts, r) boundary nodes of the level
            below, as often as nodes have such places: in an elimination tree those of the first child, and those of
            the second. Empty for cells.
    """

    own: Int[np.ndarray, "fronts s"]
    boundary: Int[np.ndarray, "fronts r"]
    children: Int[np.ndarray, "c fronts s_plus_r"]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(fronts, s + r, s): that of the blocks which hold the columns of the own nodes."""
        fronts, s = self.own.shape
        return fronts, s + self.boundary.shape[1], s
