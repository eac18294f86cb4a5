"""The matrix pencil of the Laplace–Beltrami operator."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.fem.resolution import Resolution
from hks_jax.fem.space import FunctionSpace
from hks_jax.linear.linear_map import with_transpose
from hks_jax.linear.operators import Operator, PatternedOperator
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import combine, inner_products


class Pencil(SymmetricPencil):
    """The stiffness K and mass M ≻ 0 of functions on a domain, or on the nodes of matrices from elsewhere.

    Attributes:
        stiffness: K; multiply with ``@``, or take ``.to_scipy()``, ``.to_dense()``.
        mass: M, likewise.
        resolution: what the spacing of the nodes does to signatures, for estimates; None where it is not known.
        volume: the area or volume of the domain in the units of the metric, eliminated nodes included; None where it is
            not known.
        space: the space of the functions.
        null_space: that of K ⪰ 0; None where nothing is known, and K may be indefinite.
    """

    resolution: Resolution | None
    volume: Float[Array, ""] | None
    space: FunctionSpace = eqx.field(static=True)

    def __repr__(self) -> str:
        """Return one line: how many unknowns on what, and under which boundary."""
        return f"Pencil({self.space!r})"

    @property
    def measured(self) -> bool:
        """Whether dimension and volume are known, as Weyl's law needs them."""
        return self.volume is not None and self.space.dimension is not None

    @property
    def mesh_width(self) -> Float[Array, " n_dof"]:
        """The local distance of neighbouring nodes in the units of the metric, (n_dof,)."""
        if self.resolution is None:
            raise ValueError("mesh_width: matrices from elsewhere have no mesh; use `assemble`")
        return self.resolution.mesh_width

    def with_stiffness(self, stiffness: PatternedOperator) -> "Pencil":
        """Return the pencil of another operator on the same domain, such as K + V, of whose kernel nothing is known.

        ``pencil.with_stiffness(pencil.stiffness.plus(V))`` with V (n_dof,) adds a diagonal matrix.

        Raises:
            ValueError: a matrix of another pattern.
        """
        if stiffness.pattern != self.pattern:
            raise ValueError("stiffness: got a matrix with another pattern; use `sparse_pencil` for any two matrices")
        return Pencil(stiffness, self.mass, self.resolution, self.volume, self.space)

    @property
    def parts(self) -> tuple["Pencil", ...]:
        """The pencil itself: one problem."""
        return (self,)

    def apply_stiffness(self, x: Float[Array, "k n_dof"], part: Int[Array, " k"]) -> Float[Array, "k n_dof"]:
        """Apply K to each row; ``part`` tells rows apart only where there are several parts."""
        return self.stiffness.apply(x)

    def apply_mass(self, x: Float[Array, "k n_dof"], part: Int[Array, " k"]) -> Float[Array, "k n_dof"]:
        """Apply M to each row."""
        return self.mass.apply(x)

    def among(
        self,
        images: Float[Array, "b n_dof"],
        of: Int[Array, " b"],
        vectors: Float[Array, "k n_dof"],
        part: Int[Array, " k"],
    ) -> Float[Array, "b k"]:
        """Return the products of images under K, M or their derivatives (rows) with vectors (columns), constants."""
        return _among(images, vectors)


class MirrorPencil(eqx.Module):
    """The 2^m mixed Neumann/Dirichlet pencils of a domain doubled m times: reflected along axes, or along its rim.

    Their spectra united are the spectrum of the doubled domain. An eigenfunction of a part, divided by √2^m, is
    one of the doubled domain, restricted to the original.
    """

    parts: tuple[Pencil, ...]

    @property
    def measured(self) -> bool:
        """Whether dimension and volume are known."""
        return self.parts[0].measured

    @property
    def space(self) -> FunctionSpace:
        """The space of the all-Neumann part, which holds the functions of all parts."""
        return self.parts[0].space

    @property
    def mesh_width(self) -> Float[Array, " n_dof"]:
        """The local distance of neighbouring nodes in the units of the metric, (n_dof,)."""
        return self.parts[0].mesh_width

    @property
    def n_fixed(self) -> int:
        """How many null vectors of the first part every perturbation annihilates."""
        return self.parts[0].n_fixed

    @property
    def resolution(self) -> Resolution | None:
        """What the spacing of the nodes does to signatures, for estimates."""
        return self.parts[0].resolution

    @property
    def volume(self) -> Float[Array, ""] | None:
        """The area or volume of the doubled domain."""
        return None if self.parts[0].volume is None else len(self.parts) * self.parts[0].volume

    def apply_stiffness(self, x: Float[Array, "k n_dof"], part: Int[Array, " k"]) -> Float[Array, "k n_dof"]:
        """Apply to each row, a function of one part in the space of the first, the stiffness of its part."""
        return self._apply(lambda piece: piece.stiffness, x, part)

    def apply_mass(self, x: Float[Array, "k n_dof"], part: Int[Array, " k"]) -> Float[Array, "k n_dof"]:
        """Apply to each row the mass of its part."""
        return self._apply(lambda piece: piece.mass, x, part)

    def among(
        self,
        images: Float[Array, "b n_dof"],
        of: Int[Array, " b"],
        vectors: Float[Array, "k n_dof"],
        part: Int[Array, " k"],
    ) -> Float[Array, "b k"]:
        """Return the products of images, of such parts, with vectors on the doubled domain: parts do not mix."""
        return jnp.where(of[:, None] == part, len(self.parts) * _among(images, vectors), 0)

    def _apply(self, operator: Callable[[Pencil], Operator], x: Array, part: Array) -> Array:
        total = jnp.zeros_like(x)
        for i, piece in enumerate(self.parts):
            rows = self.space.extend(jnp.where(part[:, None] == i, x, 0), outside=0.0)
            image = piece.space.extend(operator(piece).apply(piece.space.restrict(rows)), outside=0.0)
            total = total + self.space.restrict(image)
        return total


# The transpose that JAX makes of these products is one with the transposed vectors, which takes twice as long.
def _among(images: Float[Array, "b n_dof"], vectors: Float[Array, "k n_dof"]) -> Float[Array, "b k"]:
    """Return the inner products, linear in the images: the vectors are constants to derivatives."""
    return with_transpose(partial(inner_products, vectors), lambda mix: combine(mix, vectors), images)
