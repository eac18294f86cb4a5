"""A field of symmetric positive definite tensors on a grid: a Riemannian metric."""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.traced import is_traced

MetricChoice = Literal["tensor", "inverse", "adjugate"]


class TensorField(eqx.Module):
    """A Riemannian metric given at the nodes of a grid.

    A pytree: the tensors (or the arrays inside the metric's function) are its leaves, the grid is structure.
    Values are checked where they are known; under `jit`, `grad` or `vmap` only shapes are, and a tensor that is not
    positive definite gives NaN.

    Args:
        grid: the grid.
        tensors: (*shape, d, d), symmetric positive definite inside the mask; ``tensors[i, j, 0, 1]`` is T₁₂ at node
            (i, j). Units: (length / coordinate unit)². Values outside the mask are ignored.

    Raises:
        ValueError: wrong shape; NaN or infinite, unsymmetric or not positive definite inside the mask (with how many
            nodes fail, where the first is, and the worst eigenvalue).
    """

    grid: Grid = eqx.field(static=True)
    function: jtu.Partial | None
    _tensors: Float[Array, "*shape d d"] | None

    def __init__(self, grid: Grid, tensors: Any) -> None:
        self.grid = grid
        self.function = None
        self._tensors = spd.symmetrise(_checked_tensors("tensors", grid, tensors))

    @classmethod
    def from_function(cls, fn: Callable[[Array], Any], grid: Grid) -> "TensorField":
        """Return the metric ``fn``, which maps coordinates (d,) to a tensor (d, d) and is differentiable by JAX.

        The function stays with the field, so that curvature and its derivatives are exact. Parameters that should
        be traced belong in a `jax.tree_util.Partial` or an Equinox module.
        """
        function: Any = fn if isinstance(fn, jtu.Partial | eqx.Module) else jtu.Partial(fn)
        field = cls.__new__(cls)
        object.__setattr__(field, "grid", grid)
        object.__setattr__(field, "function", function)
        object.__setattr__(field, "_tensors", None)
        _checked_tensors("fn", grid, _evaluate(function, grid))
        return field

    @classmethod
    def from_diffusion(
        cls, grid: Grid, D: Any, metric: MetricChoice | None = None, *, name: str = "D"
    ) -> "TensorField":
        """Return the metric of a field of diffusion tensors D (*shape, d, d).

        There is no default for ``metric``, because the two meanings in use differ:

        - ``"inverse"``: g = D⁻¹, the metric whose distances diffusion with diffusivity D takes (t in units of time);
        - ``"tensor"``: g = D, as in Zobel, Reininghaus and Hotz;
        - ``"adjugate"``: g = |D| D⁻¹, the inverse scaled so that |g| = |D|^(d−1).
        """
        check_metric_choice(metric)
        tensors = spd.symmetrise(_checked_tensors(name, grid, D))
        if metric == "tensor":
            return cls(grid, tensors)
        tensors = _identity_outside(grid, tensors)
        return cls(grid, spd.inverse(tensors) if metric == "inverse" else spd.adjugate(tensors))

    @property
    def tensors(self) -> Float[Array, "*shape d d"]:
        """The tensors at the nodes, symmetric."""
        if self.function is None:
            assert self._tensors is not None
            return self._tensors
        return spd.symmetrise(_evaluate(self.function, self.grid))

    @property
    def domain_tensors(self) -> Float[Array, "*shape d d"]:
        """The tensors, with the identity outside the mask: what computations read."""
        return _identity_outside(self.grid, self.tensors)


def check_metric_choice(metric: str | None) -> None:
    """Raise ValueError unless it names what metric diffusion tensors stand for."""
    if metric not in ("tensor", "inverse", "adjugate"):
        raise ValueError(
            f'metric: got {metric!r}; expected "inverse" (g = D⁻¹, the distances of diffusion), '
            '"tensor" (g = D, as in the paper) or "adjugate" (g = |D| D⁻¹). There is no default: choose one'
        )


