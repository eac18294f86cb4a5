"""Block Lanczos in NumPy, and the shifts of the shift-invert solver, against dense eigenvalues."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from fields import flat, random_spd

import hks_jax as hj
from hks_jax.eigen.shift_invert import shift_invert
from hks_jax.eigen.shift_invert.host_lanczos import nearest
from hks_jax.linear.host_matrices import factorise_stably_on_host


def search(values, rng, shift, count, radius, block=4, room=200, known=0):
    """Search for eigenvalues of a pencil with the given ones; return those found, and all from the shift outwards."""
    n = len(values)
    mass = scipy.sparse.diags(rng.uniform(0.5, 2, n)).tocsr()
    q, _ = np.linalg.qr(rng.standard_normal((n, n)))
    vectors = q / np.sqrt(mass.diagonal())[:, None]
    inverse = (vectors / (values - shift)) @ vectors.T
    outwards = np.argsort(np.abs(values - shift))
    found, columns = nearest(
        lambda x: inverse @ x, mass, shift, vectors[:, outwards[:known]], count, radius, block, 20, room, 0
    )
    np.testing.assert_allclose(columns.T @ (mass @ columns), np.eye(len(found)), atol=1e-13)
    parts = vectors.T @ (mass @ columns)
    np.testing.assert_allclose((values[:, None] - found) * parts, np.zeros_like(parts), atol=1e-8)
    return np.sort(found), values[outwards[known:]]


@pytest.mark.parametrize(("shift", "block", "known"), [(40.3, 4, 0), (40.3, 8, 5), (-1.0, 4, 0), (40.0 + 1e-5, 4, 3)])
def test_all_eigenvalues_near_the_shift_are_found(rng, shift, block, known):
    found, expected = search(np.arange(300.0), rng, shift, 30, 25.0, block, known=known)
    assert len(found) >= 30
    assert np.abs(found - shift).max() >= 24
    np.testing.assert_allclose(found, np.sort(expected[: len(found)]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("distinct", [1, 3, 60])
def test_a_krylov_space_that_is_exhausted_is_continued(rng, distinct):
    """With few distinct eigenvalues, or with as many wanted pairs as there are unknowns."""
    values = np.sort(np.resize(np.arange(1.0, distinct + 1), 60))
    found, _ = search(values, rng, 0.5, 60, 0.0)
    np.testing.assert_allclose(found, values, rtol=1e-12)


def test_a_full_basis_returns_what_has_converged(rng):
    found, expected = search(np.arange(300.0), rng, 40.3, 30, 25.0, room=40)
    assert 0 < len(found) < 30
    np.testing.assert_allclose(found, np.sort(expected[: len(found)]), rtol=1e-9, atol=1e-12)


def test_solutions_that_are_not_finite_find_nothing():
    found, columns = nearest(lambda x: x * np.nan, scipy.sparse.eye(9).tocsr(), 0, np.empty((9, 0)), 3, 0, 2, 4, 9, 0)
    assert found.shape == (0,)
    assert columns.shape == (9, 0)


@pytest.mark.parametrize("case", ["within", "no eigenvalue in reach of Weyl's law", "on an eigenvalue"])
def test_shifts_are_within_the_spectrum_and_accurate(rng, monkeypatch, case):
    """A potential moves all eigenvalues away from Weyl's law; eigenvalues and certificates stay right."""
    shape, k = (14, 13), 40
    field = hj.TensorField(hj.Grid(shape, 1.0), random_spd(rng, shape, 0.2))
    pencil = hj.assemble(field, potential=1e3 if case.startswith("no") else None)
    dense = scipy.linalg.eigh(pencil.stiffness.to_dense(), pencil.mass.to_dense(), eigvals_only=True)
    if case.startswith("on"):
        usual = shift_invert._scales
        monkeypatch.setattr(shift_invert, "_scales", lambda *args: usual(*args)._replace(within=dense[12] + 1e-13))
    pairs = hj.eigenpairs(pencil, k, solver="shift-invert")
    np.testing.assert_allclose(pairs.eigenvalues, dense[:k], rtol=1e-12, atol=1e-12)
    assert pairs.converged.all()
    assert pairs.complete_below > dense[k - 2]


