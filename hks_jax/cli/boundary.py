"""Which boundary a domain has where the user chooses none; and which conditions have no effect."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool

from hks_jax.domain.components import active_elements, element_nodes, rim_nodes
from hks_jax.fem.boundary import BoundarySpec, doubled_problems, normalise_boundary

NATURAL, MEAN = "neumann", "mean"


def default_boundary(inside: Bool[np.ndarray, "*shape"]) -> tuple[str, str]:
    """Return the boundary that suits a domain, and why: the mean where it has a mask, whose rim else covers all.

    Args:
        inside: the nodes of the domain.
    """
    if inside.all():
        return NATURAL, "the domain has no mask"
    every_axis = (False,) * inside.ndim
    elements = active_elements(inside, every_axis)
    free = element_nodes(elements, every_axis) & ~rim_nodes(elements, every_axis)
    if not free[(slice(1, -1),) * inside.ndim].any():  # the Dirichlet half leaves the grid's sides out, too
        return NATURAL, "the mask is so thin that all of it is rim, and the mean needs voxels off it"
    return MEAN, f"the domain has a mask; --boundary {NATURAL} leaves its rim natural"


def n_problems(boundary: BoundarySpec, dimension: int) -> int:
    """Return how many eigenproblems share the pairs that are computed: two under the mean."""
    return len(doubled_problems(normalise_boundary(boundary, dimension)))


def recorded_boundary(settings: Mapping[str, Any]) -> BoundarySpec | None:
    """Return the boundary that settings read from JSON name, if they do: its lists are tuples."""

    def tuples(value: Any) -> Any:
        return tuple(map(tuples, value)) if isinstance(value, list) else value

    boundary: BoundarySpec | None = tuples(settings.get("boundary"))
    return boundary


def unreached_sides(inside: Bool[np.ndarray, "*shape"], boundary: BoundarySpec) -> list[str]:
    """Say which conditions have no effect, because the mask does not reach the side of the grid that they are for."""
    warned = []
    *axes, rim = normalise_boundary(boundary, inside.ndim)
    on_rim = {
        "neumann": 'the mask\'s own rim is natural (Neumann); "dirichlet-rim" and "mean" take it in',
        "dirichlet": 'the mask\'s own rim has "dirichlet"',
        "mean": 'the mask\'s own rim has "mean"',
    }[rim[0]]
    for axis, (name, conditions) in enumerate(zip("xyz", axes, strict=False)):
        for index, condition in zip((0, -1), conditions, strict=True):
            if condition not in ("neumann", rim[0]) and not np.take(inside, index, axis).any():
                warned.append(
                    f'boundary: "{condition}" has no effect at the {"low" if index == 0 else "high"} side of {name}, '
                    f"which the mask does not reach; {on_rim}"
                )
    return warned
