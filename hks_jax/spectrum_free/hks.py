"""Heat kernel signatures without eigenpairs."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.assembly import MassKind, assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.pencil import MirrorPencil, Pencil
from hks_jax.fem.space import GridSpace
from hks_jax.signatures.times import checked_times
from hks_jax.spectrum_free.chebyshev import coloured_diagonal, heat_coefficients
from hks_jax.spectrum_free.colours import Colouring, choose, least_mass_degree
from hks_jax.spectrum_free.heat_operator import heat_operator
from hks_jax.spectrum_free.selected_inversion import inversion_flops, selected_inversion
from hks_jax.spectrum_free.spectrum_bounds import Bounds, bounds, mass_bound
from hks_jax.traced import is_traced

Method = Literal["auto", "colouring", "selected-inversion"] | Colouring

_LARGE = 4096
"""Up to so many nodes a vector for each of them is no trouble."""
_COLUMNS = 16
_FASTER = 5.0
"""How much faster dense products are than stencils, per operation."""


def hks_spectrum_free(
    domain: TensorField | Pencil | MirrorPencil,
    times: Any,
    boundary: BoundarySpec = "neumann",
    mass: MassKind = "consistent",
    method: Method = "auto",
    tolerance: float = 1e-4,
) -> Float[Array, "n_times *shape"]:
    """Compute the heat kernel signature without eigenpairs: the diagonal of exp(−tM⁻¹K)M⁻¹.

    What all eigenpairs of the same discretisation would give, at any t. The cost grows with t/h², where that of
    eigenpairs falls: a method for small times. docs/spectrum-free.md derives the bounds.

    Args:
        domain: a tensor field on a grid, or a pencil of one from `assemble`.
        times: (n_times,) positive, in (metric length)².
        boundary: see `assemble`; belongs to the pencil if one is given.
        mass: likewise. ``"lumped"`` is 50 to 100 times as fast with colouring.
        method: ``"colouring"``: Chebyshev polynomials on sums of point sources that are far enough apart, 2D and 3D,
            all times from the same vectors. ``"selected-inversion"`` (2D): rational approximation and block-wise
            inversion, to about 1e-10 at any time, one time after another. ``"auto"``: whichever takes less work. Or a
            `Colouring` that `colouring` made beforehand, which is what colouring needs under `jax.jit`.
        tolerance: bounds the error of colouring at every node, relative to the smaller of (4πt)^(−d/2) and the largest
            value that a node can have. Selected inversion does not use it.

    Returns:
        (n_times, *shape) in 1/(metric length)^d; NaN outside the mask, 0 at Dirichlet nodes. NaN throughout where a
        given `Colouring` was made for a smaller spectrum or shorter times.

    Raises:
        ValueError: bad times, tolerance or method; a time so large that colouring would take about as many vectors as
            there are nodes; no `Colouring` under `jax.jit`.
        TypeError: a surface mesh.
    """
    pencil = grid_pencil(domain, boundary, mass)
    times = checked_times("times", times, pencil.parts[0].stiffness.dtype)
    settings = choose_method(pencil, times, method, tolerance)
    values = [_diagonal(part, times, settings, checked=isinstance(method, Colouring)) for part in pencil.parts]
    # On a reflected domain, heat that starts at a node is even and odd by halves.
    return jnp.mean(jnp.stack(values), axis=0)


def colouring(
    domain: TensorField | Pencil | MirrorPencil,
    times: Any,
    boundary: BoundarySpec = "neumann",
    mass: MassKind = "consistent",
    tolerance: float = 1e-4,
    memory: float = 2e9,
    slack: float = 1.0,
) -> Colouring:
    """Choose spacing and degree for `hks_spectrum_free` from the error bound; needs concrete values.

    Args:
        domain: as there.
        times: as there.
        boundary: as there.
        mass: as there.
        tolerance: as there.
        memory: bytes that the working vectors may take; fewer vectors at once where it is short.
        slack: ≥ 1: be prepared for a spectrum and a reach so many times as large, as fields have that are still to
            come (in a fit, say).

    Returns:
        The settings, static, with the error bound at each time.

    Raises:
        ValueError: bad arguments, values that are traced, or about as many vectors as nodes.
    """
    pencil = grid_pencil(domain, boundary, mass)
    times = checked_times("times", times, pencil.parts[0].stiffness.dtype)
    if not 1 <= slack < math.inf:
        raise ValueError(f"slack: got {slack}; expected a factor of at least 1")
    settings = plan(pencil, times, tolerance, memory, slack)
    require_fewer_vectors(settings, pencil)
    return settings


def grid_pencil(
    domain: TensorField | Pencil | MirrorPencil, boundary: BoundarySpec, mass: MassKind
) -> Pencil | MirrorPencil:
    """Return the pencil of a domain that must be a grid."""
    if isinstance(domain, Pencil | MirrorPencil):
        if boundary != "neumann" or mass != "consistent":
            raise ValueError("boundary, mass: a pencil has them already; give them to `assemble` instead")
        pencil = domain
    elif isinstance(domain, TensorField):
        pencil = assemble(domain, boundary, mass)
    else:
        raise TypeError(f"domain: got {type(domain).__name__}; expected a TensorField on a grid, or a pencil of one")
    if not isinstance(pencil.space, GridSpace):
        raise TypeError("domain: got a pencil of a surface mesh; expected one of a grid. Use eigenpairs on meshes")
    return pencil


def choose_method(
    pencil: Pencil | MirrorPencil, times: Float[Array, " m"], method: Method, tolerance: float
) -> Colouring | None:
    """Return the colouring to be used, or None for selected inversion."""
    space = pencil.space
    assert isinstance(space, GridSpace)
    if isinstance(method, Colouring):
        if len(method.spacing) != space.dimension:
            raise ValueError(f"method: got a Colouring for {len(method.spacing)} axes; the grid has {space.dimension}")
        return method
    if method not in ("auto", "colouring", "selected-inversion"):
        raise ValueError(
            f'method: got {method!r}; expected "auto", "colouring", "selected-inversion" or what `colouring` returns'
        )
    if method == "selected-inversion" and space.dimension != 2:
        raise ValueError('method: "selected-inversion" is for 2D grids; use "colouring", or eigenpairs for large times')
    traced = is_traced(jax.lax.stop_gradient((pencil, times)))
    if method == "selected-inversion" or (method == "auto" and traced and space.dimension == 2):
        return None
    settings = plan(pencil, times, tolerance)
    if method == "auto" and space.dimension == 2 and work(None, pencil, times) < work(settings, pencil, times):
        return None
    require_fewer_vectors(settings, pencil)
    return settings


def pole_pairs(dtype: Any) -> int:
    """Return how many pairs of poles approximate the exponential to rounding."""
    return 7 if jnp.finfo(dtype).bits > 32 else 4


def plan(
    pencil: Pencil | MirrorPencil,
    times: Float[Array, " m"],
    tolerance: float,
    memory: float = 2e9,
    slack: float = 1.0,
) -> Colouring:
    """Choose a colouring that serves all parts of a pencil."""
    if not isinstance(tolerance, int | float) or not 0 < tolerance < 1:
        raise ValueError(f"tolerance: got {tolerance!r}; expected a number between 0 and 1")
    pencil, times = jax.lax.stop_gradient((pencil, times))
    if is_traced((pencil, times)):
        raise ValueError(
            "method: spacing and degree depend on values, which are traced here (jax.jit, vmap). Choose them "
            "beforehand, with `settings = hks_jax.colouring(field, times)`, and pass method=settings"
        )
    space, concrete = pencil.space, np.asarray(times, np.float64)
    assert isinstance(space, GridSpace)
    low = jnp.min(jnp.stack([mass_bound(part) for part in pencil.parts]))
    mass_degree = 1
    while True:
        limits = _widest([bounds(part, low, mass_degree) for part in pencil.parts], slack)
        needed = least_mass_degree(concrete, limits, space.dimension, tolerance / 2)
        if needed <= mass_degree:
            break
        mass_degree = needed  # the top depends on it a little
    # Five blocks of vectors at once in the value, eight in its derivatives.
    columns = int(min(_COLUMNS, max(1, memory // (8 * space.free.size * times.dtype.itemsize))))
    return choose(concrete, limits, space, tolerance, mass_degree, columns)


def _widest(limits: Sequence[Bounds], slack: float) -> Bounds:
    """Return bounds that hold for all parts."""
    stacked = Bounds(*(jnp.stack(values) for values in zip(*limits, strict=True)))
    return Bounds(
        slack * jnp.max(stacked.top),
        jnp.min(stacked.low),
        slack * jnp.max(stacked.reach, axis=0),
        jnp.min(stacked.least_mass),
        jnp.max(stacked.greatest_mass),
    )


def work(settings: Colouring | None, pencil: Pencil | MirrorPencil, times: Float[Array, " m"]) -> float:
    """Estimate what a method takes, in floating-point operations of stencils."""
    space = pencil.space
    assert isinstance(space, GridSpace)
    if settings is None:
        inversions = len(pencil.parts) * times.size * pole_pairs(times.dtype)
        return inversions * inversion_flops(space) / _FASTER
    products = (settings.degree + 1) * settings.mass_degree
    return 2.0 * len(pencil.parts) * settings.n_vectors(space) * products * 3**space.dimension * space.free.size


def require_fewer_vectors(settings: Colouring, pencil: Pencil | MirrorPencil) -> None:
    """Raise ValueError where colouring degenerates into a vector for every node of a large grid."""
    space = pencil.space
    assert isinstance(space, GridSpace)
    vectors = settings.n_vectors(space)
    if space.n_dof > _LARGE and 2 * vectors > space.n_dof:
        other = 'method="selected-inversion", ' if space.dimension == 2 else ""
        raise ValueError(
            f"times: at the largest of them heat spreads so far that sources must be {settings.spacing} nodes apart: "
            f"{vectors} vectors for {space.n_dof} unknowns. Use {other}eigenpairs, smaller times, or a larger tolerance"
        )


def _diagonal(
    part: Pencil, times: Float[Array, " m"], settings: Colouring | None, checked: bool
) -> Float[Array, "m *shape"]:
    space = part.space
    assert isinstance(space, GridSpace)
    if settings is None:
        operator = heat_operator(part)
        values = selected_inversion(operator.stiffness, operator.mass, times, space, pole_pairs(times.dtype))
    else:
        values = _by_colours(settings, part, times)
        if checked:
            # A factor, so that the derivatives are NaN too.
            fits = _fits(settings, *jax.lax.stop_gradient((part, times)))
            values = values * jnp.where(fits, 1, jnp.nan)
    return jnp.where(space.domain, jnp.where(space.free, values, 0), jnp.nan)


@partial(jax.jit, static_argnums=0)
def _by_colours(settings: Colouring, part: Pencil, times: Float[Array, " m"]) -> Float[Array, "m *shape"]:
    assert isinstance(part.space, GridSpace)
    operator = heat_operator(part, settings.low, settings.mass_degree)
    coefficients = heat_coefficients(times, settings.top, settings.degree)
    return coloured_diagonal(settings.top, settings.columns, settings.colours(part.space), operator, coefficients)


def _fits(settings: Colouring, part: Pencil, times: Float[Array, " m"]) -> Array:
    """Tell whether given settings were made for this pencil and these times, or larger ones."""
    low = jnp.asarray(settings.low, times.dtype)
    found, rounding = bounds(part, low, settings.mass_degree), 1.001
    fits = found.top <= rounding * settings.top
    fits &= jnp.all(found.reach * jnp.max(times) <= rounding * jnp.asarray(settings.reach, times.dtype))
    return fits & (mass_bound(part) * rounding >= low)
