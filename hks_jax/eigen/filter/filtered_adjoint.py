"""Matrix-free linear solves with K − λᵢM on the complement of computed eigenvectors, by conjugate gradients.

The preconditioner is the negative filter polynomial, in single precision. Residuals and steps have the precision of the
right-hand sides. Each step projects out the computed eigenvectors, for a block of right-hand sides at once.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hks_jax.checks import require_count
from hks_jax.compilation import jit_quickly
from hks_jax.eigen.adjoints import complement
from hks_jax.eigen.adjoints.complement import Adjoint, Columns, OfRows, Rows, Scalar, Values, Vectors
from hks_jax.eigen.filter.polynomial import Band, correction, upper_end
from hks_jax.fem.nodal import nodal_pencil, to_columns, to_rows
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.stencil import StencilOperator
from hks_jax.linear.operators import OfColumns

_GAIN = 20.0
"""The filter polynomial's value at λᵢ. A larger value needs fewer steps, but more products with K in each step."""
_MOST_DEGREE = 60
_WIDEST = 0.9
"""The largest lower end of the polynomial's band, as a fraction of its upper end."""


class FilteredAdjoint(Adjoint[Pencil]):
    """Conjugate gradients with a Chebyshev preconditioner, without a factorisation; for grids, mainly in 3D.

    Attributes:
        tolerance: the wanted error in the energy norm, relative to the largest right-hand side.
        block: the number of right-hand sides solved together.

    Examples:
        >>> solver = hj.ShiftInvert(adjoint=hj.FilteredAdjoint(tolerance=1e-6))
        >>> domain = lambda s: hj.TensorField(field.grid, s * field.tensors)
        >>> scaled = lambda s: hj.hks(hj.eigenpairs(domain(s), 12, solver=solver), [0.5 * s], "volume")[0, 4, 4]
        >>> print(abs(jax.grad(scaled)(1.0)) < 1e-3)  # lengths and times grow alike
        True
    """

    tolerance: float = eqx.field(default=1e-10, static=True)
    block: int = eqx.field(default=32, static=True)

    def __check_init__(self) -> None:
        require_count("block", self.block)

    def prepare(self, pencil: Pencil, values: Values, k: int) -> Scalar:
        """Return an upper bound of the spectrum of D⁻¹K, where D is the lumped mass."""
        if not isinstance(pencil.stiffness, StencilOperator):
            raise ValueError("adjoint: got FilteredAdjoint, which needs a grid; use FactorisedAdjoint for a mesh")
        return upper_end(nodal_pencil(pencil))

    @jit_quickly()
    def solve(self, prepared: Scalar, pencil: Pencil, values: Values, vectors: Vectors, rhs: Rows) -> Rows:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`."""
        high, space, nodal = prepared, pencil.space, nodal_pencil(pencil)
        # The polynomial acts on D⁻¹K, where D is the lumped mass. On coarse grids, φᵀKφ / φᵀDφ is only a fraction of λ.
        mass = space.restrict(nodal.lumped)
        quotients = values / jax.lax.map(lambda phi: jnp.sum(mass * phi * phi), vectors, batch_size=self.block)
        band = Band(jnp.minimum(jnp.max(quotients) * (1 + 1 / values.size), _WIDEST * high), high)
        # If a quotient were nearer to the band, the polynomial of degree `_MOST_DEGREE` would not reach `_GAIN`, and
        # the preconditioner might be indefinite.
        nearest = (math.cosh(math.acosh(_GAIN) / _MOST_DEGREE) - 1) / 2
        quotients = jnp.minimum(quotients, band.low - nearest * (band.high - band.low))
        clean = complement.without_known(pencil, vectors)

        def of_block(references: OfRows) -> OfColumns:
            degree = jnp.ceil(jnp.clip(band.degree_for(jnp.max(references), _GAIN), 2, _MOST_DEGREE)).astype(int)

            def precondition(r: Columns) -> Columns:
                columns = to_columns(space.extend(r.T, outside=0.0).reshape(r.shape[1], -1), nodal.shape)
                z = correction(nodal, band, columns.astype(jnp.float32), references, degree).astype(r.dtype)
                return clean(-space.restrict(to_rows(z).reshape(-1, *nodal.shape)).T)

            return precondition

        tolerance, one_group = complement.attainable(self.tolerance, rhs.dtype), np.zeros(1, int)
        problem = pencil, values, vectors, rhs, tolerance
        return complement.solve_by_blocks(*problem, self.block, one_group, lambda _: of_block, quotients[: len(rhs)])
