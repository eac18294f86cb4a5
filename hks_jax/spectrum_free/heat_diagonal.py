"""Heat kernel signatures without eigenpairs."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.arrays import nan_is_meant, nan_outside
from hks_jax.checks import checked_times, require_number
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.assembly import MassKind
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.nodal import nodal_pencil
from hks_jax.fem.pencil import AnyPencil, Pencil, from_lower_bound
from hks_jax.fem.space import GridSpace
from hks_jax.fem.sparse_input import pencil_of
from hks_jax.linear.chebyshev import chebyshev_heat_coefficients
from hks_jax.linear.dissection import dissect
from hks_jax.spectrum_free.colours import Colouring
from hks_jax.spectrum_free.plan import Method, choose_method, plan, require_fewer_vectors, require_grid
from hks_jax.spectrum_free.probing import coloured_diagonal
from hks_jax.spectrum_free.rational import selected_inversion
from hks_jax.spectrum_free.spectrum_bounds import bounds, mass_bound


@nan_is_meant
def hks_spectrum_free(
    domain: TensorField | SimplicialMesh | AnyPencil,
    times: Any,
    boundary: BoundarySpec = "neumann",
    mass: MassKind = "consistent",
    method: Method = "auto",
    tolerance: float = 1e-4,
) -> Float[Array, "n_times *shape"]:
    """Compute the heat kernel signature without eigenpairs: the diagonal of exp(−tM⁻¹K)M⁻¹.

    What all eigenpairs of the same discretisation would give, at any t. The cost of colouring grows with t/h², where
    that of eigenpairs falls; that of selected inversion is the same at any t. docs/spectrum-free.md derives the bounds.

    Args:
        domain: a tensor field on a grid, a mesh of triangles or tetrahedra, or a pencil of one from `assemble`.
        times: (n_times,) positive, in (metric length)².
        boundary: see `assemble`; belongs to the pencil if one is given.
        mass: likewise. ``"lumped"`` is 50 to 100 times as fast with colouring.
        method: ``"colouring"`` (grids): Chebyshev polynomials on sums of point sources that are far enough apart, all
            times from the same vectors. ``"selected-inversion"``: rational approximation and selected inversion, to
            about 1e-10 at any time, one time after another; O(n^1.5) operations a time for n nodes in 2D, O(n²) in 3D,
            with the memory of factors in complex numbers. ``"auto"``: whichever takes less work. Or a `Colouring` that
            `colouring` made beforehand, which is what colouring needs under `jax.jit`.
        tolerance: what the error of colouring stays below at every node, relative to the smaller of (4πt)^(−d/2) and
            the largest value that a node can have (`Colouring.error` says how far that is proven); of a potential times
            exp(−vt), v its least value. Selected inversion does not use it.

    Returns:
        (n_times, *shape) in 1/(metric length)^d; NaN outside the mask, 0 at Dirichlet nodes. NaN throughout where a
        given `Colouring` was made for a smaller spectrum or shorter times.

    Raises:
        ValueError: bad times, tolerance or method; a tolerance below what rounding leaves in the dtype (``"auto"`` then
            takes selected inversion where memory allows); a time so large that colouring would take about as many
            vectors as there are nodes; a mesh on which ``"auto"`` would take more than 8 GB; no `Colouring` under
            `jax.jit`.
        TypeError: colouring on a mesh.
    """
    pencil, origin = from_lower_bound(_read_as_unknowns(pencil_of(domain, boundary, mass)))
    times = checked_times(times, pencil.parts[0].stiffness.dtype)
    require_number("tolerance", tolerance, 1)
    settings = choose_method(pencil, times, method, tolerance)
    scale, given = jnp.exp(-origin * times), isinstance(method, Colouring)
    values = [_diagonal(part, times, settings, scale, checked=given) for part in pencil.parts]
    # On a doubled domain, heat that starts at a node is even and odd by halves.
    return jnp.mean(jnp.stack(values), axis=0)


def colouring(
    domain: TensorField | AnyPencil,
    times: Any,
    boundary: BoundarySpec = "neumann",
    mass: MassKind = "consistent",
    tolerance: float = 1e-4,
    memory: float = 2e9,
    slack: float = 1.0,
) -> Colouring:
    """Choose spacing and degree for `hks_spectrum_free`, whose arguments these are, from the error bound.

    Needs concrete values.

    Args:
        memory: bytes that the working vectors may take; fewer vectors at once where it is short.
        slack: ≥ 1: be prepared for a spectrum and a reach so many times as large, as fields have that are still to
            come (in a fit, say).

    Returns:
        The settings, static, with the error bound at each time.

    Raises:
        ValueError: bad arguments, a tolerance below what rounding leaves in the dtype, values that are traced, or
            about as many vectors as nodes.
        TypeError: a mesh.
    """
    pencil = _read_as_unknowns(pencil_of(domain, boundary, mass))
    require_grid(pencil)
    times = checked_times(times, pencil.parts[0].stiffness.dtype)
    require_number("tolerance", tolerance, 1)
    require_number("memory", memory)
    require_number("slack", slack, above=1, inclusive=True)
    settings = plan(pencil, times, tolerance, memory, slack)
    require_fewer_vectors(settings, pencil)
    return settings


def _read_as_unknowns(pencil: AnyPencil) -> AnyPencil:
    if any(part.row_sums is not None for part in pencil.parts):
        raise ValueError(
            'domain: got a pencil of the quadrature "cancelling", from whose unknowns values are read that this method '
            'does not compute; expected "gauss". Or compute eigenpairs, and the signature from them'
        )
    return pencil


def _diagonal(
    part: Pencil, times: Float[Array, " m"], settings: Colouring | None, scale: Float[Array, " m"], checked: bool
) -> Float[Array, "m *shape"]:
    # Scales come before NaN outside, which would reach their derivatives as 0·NaN.
    space = part.space
    if settings is None:
        return space.extend(
            scale[:, None] * selected_inversion(part.stiffness, part.mass, times, dissect(part.pattern))
        )
    values = scale.reshape(-1, *[1] * len(space.node_shape)) * _by_colours(settings, part, times)
    if checked:
        # A factor, so that the derivatives are NaN too.
        fits = _fits(settings, *jax.lax.stop_gradient((part, times)))
        values = values * nan_outside(jnp.ones_like(values), fits)
    return nan_outside(jnp.where(space.free, values, 0), space.domain)


@partial(jax.jit, static_argnums=0)
def _by_colours(settings: Colouring, part: Pencil, times: Float[Array, " m"]) -> Float[Array, "m *shape"]:
    assert isinstance(part.space, GridSpace)
    coefficients = chebyshev_heat_coefficients(times, settings.top, settings.degree)
    return coloured_diagonal(settings, settings.colours(part.space), nodal_pencil(part), coefficients)


def _fits(settings: Colouring, part: Pencil, times: Float[Array, " m"]) -> Array:
    """Tell whether given settings were made for this pencil and these times, or larger ones."""
    low = jnp.asarray(settings.low, times.dtype)
    actual, rounding = bounds(part, low, settings.mass_degree), 1.001
    fits = actual.top <= rounding * settings.top
    fits &= jnp.all(actual.reach * jnp.max(times) <= rounding * jnp.asarray(settings.reach, times.dtype))
    fits &= jnp.all(actual.across <= rounding * jnp.asarray(settings.across, times.dtype))
    return fits & (mass_bound(part) * rounding >= low)