def test_refined_pairs_are_as_accurate_as_the_others(monkeypatch):
    """With a shift next to an eigenvalue, low pairs have large residuals, and a further solve removes them."""
    pencil, k = hj.assemble(flat((40, 41), (1.0, 1.03))), 50
    exact = hj.eigenpairs(pencil, k, solver="dense").eigenvalues

    def beside(K, M, k, scales):
        shift = float(exact[20]) * (1 + 2e-5)  # in units of the mean gap: 4e-4
        return shift, factorise_stably_on_host(K - shift * M)

    monkeypatch.setattr(shift_invert, "_shifted", beside)
    pairs = hj.eigenpairs(pencil, k, solver="shift-invert")
    np.testing.assert_allclose(pairs.eigenvalues[1:], exact[1:], rtol=1e-11)
    assert (pairs.residuals < 1e-8).all()
    np.testing.assert_allclose(pairs.vectors @ pencil.mass.apply(pairs.vectors).T, np.eye(k), atol=1e-11)


def path(weights):
    """Return the graph Laplacian of a path."""
    ends = np.append(weights, 0) + np.insert(weights, 0, 0)
    return scipy.sparse.diags([ends, -weights, -weights], [0, 1, -1]).tolil()


@pytest.mark.filterwarnings("ignore:k = 1 cuts a multiple eigenvalue")
@pytest.mark.parametrize("coupling", [1e-9, 1e-11])
def test_a_nearly_double_lowest_eigenvalue_far_from_zero(coupling):
    """The spread of the computed eigenvalues is too small to be the distance of a shift."""
    K = (scipy.sparse.kron(scipy.sparse.eye(2), path(np.ones(19))) + scipy.sparse.eye(40)).tolil()
    K[19, 20] = K[20, 19] = -coupling
    pairs = hj.eigsh(K.tocsr(), k=1, solver="shift-invert")
    assert pairs.converged.all()
    np.testing.assert_allclose(pairs.eigenvalues, 1, atol=1e-8)


def test_most_of_the_diagonal_is_zero():
    K = scipy.sparse.diags(np.r_[np.zeros(30), np.arange(1.0, 21)])
    pairs = hj.eigenpairs(hj.sparse_pencil(K, null_vectors=np.eye(50)[:30]), 35, solver="shift-invert")
    np.testing.assert_allclose(pairs.eigenvalues, np.r_[np.zeros(30), np.arange(1.0, 6)], atol=1e-12)


def test_a_basis_that_is_too_small_grows_unless_the_user_set_it(rng):
    """Eigenvalues over eight decades crowd at zero, relative to any shift."""
    K = path(10.0 ** (-8 * rng.random(299))).tocsr()
    pairs = hj.eigsh(K, k=10, solver="shift-invert")
    np.testing.assert_allclose(pairs.eigenvalues, scipy.linalg.eigvalsh(K.toarray())[:10], atol=1e-15)
    with pytest.warns(hj.AccuracyWarning, match=r"10 of 10 eigenpairs did not converge .* or a larger basis"):
        hj.eigsh(K, k=10, solver=hj.ShiftInvert(basis=12))


def test_numbers_that_overflow_find_nothing():
    with pytest.warns(hj.AccuracyWarning, match="4 were not found"):
        assert np.isnan(hj.eigsh(path(np.full(59, 1e-160)).tocsr(), k=4, solver="shift-invert").eigenvalues).all()


def test_pairs_of_two_rooms_with_a_narrow_neck_converge():
    """The first positive eigenvalue is a hundredth of the mean gap, to which its residual must not be relative."""
    x, y = np.indices((60, 150))
    rooms = (np.hypot(x - 30, y - 29) < 28) | (np.hypot(x - 30, y - 125) < 28)
    neck = (x >= 30) & (x < 32) & (y > 29) & (y < 125)
    grid = hj.Grid((60, 150), 0.01, mask=rooms | neck, components="largest")
    pairs = hj.eigenpairs(hj.TensorField(grid, np.tile(np.eye(2), (60, 150, 1, 1))), 60, solver="shift-invert")
    assert pairs.eigenvalues[1] < 0.02 * pairs.eigenvalues[-1] / 60
    assert pairs.converged.all()
