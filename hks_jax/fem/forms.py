"""Weak forms, the integrands of stiffness and mass, and their integrals over one element.

A form is a function of two shape functions u and v and of a point w, written as in scikit-fem. A form is bilinear and
symmetric in u and v, and is integrated with the volume element √|T| dx of the metric T, or dx for Fick's operator.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.linear.operators import ROUNDING


class ShapeFunction(NamedTuple):
    """A shape function at a point."""

    value: Float[Array, "*c"]  # the value of the function, (), or (c,) for c components
    grad: Float[Array, "*c d"]  # the derivatives with respect to x, (d,); or (c, d) with ``grad[i, j]`` = ∂uᵢ/∂xⱼ


class Point(eqx.Module):
    """A point with the values of metric and fields; on a surface in space, the tensors act on the tangent plane."""

    metric: Float[Array, "*q d d"]  # the tensor T
    inverse: Float[Array, "*q d d"]  # the inverse of the tensor T
    x: Float[Array, "*q m"] | None  # coordinates on a grid, a point in space on a mesh, None for the package's forms
    fields: Mapping[str, Array]  # the values of the user's fields; ``w["name"]`` reads one

    def __getitem__(self, name: str) -> Array:
        """Return the value of the field with this name at the point."""
        if name not in self.fields:
            there = ", ".join(map(repr, self.fields)) or "none"
            raise ValueError(f"fields: a form reads {name!r}; the fields are {there}. Pass fields={{{name!r}: …}}")
        return self.fields[name]


Form = Callable[[ShapeFunction, ShapeFunction, Point], Array]


def laplace_beltrami(u: ShapeFunction, v: ShapeFunction, w: Point) -> Array:
    """Return the stiffness's integrand ρ (T⁻¹∇u·∇v + V u v); without a potential V = 0, without a density ρ = 1."""
    energy = u.grad @ w.inverse @ v.grad
    if "potential" in w.fields:
        energy = energy + w["potential"] * u.value * v.value
    return _weighted(energy, w)


def l2(u: ShapeFunction, v: ShapeFunction, w: Point) -> Array:
    """Return the integrand ρ u·v of the mass, whose integral is the inner product of L²."""
    return _weighted(jnp.sum(u.value * v.value), w)


def _weighted(density: Array, w: Point) -> Array:
    return w["density"] * density if "density" in w.fields else density


class WeakForm(NamedTuple):
    """The forms of stiffness and mass, and the settings of their assembly; all are static arguments of `jax.jit`."""

    stiffness: Form = laplace_beltrami
    mass: Form = l2
    lumped: bool = False  # whether the mass becomes the diagonal matrix of its row sums
    components: int = 1  # the number of components of a function
    custom: bool = False  # whether a form is the user's, so that no property of the operator is known
    cancelling: bool = False  # whether shape functions are evaluated where the leading error of signatures cancels
    fick: bool = False  # whether the volume element is that of space, and D = T⁻¹ is interpolated
    checked: bool = True  # whether symmetry is checked after assembly; otherwise unsymmetric matrices become NaN


def of_components(functions: ShapeFunction, components: int) -> ShapeFunction:
    """Return n·c functions with c components each: one of n scalar functions as one component, and 0 as the others."""
    if components == 1:
        return functions
    (h, dh), eye = functions, jnp.eye(components, dtype=functions.value.dtype)
    q, n = h.shape[0], h.shape[1] * components
    value, grad = h[:, :, None, None] * eye, dh[:, :, None, None] * eye[..., None]
    return ShapeFunction(value.reshape(q, n, components), grad.reshape(q, n, components, -1))


# For each v, a form is a linear function of the value and the gradient of u. The coefficients of this linear function
# are the flux of v, such as T⁻¹∇v for the form T⁻¹∇u·∇v; JAX computes the flux by transposing the form. The fluxes of n
# shape functions therefore suffice for the integrals over all n² pairs of shape functions.
def integrate(form: Form, volume: Float[Array, " q"], functions: ShapeFunction, points: Point) -> Float[Array, "n n"]:
    """Integrate a form over one element, for all n² pairs of n shape functions.

    The shape functions have values (q, n, *c) and gradients (q, n, *c, d) at q quadrature points. Each of the q entries
    of ``volume`` is the weight of a quadrature point times the density of the volume element. A form that does not
    return one number, or that is not linear in u, raises ValueError.
    """
    read = _reads(form, *(jax.tree.map(lambda leaf: leaf[0], each) for each in (functions, points)))

    def flux(v: ShapeFunction, w: Point) -> ShapeFunction:
        (result,) = jax.linear_transpose(lambda u: form(u, v, w), v)(jnp.ones((), volume.dtype))
        return result

    with jax.default_matmul_precision("highest"):
        try:
            fluxes = jax.vmap(jax.vmap(flux, (0, None)))(functions, points)
        except (AssertionError, NotImplementedError) as error:
            raise ValueError(f"{_name(form)}: got a form that is not linear in u; expected a bilinear form") from error
    total = jnp.zeros((), volume.dtype)
    for basis, of_form, counts in zip(functions, fluxes, read, strict=True):
        if counts:
            own, other = (leaf.reshape(*leaf.shape[:2], -1) for leaf in (basis, of_form))
            total = total + jnp.einsum("q,qis,qjs->ij", volume, own, other, precision="highest")
    return jnp.broadcast_to(total, (functions.value.shape[1],) * 2)


def _reads(form: Form, functions: ShapeFunction, w: Point) -> tuple[bool, ...]:
    """Return whether a form depends on the value of u, and whether it depends on the gradient of u."""
    u = jax.tree.map(lambda leaf: leaf[0], functions)
    traced = jax.make_jaxpr(lambda *leaves: form(ShapeFunction(*leaves), u, w))(*u)
    if [(result.shape, result.dtype) for result in traced.out_avals] != [((), u.value.dtype)]:
        got = ", ".join(f"{result.dtype} of shape {result.shape}" for result in traced.out_avals)
        raise ValueError(f"{_name(form)}: the form returns {got}; expected one number, {u.value.dtype} of shape ()")
    inputs = [id(variable) for equation in traced.jaxpr.eqns for variable in equation.invars]
    read = tuple(id(variable) in inputs for variable in traced.jaxpr.invars)
    if not any(read):
        raise ValueError(f"{_name(form)}: got a form that does not depend on u; expected a form bilinear in u and v")
    return read


def _name(form: Form) -> str:
    return getattr(form, "__name__", type(form).__name__)


def symmetric_or_nan(matrices: Float[Array, "*m n n"]) -> Float[Array, "*m n n"]:
    """Return the matrices, with NaN in place of matrices that are unsymmetric beyond rounding."""
    skew = jnp.abs(matrices - jnp.swapaxes(matrices, -1, -2)).max((-2, -1), keepdims=True)
    size = jnp.abs(matrices).max((-2, -1), keepdims=True)
    return jnp.where(skew > ROUNDING * jnp.finfo(matrices.dtype).eps * size, jnp.nan, matrices)
