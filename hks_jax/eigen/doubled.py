"""Eigenpairs of a doubled domain: those of its even and odd problems, merged where somebody asks for them."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.eigen.eigenpairs import Eigenpairs, PencilEigenpairs, view
from hks_jax.fem.pencil import Inclusions, MirrorPencil
from hks_jax.traced import is_traced


def _array(of: Callable[[Any], Array]) -> Any:
    """Return a property whose value is an array, or its shape if the pairs are shapes as in `jax.eval_shape`."""

    def read(pairs: Any) -> Any:
        return jax.eval_shape(of, pairs) if isinstance(pairs.order, jax.ShapeDtypeStruct) else of(pairs)

    return property(read)


def _merged(name: str) -> Any:
    """Return a property: the attribute of the problems' pairs, merged in ascending order of eigenvalues."""
    return _array(lambda pairs: pairs.merged([getattr(each, name) for each in pairs.problems]))


class DoubledEigenpairs(Eigenpairs, eqx.Module):
    """The k lowest eigenpairs of a doubled domain, which are views of the pairs of its even and odd problems.

    Attributes:
        problems: the eigenpairs of each problem; `kept` marks those that are among the k lowest of the doubled domain.
        order: the places of the k lowest eigenvalues in the concatenated spectra of all problems.
        k: the number of pairs.
    """

    problems: tuple[PencilEigenpairs, ...]
    order: Int[Array, " k"]
    k: int = eqx.field(static=True)

    eigenvalues = _merged("eigenvalues")
    residuals = _merged("residuals")
    converged = _merged("converged")
    rounding = _merged("rounding")
    kept = _merged("kept")

    @classmethod
    def of(cls, problems: Sequence[PencilEigenpairs], k: int) -> "DoubledEigenpairs":
        """Return the k lowest pairs of all problems."""
        including = MirrorPencil(tuple(each.pencil for each in problems)).including
        order = _order([jax.lax.stop_gradient(each.eigenvalues) for each in problems], including, k)
        return cls(tuple(problems), order, k)

    def merged(self, values: Sequence[Any]) -> Array:
        """Return the values (…, k) for each pair, given those for the pairs of each problem."""
        return _in_order(list(values), self._known_order, -1)

    @property
    def _known_order(self) -> Int[Array, " k"]:
        order = self.order
        places = None if is_traced(order) or order.dtype == jax.dtypes.float0 else np.sort(np.asarray(order), axis=-1)
        if order.dtype == jax.dtypes.float0 or (places is not None and (np.diff(places, axis=-1) == 0).any()):
            raise ValueError(
                'pairs: got a derivative or difference of eigenpairs with the boundary "mean" or "mirror", which does '
                "not know the order of the eigenvalues. Differentiate a function that returns `pairs.eigenvalues` or "
                "another attribute, not the pairs; or use the eigenpairs in `.problems`"
            )
        return order

    # An eigenfunction has norm 1 on the domain doubled m times, hence norm 1/√2ᵐ on the domain itself. The values at
    # the free nodes of the even problem, which has all free nodes, are 0 at Dirichlet nodes of the other problems.
    def _functions(self, of_problems: Sequence[Float[Array, "_k _n"]]) -> Float[Array, "k n_dof"]:
        rows = [each.space.transfer(own, self.space) for each, own in zip(self.problems, of_problems, strict=True)]
        return _in_order(rows, self._known_order, -2) / math.sqrt(len(rows))

    @_array
    def vectors(self) -> Float[Array, "k n_dof"]:
        """The coefficients of the eigenfunctions, with norm 1 on the doubled domain."""
        return self._functions([each.vectors for each in self.problems])

    @_array
    def at_nodes(self) -> Float[Array, "k n_dof"]:
        """The eigenfunctions' values at the free nodes."""
        return self._functions([each.at_nodes for each in self.problems])

    @_array
    def next_eigenvalue(self) -> Float[Array, ""]:
        """The first eigenvalue that is not kept."""
        return _over([each.next_eigenvalue for each in self.problems], "nanmin")

    @_array
    def complete_below(self) -> Float[Array, ""]:
        """The bound below which none of the eigenvalues is missing in any problem."""
        return _over([each.complete_below for each in self.problems], "min")

    @_array
    def spectral_origin(self) -> Float[Array, ""]:
        """The origin of the even problem, whose lowest eigenvalue is the lowest of all."""
        return self.problems[0].spectral_origin

    @_array
    def multiplet_tolerance(self) -> Float[Array, ""]:
        """The largest tolerance of all problems."""
        return _over([each.multiplet_tolerance for each in self.problems], "max")

    @view
    def pencil(self) -> MirrorPencil | None:
        """The matrices of all problems."""
        pencils = tuple(each.pencil for each in self.problems)
        return None if None in pencils else MirrorPencil(pencils)

    @view
    def solver_name(self) -> str:
        """The names of the problems' solvers."""
        return " + ".join(dict.fromkeys(each.solver_name for each in self.problems))

    def with_problems(self, problems: Iterable[PencilEigenpairs]) -> "DoubledEigenpairs":
        """Return the pairs of other problems."""
        return replace(self, problems=tuple(problems))

    def keeping(self, kept: Bool[Array, " k"]) -> "DoubledEigenpairs":
        """Keep only the marked pairs, the lowest ones, which are the lowest ones of each problem."""
        own = _split(self.order, kept, tuple(each.k for each in self.problems))
        return self.with_problems(each.keeping(mask) for each, mask in zip(self.problems, own, strict=True))