def _evaluate(function: jtu.Partial, grid: Grid) -> Float[Array, "*shape_and_components"]:
    # Outside the mask the function may be singular, and 0·NaN would reach its parameters' derivatives: there it is
    # evaluated at a node inside instead.
    inside = grid.inside
    nodes = jnp.asarray(np.where(inside[..., None], grid.nodes, grid.nodes[inside][0]))
    flat = jax.vmap(lambda x: jnp.asarray(function(x), dtype=nodes.dtype))(nodes.reshape(-1, grid.dimension))
    return flat.reshape(*grid.shape, *flat.shape[1:])


def _identity_outside(grid: Grid, tensors: Float[Array, "*shape d d"]) -> Float[Array, "*shape d d"]:
    if grid.mask is None:
        return tensors
    return jnp.where(grid.mask[..., None, None], tensors, jnp.eye(grid.dimension, dtype=tensors.dtype))


def _checked_tensors(name: str, grid: Grid, tensors: Any) -> Float[Array, "*shape d d"]:
    if not isinstance(grid, Grid):
        raise TypeError(f"grid: got {type(grid).__name__}; expected hks_jax.Grid")
    d = grid.dimension
    expected = f"(*grid.shape, d, d) = {(*grid.shape, d, d)}, one tensor per node"
    return checked_tensors(name, tensors, grid.inside, d, expected)


def checked_tensors(
    name: str, tensors: Any, inside: np.ndarray, d: int, expected: str, place: str = "node"
) -> Float[Array, "*shape d d"]:
    """Return tensors (*inside.shape, d, d) as floating point; raise ValueError unless they are SPD inside."""
    array = jnp.asarray(tensors)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))
    if array.shape != (*inside.shape, d, d):
        raise ValueError(f"{name}: got shape {array.shape}; expected {expected}")
    if not is_traced(array):
        _check_spd(name, np.asarray(array), inside, place)
    return array


def _check_spd(name: str, tensors: Float[np.ndarray, "*shape d d"], inside: np.ndarray, place: str = "node") -> None:
    """Raise ValueError unless the tensors are finite, symmetric and positive definite inside."""
    require_finite_symmetric(name, tensors, inside, place)
    bad = inside & ~spd.is_spd(tensors)
    if bad.any():
        worst = np.linalg.eigvalsh(tensors[bad].astype(np.float64)).min()
        _fail(
            name,
            bad,
            inside,
            place,
            f"not positive definite, worst eigenvalue {worst:.3g}",
            "Exclude these nodes by the grid's mask, or raise their eigenvalues (hks_jax.io.repair_tensors)",
        )


def require_finite_symmetric(
    name: str,
    tensors: Float[np.ndarray, "*shape d d"],
    inside: np.ndarray,
    place: str,
    remedy: str = "Exclude these nodes by the grid's mask",
) -> None:
    """Raise ValueError unless the tensors are finite and symmetric inside; `remedy` is for NaN."""
    finite = np.isfinite(tensors).all(axis=(-2, -1))
    bad = inside & ~finite
    if bad.any():
        _fail(name, bad, inside, place, "NaN or infinite", remedy)
    scale = np.abs(tensors).max(axis=(-2, -1))
    skew = np.abs(tensors - np.swapaxes(tensors, -1, -2)).max(axis=(-2, -1))
    bad = inside & (skew > 1e-5 * scale)
    if bad.any():
        what = "Pass (T + Tᵀ)/2 if the difference is noise, or check the component order"
        _fail(name, bad, inside, place, "unsymmetric", what)


def _fail(name: str, bad: np.ndarray, inside: np.ndarray, place: str, what: str, remedy: str) -> None:
    first = tuple(int(i) for i in np.argwhere(bad)[0])
    raise ValueError(
        f"{name}: {int(bad.sum())} of {int(inside.sum())} tensors are {what} (the first at {place} {first}); "
        f"expected symmetric positive definite tensors. {remedy}"
    )
