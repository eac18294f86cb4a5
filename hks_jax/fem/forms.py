"""Weak forms: what is integrated for stiffness and mass. Those of the Laplace–Beltrami operator come first.

A form is a function of two shape functions u and v and of a point w, linear in u and in v, and symmetric in the two. It
is read as scikit-fem's forms are, and integrated over the domain with the volume √|T| dx.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.linear.operators import ROUNDING


class ShapeFunction(NamedTuple):
    """A shape function at a point.

    Attributes:
        value: (), or (c,) of one with c components.
        grad: (d,) its derivatives by the coordinates x; or (c, d), ``grad[i, j]`` = ∂uᵢ/∂xⱼ.
    """

    value: Float[Array, "*c"]
    grad: Float[Array, "*c d"]


class Point(eqx.Module):
    """What is known at a point, beside shape functions.

    Attributes:
        metric: (d, d) the tensor T.
        inverse: (d, d) its inverse; of a surface in space, where T is known in its tangential plane, the inverse there.
        x: (d,) the position: coordinates on a grid, a place in space on a mesh. None for forms of the package.
        fields: what a user gave, interpolated; ``w["name"]`` reads one.
    """

    metric: Float[Array, "*q d d"]
    inverse: Float[Array, "*q d d"]
    x: Float[Array, "*q m"] | None
    fields: Mapping[str, Array]

    def __getitem__(self, name: str) -> Array:
        """Return a field at this point."""
        if name not in self.fields:
            there = ", ".join(map(repr, self.fields)) or "none"
            raise ValueError(f"fields: a form reads {name!r}, and there is {there}; give fields={{{name!r}: …}}")
        return self.fields[name]


Form = Callable[[ShapeFunction, ShapeFunction, Point], Array]


def laplace_beltrami(u: ShapeFunction, v: ShapeFunction, w: Point) -> Array:
    """The stiffness of −ρ⁻¹ div(ρ ∇·) + V: T⁻¹∇u·∇v + V u v, times ρ. Without V and ρ these are 0 and 1."""
    energy = u.grad @ w.inverse @ v.grad
    if "potential" in w.fields:
        energy = energy + w["potential"] * u.value * v.value
    return _weighted(energy, w)


def l2(u: ShapeFunction, v: ShapeFunction, w: Point) -> Array:
    """The mass, the inner product of L²: u v, or u·v, times ρ."""
    return _weighted(jnp.sum(u.value * v.value), w)


def _weighted(density: Array, w: Point) -> Array:
    return w["density"] * density if "density" in w.fields else density


class WeakForm(NamedTuple):
    """What is assembled on a domain; static.

    Attributes:
        stiffness: its form.
        mass: likewise.
        lumped: whether the mass becomes a diagonal of row sums.
        components: of the functions.
        own: whether a form is the user's, of which nothing is known.
        cancelling: whether shape functions are taken where the leading error of signatures cancels.
        checked: whether their matrices can be looked at afterwards; else those that are not symmetric become NaN.
    """

    stiffness: Form = laplace_beltrami
    mass: Form = l2
    lumped: bool = False
    components: int = 1
    own: bool = False
    cancelling: bool = False
    checked: bool = True


def of_components(functions: ShapeFunction, components: int) -> ShapeFunction:
    """Return the functions (q, n) that are each of some in one component and 0 in the others: (q, n·c, c)."""
    if components == 1:
        return functions
    (h, dh), eye = functions, jnp.eye(components, dtype=functions.value.dtype)
    q, n = h.shape[0], h.shape[1] * components
    value, grad = h[:, :, None, None] * eye, dh[:, :, None, None] * eye[..., None]
    return ShapeFunction(value.reshape(q, n, components), grad.reshape(q, n, components, -1))


# A form is linear in u, so that it is a number for the value of u and one for each derivative, which its transpose
# reads off: form(u, v, w) = flux(v)·(value, grad of u). For T⁻¹∇u·∇v it is T⁻¹∇v. So n evaluations do for n² pairs.
def integrate(form: Form, volume: Float[Array, " q"], functions: ShapeFunction, points: Point) -> Float[Array, "n n"]:
    """Integrate a form over one element, for all pairs of n shape functions: value (q, n, *c), grad (q, n, *c, d).

    The volume of each of the q points includes √|T|.

    Raises:
        ValueError: a form that does not return one number, or is not linear in u.
    """
    read = _reads(form, *(jax.tree.map(lambda leaf: leaf[0], each) for each in (functions, points)))

    def flux(v: ShapeFunction, w: Point) -> ShapeFunction:
        (result,) = jax.linear_transpose(lambda u: form(u, v, w), v)(jnp.ones((), volume.dtype))
        return result

    with jax.default_matmul_precision("highest"):
        try:
            fluxes = jax.vmap(jax.vmap(flux, (0, None)))(functions, points)
        except (AssertionError, NotImplementedError) as error:
            raise ValueError(f"{_name(form)}: not linear in u, a shape function; expected a bilinear form") from error
    total = jnp.zeros((), volume.dtype)
    for basis, of_form, counts in zip(functions, fluxes, read, strict=True):
        if counts:
            own, other = (leaf.reshape(*leaf.shape[:2], -1) for leaf in (basis, of_form))
            total = total + jnp.einsum("q,qis,qjs->ij", volume, own, other, precision="highest")
    return jnp.broadcast_to(total, (functions.value.shape[1],) * 2)


def _reads(form: Form, functions: ShapeFunction, w: Point) -> tuple[bool, ...]:
    """Return whether a form reads the value of u and its derivatives: by what it does not, nothing is multiplied."""
    u = jax.tree.map(lambda leaf: leaf[0], functions)
    traced = jax.make_jaxpr(lambda *leaves: form(ShapeFunction(*leaves), u, w))(*u)
    if [(result.shape, result.dtype) for result in traced.out_avals] != [((), u.value.dtype)]:
        got = ", ".join(f"{result.dtype} of shape {result.shape}" for result in traced.out_avals)
        raise ValueError(f"{_name(form)}: returns {got}; expected one number, {u.value.dtype} of shape ()")
    inputs = [id(variable) for equation in traced.jaxpr.eqns for variable in equation.invars]
    read = tuple(id(variable) in inputs for variable in traced.jaxpr.invars)
    if not any(read):
        raise ValueError(f"{_name(form)}: reads nothing of u, a shape function; expected a form bilinear in u and v")
    return read


def _name(form: Form) -> str:
    return getattr(form, "__name__", type(form).__name__)


def symmetric_or_nan(matrices: Float[Array, "*m n n"]) -> Float[Array, "*m n n"]:
    """Return matrices, NaN in place of those that are unsymmetric beyond rounding."""
    skew = jnp.abs(matrices - jnp.swapaxes(matrices, -1, -2)).max((-2, -1), keepdims=True)
    size = jnp.abs(matrices).max((-2, -1), keepdims=True)
    return jnp.where(skew > ROUNDING * jnp.finfo(matrices.dtype).eps * size, jnp.nan, matrices)
