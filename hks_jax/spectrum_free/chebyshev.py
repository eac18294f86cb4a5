"""The diagonal of exp(−tM⁻¹K)M⁻¹ by Chebyshev polynomials on coloured sources, and its derivative."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from hks_jax.eigen.first_order import first_order_only
from hks_jax.fem.nodal import NodalPencil
from hks_jax.linear.chebyshev import chebyshev_recurrence
from hks_jax.spectrum_free.colours import Colouring
from hks_jax.static_array import StaticArray


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def coloured_diagonal(
    settings: Colouring, colours: StaticArray, pencil: NodalPencil, coefficients: Float[Array, "m terms"]
) -> Float[Array, "m *shape"]:
    """Return Σₙ cₙ Tₙ(2A/top − 1) P at the sources, for every row of coefficients; 0 at nodes without a colour.

    Args:
        settings: the bound ``top`` of the spectrum of A = PK, how P ≈ M⁻¹ is made, and how many columns are worked on
            at once.
        colours: int (*shape), 0, 1, … or −1; the vector of a colour is 1 at all its nodes.
        pencil: K and M.
        coefficients: cₙ.
    """
    stiffness, solve_mass = pencil.stiffness.of_columns(), pencil.mass_solve(settings.low, settings.mass_degree)

    def block(number: Array, total: Array) -> Array:
        sources = _sources(colours, settings.columns, number, total.dtype)

        def product(y: Array) -> Array:
            return _scaled(settings.top, solve_mass(stiffness(y)), y)

        def add(n: Any, y: Array, total: Array) -> Array:
            return total + _outer(coefficients[:, n], sources, y)

        return chebyshev_recurrence(product, solve_mass(sources), degree, total, add)[2]

    degree = coefficients.shape[1] - 1
    start = jnp.zeros((coefficients.shape[0], *colours.value.shape), coefficients.dtype)
    return jax.lax.fori_loop(0, _blocks(settings, colours), block, start)


# y₀ = Pv, y₁ = Ây₀, yₙ₊₁ = 2Âyₙ − yₙ₋₁ with  = 2PK/top − 1, and the result is Σₙ cₙ v∘yₙ. Taking P for M⁻¹, of
# which dM⁻¹ = −M⁻¹ dM M⁻¹, the tangents of aₙ = PKyₙ are P(dK yₙ + K dyₙ − dM aₙ), and dy₀ = −P dM y₀.
#
# Transposed: with the cotangent g, pₙ = P(v∘sₙ) + fₙ Âpₙ₊₁ − pₙ₊₂, sₙ = Σₜ cₙ(t) g(t), f₀ = 1, fₙ = 2, from the
# last n down to 0 (Clenshaw's recurrence), and the cotangents are
#
#     of K: Σₙ (2fₙ/top) pₙ₊₁ ⊗ yₙ,    of M: −p₀ ⊗ y₀ − Σₙ (2fₙ/top) pₙ₊₁ ⊗ aₙ,    of cₙ(t): Σ g(t)∘v∘yₙ.
#
# The yₙ are wanted in the order n = N − 1 … 0, and yₙ₋₁ = 2Âyₙ − yₙ₊₁ gives them in that order from the last two:
# three-term recurrences run as well backwards as forwards, rounding grows like |Uₙ| ≤ n + 1 either way. So nothing
# is stored that grows with the degree.
@partial(coloured_diagonal.defjvp, symbolic_zeros=True)
def _coloured_diagonal_jvp(
    settings: Colouring, colours: StaticArray, primals: tuple, tangents: tuple
) -> tuple[Array, Array]:
    pencil, coefficients = primals
    d_pencil, d_coefficients = tangents
    value = coloured_diagonal(settings, colours, pencil, coefficients)
    moved = _linked((d_pencil.stiffness.coefficients, d_pencil.mass.coefficients, d_coefficients))
    if moved is None:
        return value, jnp.zeros_like(value)
    fixed = first_order_only((pencil, coefficients))
    forward, backward = (partial(function, settings, colours, *fixed) for function in (_tangent, _cotangent))
    return value, _linear_map(forward, backward, moved, value)


def _tangent(
    settings: Colouring, colours: StaticArray, pencil: NodalPencil, coefficients: Array, moved: tuple
) -> Float[Array, "m *shape"]:
    d_stiffness, d_mass, d_coefficients = moved
    degree, top = coefficients.shape[1] - 1, settings.top
    stiffness, solve_mass = pencil.stiffness.of_columns(), pencil.mass_solve(settings.low, settings.mass_degree)
    by_stiffness = replace(pencil.stiffness, coefficients=d_stiffness).of_columns()
    by_mass = replace(pencil.mass, coefficients=d_mass).of_columns()

    def block(number: Array, total: Array) -> Array:
        sources = _sources(colours, settings.columns, number, total.dtype)

        def product(state: tuple[Array, Array]) -> tuple[Array, Array]:
            y, dy = state
            image = solve_mass(stiffness(y))
            change = by_stiffness(y) - by_mass(image) + stiffness(dy)
            return _scaled(top, image, y), _scaled(top, solve_mass(change), dy)

        def add(n: Any, state: tuple[Array, Array], total: Array) -> Array:
            y, dy = state
            return total + _outer(d_coefficients[:, n], sources, y) + _outer(coefficients[:, n], sources, dy)

        y = solve_mass(sources)
        return chebyshev_recurrence(product, (y, solve_mass(-by_mass(y))), degree, total, add)[2]

    start = jnp.zeros((coefficients.shape[0], *colours.value.shape), coefficients.dtype)
    return jax.lax.fori_loop(0, _blocks(settings, colours), block, start)


def _cotangent(
    settings: Colouring, colours: StaticArray, pencil: NodalPencil, coefficients: Array, g: Array
) -> tuple[Array, Array, Array]:
    degree, top = coefficients.shape[1] - 1, settings.top
    stiffness, solve_mass = pencil.stiffness.of_columns(), pencil.mass_solve(settings.low, settings.mass_degree)

    def block(number: Array, total: tuple) -> tuple:
        sources = _sources(colours, settings.columns, number, g.dtype)

        def product(y: Array) -> Array:
            return _scaled(top, solve_mass(stiffness(y)), y)

        def read(y: Array) -> Array:
            return _contract(g, jnp.sum(sources * y, axis=-1))

        def source(n: Any) -> Array:
            return jnp.tensordot(coefficients[:, n], g, 1, precision="highest")[..., None] * sources

        def down(i: Array, state: tuple) -> tuple:
            y, after, p, p_after, (of_stiffness, of_mass, of_coefficients) = state
            n = degree - 1 - i
            factor = jnp.where(n == 0, 1, 2).astype(y.dtype)
            image = solve_mass(stiffness(y))
            weighted = (2 * factor / top) * p
            of_stiffness = of_stiffness + pencil.stiffness.outer(weighted, y)
            of_mass = of_mass - pencil.mass.outer(weighted, image)
            of_coefficients = of_coefficients.at[:, n].add(read(y))
            following = solve_mass(source(n) + stiffness(weighted)) - factor * p - p_after
            total = of_stiffness, of_mass, of_coefficients
            return factor * _scaled(top, image, y) - after, y, following, p, total

        after, y, _ = chebyshev_recurrence(product, solve_mass(sources), degree)
        of_stiffness, of_mass, of_coefficients = total
        total = of_stiffness, of_mass, of_coefficients.at[:, degree].add(read(after))
        p = solve_mass(source(degree))
        state = jax.lax.fori_loop(0, degree, down, (y, after, p, jnp.zeros_like(p), total))
        _, y, p, _, (of_stiffness, of_mass, of_coefficients) = state
        return of_stiffness, of_mass - pencil.mass.outer(p, y), of_coefficients

    matrices = pencil.stiffness.coefficients, pencil.mass.coefficients, coefficients
    return jax.lax.fori_loop(0, _blocks(settings, colours), block, jax.tree.map(jnp.zeros_like, matrices))


def _scaled(top: float, image: Array, y: Array) -> Array:
    """Return Ây, of PKy and y."""
    return (2 / top) * image - y


def _blocks(settings: Colouring, colours: StaticArray) -> int:
    return -(-(int(colours.value.max()) + 1) // settings.columns)


def _sources(colours: StaticArray, columns: int, number: Array, dtype: Any) -> Float[Array, "*shape b"]:
    """Return the vectors of one block of colours."""
    numbers: Int[Array, " b"] = number * columns + jnp.arange(columns, dtype=jnp.int32)
    return (jnp.asarray(colours.value, jnp.int32)[..., None] == numbers).astype(dtype)


def _outer(row: Float[Array, " m"], sources: Array, y: Array) -> Float[Array, "m *shape"]:
    return jnp.multiply.outer(row, jnp.sum(sources * y, axis=-1))


def _contract(g: Float[Array, "m *shape"], moment: Float[Array, "*shape"]) -> Float[Array, " m"]:
    return jnp.matmul(g.reshape(g.shape[0], -1), moment.ravel(), precision="highest")


def _linked(tangents: tuple) -> tuple | None:
    """Return tangents with symbolic zeros as arrays, or None if all are zero.

    The zeros are made to depend on the others: transposition then finds nothing constant among linear inputs.
    """
    moving = [leaf for leaf in tangents if not isinstance(leaf, SymbolicZero)]
    if not moving:
        return None
    zero = sum(jnp.sum(0 * leaf) for leaf in moving)
    return tuple(
        jnp.zeros(leaf.shape, leaf.dtype) + zero if isinstance(leaf, SymbolicZero) else leaf for leaf in tangents
    )


def _linear_map(forward: Any, backward: Any, x: tuple, like: Array) -> Array:
    """Return forward(x), a linear map whose transpose is backward.

    As the second part of the solution of x = u, h − forward(x) = 0: JAX lets linear solves say how their transpose is
    solved, under every transformation. The system itself would matter to second derivatives alone, which are refused.
    """
    nothing = jnp.zeros_like(like) + sum(jnp.sum(0 * leaf) for leaf in x)

    def solve(_: Any, b: tuple) -> tuple:
        return b[0], b[1] + forward(b[0])

    def transpose_solve(_: Any, b: tuple) -> tuple:
        return jax.tree.map(jnp.add, b[0], backward(b[1])), b[1]

    return jax.lax.custom_linear_solve(lambda v: v, (x, nothing), solve, transpose_solve)[1]
