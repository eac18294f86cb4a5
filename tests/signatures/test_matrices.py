"""Signatures of matrices from elsewhere, with their derivatives by the entries, against dense linear algebra."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robust_laplacian
import scipy.linalg
import scipy.sparse as sp
import skfem
from fields import random_spd
from jax.experimental.sparse import BCOO
from skfem.models.poisson import laplace, mass

import hks_jax as hj
from hks_jax.io.pairs import load_pairs, save_pairs

pytestmark = pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")

TIMES = np.array([0.3, 2.0])


def quadratic_elements():
    """P2 on a square, by scikit-fem."""
    basis = skfem.Basis(skfem.MeshTri().refined(2), skfem.ElementTriP2())
    return laplace.assemble(basis), mass.assemble(basis)


def non_manifold():
    """Three sheets that meet in one edge, by robust_laplacian: lumped mass."""
    n = 5
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    one = np.concatenate(
        [np.stack([corner, corner + n, corner + n + 1], 1), np.stack([corner, corner + n + 1, corner + 1], 1)]
    )
    sheets = [(x * np.cos(a), x * np.sin(a), y) for a in (0, 2, 4)]
    points = np.concatenate([np.stack([c.ravel() for c in sheet], 1) for sheet in sheets])
    points, number = np.unique(points.round(12), axis=0, return_inverse=True)
    faces = number.ravel()[np.concatenate([one + i * n * n for i in range(3)])]
    return robust_laplacian.mesh_laplacian(points, faces)


def graph():
    """The Laplacian of three connected graphs with weights."""
    rng = np.random.default_rng(3)
    parts = []
    for n in (15, 18, 11):
        weights = np.triu(rng.random((n, n)) * (rng.random((n, n)) < 0.4), 1) + np.eye(n, k=1)
        weights = weights + weights.T
        parts.append(np.diag(weights.sum(1)) - weights)
    return sp.csr_matrix(scipy.linalg.block_diag(*parts)), None


def truss():
    """A free truss in space: six rigid modes."""
    rng = np.random.default_rng(4)
    joints = rng.normal(size=(12, 3))
    K = np.zeros((36, 36))
    for i in range(12):
        for j in range(i):
            bar = joints[i] - joints[j]
            block = np.outer(bar, bar) / np.linalg.norm(bar) ** 3
            for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                K[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += sign * block
    return sp.csr_matrix(K), np.repeat(rng.uniform(0.5, 2, 12), 3)


def potential(sign):
    def matrices():
        K, M = quadratic_elements()
        return K + sign * 50 * sp.diags(M.diagonal() * np.linspace(0, 1, K.shape[0])), M

    return matrices


PROBLEMS = {
    "P2": (quadratic_elements, 1),
    "non-manifold": (non_manifold, 1),
    "graph": (graph, 3),
    "truss": (truss, 6),
    "K + V": (potential(1), 0),
    "K − V": (potential(-1), 0),
}


def dense(matrix, n):
    if matrix is None:
        return np.eye(n)
    return np.diag(matrix) if np.ndim(matrix) == 1 and not sp.issparse(matrix) else matrix.toarray()


def cut(spectrum, least):
    """The first place from ``least`` on at which no multiple eigenvalue is cut."""
    return next(k for k in range(least, len(spectrum)) if spectrum[k] - spectrum[k - 1] > 1e-3 * np.ptp(spectrum[:k]))


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_hks_and_its_derivative_by_the_entries(name, rng):
    matrices, zeros = PROBLEMS[name]
    K, M = matrices()
    n, at = K.shape[0], 7
    full, weight = K.toarray(), dense(M, n)
    spectrum = scipy.linalg.eigvalsh(full, weight)
    k = cut(spectrum, zeros + 6)
    scale = 1 / (spectrum[k - 1] - spectrum[0])
    K, full = K * scale, full * scale
    held = BCOO.from_scipy_sparse(sp.coo_matrix(K))
    places = tuple(np.asarray(held.indices).T)

    def signature(entries):
        pairs = hj.eigsh(BCOO((entries, held.indices), shape=held.shape), M, k)
        return hj.hks(pairs, TIMES)[:, at]

    def exact(entries):
        matrix = np.zeros((n, n))
        np.add.at(matrix, places, entries)
        values, vectors = scipy.linalg.eigh((matrix + matrix.T) / 2, weight)
        return np.exp(-np.outer(TIMES, values[:k])) @ vectors[at, :k] ** 2

    entries = np.asarray(held.data, float)
    np.testing.assert_allclose(signature(jnp.asarray(entries)), exact(entries), rtol=1e-9)
    change, h = rng.standard_normal(entries.shape) * np.abs(entries), 1e-5
    along = (exact(entries + h * change) - exact(entries - h * change)) / (2 * h)
    forward = jax.jvp(signature, (jnp.asarray(entries),), (jnp.asarray(change),))[1]
    backward = jax.jacrev(signature)(jnp.asarray(entries)) @ change
    np.testing.assert_allclose(forward, along, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(backward, forward, rtol=1e-9)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n == "P2" else ()) for n in PROBLEMS])
def test_zeros_are_counted(name):
    matrices, zeros = PROBLEMS[name]
    K, M = matrices()
    pairs = hj.eigsh(K, M, zeros + 4)
    assert pairs.n_null == zeros
    assert (np.asarray(pairs.eigenvalues) == 0).sum() == zeros
    assert pairs.converged.all()


@pytest.mark.slow
def test_potentials_from_every_solver(rng):
    """Changing the stiffness of an assembled pencil: the right spectrum, or a refusal."""
    pencil = hj.assemble(hj.TensorField(hj.Grid((26, 25), 1 / 25), random_spd(rng, (26, 25))))
    V = 50 * np.linspace(-1, 1, pencil.size) * np.asarray(pencil.mass.diagonal())
    moved = pencil.with_stiffness(pencil.stiffness.plus(V))
    K, M = (np.asarray(matrix.to_dense()) for matrix in (moved.stiffness, moved.mass))
    np.testing.assert_allclose(K, np.asarray(pencil.stiffness.to_dense()) + np.diag(V), rtol=1e-13)
    exact = scipy.linalg.eigvalsh(K, M)[:8]
    assert exact[0] < 0
    for solver in ("auto", "dense", "shift-invert", "block-lanczos"):
        pairs = hj.eigenpairs(moved, 8, solver=solver)
        np.testing.assert_allclose(pairs.eigenvalues, exact, rtol=1e-9)
        assert pairs.converged.all()
        assert pairs.complete_below >= pairs.eigenvalues[-1]
    compiled = eqx.filter_jit(lambda pencil: hj.eigenpairs(pencil, 8, solver="shift-invert"))(moved)
    np.testing.assert_allclose(compiled.eigenvalues, exact, rtol=1e-9)
    assert compiled.result == hj.RESULTS.successful
    with pytest.raises(
        ValueError, match="solver: got 'chebyshev-filter', which needs a positive semidefinite stiffness"
    ):
        hj.eigenpairs(moved, 8, solver="chebyshev-filter")
    with pytest.raises(ValueError, match=r"null_vectors: the stiffness does not annihilate vector 0: .*with_stiffness"):
        hj.eigenpairs(eqx.tree_at(lambda p: p.stiffness, pencil, moved.stiffness), 8)


SIGNATURES = {
    "hks": lambda pairs: hj.hks(pairs, TIMES),
    "by trace": lambda pairs: hj.hks(pairs, TIMES, "heat-trace"),
    "by volume": lambda pairs: hj.hks(pairs, TIMES, "volume"),
    "flat": lambda pairs: hj.hks(pairs, TIMES, "flat"),
    "wks": hj.wks,
    "scale-invariant": lambda pairs: hj.scale_invariant_hks(pairs, n_times=16),
    "heat kernel": lambda pairs: hj.heat_kernel(pairs, TIMES, [17]),
    "heat trace": lambda pairs: hj.heat_trace(pairs, TIMES),
    "diffusion distance": lambda pairs: hj.diffusion_distance(pairs, TIMES, [17]),
    "biharmonic distance": lambda pairs: hj.biharmonic_distance(pairs, [17]),
    "ShapeDNA": hj.shape_dna,
    "heat flow": lambda pairs: hj.heat_flow(pairs, TIMES, jnp.linspace(0, 1, pairs.space.n_dof)),
    "of one's own": lambda pairs: hj.spectral_signature(pairs, lambda t, x: 1 / (1 + t * x), jnp.asarray(TIMES)),
    "times": hj.default_times,
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name == "hks" else pytest.mark.slow) for name in SIGNATURES],
)
def test_signatures_are_those_of_the_domain(name):
    """The matrices of a mesh, with null vectors and geometry said: the same signatures and derivatives."""
    mesh = hj.examples.sphere_mesh(5)
    pencil, signature, k = hj.assemble(mesh), SIGNATURES[name], 16
    n = pencil.size
    geometry = {"null_vectors": np.ones((1, n)), "dimension": 2, "volume": float(pencil.volume)}
    held = hj.sparse_pencil(pencil, **geometry)

    def of_entries(pencil, entries):
        moved = eqx.tree_at(lambda p: p.stiffness.entries, pencil, entries)
        return signature(hj.eigenpairs(moved, k, solver="dense"))

    one, other = (of_entries(each, each.stiffness.entries) for each in (pencil, held))
    np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-12)
    entries = pencil.stiffness.entries
    tangents = [jax.jvp(lambda e, p=p: of_entries(p, e), (entries,), (0.3 * entries,))[1] for p in (pencil, held)]
    np.testing.assert_allclose(tangents[1], tangents[0], rtol=1e-7, atol=1e-9)


def test_a_geometry_that_is_lacking_is_named():
    pairs = hj.eigsh(*graph(), k=8)
    for signature, lacking in (
        (lambda: hj.hks(pairs, TIMES, "flat"), "dimension"),
        (lambda: hj.hks(pairs, TIMES, "volume"), "volume"),
        (lambda: hj.shape_dna(pairs), "dimension"),
        (lambda: hj.truncation(pairs, TIMES), "dimension"),
    ):
        with pytest.raises(ValueError, match=rf"without the {lacking} of .*`sparse_pencil\("):
            signature()
    with pytest.raises(ValueError, match="problem: got matrices without dimension or volume"):
        hj.weyl_count(pairs, [1.0])
    with pytest.raises(ValueError, match="domain: got a stiffness K that may be indefinite"):
        hj.hks_spectrum_free(pairs.pencil, TIMES)


def test_what_sparse_pencil_refuses():
    K, M = truss()
    rigid = np.zeros((3, 36))
    for axis in range(3):
        rigid[axis, axis::3] = 1
    assert hj.sparse_pencil(K, M, null_vectors=rigid).n_null == 3
    bad = rigid.copy()
    bad[1, 1] = 2
    with pytest.raises(ValueError, match=r"null_vectors: the stiffness does not annihilate vector 1: ‖Kv‖ is 0\.\d+"):
        hj.sparse_pencil(K, M, null_vectors=bad)
    with pytest.raises(ValueError, match="null_vectors: got linearly dependent vectors"):
        hj.sparse_pencil(K, M, null_vectors=rigid[[0, 1, 0]])
    with pytest.raises(ValueError, match=r"null_vectors: got shape \(36,\); expected \(m, 36\)"):
        hj.sparse_pencil(K, M, null_vectors=rigid[0])
    with pytest.raises(ValueError, match=r"shape: got \(5, 7\), 35 nodes; expected 36"):
        hj.sparse_pencil(K, M, shape=(5, 7))
    with pytest.raises(ValueError, match="dimension: got 4"):
        hj.sparse_pencil(K, M, dimension=4)


def test_null_vectors_that_are_not_all_are_told():
    path = sp.diags([-np.ones(5), np.r_[1, 2 * np.ones(4), 1], -np.ones(5)], [-1, 0, 1])
    pencil = hj.sparse_pencil(sp.block_diag([path] * 3), null_vectors=np.ones((1, 18)))
    with pytest.warns(hj.AccuracyWarning, match="K has 2 null vectors beyond the 1 given: expected a basis"):
        hj.eigenpairs(pencil, 6, solver="dense")


def test_callers_matrices_stay_as_they_are():
    twice = sp.coo_matrix(([1.0, 1.0, 3.0], ([0, 0, 1], [0, 0, 1])), shape=(2, 2))
    hj.eigsh(twice, k=1)
    assert twice.nnz == 3


def test_a_matrix_or_two_are_a_domain():
    K, M = quadratic_elements()
    expected = hj.eigsh(K, M, 5).eigenvalues
    np.testing.assert_array_equal(hj.eigenpairs((K, M), 5).eigenvalues, expected)
    np.testing.assert_array_equal(hj.eigenpairs(K, 5).eigenvalues, hj.eigsh(K, k=5).eigenvalues)
    with pytest.raises(ValueError, match="domain: got a tuple of 3"):
        hj.eigenpairs((K, M, M), 5)


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["neumann", "mirror", ("dirichlet", "neumann")])
def test_a_band_is_the_difference_of_two_truncated_sums(boundary, rng):
    field = hj.TensorField(hj.Grid((16, 15), 1 / 15), random_spd(rng, (16, 15)))
    values = np.asarray(hj.eigenpairs(field, 60, boundary).eigenvalues)
    low, high = ((values[i - 1] + values[i]) / 2 for i in (20, 45))
    k = int(hj.count_eigenvalues(field, high, boundary))
    assert k == 45

    def of_band(tensors):
        pairs = hj.eigenpairs(hj.TensorField(field.grid, tensors), k, boundary)
        return hj.spectral_signature(pairs, lambda t, x: jnp.where(x >= low, jnp.exp(-t * x), 0), jnp.array([0.01]))

    def difference(tensors):
        moved = hj.TensorField(field.grid, tensors)
        return hj.hks(hj.eigenpairs(moved, 45, boundary), [0.01]) - hj.hks(hj.eigenpairs(moved, 20, boundary), [0.01])

    change = jnp.asarray(random_spd(rng, (16, 15)))
    (one, d_one), (other, d_other) = (jax.jvp(f, (field.tensors,), (change,)) for f in (of_band, difference))
    np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(other).max())
    np.testing.assert_allclose(d_one, d_other, atol=1e-6 * np.abs(d_other).max())


def test_pairs_of_matrices_are_saved_and_read(tmp_path):
    K, M = graph()
    pairs = hj.eigsh(K, M, 8)
    read = load_pairs(save_pairs(tmp_path / "pairs.npz", pairs), hj.sparse_pencil(K, M))
    np.testing.assert_array_equal(hj.hks(read, TIMES), hj.hks(pairs, TIMES))


def test_single_precision():
    K, M = quadratic_elements()
    exact = hj.hks(hj.eigsh(K, M, 9), [0.05])
    pairs = hj.eigsh(K.astype(np.float32), M.astype(np.float32), 9)
    assert pairs.eigenvalues.dtype == jnp.float32
    np.testing.assert_allclose(hj.hks(pairs, [0.05]), exact, rtol=1e-4)


def test_an_entry_and_the_one_across_the_diagonal_are_one_parameter(rng):
    K, M = graph()
    pencil = hj.sparse_pencil(K, M)

    def value(entries):
        moved = eqx.tree_at(lambda p: p.stiffness.entries, pencil, entries)
        return jnp.sum(hj.hks(hj.eigenpairs(moved, 8), TIMES)[:, 3])

    gradient = np.asarray(jax.grad(value)(pencil.stiffness.entries))
    np.testing.assert_allclose(gradient, gradient[pencil.pattern.across], rtol=1e-12)
    assert np.abs(gradient).max() > 1e-3
    after = value(pencil.stiffness.entries - 0.01 * jnp.sign(rng.standard_normal(gradient.shape)) * gradient)
    assert np.isfinite(after)


def test_as_many_pairs_as_rigid_modes():
    pairs = hj.eigsh(*truss(), k=6, throw=True)
    np.testing.assert_array_equal(pairs.eigenvalues, 0)
    assert pairs.residuals.max() < 1e-10


def path(n):
    """The Laplacian of a path."""
    ends = np.r_[1.0, 2 * np.ones(n - 2), 1.0]
    return sp.diags([ends, -np.ones(n - 1), -np.ones(n - 1)], [0, 1, -1]).tocsr()


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, -1e5, 1e5])
@pytest.mark.parametrize("solver", ["dense", "block-lanczos"])
def test_an_offset_changes_no_derivative(offset, solver):
    """Gaps, and not eigenvalues, say which eigenvectors are known, wherever the spectrum lies."""
    n, k = 300, 8
    pencil, change = sparse_path(n), np.sin(0.7 * np.arange(n))
    full = path(n).toarray()

    def signature(potential):
        moved = pencil.with_stiffness(pencil.stiffness.plus(offset + potential))
        pairs = hj.eigenpairs(moved, k, solver=solver)
        return hj.spectral_signature(pairs, lambda t, x: jnp.exp(-t * (x - offset)), jnp.ones(1))[0, 5]

    def exact(h):
        values, vectors = scipy.linalg.eigh(full + h * np.diag(change))
        return np.exp(-values[:k]) @ vectors[5, :k] ** 2

    along = (exact(1e-5) - exact(-1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(signature)(jnp.zeros(n)) @ change, along, rtol=1e-5)


def sparse_path(n):
    return hj.sparse_pencil(path(n))


def test_pairs_of_other_matrices_are_refused(tmp_path):
    moved = hj.sparse_pencil(path(30) + sp.diags(np.linspace(-1, 1, 30)))
    file = save_pairs(tmp_path / "moved.npz", hj.eigsh(moved, k=3))
    load_pairs(file, moved)
    of_interval = save_pairs(tmp_path / "interval.npz", hj.eigsh(moved, k=3), {"lowest": False})
    with pytest.raises(ValueError, match="got the eigenpairs of an interval"):
        load_pairs(of_interval, moved)
    with pytest.raises(ValueError, match="the pairs do not solve"):
        load_pairs(file, hj.sparse_pencil(5 * path(30)))


@pytest.mark.parametrize("offset", [-3.0, 3.0])
def test_what_lies_beyond_is_estimated_from_the_bottom_of_the_spectrum(offset):
    plain = hj.assemble(hj.TensorField(hj.Grid((14, 14), 1.0), jnp.broadcast_to(jnp.eye(2), (14, 14, 2, 2))))
    moved = plain.with_stiffness(plain.stiffness.plus(offset * (plain.mass @ jnp.ones(plain.size))))
    few, all_pairs = hj.eigenpairs(moved, 10), hj.eigenpairs(moved, plain.size)
    true = 1 - hj.heat_trace(few, [0.5]) / hj.heat_trace(all_pairs, [0.5])
    np.testing.assert_allclose(hj.truncation(few, [0.5]).tail, true, rtol=0.2)


def test_vectors_that_only_add_up_to_a_null_vector_are_refused():
    halves = np.zeros((2, 60))
    halves[0, :25] = halves[1, 25:] = 1
    with pytest.raises(ValueError, match="null_vectors: the stiffness does not annihilate vector 0"):
        hj.sparse_pencil(path(60), null_vectors=halves)


def test_only_positive_eigenvalues_have_a_point_signature():
    pairs = hj.eigsh(sp.diags([-2.0, -1.0, 0.0, 1.0, 4.0]).tocsr(), k=5)
    np.testing.assert_allclose(np.abs(hj.global_point_signature(pairs)), [[0, 0, 0, 1, 0], [0, 0, 0, 0, 0.5]])


@pytest.mark.slow
def test_counts_take_matrices_and_the_checks_of_eigenpairs():
    K, M = sp.diags([1.0, 2.0, 2.0, 5.0]).tocsr(), sp.diags([1.0, 1.0, 1.0, 2.0]).tocsr()
    assert int(hj.count_eigenvalues((K, M), 2.2)) == 3
    assert int(hj.count_eigenvalues(K, 1.5)) == 1
    indefinite = sp.csr_matrix(np.diag([1.0, 1, 1, 1]) + 2 * np.eye(4, k=1) + 2 * np.eye(4, k=-1))
    with pytest.raises(ValueError, match=r"M: got a matrix with \d negative"):
        hj.count_eigenvalues((K, indefinite), 1.0)
