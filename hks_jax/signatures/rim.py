"""The influence of the boundary on the heat kernel signature: exact from two problems, or estimated from one."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.arrays import nan_is_meant, nan_outside
from hks_jax.compilation import jit_quickly, library_of, numpy_where_known
from hks_jax.domain.components import boundary_nodes
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.driver import eigenpairs
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.assembly import assemble
from hks_jax.fem.boundary import BoundarySpec, normalise_boundary
from hks_jax.fem.pencil import AnyPencil, Pencil
from hks_jax.fem.space import FunctionSpace, GridSpace, MeshSpace
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.signatures.filters import Heat
from hks_jax.signatures.spectral_functions import spectral_diagonal
from hks_jax.signatures.times import FREE
from hks_jax.signatures.truncation import resolved_times

_CANDIDATES = 24
"""The number of times at which the share of free nodes is computed, to find the time at which it is a half."""
_STEPS, _TOLERANCE = 2000, 1e-7
"""The largest number of steps of conjugate gradients for the estimate, and their relative tolerance."""
_ON_HOST = 1 << 28
"""The largest number of matrix entries for which the estimate is computed without compilation."""


@nan_is_meant
def boundary_influence(
    domain: TensorField | SimplicialMesh | Eigenpairs,
    times: Any,
    k: int | None = None,
    boundary: BoundarySpec = "neumann",
    solver: str | Eigensolver = "auto",
) -> Float[Array, "n_times *shape"]:
    """Return the share of the heat kernel signature that is due to the boundary, (k_N − k_D)/(k_N + k_D).

    Here k_N ≥ k_D are the signatures with Neumann and with Dirichlet conditions on the whole boundary, including the
    rim of a mask. The share is 1 on the boundary, 0 where the boundary has no effect yet at the time t, and NaN outside
    the mask. At a distance d from a straight side of a flat domain the share is exp(−d²/t).

    For a field or a mesh, the eigenpairs of a Neumann and of a Dirichlet problem are computed, which together are the
    eigenpairs with the boundary ``"mean"`` and the signature (k_N + k_D)/2. The result is then differentiable with
    respect to the tensors.

    For eigenpairs of one problem, such as ``"neumann"``, the share is estimated from the time τ at which Brownian
    motion first reaches the boundary: exp(−log²(u)/4) with u = E exp(−4τ/t), which is exact for a straight side of a
    flat domain. Where the share was 2 to 50 % on slices of a brain, the estimate was 0.85 to 1.5 times the share.
    Derivatives treat the estimate as constant. Without a boundary the share is 0.

    Args:
        domain: a metric in 2D or 3D, a mesh, or eigenpairs of a field or a mesh.
        times: (n_times,) positive, in (metric length)².
        k: the number of eigenpairs of each of the two problems. Omit k if `domain` is given as eigenpairs.
        boundary: ``"neumann"`` or ``"mean"``, which are equivalent here. Grids also accept ``"periodic"``, as one value
            for all axes or one per axis. Omit `boundary` if `domain` is given as eigenpairs.
        solver: the same as for `eigenpairs`.

    Raises:
        ValueError: if the boundary is invalid, if no node or every node lies on it, if the boundary of the eigenpairs
            is not known, or as in `eigenpairs` and `hks`.

    Warns:
        AccuracyWarning: as in `eigenpairs` and `hks`.

    Examples:
        >>> influence = hj.boundary_influence(field, [0.2], k=12)[0]
        >>> print(influence[0, 0], influence[4, 4] < 1)
        1.0 True
    """
    if isinstance(domain, Eigenpairs):
        if k is not None or boundary != "neumann":
            raise ValueError("k, boundary: eigenpairs already determine both; omit these arguments")
        return influence_of(domain, resolved_times(domain, times))
    if k is None:
        raise ValueError("k: got None; expected the number of eigenpairs to compute for each of the two problems")
    pencil = assemble(domain, _glued(domain, boundary))
    both = (eigenpairs(part, k, solver=solver, multiplet="complete") for part in pencil.parts)
    return _share(*(spectral_diagonal(each, Heat(resolved_times(each, times))) for each in both))


def is_estimated(pairs: Eigenpairs) -> bool:
    """Return whether `boundary_influence` is estimated, because the eigenpairs belong to one problem at some sides."""
    first, last = pairs.problems[0].space, pairs.problems[-1].space
    return bool((rim_of(pairs.pencil) & ~(first.free & ~last.free)).any())


def influence_of(pairs: Eigenpairs, times: Float[Array, " m"]) -> Float[Array, "m *shape"]:
    """Return `boundary_influence` of eigenpairs without warnings of unresolved times."""
    if not is_known(pairs):
        raise ValueError(
            "domain: got eigenpairs of other matrices or, of one problem, with a potential; expected eigenpairs of a "
            'field or a mesh. With a potential, compute them with the boundary "mean"'
        )
    if rim_of(pairs.pencil).any() and not is_estimated(pairs):
        return _share(*(spectral_diagonal(pairs.problems[i], Heat(times)) for i in (0, -1)))
    return estimate_of(pairs, times)


def estimate_of(pairs: Eigenpairs, times: Float[Array, " m"]) -> Float[Array, "m *shape"]:
    """Return the estimate of `boundary_influence` from first passage times, which needs no eigenpairs."""
    return _estimate(pairs.problems[0].pencil, rim_of(pairs.pencil), jax.lax.stop_gradient(times))


@jit_quickly()
def _share(neumann: Float[Array, "m *shape"], dirichlet: Float[Array, "m *shape"]) -> Float[Array, "m *shape"]:
    # Rounding of nearly equal signatures, or truncation of small signatures, may move the ratio out of [0, 1].
    return jnp.clip((neumann - dirichlet) / (neumann + dirichlet), 0, 1)


def rim_of(pencil: AnyPencil) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes on all sides that are not periodic, and on the rim of a mask."""
    space = pencil.space
    if isinstance(space, MeshSpace):
        cells = space.triangulation
        rims = [cells.boundary_vertices] + [cells.boundary_edges] * (space.degree == 2)
        return np.concatenate(rims)
    assert isinstance(space, GridSpace)
    return boundary_nodes(space.elements, space.periodic)


