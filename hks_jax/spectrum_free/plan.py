"""The choice between colouring and selected inversion, and the settings of colouring that take the least work."""

import math
from collections.abc import Sequence
from itertools import count
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.fem.pencil import AnyPencil, from_lower_bound
from hks_jax.fem.space import GridSpace
from hks_jax.linear.dissection import dissect
from hks_jax.linear.selected_inversion import inversion_cost
from hks_jax.spectrum_free.colouring import Colouring, choose, mass_error, rounding_error
from hks_jax.spectrum_free.rational import pole_pairs
from hks_jax.spectrum_free.spectrum_bounds import Bounds, bounds, mass_bound
from hks_jax.traced import is_traced

Method = Literal["auto", "colouring", "selected-inversion"] | Colouring

_LARGE = 4096
"""The number of free nodes up to which colouring may take as many vectors as there are nodes."""
_COLUMNS = 16
_FASTER = 3.0
"""The number of operations of dense products that take as long as one operation of a stencil."""
_MEMORY = 8e9
"""The memory in bytes above which selected inversion is not chosen automatically."""
_FILL = {2: 150, 3: 40}
"""Lower bounds, for each dimension d, on a factor's number of entries over n^(2 − 2/d), for large numbers n of rows."""


def require_grid(pencil: AnyPencil) -> None:
    """Raise TypeError if colouring is requested on a mesh."""
    if not isinstance(pencil.space, GridSpace):
        raise TypeError(
            "domain: got a mesh; expected a grid, which colouring needs. Use hks_spectrum_free with "
            'method="selected-inversion" (or "auto"), or eigenpairs'
        )


def choose_method(pencil: AnyPencil, times: Float[Array, " m"], method: Method, tolerance: float) -> Colouring | None:
    """Return the colouring to be used, or None for selected inversion."""
    if not isinstance(method, Colouring) and method not in ("auto", "colouring", "selected-inversion"):
        raise ValueError(
            f'method: got {method!r}; expected "auto", "colouring", "selected-inversion" or a result of `colouring`'
        )
    if not all(part.bounded for part in pencil.parts):
        raise ValueError(
            "domain: got a stiffness K that may be indefinite, since its null space is unknown; expected K ⪰ 0. Pass "
            "the null vectors to `sparse_pencil`, or use eigenpairs"
        )
    if method == "selected-inversion" or (method == "auto" and pencil.space.dimension is None):
        return None
    if method == "auto":
        return least_work(pencil, times, tolerance)
    require_grid(pencil)
    if not isinstance(method, Colouring):
        return plan(pencil, times, tolerance)
    axes, dimension = len(method.spacing), pencil.space.dimension
    if axes != dimension:
        raise ValueError(f"method: got a Colouring for {axes} axes; expected {dimension}, as for the grid")
    # On a longer axis, a spacing of n for one source on n nodes makes several sources, without a bound on the distance.
    if any(n > planned for n, planned in zip(pencil.space.node_shape, method.shape, strict=True)):
        raise ValueError(
            f"method: got a Colouring for a grid of the shape {method.shape}; expected one for at least the shape "
            f"{pencil.space.node_shape} of this grid. Make a new one by `colouring`"
        )
    return method


def least_work(pencil: AnyPencil, times: Float[Array, " m"], tolerance: float) -> Colouring | None:
    """Return the colouring if it takes less work than selected inversion, or None.

    `Unattainable` is raised if selected inversion needs too much memory, and the domain is a mesh or `plan` fails.
    """
    of_inversion = work(None, pencil, times)
    affordable = math.isfinite(of_inversion)
    if not isinstance(pencil.space, GridSpace):
        if not affordable:
            raise Unattainable(
                f"domain: got a mesh with {pencil.space.n_dof} free vertices, on which selected inversion needs more "
                f"than {_MEMORY / 1e9:g} GB. Use eigenpairs or, with enough memory, hks_spectrum_free(…, "
                'method="selected-inversion")'
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
    """The error raised if colouring is not possible, or if selected inversion on a mesh needs too much memory."""


def plan(
    pencil: AnyPencil, times: Float[Array, " m"], tolerance: float, memory: float = 2e9, slack: float = 1.0
) -> Colouring:
    """Return a colouring for all parts of a pencil; traced values raise ValueError.

    `Unattainable` is raised if the tolerance is below the rounding error, or if colouring needs about one vector for
    each node of a large grid.
    """
    pencil, times = jax.lax.stop_gradient((from_lower_bound(pencil)[0], times))
    if is_traced((pencil, times)):
        raise ValueError(
            "method: got traced values (jax.jit, vmap), on which spacing and degree depend. Choose them beforehand "
            "by `settings = hks_jax.colouring(field, times)`, and pass method=settings"
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
                f"tolerance: got {tolerance:g}, below the rounding error of about {rounding:.1e} in {times.dtype} at "
                f"t = {concrete.max():.4g}. Use a tolerance of at least {1.25 * rounding:.1e}, float64, or smaller "
                "times" + (' (or method="selected-inversion")' if math.isfinite(work(None, pencil, times)) else "")
            )
        errors = (max(mass_error(m, t, limits, space.dimension) for t in concrete) for m in count(mass_degree))
        more = next(i for i, error in enumerate(errors) if error <= (tolerance - rounding) / 2)
        if not more:
            break
        mass_degree += more  # the loop repeats, because `top` depends slightly on this degree
    # The signature needs five blocks of vectors in memory, and the derivatives of the signature need eight.
    columns = int(min(_COLUMNS, max(1, memory // (8 * space.free.size * times.dtype.itemsize))))
    settings = choose(concrete, limits, space, tolerance, mass_degree, columns, eps)
    vectors = settings.n_vectors(space)
    if space.n_dof > _LARGE and 2 * vectors > space.n_dof:
        other = 'method="selected-inversion", ' if math.isfinite(work(None, pencil, times)) else ""
        raise Unattainable(
            f"times: heat spreads so far at the largest time that sources must be {settings.spacing} nodes apart, "
            f"which takes {vectors} vectors for {space.n_dof} unknowns. Use {other}eigenpairs, smaller times or a "
            "larger tolerance"
        )
    return settings


def _widest(limits: Sequence[Bounds], slack: float) -> Bounds:
    stacked = Bounds(*(np.stack(values).astype(float) for values in zip(*limits, strict=True)))
    top, reach, across = (slack * x.max(axis=0) for x in (stacked.top, stacked.reach, stacked.across))
    return Bounds(top, stacked.low.min(), reach, across, stacked.least_mass.min(), stacked.greatest_mass.max())


def work(settings: Colouring | None, pencil: AnyPencil, times: Float[Array, " m"]) -> float:
    """Estimate a method's work in operations of stencils; infinite if an inversion needs more than `_MEMORY` bytes."""
    space = pencil.space
    if settings is None:
        size, d = 2 * times.dtype.itemsize, space.dimension
        if _FILL[d] * float(space.n_dof) ** (2 - 2 / d) * size > _MEMORY:  # known without a dissection
            return math.inf
        operations, entries = zip(*(inversion_cost(dissect(part.pattern)) for part in pencil.parts), strict=True)
        if max(entries) * size > _MEMORY:
            return math.inf
        return times.size * pole_pairs(times.dtype) * sum(operations) / _FASTER
    assert isinstance(space, GridSpace)
    products = (settings.degree + 1) * settings.mass_degree
    return 2.0 * len(pencil.parts) * settings.n_vectors(space) * products * 3**space.dimension * space.free.size
