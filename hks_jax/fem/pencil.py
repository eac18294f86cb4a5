"""The matrix pencil of the Laplace–Beltrami operator."""

import equinox as eqx
from jaxtyping import Array, Float

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
