"""Which method reaches given times, with which settings, for the least work."""

import math
from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.fem.pencil import AnyPencil, from_lower_bound
from hks_jax.fem.space import GridSpace
from hks_jax.linear.dissection import dissect
from hks_jax.linear.selected_inversion import inversion_cost
from hks_jax.spectrum_free.colours import Colouring, choose, least_mass_degree, rounding_error
from hks_jax.spectrum_free.rational import pole_pairs
from hks_jax.spectrum_free.spectrum_bounds import Bounds, bounds, mass_bound
from hks_jax.traced import is_traced

Method = Literal["auto", "colouring", "selected-inversion"] | Colouring

_LARGE = 4096
"""Up to so many nodes a vector for each of them is no trouble."""
_COLUMNS = 16
_FASTER = 3.0
"""How much faster dense products are than stencils, per operation."""
_MEMORY = 8e9
"""Bytes from which on selected inversion is not chosen automatically."""
_FILL = {2: 150, 3: 40}
"""How many times n^(2 − 2/d), the entries of a separator's block, the factors of n nodes in d dimensions have at least
where n is large."""


def require_grid(pencil: AnyPencil) -> None:
    """Raise TypeError where colouring is asked for on a mesh."""
    if not isinstance(pencil.space, GridSpace):
        raise TypeError(
            "domain: got a mesh, and colouring is for grids. Use hks_spectrum_free with "
            'method="selected-inversion" (or "auto"), or eigenpairs'
        )


def choose_method(pencil: AnyPencil, times: Float[Array, " m"], method: Method, tolerance: float) -> Colouring | None:
    """Return the colouring to be used, or None for selected inversion."""
    if not isinstance(method, Colouring) and method not in ("auto", "colouring", "selected-inversion"):
        raise ValueError(
            f'method: got {method!r}; expected "auto", "colouring", "selected-inversion" or what `colouring` returns'
        )
    if not all(part.bounded for part in pencil.parts):
        raise ValueError(
            "domain: nothing is known of the null space of its stiffness, which may be indefinite, and the exponential "
            "is approximated for K ⪰ 0. Give `sparse_pencil` the null vectors, or use eigenpairs"
        )
    if method == "selected-inversion" or (method == "auto" and pencil.space.dimension is None):
        return None
    if method == "auto":
        settings = least_work(pencil, times, tolerance)
    else:
        require_grid(pencil)
        if isinstance(method, Colouring):
            axes, dimension = len(method.spacing), pencil.space.dimension
            if axes != dimension:
                raise ValueError(f"method: got a Colouring for {axes} axes; the grid has {dimension}")
            return method
        settings = plan(pencil, times, tolerance)
    if settings is not None:
        require_fewer_vectors(settings, pencil)
    return settings


def least_work(pencil: AnyPencil, times: Float[Array, " m"], tolerance: float) -> Colouring | None:
    """Return the colouring if it takes less work than selected inversion, or None.

    Raises:
        Unattainable: where selected inversion would take too much memory, a mesh, or a tolerance below what rounding
            leaves.
        ValueError: traced values there.
    """
    of_inversion = work(None, pencil, times)
    affordable = math.isfinite(of_inversion)
    if not isinstance(pencil.space, GridSpace):
        if not affordable:
            raise Unattainable(
                f"domain: got a mesh of {pencil.space.n_dof} free vertices, for which selected inversion takes more "
                f"than {_MEMORY / 1e9:g} GB. Use eigenpairs; or, with enough memory, "
                'hks_spectrum_free(…, method="selected-inversion")'
            )
        return None
    if affordable and is_traced(jax.lax.stop_gradient((pencil, times))):
        return None
    try:
        settings = plan(pencil, times, tolerance)
    except Unattainable:
        if affordable:
            return None
        raise
    return None if of_inversion < work(settings, pencil, times) else settings


class Unattainable(ValueError):
    """What no method reaches: a tolerance below what rounding leaves, or a mesh beyond the memory."""


