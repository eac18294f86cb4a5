"""A field of symmetric positive definite tensors on a grid: a Riemannian metric."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import describe_array, jax_array
from hks_jax.checks import real_array
from hks_jax.compilation import numpy_where_known
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_checks import (
    Interpolation,
    MetricChoice,
    OperatorChoice,
    PositiveMap,
    checked_interpolation,
    checked_operator,
    of_diffusion,
    positive_map,
    require_grid,
    require_spd,
    right_cauchy_green,
    tensors_on,
)
from hks_jax.traced import is_traced


class TensorField(eqx.Module):
    """A Riemannian metric given at the nodes of a grid, and the operator that it defines.

    A field is a pytree: its leaves are the tensors, or the arrays in the metric's function. The grid is static. Under
    `jit`, `grad` or `vmap` only shapes are checked, not values, and a tensor that is not positive definite gives NaN.

    Args:
        grid: the grid.
        tensors: (*shape, d, d), symmetric positive definite inside the mask; ``tensors[i, j, 0, 1]`` is T₁₂ at node
            (i, j). Units: (length / coordinate unit)². Values outside the mask are ignored.
        interpolation: the interpolation between the nodes. With ``"linear"`` the components are multilinear, as in
            Zobel, Reininghaus and Hotz; if the eigenvectors turn, the determinant is larger between the nodes. With
            ``"log-euclidean"`` the components of log T are multilinear (Arsigny, Fillard, Pennec and Ayache), as is the
            logarithm of the determinant, and T⁻¹ is interpolated in the same way as T.
        operator: ``"laplace-beltrami"``, the operator |T|^(−½) div(|T|^½ T⁻¹∇u) of the metric T; or ``"fick"``, the
            operator div(D∇u) of Fick's law with D = T⁻¹, whose volume element is dx, and whose linear interpolation is
            that of D (see `from_diffusion`). Distances are those of the metric T for both operators.

    Raises:
        ValueError: a wrong shape; tensors that are NaN, infinite, unsymmetric or not positive definite inside the mask
            (with their number, the first node and the worst eigenvalue); an unknown interpolation or operator.

    Examples:
        >>> rectangle = hj.TensorField(field.grid, np.tile(np.diag([4.0, 1.0]), (9, 9, 1, 1)))
        >>> print(hj.assemble(rectangle).volume.round(3))  # the area, √(4 · 1)
        2.0
    """

    grid: Grid = eqx.field(static=True)
    interpolation: Interpolation = eqx.field(static=True)
    operator: OperatorChoice = eqx.field(static=True)
    function: jtu.Partial | None
    _tensors: Float[Array, "*shape d d"] | None

    def __init__(
        self,
        grid: Grid,
        tensors: Any,
        interpolation: Interpolation = "linear",
        *,
        operator: OperatorChoice = "laplace-beltrami",
    ) -> None:
        self.grid = grid
        self.interpolation = checked_interpolation(interpolation)
        self.operator = checked_operator(operator)
        self.function = None
        self._tensors = _checked_tensors("tensors", grid, tensors)

    @classmethod
    def from_function(
        cls,
        fn: Callable[[Array], Any],
        grid: Grid,
        interpolation: Interpolation = "linear",
        *,
        operator: OperatorChoice = "laplace-beltrami",
    ) -> "TensorField":
        """Return the metric ``fn``, which maps coordinates (d,) to a tensor (d, d) and is differentiable by JAX.

        The field keeps the function, so that curvature and its derivatives are exact; `assemble` interpolates between
        the function's values at the nodes. Traced parameters belong in a `jax.tree_util.Partial` or an Equinox module.

        Examples:
            >>> grid = hj.Grid.from_bounds(1, 2, (9, 9))
            >>> half_plane = hj.TensorField.from_function(lambda x: jnp.eye(2) / x[1] ** 2, grid)
            >>> print(hj.gaussian_curvature(half_plane)[4, 4].round(3))
            -1.0
        """
        require_grid(grid)
        if not callable(fn):
            raise TypeError(
                f"fn: got {type(fn).__name__}; expected a function from coordinates (d,) to a tensor (d, d)"
            )
        function: Any = fn if isinstance(fn, jtu.Partial | eqx.Module) else jtu.Partial(fn)
        _checked_tensors("fn", grid, _evaluate(function, grid))
        return cls._checked(grid, interpolation, function=function, operator=operator)

    @classmethod
    def _checked(
        cls,
        grid: Grid,
        interpolation: Interpolation,
        tensors: Any = None,
        function: Any = None,
        operator: OperatorChoice = "laplace-beltrami",
    ) -> "TensorField":
        """Return a field without another check of its tensors or of its function's values."""
        field, settings = cls.__new__(cls), {"interpolation": checked_interpolation(interpolation)}
        values = {**settings, "grid": grid, "operator": checked_operator(operator), "function": function}
        values["_tensors"] = tensors
        for name, value in values.items():
            object.__setattr__(field, name, value)
        return field

    @classmethod
    def from_diffusion(
        cls,
        grid: Grid,
        D: Any,
        metric: MetricChoice | None = None,
        *,
        operator: OperatorChoice = "laplace-beltrami",
        interpolation: Interpolation = "linear",
        name: str = "D",
    ) -> "TensorField":
        """Return the metric of a field of diffusion tensors D (*shape, d, d), or the field of Fick's operator.

        Pass either ``metric`` or ``operator="fick"``; there is no default, because several conventions are in use. The
        metric g gives its Laplace–Beltrami operator, which does not depend on coordinates:

        - ``"inverse"``: g = D⁻¹, in which two points are near if diffusion between them is fast. The operator is
          √|D| div(|D|^(−½) D∇u) = div(D∇u) − ½ (D∇log|D|)·∇u, which is Fick's only where |D| is constant. Heat becomes
          uniform with respect to the volume |D|^(−½) dx. The times of signatures have units of time.
        - ``"tensor"``: g = D, as in Zobel, Reininghaus and Hotz;
        - ``"adjugate"``: g = |D| D⁻¹, the inverse scaled so that |g| = |D|^(d−1). In three dimensions the operator is
          |D|⁻¹ div(D∇u), which has the steady states of Fick's operator.

        ``operator="fick"`` gives Fick's operator div(D∇u), the diffusion of a substance with the diffusivity D, whose
        density becomes uniform with respect to the volume dx. Its metric is D⁻¹: for small times, heat spreads by the
        distances of D⁻¹. Times have units of time.

        The field interpolates g, or D for Fick's operator, between the nodes. With ``"log-euclidean"`` both are the
        same.

        Examples:
            >>> metric = hj.TensorField.from_diffusion(field.grid, field.tensors, metric="inverse")
            >>> print(jnp.linalg.det(metric.tensors[4, 4]).round(3))  # 1/|D|
            0.25
            >>> diffusion = hj.TensorField.from_diffusion(field.grid, field.tensors, operator="fick")
            >>> pencil = hj.assemble(diffusion)
            >>> print(pencil.measure.round(2), pencil.volume.round(2))  # the integrals of dx and of |D|^(−½) dx
            1.0 0.5
        """
        tensors = _checked_tensors(name, grid, D)
        metric = of_diffusion(metric, operator)
        if metric == "tensor":
            return cls._checked(grid, interpolation, tensors)
        tensors = spd.symmetrise(tensors)
        given = _metric_of_diffusion(spd.identity_outside(tensors, grid.inside), metric)
        return cls(grid, given, interpolation, operator=operator)

    @classmethod
    def from_deformation(
        cls, grid: Grid, F: Any, *, interpolation: Interpolation = "linear", name: str = "F"
    ) -> "TensorField":
        """Return the metric C = FᵀF of a deformation gradient F (*shape, d, d), the right Cauchy–Green tensor.

        ``F[..., i, j]`` is ∂yᵢ/∂xⱼ, where y is the position to which the point x moves, or would move without
        constraints. The metric measures lengths after the deformation, and is invariant to rotations that follow it.

        If F is the gradient of a map y(x), the metric is flat, and its signatures are the signatures of the deformed
        body. If F describes growth, plastic or elastic strain, the curvature of C is the strain's incompatibility
        (docs/strain.md).

        Args:
            grid: the grid of the undeformed coordinates x.
            F: (*shape, d, d) with positive determinants inside the mask; or (*shape, m, d) with m > d, such as the
                Jacobian of a surface in space. Values outside the mask are ignored.
            interpolation: the interpolation of C between the nodes, as for the tensors of a field.
            name: the name of F in messages.

        Raises:
            ValueError: a wrong shape; NaN or infinite values; a determinant that is not positive; a rank below d.

        Examples:
            >>> shear = np.tile([[1.0, 1.0], [0.0, 1.0]], (9, 9, 1, 1))
            >>> print(hj.TensorField.from_deformation(field.grid, shear).tensors[4, 4].tolist())
            [[1.0, 1.0], [1.0, 2.0]]
        """
        C = _checked_tensors(f"{name}ᵀ{name}", grid, right_cauchy_green(name, grid, F))
        return cls._checked(grid, interpolation, C)

    @classmethod
    def from_indefinite(
        cls,
        grid: Grid,
        S: Any,
        how: PositiveMap | None = None,
        number: Any = None,
        *,
        interpolation: Interpolation = "linear",
        name: str = "S",
    ) -> "TensorField":
        """Return a metric made of symmetric tensors S (*shape, d, d) with eigenvalues of either sign, such as stress.

        Indefinite tensors define no metric. Two maps from S to a metric g are available, which keep the eigenvectors
        and the order of the eigenvalues of S (Hotz and others 2004); neither is the default:

        - ``"exp"``: g = exp(S/s), where `number` is the scale s > 0 in the units of S. An eigenvalue σ of S becomes
          exp(σ/s). Choose a scale near the largest absolute value of the eigenvalues.
        - ``"shift"``: g = S + c·I, where `number` is the shift c, larger than minus the least eigenvalue of S. The
          larger the shift, the less the signature depends on S. With a shift just above its lower limit, lengths along
          the strongest compression are almost zero.

        docs/strain.md describes the signatures of the metrics exp(S/s) and S + c·I.

        Args:
            S: the tensors; values outside the mask are ignored.
            how: ``"exp"`` or ``"shift"``.
            number: the scale or the shift; may be traced.
            interpolation: the interpolation of g between nodes. If ``how`` is ``"exp"``, ``"log-euclidean"``
                interpolates S linearly.
            name: the name of S in messages.

        Raises:
            ValueError: a missing or unknown map; a missing number; a wrong shape; NaN, infinite or unsymmetric tensors;
                a scale or shift so small that the metric is singular.

        Examples:
            >>> stress = np.tile(np.diag([1.0, -1.0]), (9, 9, 1, 1))
            >>> print(hj.TensorField.from_indefinite(field.grid, stress, "shift", 2.0).tensors[4, 4].diagonal())
            [3. 1.]
        """
        mapped = positive_map(name, tensors_on(grid, name, S), how, number, grid.inside)
        return cls._checked(grid, interpolation, mapped)

    def __repr__(self) -> str:
        values = "a function" if self.function is not None else describe_array(self._tensors)
        operator = "" if self.operator == "laplace-beltrami" else f", operator={self.operator!r}"
        return f"TensorField({values} on {self.grid!r}, interpolation={self.interpolation!r}{operator})"

    def with_tensors(self, tensors: Any, grid: Grid | None = None) -> "TensorField":
        """Return the field of other metric tensors, on another grid if one is given, with the same settings.

        Examples:
            >>> print(field.with_tensors(2 * field.tensors).tensors[4, 4].diagonal())
            [5. 5.]
        """
        return TensorField(grid or self.grid, tensors, self.interpolation, operator=self.operator)

    @property
    def tensors(self) -> Float[Array, "*shape d d"]:
        """The tensors at the nodes: the symmetric parts of the leaf or of the function's values."""
        # The symmetric part is taken here, and not when the field is made, because the leaf may change afterwards. So
        # gradients with respect to the leaf are symmetric, and a leaf that an optimiser makes unsymmetric is harmless.
        return spd.symmetrise(self._tensors if self.function is None else _evaluate(self.function, self.grid))

    @property
    def domain_tensors(self) -> Float[Array, "*shape d d"]:
        """The tensors for computations: the identity outside the mask, NaN if a tensor is not positive definite."""
        return spd.positive_or_nan(spd.identity_outside(self.tensors, self.grid.inside))


