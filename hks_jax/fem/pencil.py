"""The matrix pencil of the Laplace–Beltrami operator."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.fem.operators import Operator
from hks_jax.fem.space import FunctionSpace


class Pencil(eqx.Module):
    """The stiffness K and mass M of Kφ = λMφ, symmetric, K ⪰ 0, M ≻ 0.

    Attributes:
        stiffness: K; multiply with ``@``, or take ``.to_scipy()``, ``.to_dense()``.
        mass: M, likewise.
        mesh_width: the local distance of neighbouring nodes in the units of the metric, (n_dof,).
        volume: the area or volume of the domain in the units of the metric, eliminated nodes included.
    """

    stiffness: Operator
    mass: Operator
    mesh_width: Float[Array, " n_dof"]
    volume: Float[Array, ""]

    @property
    def space(self) -> FunctionSpace:
        """The space of the degrees of freedom."""
        return self.stiffness.space

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
        self, images: Float[Array, "k n_dof"], vectors: Float[Array, "k n_dof"], part: Int[Array, " k"]
    ) -> Float[Array, "k k"]:
        """Return the products of images under K, M or their derivatives (rows) with vectors (columns)."""
        return jnp.matmul(images, vectors.T, precision="highest")


class MirrorPencil(eqx.Module):
    """The 2^m mixed Neumann/Dirichlet pencils of a domain reflected along m axes.

    Their spectra united are the spectrum of the reflected domain. An eigenfunction of a part, divided by √2^m, is
    one of the reflected domain, restricted to the original.
    """

    parts: tuple[Pencil, ...]

    @property
    def space(self) -> FunctionSpace:
        """The space of the all-Neumann part, which holds the functions of all parts."""
        return self.parts[0].space

    @property
    def mesh_width(self) -> Float[Array, " n_dof"]:
        """The local distance of neighbouring nodes in the units of the metric, (n_dof,)."""
        return self.parts[0].mesh_width

    @property
    def volume(self) -> Float[Array, ""]:
        """The area or volume of the reflected domain."""
        return len(self.parts) * self.parts[0].volume

    def apply_stiffness(self, x: Float[Array, "k n_dof"], part: Int[Array, " k"]) -> Float[Array, "k n_dof"]:
        """Apply to each row, a function of one part in the space of the first, the stiffness of its part."""
        return self._apply([piece.stiffness for piece in self.parts], x, part)

    def apply_mass(self, x: Float[Array, "k n_dof"], part: Int[Array, " k"]) -> Float[Array, "k n_dof"]:
        """Apply to each row the mass of its part."""
        return self._apply([piece.mass for piece in self.parts], x, part)

    def among(
        self, images: Float[Array, "k n_dof"], vectors: Float[Array, "k n_dof"], part: Int[Array, " k"]
    ) -> Float[Array, "k k"]:
        """Return the products of images with vectors on the reflected domain: parts do not mix."""
        products = len(self.parts) * jnp.matmul(images, vectors.T, precision="highest")
        return jnp.where(part[:, None] == part, products, 0)

    def _apply(self, operators: list[Operator], x: Array, part: Array) -> Array:
        total = jnp.zeros_like(x)
        for i, operator in enumerate(operators):
            rows = self.space.extend(jnp.where(part[:, None] == i, x, 0), outside=0.0)
            image = operator.space.extend(operator.apply(operator.space.restrict(rows)), outside=0.0)
            total = total + self.space.restrict(image)
        return total
