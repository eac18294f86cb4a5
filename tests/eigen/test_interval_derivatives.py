"""Derivatives of the eigenpairs in an interval."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from pencils import directions, graph_laplacian, indefinite, lattice

import hks_jax as hj
from hks_jax.eigen.adjoints.factorised_adjoint import InteriorAdjoint
from hks_jax.eigen.inertia import certain_count, lowered, translated

SOLVER = hj.BlockLanczos(block=4)


def mass(K):
    """A positive definite matrix with the pattern of K that has the eigenvectors of no other."""
    return sp.diags(np.linspace(1, 2, K.shape[0])) + 1e-2 * abs(K)


def spectrum(pencil):
    """All eigenpairs, the vectors as rows."""
    values, vectors = hj.eigh(pencil.stiffness.to_dense(), pencil.mass.to_dense())
    return values, vectors.T


def between(values, first: int, last: int) -> tuple[float, float]:
    """An interval with the eigenvalues first … last − 1."""
    padded = np.concatenate([[2 * values[0] - values[1]], values, [2 * values[-1] - values[-2]]])
    return float(padded[first : first + 2].mean()), float(padded[last : last + 2].mean())


def basis_free(values, squares, weights):
    """What no basis of a multiple eigenvalue changes, nor which of its copies is which: Σ sin λᵢ + Σ w·φᵢ²."""
    return jnp.sum(jnp.sin(values)) + jnp.sum(squares * weights)


def squares(pairs):
    return hj.spectral_signature(pairs, one, jnp.zeros(1))[0]


def one(_, x):
    return jnp.ones_like(x)


def along(gradient, change):
    """The product of a gradient and a change, both pencils."""
    pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(change), strict=True)
    return sum(jnp.vdot(g, c) for g, c in pairs)


def check(pencil, first, last, solver, rng, tolerance=1e-7):
    """Reverse mode against forward mode, and both against the derivative of all eigenpairs at once."""
    weights = jnp.asarray(rng.standard_normal(pencil.size))
    ends = between(spectrum(pencil)[0], first, last)

    def run(pencil):
        pairs = hj.eigsh(pencil, interval=ends, solver=solver, k=last - first)
        return basis_free(pairs.eigenvalues, squares(pairs), weights)

    def exact(pencil):
        values, vectors = spectrum(pencil)
        return basis_free(values[first:last], jnp.sum(vectors[first:last] ** 2, axis=0), weights)

    value, gradient = jax.value_and_grad(run)(pencil)
    reference, expected = jax.value_and_grad(exact)(pencil)
    np.testing.assert_allclose(value, reference, rtol=1e-10)
    for change in directions(pencil, rng):
        right = along(expected, change)
        np.testing.assert_allclose(along(gradient, change), right, rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(jax.jvp(run, (pencil,), (change,))[1], right, rtol=tolerance, atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, pytest.param(SOLVER, marks=pytest.mark.slow)])
def test_multiple_eigenvalues(rng, solver):
    """A torus, whose eigenvalues come in groups of four and eight."""
    K = lattice(18)
    pencil = hj.sparse_pencil(K, sp.eye(324) + 1e-2 * abs(K))
    gaps = np.flatnonzero(np.diff(spectrum(pencil)[0]) > 1e-2) + 1
    first = np.searchsorted(gaps, 60)
    check(pencil, int(gaps[first]), int(gaps[first + 4]), solver, rng)


@pytest.mark.slow
@pytest.mark.parametrize(("first", "last"), [(100, 115), (0, 12), (290, 300), (40, 41)])
def test_an_indefinite_matrix(rng, first, last):
    """In the middle of the spectrum, at both of its ends, and one pair alone."""
    check(hj.sparse_pencil(*indefinite(300)), first, last, SOLVER, rng)


@pytest.mark.slow
def test_an_eigenvalue_with_a_hundred_copies(rng):
    K = graph_laplacian(3, 120)
    pencil = hj.sparse_pencil(K, sp.eye(480) + 1e-3 * abs(K))
    values = spectrum(pencil)[0]
    check(pencil, *map(int, np.searchsorted(values, (0.95, 1.3))), hj.BlockLanczos(block=8), rng)


@pytest.mark.slow
def test_differences_traced_and_batched(rng):
    pencil, weights = hj.sparse_pencil(*indefinite(300)), jnp.asarray(rng.standard_normal(300))
    ends = between(spectrum(pencil)[0], 100, 112)

    @jax.jit
    def run(entries):
        moved = eqx.tree_at(lambda p: p.stiffness.entries, pencil, entries)
        pairs = hj.eigsh(moved, interval=ends, k=12, solver=SOLVER)
        return basis_free(pairs.eigenvalues, squares(pairs), weights)

    entries = pencil.stiffness.entries
    change = next(directions(pencil, rng)).stiffness.entries
    gradient = jax.jit(jax.grad(run))
    ends_of = [run(entries + h * change) for h in (-2e-5, 2e-5)]
    np.testing.assert_allclose(jnp.vdot(gradient(entries), change), (ends_of[1] - ends_of[0]) / 4e-5, rtol=1e-6)
    several = entries * jnp.asarray([[1.0], [1.0 + 1e-6]])
    batch = jax.vmap(gradient)(several)
    np.testing.assert_allclose(batch[0], gradient(entries), atol=1e-7)
    np.testing.assert_allclose(batch[1], gradient(several[1]), atol=1e-7)


def located(pencil, low, high, k):
    """The pencil from an interval's lower end on."""
    low, width = jnp.asarray(low), jnp.asarray(high - low)
    return translated(pencil, low, certain_count(pencil, low)[0], width / 2, width / k)


