"""Eigenpairs of a doubled domain: those of its even and odd problems, merged where somebody asks for them."""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.arrays import jax_array
from hks_jax.compilation import numpy_where_known
from hks_jax.eigen.automatic import choose_solvers
from hks_jax.eigen.eigenpairs import Eigenpairs, PencilEigenpairs, view
from hks_jax.eigen.one_pencil import pairs_of_pencil
from hks_jax.eigen.solver import Dense, Eigensolver, Report, Status
from hks_jax.fem.pencil import MirrorPencil
from hks_jax.traced import is_traced

Including = tuple[tuple[int, ...], ...]
"""See `MirrorPencil.including`."""


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
        including: the inclusions of the problems' function spaces; see `MirrorPencil`.
        k: the number of pairs.
    """

    problems: tuple[PencilEigenpairs, ...]
    order: Int[Array, " k"]
    including: Including = eqx.field(static=True)
    k: int = eqx.field(static=True)

    eigenvalues = _merged("eigenvalues")
    residuals = _merged("residuals")
    converged = _merged("converged")
    rounding = _merged("rounding")
    kept = _merged("kept")

    @classmethod
    def of(cls, problems: Sequence[PencilEigenpairs], including: Including, k: int) -> "DoubledEigenpairs":
        """Return the k lowest pairs of all problems; see `MirrorPencil` for ``including``."""
        order = _order([jax.lax.stop_gradient(each.eigenvalues) for each in problems], including, k)
        return cls(tuple(problems), order, including, k)

    def merged(self, values: Sequence[Any]) -> Array:
        """Return the values (…, k) for each pair, given those for the pairs of each problem."""
        return _in_order(list(values), self._known_order, -1)

    @property
    def _known_order(self) -> Int[Array, " k"]:
        order = self.order
        known = None if is_traced(order) or order.dtype == jax.dtypes.float0 else np.sort(np.asarray(order), axis=-1)
        if order.dtype == jax.dtypes.float0 or (known is not None and (np.diff(known, axis=-1) == 0).any()):
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
        return None if None in pencils else MirrorPencil(pencils, self.including)

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
def _order(xp: Any, spectra: Any, including: Including, k: int) -> Any:
    """Return the places (…, k) of the k lowest eigenvalues in the concatenated spectra of all problems."""
    keys: list[Any] = []
    for own, others in zip(spectra, including, strict=True):
        for key in (keys[j] for j in others[:-1]):
            both = min(own.shape[-1], key.shape[-1])
            own = xp.concatenate([xp.maximum(own[..., :both], key[..., :both]), own[..., both:]], axis=-1)
        keys.append(own)
    return xp.argsort(xp.concatenate(keys, axis=-1), axis=-1, stable=True)[..., :k]


@numpy_where_known(static_argnums=2)
def _in_order(xp: Any, values: Any, order: Any, axis: int) -> Any:
    """Return the values of all problems, along an axis, in the order of the k lowest eigenvalues."""
    whole = xp.concatenate(values, axis=axis)
    if order.ndim == 1:
        return xp.take(whole, order, axis=axis)
    return xp.take_along_axis(whole, order if axis == -1 else order[..., None], axis=axis)


@numpy_where_known(static_argnums=1)
def _over(xp: Any, values: Any, name: str) -> Any:
    return getattr(xp, name)(xp.stack(values), axis=0)


@numpy_where_known(static_argnums=2)
def _split(xp: Any, order: Any, kept: Any, sizes: tuple[int, ...]) -> Any:
    """Return the mask of each problem's pairs that are among the kept ones of the k lowest."""
    problem = xp.asarray(np.repeat(np.arange(len(sizes)), sizes))[order]
    return [xp.arange(size) < xp.sum(kept & (problem == i)) for i, size in enumerate(sizes)]


def pairs_of_doubled(
    pencil: MirrorPencil,
    solver: str | Eigensolver,
    k: int,
    throw: bool,
    report: Report,
    starts: Sequence[PencilEigenpairs | None],
) -> DoubledEigenpairs:
    """Return the k lowest pairs of a doubled domain, from its problems, each solved for one more eigenvalue.

    For traced values, each problem is solved for the largest number of pairs that it can have among the k lowest
    (`_limits`). For concrete values, each problem is first solved for an equal share of the k pairs plus a margin, and
    again for twice as many pairs while some of its pairs may be missing.
    """
    parts, limits = pencil.parts, _limits(pencil, k)
    traced = is_traced(jax.lax.stop_gradient(pencil))
    wanted = limits
    if not traced:
        before = [0 if start is None else start.k for start in starts]
        wanted = [min(limit, max(_share(pencil, k), own)) for limit, own in zip(limits, before, strict=True)]
    solvers = choose_solvers(solver, pencil, k)

    def solve(number: int, report: Report) -> PencilEigenpairs:
        part, own, limit = parts[number], solvers[number], limits[number]
        extra = min(1, part.size - wanted[number])
        if limit + extra > own.max_pairs(part.size):  # all pairs of a small problem may be needed
            own = Dense(own.tolerance)
        return pairs_of_pencil(part, own, wanted[number], extra, throw, report, starts[number])

    solved = [solve(i, _of_problem(report, i, len(parts))) for i in range(len(parts))]
    while not traced:
        known = jax.lax.stop_gradient([(pairs.eigenvalues, pairs.next_eigenvalue) for pairs in solved])
        merged = np.sort(np.concatenate([np.append(*each) for each in known]))
        reach = merged[k] if merged.size > k else np.inf
        short = [i for i, (_, end) in enumerate(known) if wanted[i] < limits[i] and not end >= reach]
        if not short:
            break
        for i in short:
            wanted[i] = min(limits[i], 2 * wanted[i])
            solved[i] = solve(i, report)
    return DoubledEigenpairs.of(solved, pencil.including, k).keeping(jax_array(np.ones(k, bool)))


def _limits(pencil: MirrorPencil, k: int) -> list[int]:
    """Return, for each problem, the largest possible number of its pairs among the k lowest pairs of all problems."""
    shares = zip(pencil.including, pencil.parts, strict=True)
    return [min(max(k // len(including), 1), part.size) for including, part in shares]


# By Weyl's law, a problem has N(λ) ≈ V λ^(3/2)/6π² ± S λ/16π eigenvalues below λ in 3D, and (A λ ± L √λ)/4π in 2D; S
# or L is the measure of its boundary. The boundary terms of all problems cancel: with the share m = k/n of each of n
# problems, the k-th eigenvalue of all is about (6π²m/V)^(2/3) or 4πm/A. There the boundary term of the even problem is
# S V^(−2/3) (6π²m)^(2/3)/16π or L √(m/4πA): for a cube 1.8 m^(2/3), for a square 1.1 √m. The margin is 2.5 times as
# large, for domains with a longer boundary.
_MARGIN = {2: 2.8, 3: 4.5}


def _share(pencil: MirrorPencil, k: int) -> int:
    """Return a number of pairs that each problem rarely exceeds among the k lowest pairs of all problems."""
    d, mean = pencil.space.dimension, k / len(pencil.parts)
    return math.ceil(mean + _MARGIN[d] * mean ** (1 - 1 / d)) + 4


def _of_problem(report: Report, number: int, of: int) -> Report:
    """Return a report function that names the current problem, and assumes that each later problem takes as long."""
    begin = time.perf_counter()

    def tell(text: str) -> None:
        left = getattr(text, "seconds_left", None)
        if left is not None:
            left += (of - 1 - number) * (time.perf_counter() - begin + left)
        report(Status(f"problem {number + 1} of {of}: {text}", left))

    return tell
