"""Smoothing of maps along the tissue, by the heat flow of a domain without eigenpairs."""

import math
import time as clock
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import nan_is_meant
from hks_jax.checks import real_array, require_number
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.solver import Report, Status, silent
from hks_jax.fem.assembly import assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.box import cropped
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.resolution import mean_diffusivity
from hks_jax.linear import accelerators
from hks_jax.linear.chebyshev import chebyshev_heat_coefficients, chebyshev_recurrence, least_degree
from hks_jax.traced import is_traced

_OMITTED = 1e-10
"""The greatest sum of the omitted Chebyshev coefficients in double precision."""
_BLOCK = 16
"""The largest number of maps that are smoothed together on a CPU, where larger blocks exceed the cache."""


@nan_is_meant
def smooth(
    domain: TensorField | SimplicialMesh,
    f: Any,
    fwhm: float,
    boundary: BoundarySpec = "neumann",
    diffusivity: float | None = None,
    progress: Report | None = None,
) -> Float[Array, "*functions_and_shape"]:
    """Smooth maps along the tissue: by the heat flow of the domain for the time in which its mean FWHM is reached.

    In a constant tensor D, heat spreads as a Gaussian, whose full width at half maximum along an axis with the
    diffusivity a is 4√(ln2 · a t). The time t is that in which the mean diffusivity gives the full width `fwhm`; along
    fibres maps are smoothed more, and across them less. Fluid diffuses faster than tissue, and raises the mean; exclude
    it by the mask.

    The flow is computed by Chebyshev polynomials of the matrices with lumped mass, without eigenpairs, and equals
    `heat_flow` with all eigenpairs. The integral of f with the mass is kept, except under Dirichlet conditions; it is
    the plain integral for a field with ``operator="fick"``. The result is differentiable with respect to f. It is NaN
    outside the mask, and 0 at Dirichlet nodes.

    Args:
        domain: a tensor field, best with ``operator="fick"``, or a mesh.
        f: (*shape), or (…, *shape) for several maps, such as a time series. Values outside the mask are not used.
        fwhm: the full width at half maximum, in the unit of the domain's coordinates (mm for voxels or vertices in mm),
            at least the greatest spacing of a grid or the median edge of a mesh. On a grid, if the ratio of the
            tensor's eigenvalues is 3, a single voxel spreads as the Gaussian up to 3 % of its greatest value for a
            width of 10 spacings, 6 % for 8 and 12 % for 6; the covariance is right for all. For narrower widths, values
            may become slightly negative.
        boundary: see `assemble`. Maps are smoothed within the mask only; ``"mirror"`` and ``"mean"`` reflect them,
            which is as under ``"neumann"``.
        diffusivity: the D of the time FWHM²/(16 ln2 D). None means the mean of trace(T⁻¹)/d over the domain with the
            metric T, which for the metric D⁻¹ and for Fick's operator is the mean diffusivity (on a surface that of the
            tensors' tangential parts), and is 1 for a mesh without tensors.
        progress: a function such as ``print`` that receives short texts during the smoothing of many concrete maps.

    Raises:
        ValueError: if f has another shape or is not finite inside the mask, if the FWHM is below the spacing, or if the
            domain, the FWHM or the diffusivity is traced (the degree of the polynomials depends on them).

    Examples:
        >>> spot = np.zeros((9, 9))
        >>> spot[4, 4] = 1
        >>> flat = hj.TensorField.from_diffusion(field.grid, np.tile(np.diag([1, 0.2]), (9, 9, 1, 1)), operator="fick")
        >>> spread = hj.smooth(flat, spot, fwhm=0.3)
        >>> print(spread[5, 4] > 2 * spread[4, 5])  # more along the first axis
        True
    """
    for name, value in (("domain", domain), ("fwhm", fwhm), ("diffusivity", diffusivity)):
        if is_traced(value):
            raise ValueError(
                f"{name}: got traced values (jax.jit, vmap, grad), on which the degree of the polynomials depends; "
                "expected a concrete domain, FWHM and diffusivity. Otherwise use `heat_flow` with eigenpairs"
            )
    require_number("fwhm", fwhm)
    what, least = _least_width(domain)
    if fwhm < least:
        raise ValueError(
            f"fwhm: got {fwhm:g} on a {what} {least:.4g}, which does not resolve it; expected at least this length"
        )
    with jax.ensure_compile_time_eval():  # only the maps may be traced
        pencil = assemble(domain, boundary, "lumped").parts[0]
        top = float(_greatest(pencil))
        if diffusivity is None:
            diffusivity = float(mean_diffusivity(pencil.metric, pencil.space, pencil.stiffness.dtype))
    require_number("diffusivity", diffusivity)
    space, dtype = pencil.space, pencil.stiffness.dtype
    u = real_array("f", f).astype(dtype)
    shape = space.node_shape
    if u.ndim < len(shape) or u.shape[u.ndim - len(shape) :] != shape:
        raise ValueError(f"f: got shape {u.shape}; expected {shape}, with optional leading axes for several maps")
    rows = space.restrict(u.reshape(-1, *shape))
    if not is_traced(rows) and (lacking := int((~np.isfinite(np.asarray(rows))).sum())):
        raise ValueError(
            f"f: got {lacking} NaN or infinite values inside the mask; expected finite values. Exclude these nodes by "
            "the mask"
        )
    time = fwhm**2 / (16 * math.log(2.0) * diffusivity)
    degree = least_degree(time * top / 2, max(_OMITTED, float(jnp.finfo(dtype).eps)))
    flow = partial(_flow, degree, cropped(pencil), jnp.asarray(top, dtype), jnp.asarray(time, dtype))
    smoothed = flow(rows) if is_traced(rows) else _by_blocks(flow, rows, progress or silent)
    return space.extend(smoothed).reshape(u.shape)