@pytest.mark.slow
def test_solves_between_what_is_left(rng):
    """Many rows in several groups: (K − λM)x = Qb on the complement; a row that has no solution is NaN."""
    K = lattice(20) + sp.diags(rng.uniform(0, 0.5, 400))
    pencil = hj.sparse_pencil(K, mass(K))
    values, vectors = spectrum(pencil)
    first, k, guards = 150, 80, 6
    moved = located(pencil, *between(values, first, first + k), k)
    rows = np.r_[first : first + k + guards, first - guards : first]
    origin = (values - jnp.diag(vectors @ moved.stiffness.apply(vectors).T))[0]
    known, phi = values[rows] - origin, vectors[rows]
    b, adjoint = jnp.asarray(rng.standard_normal((k, 400))), InteriorAdjoint()
    x = adjoint.solve(adjoint.prepare(moved, known, k), moved, known, phi, b)
    others = np.setdiff1d(np.arange(400), rows)
    share = b @ vectors[others].T / (values[others] - values[first : first + k, None])
    np.testing.assert_allclose(x, share @ vectors[others], atol=1e-7 * float(jnp.abs(x).max()))

    # The first guard has the eigenvalue of a row, and is not known: its copy is left.
    alike = known.at[3].set(known[k])
    none = phi.at[k].set(0)
    x = adjoint.solve(adjoint.prepare(moved, alike, k), moved, alike, none, b)
    assert jnp.isnan(x[3]).all()
    assert jnp.isfinite(x[jnp.arange(k) != 3]).all()


@pytest.mark.parametrize("most", [pytest.param(3, marks=pytest.mark.slow), 8])
def test_an_origin_is_lowered_past_few_eigenvalues(most):
    values = np.sort(np.r_[np.arange(20.0), 25.0 + 0.1 * np.arange(40), [30.0] * 12, 33.0])
    pencil = hj.sparse_pencil(sp.diags(values).tocsr() + 0 * lattice_pattern(values.size))
    for low, high in ((18.5, 19.5), (26.03, 28.0), (32.0, 34.0), (0.5, 3.5), (-1.0, 3.5)):
        inside, below = int(np.sum((values > low) & (values < high))), int(np.sum(values < low))
        distance, passed = lowered(located(pencil, low, high, inside), most, 4)
        assert passed == below - np.sum(values < low - float(distance))
        # The twelve copies below the third interval are too many.
        assert min(below, -(-most // 2)) * (low != 32.0) <= passed <= most


def lattice_pattern(n: int) -> sp.csr_matrix:
    """A chain."""
    return (sp.eye(n, k=1) + sp.eye(n, k=-1)).tocsr()


@pytest.mark.slow
def test_no_second_derivatives():
    pencil = hj.sparse_pencil(sp.diags(np.arange(1.0, 9)).tocsr())

    def run(scale):
        moved = eqx.tree_at(lambda p: p.stiffness.entries, pencil, scale * pencil.stiffness.entries)
        return jnp.sum(hj.eigsh(moved, interval=(2.5, 4.5), k=2).eigenvalues)

    np.testing.assert_allclose(jax.grad(run)(1.0), 7)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.grad(jax.grad(run))(1.0)
