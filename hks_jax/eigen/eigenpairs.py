"""Eigenpairs, the indicators of their quality, and the truncation of a spectrum."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.arrays import describe_array, jax_array
from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.domain.tensor_checks import MANY
from hks_jax.eigen.multiplets import Cut, MultipletChoice, Spectrum, cut_of, kept_of
from hks_jax.eigen.quality import indistinct
from hks_jax.eigen.rotations import of_simple, with_rotations
from hks_jax.fem.pencil import AnyPencil, Pencil
from hks_jax.fem.space import FunctionSpace, MatrixSpace
from hks_jax.traced import is_traced

_ROUNDED = 1e-3
"""If rounding tensors to float32 changes eigenvalues by more than this relative error, a message reports it."""
UNCERTAIN = 1e-2
"""If rounding matrices to float32 changes eigenvalues by more than this relative error, a message reports it."""
_ZERO = 1e-9
"""The size of an eigenvalue, relative to the last one, up to which it is zero within rounding."""
_SAMPLE = 20_000
"""The number of tensors in the sample that measures anisotropy."""


class RESULTS(eqx.Enumeration):
    """The outcome of a computation of eigenpairs: a traceable code like those of lineax and optimistix."""

    successful = (
        "All eigenpairs converged, and a solver with a certificate (`.complete_below` is not NaN) confirmed that it "
        "missed none."
    )
    not_finite = "The matrices are not finite: tensors are NaN, infinite or not positive definite."
    unconverged = (
        "Some eigenpairs did not converge (see `.converged`), or were not found and are NaN. Use float64, fewer pairs, "
        "or another solver."
    )
    unconfirmed = (
        "The solver could not confirm that it missed no eigenvalue above `.complete_below`. Use another solver, or a "
        "slightly different k."
    )
    uncertain = (
        "Rounding of the matrices may change some eigenvalues by more than 1 % (see `.rounding`). Use float64, or "
        "state the null vectors."
    )


class Eigenpairs(ABC):
    """The k lowest eigenpairs of Kφ = λMφ; a pytree.

    The derivatives of signatures with respect to the matrices use the pencil, not `eigenvalues`. So do not rescale
    `eigenvalues`: derivatives of signatures would then refer to the new array, not to the matrices. Rescale times or
    the pencil instead. Differentiate functions that return attributes, such as `vectors`, not functions that return
    the pairs: the vectors of a tangent of pairs lack rotations. For the boundaries "mirror" and "mean", attributes are
    views of the arrays in `problems`, which are the leaves of the pytree.

    Attributes:
        eigenvalues: (k,) in ascending order, in 1/(metric length)²; exactly 0 for null vectors.
        vectors: (k, n_dof) the coefficients of the eigenfunctions, with φᵢᵀMφⱼ = δᵢⱼ. For the boundaries "mirror" and
            "mean", M is the mass of the domain doubled m times; on the domain itself, the norm of each φᵢ is 1/√2ᵐ. The
            derivative of a vector is NaN unless its eigenvalue is simple and kept.
        at_nodes: (k, n_dof) the eigenfunctions' values at the free nodes: `vectors`, unless the quadrature is
            ``"cancelling"``.
        residuals: (k,) ‖Kφ − λMφ‖ / ‖Mφ‖ / max(λ, λ₁), where λ₁ is the first positive eigenvalue. If the null
            space is unknown, max(λ, λ₁) is replaced by the larger of two numbers: the mean gap of the eigenvalues, and
            the distance of λ from the spectrum's known lower bound or, without one, from the lowest eigenvalue.
        converged: (k,) whether the residual is at most the solver's tolerance, or at most the level of rounding.
        rounding: (k,) for small eigenvalues of float32 matrices, the error that rounding of the matrices' entries may
            cause; 0 for other eigenvalues, and for eigenvalues that are zero in float64 too. An eigenvalue is small if
            the rounding of the largest one may change it by more than 1 % (outside of `jit` on CPUs), or 100 % (under
            `jit` and on accelerators). Derivatives treat `rounding` as a constant.
        kept: (k,) whether each pair belongs to the truncated spectrum; signatures ignore the other pairs. The choices
            ``multiplet="drop"`` and ``"complete"`` may exclude the last pairs.
        next_eigenvalue: the first eigenvalue that is not kept; infinite if it does not exist. Derivatives treat
            `next_eigenvalue` as a constant.
        complete_below: the bound below which the solver certifies that it missed no eigenvalue, by Sylvester's law of
            inertia or because it computed all eigenvalues; NaN without a certificate. The solver may have computed more
            than k pairs: no eigenvalue below both `complete_below` and `next_eigenvalue` is missing among the k.
            Derivatives treat `complete_below` as a constant.
        spectral_origin: the reference point of relative errors: 0 if K ⪰ 0 is known, otherwise the lowest eigenvalue.
        multiplet_tolerance: the gap, relative to the distance from `spectral_origin`, below which neighbouring
            eigenvalues count as equal. If the null space is unknown, gaps at the level of rounding count as zero too.
        problems: the eigenpairs of each problem, which belong to one pencil. For the boundaries "mirror" and "mean",
            these are the even problem (Neumann) and the odd problems; their `kept` marks the pairs that are among the
            k lowest of the doubled domain. Signatures are the mean of the problems' signatures. For other boundaries,
            the only problem is the result itself.
        pencil: the matrices K and M.
        solver_name: the name of the solver.
        k: the number of pairs.
    """

    eigenvalues: Float[Array, " k"]
    vectors: Float[Array, "k n_dof"]
    at_nodes: Float[Array, "k n_dof"]
    residuals: Float[Array, " k"]
    converged: Bool[Array, " k"]
    rounding: Float[Array, " k"]
    kept: Bool[Array, " k"]
    next_eigenvalue: Float[Array, ""]
    complete_below: Float[Array, ""]
    spectral_origin: Float[Array, ""]
    multiplet_tolerance: Float[Array, ""]
    problems: "tuple[PencilEigenpairs, ...]"
    pencil: AnyPencil
    solver_name: str
    k: int

    @abstractmethod
    def with_problems(self, problems: "Iterable[PencilEigenpairs]") -> "Eigenpairs":
        """Return eigenpairs of other problems."""

    @abstractmethod
    def keeping(self, kept: Bool[Array, " k"]) -> "Eigenpairs":
        """Keep only the marked pairs, the lowest ones; signatures then ignore the other pairs."""

    @abstractmethod
    def merged(self, values: Sequence[Any]) -> Array:
        """Return the values (…, k) for each pair, given those for the pairs of each problem."""

    def of_even(self, values: Float[Array, "*leading k0"] | Bool[Array, " k0"]) -> Array:
        """Return values (…, k) for each pair, given those for the pairs of the first problem; 0 for all other pairs."""
        odd = [jax_array(np.zeros((*values.shape[:-1], each.k), values.dtype)) for each in self.problems[1:]]
        return self.merged([values, *odd])

    @property
    def problem_numbers(self) -> Int[Array, " k"]:
        """The number of the problem that each pair belongs to: 0 for the even one."""
        return self.merged([jax_array(np.full(each.k, i)) for i, each in enumerate(self.problems)])

    def __repr__(self) -> str:
        return (
            f"Eigenpairs(k={self.k} of {self.n_unknowns}, eigenvalues {describe_array(self.eigenvalues)}, "
            f"vectors {describe_array(self.vectors)}, solver_name={self.solver_name!r})"
        )

    @property
    def _pencils(self) -> list[Pencil]:
        return [each.pencil for each in self.problems if each.pencil is not None]

    @property
    def n_unknowns(self) -> int:
        """The number of all eigenvalues of the matrices."""
        return sum(pencil.size for pencil in self._pencils)

    def truncated(self, k: int, multiplet: MultipletChoice) -> "Eigenpairs":
        """Keep the lowest k pairs, or a different number if the cut would split a multiple eigenvalue.

        ``"report"`` keeps exactly k. If k cuts a multiple eigenvalue, ``"drop"`` excludes its pairs, unless no pair
        would remain; ``"complete"`` includes all its pairs if they were computed, and otherwise excludes them.
        """
        return self.keeping(kept_of(self._spectrum, k, multiplet))

    @property
    def eigenfunctions(self) -> Float[Array, "k *shape"]:
        """The eigenfunctions at the nodes: NaN outside the mask, zero at Dirichlet nodes."""
        return self.space.extend(self.at_nodes)

    @property
    def space(self) -> FunctionSpace:
        """The function space of the eigenfunctions."""
        return self.pencil.space

    @property
    def null_space_known(self) -> bool:
        """Whether the pencils' null spaces are known."""
        # `Eigenpairs` in the outcome of a fit have no pencil. A fit is for a tensor field, whose null space is known.
        return all(pencil.null_space is not None for pencil in self._pencils)

    @property
    def n_null(self) -> int:
        """The number of zero eigenvalues among the k eigenvalues.

        Raises:
            ValueError: values are traced and the null space is unknown.
        """
        if self.null_space_known:
            return min(self.k, sum(pencil.n_null for pencil in self._pencils))
        values = jax.lax.stop_gradient(self.eigenvalues)
        if is_traced(values):
            raise ValueError(
                "pairs: got traced values, which do not show the number of zero eigenvalues; give `sparse_pencil` the "
                "null vectors"
            )
        return int((values == 0).sum())

    @property
    def cut_multiplet(self) -> Array:
        """The number of kept pairs of the multiple eigenvalue that the cut divides; 0 if the cut divides none."""
        return self._cut.cut_multiplet

    @property
    def multiplets(self) -> Int[Array, " k"]:
        """The number of the multiple eigenvalue that each eigenvalue belongs to, from 0, as `cut_multiplet` tells."""
        return self._cut.multiplets

    @property
    def _spectrum(self) -> Spectrum:
        # A known null space makes the lowest eigenvalues exact, and the distance of the others from zero is accurate.
        pairs = jax.lax.stop_gradient(self)
        values, unknown = pairs.eigenvalues, [pencil for pencil in pairs._pencils if pencil.null_space is None]
        rounding = jnp.zeros((), values.dtype)
        if unknown:
            rounding = jnp.max(jnp.stack([indistinct(pencil, values.dtype) for pencil in unknown]))
        return Spectrum(values, pairs.next_eigenvalue, pairs.spectral_origin, pairs.multiplet_tolerance, rounding)

    @property
    def unconfirmed(self) -> Bool[Array, ""]:
        """Whether the solver's certificate ends below the last kept eigenvalue.

        If a lower bound of the spectrum is known, no certificate is needed, because some solvers give none.
        """
        return self._cut.unconfirmed

    @property
    def _cut(self) -> Cut:
        optional = all(pencil.bounded for pencil in self._pencils)
        return cut_of(self._spectrum, self.kept, jax.lax.stop_gradient(self.complete_below), optional)

    @property
    def uncertain(self) -> Bool[Array, " k"]:
        """Whether `rounding` is more than 1 % of each eigenvalue; even the sign of the eigenvalue may be uncertain."""
        return _uncertain(self.kept, self.rounding, jax.lax.stop_gradient(self.eigenvalues))

    @property
    def result(self) -> RESULTS:
        """The traceable code of the most serious failure, for a comparison with ``RESULTS.successful``."""
        finite = _all_finite([leaf for leaf in jax.tree.leaves(self._pencils) if eqx.is_inexact_array(leaf)])
        code: Any = RESULTS  # mypy sees its members as strings
        result = code.where(jnp.any(self.uncertain), code.uncertain, code.successful)
        result = code.where(self.unconfirmed, code.unconfirmed, result)
        result = code.where(jnp.all(self.converged), result, code.unconverged)
        return code.where(finite, result, code.not_finite)

    def messages(self) -> list[str]:
        """Return sentences that describe defects of these pairs. Values must be concrete."""
        other = "a larger basis or another solver" if "shift-invert" in self.solver_name else "another solver"
        values, bad = np.asarray(self.eigenvalues), ~np.asarray(self.converged)
        kept, (_, cut_multiplet, unconfirmed) = int(np.asarray(self.kept).sum()), self._cut
        cut = int(cut_multiplet)
        sentences, last = [], values[kept - 1]
        lost = bad & (np.arange(values.size) >= self.n_null) & (np.abs(values) <= _ZERO * abs(last))
        given = any(isinstance(pencil.space, MatrixSpace) for pencil in self._pencils)
        if given and self.null_space_known and lost.any():
            sentences.append(
                f"K has {int(lost.sum())} null vectors beyond the {self.n_null} given: expected a basis of its whole "
                "null space as null_vectors. Add them, or give none"
            )
        elif bad.any():
            missing, worst = int(np.isnan(values).sum()), np.nanmax(np.asarray(self.residuals)[bad], initial=0.0)
            found = f"; the largest relative residual of the others is {worst:.1e}" if missing < bad.sum() else ""
            better = "" if values.dtype == np.float64 else "float64, "
            sentences.append(
                f"{int(bad.sum())} of {values.size} eigenpairs did not converge ({missing} were not found{found}) "
                f"with the {self.solver_name} solver. Use {better}fewer pairs, or {other}"
            )
        if bool(unconfirmed) and not np.isnan(last):
            bound = float(self.complete_below)
            where = f"below {last:.6g}" if np.isnan(bound) else f"between {bound:.6g} and {last:.6g}"
            sentences.append(
                f"the {self.solver_name} solver could not confirm that it missed no eigenvalue {where}. "
                f"Use slightly more or fewer pairs, or {other}"
            )
        if cut:
            fewer = f"k = {kept - cut} or " if cut < kept else ""
            sentences.append(
                f"k = {kept} cuts a multiple eigenvalue: the last {cut} pair(s), at λ = {last:.6g}, are an arbitrary "
                f"part of its eigenspace. Take {fewer}the k that `count_eigenvalues` counts just above this λ"
            )
        if (uncertain := np.asarray(self.uncertain)).any():
            some = ", ".join(f"{value:.3g}" for value in values[uncertain][:3])
            most, of = float(np.asarray(self.rounding)[uncertain].max()), int(uncertain.sum())
            stated = ", or give `sparse_pencil` the null vectors" * (given and not self.null_space_known)
            single = values.dtype == np.float32
            remedy = "Use float64" if single else "Eliminate unknowns instead of fixing them by large entries"
            sentences.append(
                f"{of} of {values.size} eigenvalues (λ = {some}{', …' * (of > 3)}) are uncertain: rounding of the "
                f"matrices to {values.dtype} changes them by up to {most:.1e}. {remedy}{stated}"
            )
        stretch = _anisotropy(self._pencils) if values.dtype == np.float32 else 1.0
        if (rounding := np.finfo(np.float32).eps * stretch) > _ROUNDED:
            sentences.append(
                f"the ratio of a tensor's eigenvalues is up to {stretch:.1e}: rounding such tensors to "
                f"float32 changes eigenvalues by up to {rounding:.0e}, which residuals do not show. Use float64"
            )
        return sentences

    def summary(self) -> str:
        """Describe size, method, range and quality in a few lines. Values must be concrete."""
        require_pairs(self)
        values, residuals = np.asarray(self.eigenvalues), np.asarray(self.residuals)
        kept, following = int(np.asarray(self.kept).sum()), float(self.next_eigenvalue)
        last = values[kept - 1]
        lines = [
            f"{self.k} eigenpairs of {self.n_unknowns} by {self.solver_name}",
            f"eigenvalues {values[0]:.6g} … {last:.6g} ({self.n_null} zero; the next is {following:.6g})",
            f"worst relative residual {np.max(residuals):.1e}; {int(np.sum(self.converged))} of {self.k} converged",
        ]
        bound = float(self.complete_below)
        if not np.isnan(bound):
            lines.append("none missed" if bound > min(last, following) else f"none missed below {bound:.6g}")
        if kept < self.k:
            lines.append(f"{kept} of them kept, so that no multiple eigenvalue is cut")
        return "\n".join(lines + self.messages())