def is_known(pairs: Eigenpairs) -> bool:
    """Return whether `boundary_influence` can tell the influence of the boundary on eigenpairs.

    The estimate is for Brownian motion without a potential.
    """
    first = pairs.problems[0].pencil
    of_domain = isinstance(first.space, GridSpace | MeshSpace) and first.metric is not None
    return of_domain and not (first.has_potential and is_estimated(pairs))


# From the distance d to a straight side, the first passage time τ has E exp(−4τ/t) = exp(−2d/√t), and the function
# u = E exp(−4τ/t) is 1 on the boundary and solves u = (t/4) Δu inside. The share exp(−d²/t) equals exp(−log²(u)/4).
# Between two sides, u is nearly the sum of the functions of both sides, as is the share. The function w = 1 − u
# vanishes on the boundary, so that one equation, (M + (t/4) K) w = M 1, serves for all boundary conditions. For linear
# elements, M is the mean of the consistent and a lumped mass, whose errors of second order cancel. With the consistent
# mass, u would fall too fast from the boundary where t is as small as the squared node distance.
def _estimate(pencil: Pencil, rim: Bool[np.ndarray, "*shape"], times: Float[Array, " m"]) -> Float[Array, "m *shape"]:
    space = pencil.space
    inner = (space.free & ~rim).ravel()[np.flatnonzero(space.free.ravel())]
    if not rim.any() or not inner.any():
        found = jnp.full((times.size, space.n_dof), float(rim.any()), times.dtype)
    else:
        linear = space.degree == 1 and pencil.row_sums is None
        found = _hitting(*jax.lax.stop_gradient((pencil.stiffness, pencil.mass)), inner, times, linear)
    values = jnp.where(rim, 1.0, space.extend(found, outside=0.0))
    return nan_outside(values.astype(times.dtype), space.domain)


