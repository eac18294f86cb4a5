"""The diagonal of exp(−tM⁻¹K)M⁻¹ by Chebyshev polynomials applied to coloured sources, and its derivative."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.arrays import StaticArray
from hks_jax.fem.nodal import NodalPencil
from hks_jax.linear.chebyshev import chebyshev_recurrence
from hks_jax.linear.linear_map import first_order_only, with_transpose
from hks_jax.linear.products import aligned
from hks_jax.spectrum_free.colours import Colouring

T = TypeVar("T")


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def coloured_diagonal(
    settings: Colouring, colours: StaticArray, pencil: NodalPencil, coefficients: Float[Array, "m terms"]
) -> Float[Array, "m *shape"]:
    """Return the diagonal of Σₙ cₙ Tₙ(2A/top − 1) P, where P ≈ M⁻¹ and A = PK, for every row c of coefficients.

    The array of colours (*shape) has 0, 1, … at coloured nodes, and −1 at all other nodes, where the result is 0. The
    vector of a colour is 1 at the nodes of this colour and 0 elsewhere.
    """
    stiffness, solve_mass = _products(settings, pencil)

    def product(y: Array) -> Array:
        return _scaled(settings.top, solve_mass(stiffness(y)), y)

    def term(sources: Array, total: Array) -> Array:
        def add(n: Any, y: Array, total: Array) -> Array:
            return total + _outer(coefficients[:, n], sources, y)

        return chebyshev_recurrence(product, solve_mass(sources), coefficients.shape[1] - 1, total, add)[2]

    start = jnp.zeros((coefficients.shape[0], *colours.value.shape), coefficients.dtype)
    return _sum_of_blocks(settings, colours, term, start)


# For the vector v of a colour, the Chebyshev vectors are y₀ = Pv, y₁ = Ây₀ and yₙ₊₁ = 2Âyₙ − yₙ₋₁, with the matrix
# Â = 2PK/top − 1. The result is the sum, over n and all colours, of cₙ v∘yₙ with the coefficients cₙ and entrywise
# products ∘. Since P ≈ M⁻¹ and dM⁻¹ = −M⁻¹ dM M⁻¹, the tangent of y₀ is −P dM y₀, and the tangents of aₙ = PKyₙ are
# P(dK yₙ + K dyₙ − dM aₙ).
#
# The transpose maps a cotangent g of the result by Clenshaw's recurrence pₙ = P(v∘sₙ) + fₙ Âpₙ₊₁ − pₙ₊₂ from the last n
# down to 0, where sₙ = Σₜ cₙ(t) g(t), f₀ = 1 and fₙ = 2 for n > 0. The cotangents of K, M and cₙ(t) are, in this order,
#
#     Σₙ (2fₙ/top) pₙ₊₁ ⊗ yₙ,    −p₀ ⊗ y₀ − Σₙ (2fₙ/top) pₙ₊₁ ⊗ aₙ    and    Σ g(t)∘v∘yₙ.
#
# Clenshaw's recurrence needs the Chebyshev vectors yₙ in the order of falling n, and yₙ₋₁ = 2Âyₙ − yₙ₊₁ computes them
# in this order, so that the memory does not grow with the degree. The three-term recurrence is as stable backwards as
# forwards: rounding errors grow like the Chebyshev polynomials |Uₙ| ≤ n + 1 in both directions.
@coloured_diagonal.defjvp
def _coloured_diagonal_jvp(
    settings: Colouring, colours: StaticArray, primals: tuple, tangents: tuple
) -> tuple[Array, Array]:
    d_pencil, d_coefficients = tangents
    moved = d_pencil.stiffness.coefficients, d_pencil.mass.coefficients, d_coefficients
    fixed = first_order_only(primals)
    forward, backward = (partial(function, settings, colours, *fixed) for function in (_tangent, _cotangent))
    return coloured_diagonal(settings, colours, *primals), with_transpose(forward, backward, moved)


def _tangent(
    settings: Colouring, colours: StaticArray, pencil: NodalPencil, coefficients: Array, moved: tuple
) -> Float[Array, "m *shape"]:
    d_stiffness, d_mass, d_coefficients = moved
    degree, top = coefficients.shape[1] - 1, settings.top
    stiffness, solve_mass = _products(settings, pencil)
    by_stiffness = replace(pencil.stiffness, coefficients=d_stiffness).of_columns()
    by_mass = replace(pencil.mass, coefficients=d_mass).of_columns()

    def term(sources: Array, total: Array) -> Array:
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
    return _sum_of_blocks(settings, colours, term, start)


def _cotangent(
    settings: Colouring, colours: StaticArray, pencil: NodalPencil, coefficients: Array, g: Array
) -> tuple[Array, Array, Array]:
    degree, top = coefficients.shape[1] - 1, settings.top
    stiffness, solve_mass = _products(settings, pencil)

    def term(sources: Array, total: tuple) -> tuple:
        def product(y: Array) -> Array:
            return _scaled(top, solve_mass(stiffness(y)), y)

        def read(y: Array) -> Array:
            return jnp.matmul(g.reshape(len(g), -1), jnp.sum(sources * y, axis=-1).ravel(), precision="highest")

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
    return _sum_of_blocks(settings, colours, term, jax.tree.map(jnp.zeros_like, matrices))


def _scaled(top: float, image: Array, y: Array) -> Array:
    return (2 / top) * image - y


def _products(settings: Colouring, pencil: NodalPencil) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    return pencil.stiffness.of_columns(), pencil.mass_solve(settings.low, settings.mass_degree)


def _sum_of_blocks(
    settings: Colouring, colours: StaticArray, term: Callable[[Float[Array, "*shape b"], T], T], total: T
) -> T:
    """Return ``total`` plus the contributions of all blocks of colours; ``term`` adds the contribution of one block."""
    numbers, dtype = jnp.arange(settings.columns, dtype=jnp.int32), jax.tree.leaves(total)[0].dtype

    def step(number: Array, total: T) -> T:
        own, of_nodes = number * settings.columns + numbers, jnp.asarray(colours.value, jnp.int32)[..., None]
        return term((of_nodes == aligned(own, of_nodes)).astype(dtype), total)

    return jax.lax.fori_loop(0, -(-(int(colours.value.max()) + 1) // settings.columns), step, total)


def _outer(row: Float[Array, " m"], sources: Array, y: Array) -> Float[Array, "m *shape"]:
    return jnp.multiply.outer(row, jnp.sum(sources * y, axis=-1))