def view(of: Callable[[Any], Any]) -> Any:
    """Return a property in place of an attribute that a base class only declares."""
    return property(of)


class PencilEigenpairs(Eigenpairs, eqx.Module):
    """The k lowest eigenpairs of one pencil.

    Attributes:
        frame: (k, n_dof) the values of `vectors`, but with a derivative that excludes rotations of eigenvectors among
            themselves, which are singular at multiple eigenvalues. Derivatives of signatures include the effect of such
            rotations by divided differences.
        spare: the vectors after the k-th that a `ChebyshevFilter` with ``keep_spare`` has computed, which do not count
            as converged. `eigenpairs` uses them to start from these pairs. None for other solvers.
    """

    eigenvalues: Float[Array, " k"]
    residuals: Float[Array, " k"]
    converged: Bool[Array, " k"]
    rounding: Float[Array, " k"]
    kept: Bool[Array, " k"]
    next_eigenvalue: Float[Array, ""]
    complete_below: Float[Array, ""]
    spectral_origin: Float[Array, ""]
    multiplet_tolerance: Float[Array, ""]
    frame: Float[Array, "k n_dof"]
    pencil: Pencil
    solver_name: str = eqx.field(static=True)
    spare: Float[Array, "spare n_dof"] | None = None

    @view
    def problems(self) -> "tuple[PencilEigenpairs, ...]":
        """The pairs themselves, as the only problem."""
        return (self,)

    @view
    def k(self) -> int:
        """The number of pairs."""
        return self.eigenvalues.shape[-1]

    @view
    def vectors(self) -> Float[Array, "k n_dof"]:
        """The coefficients of the eigenfunctions; the derivative of a vector is NaN unless it is simple and kept."""
        if self.pencil is None:
            return self.frame
        values, following = jax.lax.stop_gradient((self.eigenvalues, self.next_eigenvalue))
        vectors = with_rotations(self.frame, values, self.pencil)
        return of_simple(vectors, values, following, self.kept, self.pencil)

    @view
    def at_nodes(self) -> Float[Array, "k n_dof"]:
        """The eigenfunctions' values at the free nodes."""
        return self.pencil.read(self.vectors)

    def with_problems(self, problems: "Iterable[PencilEigenpairs]") -> "PencilEigenpairs":
        """Return the only problem."""
        (problem,) = problems
        return problem

    def keeping(self, kept: Bool[Array, " k"]) -> "PencilEigenpairs":
        """Keep only the marked pairs, the lowest ones."""
        following = _first_beyond(kept, *jax.lax.stop_gradient((self.eigenvalues, self.next_eigenvalue)))
        return eqx.tree_at(lambda p: (p.kept, p.next_eigenvalue), self, (kept, following))

    def merged(self, values: Sequence[Any]) -> Array:
        """Return the values of the only problem."""
        return values[0]


