"""The heat kernel signature without eigenpairs, by colouring or by selected inversion."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import nan_is_meant, nan_outside
from hks_jax.checks import checked_times, require_number
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.quality import largest
from hks_jax.fem.assembly import MassKind
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.nodal import nodal_pencil
from hks_jax.fem.pencil import AnyPencil, Pencil, from_lower_bound
from hks_jax.fem.space import GridSpace
from hks_jax.fem.sparse_input import pencil_of
from hks_jax.linear.chebyshev import chebyshev_heat_coefficients
from hks_jax.linear.dissection import dissect
from hks_jax.spectrum_free.colouring import Colouring
from hks_jax.spectrum_free.plan import Method, choose_method, plan, require_grid
from hks_jax.spectrum_free.probing import coloured_diagonal
from hks_jax.spectrum_free.rational import selected_inversion
from hks_jax.spectrum_free.spectrum_bounds import bounds, mass_bound
from hks_jax.traced import is_traced

_ROUNDING = 1e-13
"""The error of the rational approximation of the exponential in double precision."""
_LATE = 0.3
"""The largest product ελt at which selected inversion is used."""
_ROUNDED = 1.001
"""The largest ratio of two bounds that are equal up to rounding."""


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

    The result equals the signature of all eigenpairs of the discretisation, at any t. For node spacing h, the cost of
    colouring grows with t/h², whereas the cost of eigenpairs falls; selected inversion costs the same at any t.
    docs/spectrum-free.md describes the bounds. The unit is 1/(metric length)^d. Values are NaN outside the mask, and 0
    at Dirichlet nodes. All values are NaN if times or the largest eigenvalue exceed those for which a given `Colouring`
    was made. Values at large times are NaN if errors may exceed a few per cent: with selected inversion in float32, or
    if the lowest eigenvalue is far above zero (with Dirichlet conditions) or above a potential's least value.

    Args:
        domain: a tensor field on a grid, a mesh of triangles or tetrahedra, or a pencil of either from `assemble`.
        times: (n_times,) positive, in (metric length)².
        boundary: see `assemble`; to be omitted if a pencil is given.
        mass: see `assemble`. Colouring is 50 to 100 times as fast with ``"lumped"`` as with ``"consistent"``.
        method: ``"colouring"`` (on grids) applies Chebyshev polynomials to sums of distant point sources, with the same
            vectors for all times. ``"selected-inversion"`` uses a rational approximation with an error of about 1e-10.
            For n nodes, selected inversion takes O(n^1.5) operations per time in 2D and O(n²) in 3D, and keeps complex
            factors in memory. ``"auto"`` chooses the method with less work. Under `jax.jit`, colouring needs a
            `Colouring` from `colouring`.
        tolerance: a bound on the error of colouring at every node, relative to the smaller of (4πt)^(−d/2) and the
            largest possible value at a node. For Fick's operator, (4πt)^(−d/2) is divided by the greatest √|D|. A
            potential with the least value v multiplies the bound by exp(−vt).
            `Colouring.error` contains the proven bound. Selected inversion ignores the tolerance.

    Raises:
        ValueError: invalid times, tolerance or method; a tolerance below the rounding error; a time so large that
            colouring takes about as many vectors as there are nodes (``"auto"`` then uses selected inversion if memory
            suffices); ``"auto"`` on a mesh, if selected inversion takes more than 8 GB; colouring under `jax.jit`
            without a given `Colouring`; a `Colouring` for a smaller grid.
        TypeError: colouring on a mesh.

    Warns:
        AccuracyWarning: concrete values are NaN, because errors may exceed a few per cent, or because a given
            `Colouring` is not for these times or this domain.

    Examples:
        >>> np.allclose(hj.hks_spectrum_free(field, [0.5]), hj.hks(pairs, [0.5]), atol=1e-4)
        True
    """
    pencil, origin = from_lower_bound(_read_as_unknowns(pencil_of(domain, boundary, mass)))
    times = checked_times(times, pencil.parts[0].stiffness.dtype)
    require_number("tolerance", tolerance, 1)
    settings = choose_method(pencil, times, method, tolerance)
    scale = jnp.exp(-origin * times)
    values = [_diagonal(part, times, settings, scale) for part in pencil.parts]
    # The mean over even and odd parts is the signature: a point source is half the sum of an even and an odd function.
    mean = jnp.mean(jnp.stack(values), axis=0)
    if isinstance(method, Colouring):
        excess = _excess(method, *jax.lax.stop_gradient((pencil.parts, times)))
        fits = jnp.all(jnp.stack(excess) <= _ROUNDED)
        # Multiplication by NaN makes the derivatives NaN as well.
        mean = mean * nan_outside(jnp.ones_like(mean), fits)
        if not is_traced(fits) and not fits:
            _warn_of_misfit(method, times, *map(float, excess))
            return mean
    return _nan_if_lost(mean, pencil, times, settings, scale)