# The j-th eigenvalue of a problem is sorted by the maximum of itself and the j-th eigenvalues of all problems whose
# function spaces include that of this problem. Without rounding this maximum is the eigenvalue itself, because a larger
# function space has no larger j-th eigenvalue. If the j-th eigenvalues of two problems are equal, rounding may exchange
# their order. The problem with the smaller space could then have more of the lowest eigenvalues of the doubled domain
# than `MirrorPencil.including` allows.
@numpy_where_known(static_argnums=(1, 2))
def _order(spectra: Any, including: Inclusions, k: int) -> Any:
    """Return the places (…, k) of the k lowest eigenvalues in the concatenated spectra of all problems."""
    xp = library_of(*spectra)
    keys: list[Any] = []
    for own, others in zip(spectra, including, strict=True):
        for key in (keys[j] for j in others[:-1]):
            both = min(own.shape[-1], key.shape[-1])
            own = xp.concatenate([xp.maximum(own[..., :both], key[..., :both]), own[..., both:]], axis=-1)
        keys.append(own)
    return xp.argsort(xp.concatenate(keys, axis=-1), axis=-1, stable=True)[..., :k]


@numpy_where_known(static_argnums=2)
def _in_order(values: Any, order: Any, axis: int) -> Any:
    """Return the values of all problems, along an axis, in the order of the k lowest eigenvalues."""
    xp = library_of(order)
    whole = xp.concatenate(values, axis=axis)
    if order.ndim == 1:
        return xp.take(whole, order, axis=axis)
    return xp.take_along_axis(whole, order if axis == -1 else order[..., None], axis=axis)


@numpy_where_known(static_argnums=1)
def _over(values: Any, name: str) -> Any:
    xp = library_of(*values)
    return getattr(xp, name)(xp.stack(values), axis=0)


@numpy_where_known(static_argnums=2)
def _split(order: Any, kept: Any, sizes: tuple[int, ...]) -> Any:
    """Return the mask of each problem's pairs that are among the kept ones of the k lowest."""
    xp = library_of(order)
    problem = xp.asarray(np.repeat(np.arange(len(sizes)), sizes))[order]
    return [xp.arange(size) < xp.sum(kept & (problem == i)) for i, size in enumerate(sizes)]