@numpy_where_known()
def _first_beyond(kept: Any, values: Any, following: Any) -> Any:
    xp = library_of(values)
    return xp.append(values, following)[xp.sum(kept)]


def require_pairs(pairs: Eigenpairs) -> Eigenpairs:
    """Return the pairs; raise TypeError or ValueError unless they are eigenpairs of one domain."""
    if not isinstance(pairs, Eigenpairs):
        raise TypeError(f"pairs: got {type(pairs).__name__}; expected the result of `eigenpairs`")
    if pairs.problems[0].eigenvalues.ndim != 1:
        raise ValueError(
            f"pairs: got a batch with eigenvalues of shape {pairs.eigenvalues.shape}; expected (k,). Use jax.vmap, or "
            "jax.tree.map(lambda x: x[i], pairs) for one of them"
        )
    return pairs


def _anisotropy(pencils: list[Pencil]) -> float:
    """Return a high quantile of the tensors' eigenvalue ratios in a sample of the grid; 1 if there is no grid."""
    metric = pencils[0].metric if pencils else None
    if metric is None or metric.spacing is None or not getattr(metric.tensors, "is_fully_addressable", True):
        return 1.0
    tensors, d = metric.tensors, metric.tensors.shape[-1]
    if tensors.size > _SAMPLE * d * d:
        tensors = tensors.reshape(-1, d, d)[:: tensors.size // (_SAMPLE * d * d)]
    sample = np.asarray(tensors, np.float64).reshape(-1, d, d)
    values = np.linalg.eigvalsh(sample[np.isfinite(sample).all(axis=(1, 2))])
    values = values[values[:, 0] > 0]
    return float(np.quantile(values[:, -1] / values[:, 0], 1 - MANY)) if len(values) else 1.0


@numpy_where_known()
def _uncertain(kept: Any, rounding: Any, values: Any) -> Any:
    return kept & (rounding > UNCERTAIN * abs(values))


@numpy_where_known()
def _all_finite(arrays: list[Any]) -> Any:
    xp = library_of(*arrays)
    return xp.all(xp.stack([xp.all(xp.isfinite(array)) for array in arrays]))