def colouring(
    domain: TensorField | AnyPencil,
    times: Any,
    boundary: BoundarySpec = "neumann",
    mass: MassKind = "consistent",
    tolerance: float = 1e-4,
    memory: float = 2e9,
    slack: float = 1.0,
) -> Colouring:
    """Choose the spacing of point sources and the degree of the Chebyshev expansion for `hks_spectrum_free`.

    Args:
        memory: the maximum size of the working vectors in bytes, which limits the number of vectors in use at once.
        slack: a factor ≥ 1 by which the largest eigenvalue and the reach of heat may grow, as in later fields of a fit.

    Raises:
        ValueError: an invalid argument; a tolerance below the rounding error; traced values; colouring that takes about
            as many vectors as there are nodes.
        TypeError: a domain that is a mesh.

    Examples:
        >>> colours = hj.colouring(field, [0.05], mass="lumped", tolerance=1e-4)
        >>> colours.error[0] < 1e-4
        True
    """
    pencil = _read_as_unknowns(pencil_of(domain, boundary, mass))
    require_grid(pencil)
    times = checked_times(times, pencil.parts[0].stiffness.dtype)
    require_number("tolerance", tolerance, 1)
    require_number("memory", memory)
    require_number("slack", slack, above=1, inclusive=True)
    return plan(pencil, times, tolerance, memory, slack)


# With the rounding unit ε and the largest eigenvalue λ, selected inversion at a time t had a relative error of at most
# ελt/10 in measurements. The error of the signature of K − vM is about `_ROUNDING` divided by the least mass for
# selected inversion. For colouring it is at most the bound. The scale exp(−vt) multiplies this error.
def _nan_if_lost(
    values: Float[Array, "m *shape"],
    pencil: AnyPencil,
    times: Float[Array, " m"],
    settings: Colouring | None,
    scale: Float[Array, " m"],
) -> Float[Array, "m *shape"]:
    """Return the signature, with NaN at times at which errors may exceed a few per cent of the largest value."""
    known_times = jax.lax.stop_gradient(times)
    lost = _lost(settings, *jax.lax.stop_gradient((values, pencil.parts, times, scale)))
    if not is_traced(lost) and lost.any():
        first = float(known_times[lost][0])
        warn_of_accuracy(
            f"times: the signatures at {int(lost.sum())} of {times.size} times, the first {first:.4g}, are NaN, "
            f"because errors in {times.dtype} may exceed a few per cent. Relative errors grow with t, in "
            "particular if the lowest eigenvalue is far above zero or above a potential's least value. Use eigenpairs "
            "or smaller times"
        )
    return values * jnp.where(lost, jnp.nan, 1).astype(values.dtype).reshape(-1, *[1] * (values.ndim - 1))