@numpy_where_known(most=_ON_HOST, static_argnums=4)
def _hitting(stiffness: Any, mass: Any, inner: Any, times: Any, linear: bool) -> Any:
    """Return exp(−log²(u)/4) at the unknowns, for the solution u at each time."""
    xp = library_of(times)
    scale, inside, share = times / 4, inner[:, None], 0.5 if linear else 0.0
    measure, of_mass = (mass @ xp.ones(inner.size, times.dtype))[:, None], mass.diagonal()[:, None]
    lumped = share * of_mass * (xp.sum(measure) / xp.sum(of_mass))
    one = xp.where(inside, (1 - share) * measure + lumped, 0) * xp.ones_like(times)
    diagonal = xp.where(inside, (1 - share) * of_mass + lumped + scale * stiffness.diagonal()[:, None], 1)

    def product(x: Any) -> tuple[Any, Any]:
        image = lumped * x + mass @ ((1 - share) * x) + stiffness @ (scale * x)
        return xp.where(inside, image, x), xp.zeros_like(times)

    wanted = xp.full_like(times, _TOLERANCE)
    w = conjugate_gradients(product, lambda r: r / diagonal, one, wanted, most=_STEPS).x
    u = xp.where(inside, xp.clip(1 - w, xp.finfo(times.dtype).tiny, 1), 1)
    return xp.exp(-(xp.log(u) ** 2) / 4).T


def free_share(influence: Float[Array | np.ndarray, "m *shape"], space: FunctionSpace) -> Float[Array, " m"]:
    """Return the share of the domain's nodes at which the boundary's influence is below `FREE`, at each time."""
    return _free(jnp.asarray(influence)) / int(space.domain.sum())


@jit_quickly()
def _free(influence: Float[Array, "m *shape"]) -> Float[Array, " m"]:
    """Return the number of nodes at which the boundary's influence is below `FREE`, at each time."""
    return jnp.sum(influence < FREE, axis=tuple(range(1, influence.ndim)), dtype=influence.dtype)


def half_free(pairs: Eigenpairs, first: Any, last: Any) -> Float[Array, ""]:
    """Return the time from `first` to `last` at which half of the nodes are free of the boundary, or the nearer end.

    The result is `last` if the influence of the boundary is not known.
    """
    if not is_known(pairs) or not rim_of(pairs.pencil).any():
        return jnp.asarray(last)
    times = _candidates(first, last)
    return _time_of_half(jax.lax.stop_gradient(free_share(influence_of(pairs, times), pairs.space)), times)


@numpy_where_known()
def _candidates(first: Any, last: Any) -> Any:
    return library_of(first).geomspace(first, last, _CANDIDATES, dtype=first.dtype)


@numpy_where_known()
def _time_of_half(share: Any, times: Any) -> Any:
    xp = library_of(share)
    share = np.minimum.accumulate(share) if xp is np else jax.lax.cummin(share)
    # The share decreases, so that the negative shares are ascending.
    return xp.exp(xp.interp(-0.5, -share, xp.log(times)))


def _glued(domain: TensorField | SimplicialMesh, boundary: BoundarySpec) -> BoundarySpec:
    """Return the boundary conditions with "mean" on every side that is not periodic."""
    if not isinstance(domain, TensorField):
        if boundary not in ("neumann", "mean"):
            raise ValueError(f'boundary: got {boundary!r}; expected "neumann" for a mesh')
        return "mean"
    sides = normalise_boundary(boundary, domain.grid.dimension)
    if not {condition for pair in sides for condition in pair} <= {"neumann", "mean", "periodic"}:
        raise ValueError(
            f'boundary: got {boundary!r}; expected "neumann" or "periodic" for each axis. Neumann and Dirichlet '
            "conditions are compared on all sides that are not periodic"
        )
    return tuple("periodic" if pair == ("periodic", "periodic") else "mean" for pair in sides)
