"""The matrix pencil of the Laplace–Beltrami operator."""

from typing import TypeAlias

import equinox as eqx
from jaxtyping import Array, Float

from hks_jax.fem.resolution import Resolution, SampledMetric, resolution_of
from hks_jax.fem.space import FunctionSpace
from hks_jax.linear.operators import DiagonalOperator, PatternedOperator
from hks_jax.linear.pencil import SymmetricPencil


class Pencil(SymmetricPencil):
    """The stiffness K and mass M ≻ 0 of functions on a domain, or on the nodes of matrices from elsewhere.

    Attributes:
        stiffness: K; multiply with ``@``, or take ``.to_scipy()``, ``.to_dense()``.
        mass: M, likewise.
        metric: that of the domain, for estimates; None where it is not known.
        volume: the area or volume of the domain in the units of the metric, eliminated nodes included; None where it is
            not known.
        space: the space of the functions.
        null_space: that of K ⪰ 0; None where nothing is known, and K may be indefinite.
        lower_bound: a number below which there is no eigenvalue, where that is known of a K that may be indefinite;
            constant to derivatives.
    """

    metric: SampledMetric | None
    volume: Float[Array, ""] | None
    space: FunctionSpace = eqx.field(static=True)
    lower_bound: Float[Array, ""] | None = eqx.field(default=None, kw_only=True)

    def __repr__(self) -> str:
        """Return one line: how many unknowns on what, and under which boundary."""
        return f"Pencil({self.space!r})"

    @property
    def bounded(self) -> bool:
        """Whether it is known where the spectrum begins."""
        return self.null_space is not None or self.lower_bound is not None

    @property
    def measured(self) -> bool:
        """Whether dimension and volume are known, as Weyl's law needs them."""
        return self.volume is not None and self.space.dimension is not None

    @property
    def resolution(self) -> Resolution | None:
        """What the spacing of the nodes does to signatures, for estimates; None where it is not known."""
        if self.metric is None:
            return None
        return resolution_of(self.metric, self.space, isinstance(self.mass, DiagonalOperator))

    def with_stiffness(self, stiffness: PatternedOperator) -> "Pencil":
        """Return the pencil of another operator on the same domain, such as K + V, of whose kernel nothing is known.

        ``pencil.with_stiffness(pencil.stiffness.plus(V))`` with V (n_dof,) adds a diagonal matrix.

        Raises:
            ValueError: a matrix of another pattern.
        """
        if stiffness.pattern != self.pattern:
            raise ValueError("stiffness: got a matrix with another pattern; use `sparse_pencil` for any two matrices")
        return Pencil(stiffness, self.mass, self.metric, self.volume, self.space)

    @property
    def parts(self) -> tuple["Pencil", ...]:
        """The pencil itself: one problem."""
        return (self,)


class MirrorPencil(eqx.Module):
    """The 2^m mixed Neumann/Dirichlet pencils of a domain doubled m times: reflected along axes, or along its rim.

    Their spectra united are the spectrum of the doubled domain. An eigenfunction of a part, divided by √2^m, is
    one of the doubled domain, restricted to the original.

    Attributes:
        parts: the mixed problems, the one that is Neumann everywhere first.
        including: for each part the parts whose functions include its own: some before it, and itself. By min–max no
            eigenvalue of a part is less than that of the same number of a part that includes it. So of the lowest
            eigenvalues of all parts, a part that c parts include has at most 1/c.
    """

    parts: tuple[Pencil, ...]
    including: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @property
    def measured(self) -> bool:
        """Whether dimension and volume are known."""
        return self.parts[0].measured

    @property
    def space(self) -> FunctionSpace:
        """The space of the all-Neumann part, which holds the functions of all parts."""
        return self.parts[0].space

    @property
    def resolution(self) -> Resolution | None:
        """What the spacing of the nodes does to signatures, for estimates."""
        return self.parts[0].resolution

    @property
    def volume(self) -> Float[Array, ""] | None:
        """The area or volume of the doubled domain."""
        return None if self.parts[0].volume is None else len(self.parts) * self.parts[0].volume


AnyPencil: TypeAlias = Pencil | MirrorPencil