def _by_blocks(flow: Callable[[Array], Array], rows: Float[Array, "s n"], report: Report) -> Float[Array, "s n"]:
    """Return the flow of all rows, computed for a few rows at a time; report the numbers of rows and the time left."""
    count, begin = len(rows), clock.perf_counter()
    if count <= _BLOCK or accelerators.at_hand():
        return flow(rows)
    done, size = list[Array](), -(-count // -(-count // _BLOCK))  # blocks of equal size are compiled once
    for start in range(0, count, size):
        block = rows[start : start + size]
        padded = jnp.pad(block, ((0, size - len(block)), (0, 0)))
        done.append(jax.block_until_ready(flow(padded))[: len(block)])
        finished = start + len(block)
        left = (clock.perf_counter() - begin) / finished * (count - finished)
        report(Status(f"{finished} of {count} maps", left))
    return jnp.concatenate(done)


def _least_width(domain: TensorField | SimplicialMesh) -> tuple[str, float]:
    """Return the spacing of a grid, or the median edge of a mesh, with its name."""
    if isinstance(domain, TensorField):
        return "grid with the spacing", max(domain.grid.spacing)
    ends = np.asarray(domain.vertices, np.float64)[domain.triangulation.edges]
    return "mesh with the median edge", float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)))


@jax.jit
def _greatest(pencil: Pencil) -> Float[Array, ""]:
    """Return Gershgorin's bound of the eigenvalues of D⁻¹K for a diagonal mass D."""
    entries, (places, _) = pencil.stiffness.triplets()
    sums = jnp.zeros(pencil.size, entries.dtype).at[jnp.asarray(places)].add(jnp.abs(entries))
    return jnp.max(sums / pencil.mass.diagonal())


@partial(jax.jit, static_argnums=0)
def _flow(
    degree: int, pencil: Pencil, top: Float[Array, ""], time: Float[Array, ""], rows: Float[Array, "s n"]
) -> Float[Array, "s n"]:
    """Return exp(−tD⁻¹K)u for each row u, by the Chebyshev expansion of degree ``degree`` on the spectrum [0, top]."""
    coefficients = chebyshev_heat_coefficients(time[None], top, degree)[0]
    stiffness, inverse = pencil.stiffness.of_columns(), 1 / pencil.mass.diagonal()[:, None]

    def product(x: Float[Array, "n s"]) -> Float[Array, "n s"]:
        return (2 / top) * inverse * stiffness(x) - x

    def add(n: Any, y: Float[Array, "n s"], total: Float[Array, "n s"]) -> Float[Array, "n s"]:
        return total + coefficients[n] * y

    columns = rows.T
    return chebyshev_recurrence(product, columns, degree, jnp.zeros_like(columns), add)[2].T