def plan(
    pencil: AnyPencil, times: Float[Array, " m"], tolerance: float, memory: float = 2e9, slack: float = 1.0
) -> Colouring:
    """Choose a colouring that serves all parts of a pencil.

    Raises:
        Unattainable: a tolerance below what rounding leaves.
        ValueError: traced values.
    """
    pencil, times = jax.lax.stop_gradient((from_lower_bound(pencil)[0], times))
    if is_traced((pencil, times)):
        raise ValueError(
            "method: spacing and degree depend on values, which are traced here (jax.jit, vmap). Choose them "
            "beforehand, with `settings = hks_jax.colouring(field, times)`, and pass method=settings"
        )
    space, concrete = pencil.space, np.asarray(times, np.float64)
    assert isinstance(space, GridSpace)
    low = jnp.min(jnp.stack([mass_bound(part) for part in pencil.parts]))
    mass_degree, eps = 1, float(jnp.finfo(times.dtype).eps)
    while True:
        limits = _widest([bounds(part, low, mass_degree) for part in pencil.parts], slack)
        rounding = max(rounding_error(t, limits, space.dimension, eps) for t in concrete)
        if rounding > 0.8 * tolerance:
            raise Unattainable(
                f"tolerance: got {tolerance:g}; in {times.dtype} rounding alone leaves about {rounding:.1e} at "
                f"t = {concrete.max():.4g}. Use a tolerance from {1.25 * rounding:.1e}, float64, or smaller times"
                + (' (or method="selected-inversion")' if math.isfinite(work(None, pencil, times)) else "")
            )
        needed = least_mass_degree(concrete, limits, space.dimension, (tolerance - rounding) / 2)
        if needed <= mass_degree:
            break
        mass_degree = needed  # the top depends on it a little
    # Five blocks of vectors at once in the value, eight in its derivatives.
    columns = int(min(_COLUMNS, max(1, memory // (8 * space.free.size * times.dtype.itemsize))))
    return choose(concrete, limits, space, tolerance, mass_degree, columns, eps)


def _widest(limits: Sequence[Bounds], slack: float) -> Bounds:
    """Return bounds that hold for all parts, on the host."""
    stacked = Bounds(*(np.stack(values).astype(float) for values in zip(*limits, strict=True)))
    top, reach, across = (slack * x.max(axis=0) for x in (stacked.top, stacked.reach, stacked.across))
    return Bounds(top, stacked.low.min(), reach, across, stacked.least_mass.min(), stacked.greatest_mass.max())


def work(settings: Colouring | None, pencil: AnyPencil, times: Float[Array, " m"]) -> float:
    """Estimate what a method takes, in floating-point operations of stencils.

    Infinite for selected inversion where that would take more memory than is chosen automatically.
    """
    space = pencil.space
    if settings is None:
        size, d = 2 * times.dtype.itemsize, space.dimension
        if _FILL[d] * float(space.n_dof) ** (2 - 2 / d) * size > _MEMORY:  # no need to dissect
            return math.inf
        costs = [inversion_cost(dissect(part.pattern)) for part in pencil.parts]
        if max(cost.entries for cost in costs) * size > _MEMORY:
            return math.inf
        return times.size * pole_pairs(times.dtype) * sum(cost.operations for cost in costs) / _FASTER
    assert isinstance(space, GridSpace)
    products = (settings.degree + 1) * settings.mass_degree
    return 2.0 * len(pencil.parts) * settings.n_vectors(space) * products * 3**space.dimension * space.free.size


def require_fewer_vectors(settings: Colouring, pencil: AnyPencil) -> None:
    """Raise ValueError where colouring degenerates into a vector for every node of a large grid."""
    space = pencil.space
    assert isinstance(space, GridSpace)
    vectors = settings.n_vectors(space)
    if space.n_dof > _LARGE and 2 * vectors > space.n_dof:
        affordable = math.isfinite(work(None, pencil, jnp.ones(1, pencil.parts[0].stiffness.dtype)))
        other = 'method="selected-inversion", ' if affordable else ""
        raise ValueError(
            f"times: at the largest of them heat spreads so far that sources must be {settings.spacing} nodes apart: "
            f"{vectors} vectors for {space.n_dof} unknowns. Use {other}eigenpairs, smaller times, or a larger tolerance"
        )