@numpy_where_known(static_argnums=1)
def _metric_of_diffusion(D: Any, metric: MetricChoice) -> Any:
    # In three dimensions −D and D have the same adjugate, so D is set to NaN where it is not positive definite.
    return spd.metric_of_diffusion(spd.nan_unless_positive(D), metric)


def require_laplace_beltrami(field: TensorField, what: str) -> None:
    """Raise ValueError if the field's operator is not that of its metric."""
    if field.operator != "laplace-beltrami":
        raise ValueError(
            f"field: got operator={field.operator!r}, but {what} belongs to the Laplace–Beltrami operator; expected a "
            'metric, such as from_diffusion(grid, D, metric="inverse")'
        )


def require_field(field: Any) -> None:
    """Raise TypeError for anything that is not a tensor field."""
    if not isinstance(field, TensorField):
        raise TypeError(
            f"field: got {type(field).__name__}; expected hks_jax.TensorField. For an array T (*shape, d, d), pass "
            "TensorField(Grid(shape), T)"
        )


def _evaluate(function: jtu.Partial, grid: Grid) -> Float[Array, "*shape_and_components"]:
    # Outside the mask the user's function may be singular, and 0·NaN would make the derivatives with respect to its
    # parameters NaN. So it is evaluated at a node inside the mask, in place of each node outside.
    inside = grid.inside
    nodes = jax_array(np.where(inside[..., None], grid.nodes, grid.nodes[inside][0]).reshape(-1, grid.dimension))
    flat = jax.vmap(lambda x: real_array("fn", function(x)))(nodes).astype(nodes.dtype)
    return flat.reshape(*grid.shape, *flat.shape[1:])


def _checked_tensors(name: str, grid: Grid, tensors: Any) -> Float[Array, "*shape d d"]:
    array = tensors_on(grid, name, tensors)
    if not is_traced(array):
        require_spd(name, np.asarray(array), grid.inside, "node")
    return array