@partial(jax.jit, static_argnums=0)
def _lost(
    settings: Colouring | None,
    known: Float[Array, "m *shape"],
    parts: tuple[Pencil, ...],
    times: Float[Array, " m"],
    scale: Float[Array, " m"],
) -> Bool[Array, " m"]:
    if settings is None:
        eps, least = float(jnp.finfo(times.dtype).eps), jnp.stack([jnp.min(part.mass.diagonal()) for part in parts])
        error = max(_ROUNDING, eps) / jnp.min(least)
        late = eps * times * jnp.max(jnp.stack([largest(part) for part in parts])) > _LATE
    else:
        error = max(settings.error) * (4 * jnp.pi * times) ** (-len(settings.spacing) / 2)
        if parts[0].density is not None:  # as in `bounds`
            error = error / jnp.max(parts[0].density)
        late = jnp.zeros(times.shape, bool)
    most = jnp.max(jnp.where(jnp.isnan(known), 0, jnp.abs(known)).reshape(times.size, -1), axis=1)
    # Constants, where they are functions of the space, keep the signature far above the error at any time.
    decays = not any(part.n_null for part in parts)
    return late | decays & ~(error * scale <= 0.03 * most)


def _read_as_unknowns(pencil: AnyPencil) -> AnyPencil:
    if any(part.row_sums is not None for part in pencil.parts):
        raise ValueError(
            'domain: got a pencil with the quadrature "cancelling", whose nodal values this method cannot compute; '
            'expected "gauss". Otherwise compute the signature from eigenpairs'
        )
    return pencil


def _diagonal(
    part: Pencil, times: Float[Array, " m"], settings: Colouring | None, scale: Float[Array, " m"]
) -> Float[Array, "m *shape"]:
    # Values are scaled before NaN is inserted, because NaN would enter the derivatives of the scales as 0·NaN.
    space = part.space
    if settings is None:
        diagonals = selected_inversion(part.stiffness, part.mass, times, dissect(part.pattern))
        return space.extend(scale[:, None] * diagonals)
    values = scale.reshape(-1, *[1] * len(space.node_shape)) * _by_colours(settings, part, times)
    return nan_outside(jnp.where(space.free, values, 0), space.domain)


@partial(jax.jit, static_argnums=0)
def _by_colours(settings: Colouring, part: Pencil, times: Float[Array, " m"]) -> Float[Array, "m *shape"]:
    assert isinstance(part.space, GridSpace)
    coefficients = chebyshev_heat_coefficients(times, settings.top, settings.degree)
    return coloured_diagonal(settings, settings.colours(part.space), nodal_pencil(part), coefficients)


def _excess(
    settings: Colouring, parts: tuple[Pencil, ...], times: Float[Array, " m"]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Return by which factors the times, the bounds that a slack raises, and the coupling by the mass are too large."""
    low, d = jnp.asarray(settings.low, times.dtype), len(settings.reach)
    latest = jnp.max(times)
    growth, couplings = [], []
    for part in parts:
        actual = bounds(part, low, settings.mass_degree)
        growth.append(actual.top / settings.top)
        growth += [latest * actual.reach[a] / settings.reach[a] for a in range(d)]
        growth += [actual.across[a] / settings.across[a] for a in range(d) if settings.across[a]]
        couplings.append(low / mass_bound(part))
    # The expansion is that of [0, `settings.top`] for any spectrum, so its degree suffices for the planned times only.
    return latest / settings.longest, jnp.max(jnp.stack(growth)), jnp.max(jnp.stack(couplings))


def _warn_of_misfit(settings: Colouring, times: Float[Array, " m"], late: float, growth: float, coupled: float) -> None:
    times = jax.lax.stop_gradient(times)
    if late > _ROUNDED:
        warn_of_accuracy(
            f"method: got a Colouring for times up to {settings.longest:.4g}; expected one for times up to "
            f"{float(jnp.max(times)):.4g}, so the signature is NaN. Make a new one by `colouring` with all times"
        )
    elif coupled > _ROUNDED:
        warn_of_accuracy(
            "method: got a Colouring for a mass with weaker couplings, such as a lumped one, so the signature is NaN; "
            "expected one for this mass. Make a new one by `colouring` with this domain and mass"
        )
    else:
        warn_of_accuracy(
            f"method: the largest eigenvalue or the reach of heat on this domain is {growth:.3g} times that of the "
            "Colouring, so the signature is NaN; expected one for this domain. Make a new one by "
            f"`colouring` with this domain, or with a slack {1.005 * growth:.3g} times as large"
        )
