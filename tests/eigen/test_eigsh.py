"""Eigenpairs of sparse matrices that are none of ours."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from annotations import unchecked
from jax.experimental.sparse import BCOO, BCSR
from pencils import directions, graph_laplacian, indefinite, lattice
from scipy.sparse.linalg import aslinearoperator
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, MeshTet
from skfem.helpers import dot
from skfem.models.elasticity import lame_parameters, linear_elasticity

import hks_jax as hj
from hks_jax.eigen import inertia
from hks_jax.eigen.inertia import locate
from hks_jax.eigen.quality import measure_pairs, measured_on_host

SOLVER = hj.BlockLanczos(block=4)


def elastic_body() -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """Stiffness and mass of a free elastic box: six rigid modes."""
    mesh = MeshTet.init_tensor(*(np.linspace(0, length, m) for length, m in ((2.0, 7), (1.0, 4), (1.1, 5))))
    basis = Basis(mesh, ElementVector(ElementTetP1()))
    mass = BilinearForm(lambda u, v, _: dot(u, v)).assemble(basis)
    return linear_elasticity(*lame_parameters(1.0, 0.3)).assemble(basis).tocsr(), mass.tocsr()


CASES = {
    "six rigid modes": lambda: elastic_body(),
    "components": lambda: (graph_laplacian(3, 120), None),
    "indefinite": lambda: indefinite(500),
}


@pytest.fixture(
    scope="module", params=[pytest.param(n, marks=pytest.mark.slow if n != "components" else ()) for n in CASES]
)
def problem(request):
    K, M = CASES[request.param]()
    dense = sp.eye(K.shape[0]) if M is None else M
    return K, M, scipy.linalg.eigh(K.toarray(), dense.toarray(), eigvals_only=True)


def check(pairs, K, M, exact):
    """The right eigenvalues, M-orthonormal eigenvectors, all converged and certified."""
    spread = np.ptp(exact)
    np.testing.assert_allclose(pairs.eigenvalues, exact, atol=1e-8 * spread)
    vectors = np.asarray(pairs.vectors)
    weighted = vectors if M is None else (M @ vectors.T).T
    np.testing.assert_allclose(vectors @ weighted.T, np.eye(pairs.k), atol=1e-7)
    residual = (K @ vectors.T).T - np.asarray(pairs.eigenvalues)[:, None] * weighted
    assert np.linalg.norm(residual, axis=1).max() < 1e-6 * spread
    assert pairs.converged.all()
    assert pairs.complete_below >= pairs.eigenvalues[-1]
    assert pairs.result == hj.RESULTS.successful


@pytest.mark.parametrize("solver", [pytest.param(None, marks=pytest.mark.slow), SOLVER])
def test_the_lowest_of_any_pencil(problem, solver):
    K, M, spectrum = problem
    k = 20
    while spectrum[k] - spectrum[k - 1] < 1e-3 * (spectrum[k] - spectrum[0]):
        k += 1
    check(hj.eigsh(K, M, k, solver=solver), K, M, spectrum[:k])


@pytest.mark.slow
def test_every_form_of_a_matrix():
    K, M = indefinite(200)
    reference = hj.eigsh(K, M, 5).eigenvalues
    coo = K.tocoo()
    coo = coo.row, coo.col, coo.data
    bcoo = BCOO((jnp.asarray(coo[2]), jnp.stack([jnp.asarray(coo[0]), jnp.asarray(coo[1])], axis=1)), shape=K.shape)
    pencil = hj.sparse_pencil(K, M)
    for given in (K.toarray(), K.tocsc(), bcoo, BCSR.from_bcoo(bcoo.sort_indices()), pencil.stiffness):
        np.testing.assert_allclose(hj.eigsh(given, M, 5).eigenvalues, reference, atol=1e-12)
    np.testing.assert_allclose(hj.eigsh(pencil, k=5).eigenvalues, reference, atol=1e-12)
    field = hj.TensorField(hj.Grid((14, 16), 0.1), np.broadcast_to(np.eye(2), (14, 16, 2, 2)))
    grid = hj.assemble(field)
    of_grid = hj.eigsh(grid, k=5, solver=SOLVER), hj.eigsh(grid.stiffness, grid.mass, 5)
    for pairs in of_grid:
        np.testing.assert_allclose(pairs.eigenvalues, hj.eigenpairs(field, 5).eigenvalues, atol=1e-9)
    ones = hj.eigsh(K, k=5).eigenvalues
    for identity in (np.ones(200), sp.eye(200), np.eye(200)):
        np.testing.assert_allclose(hj.eigsh(K, identity, 5).eigenvalues, ones, atol=1e-12)


def loss(pencil, k, weights, solver=SOLVER):
    """What does not depend on the basis of the last multiple eigenvalue, if k does not cut it."""
    pairs = hj.eigsh(pencil, k=k, solver=solver)
    squares = hj.spectral_signature(pairs, one, jnp.zeros(1))
    return jnp.sum(pairs.eigenvalues) + jnp.sum(squares * weights[None])


def one(_, x):
    return jnp.ones_like(x)


SIMPLE = (lambda: indefinite(300), 12)
MULTIPLE = (lambda: (lattice(18), sp.eye(324)), 9)


@pytest.mark.slow
@pytest.mark.parametrize(("matrices", "k"), [SIMPLE, MULTIPLE])
def test_gradients_at_simple_and_multiple_eigenvalues(rng, matrices, k):
    K, M = matrices()
    if M.nnz == K.shape[0]:  # with a pattern of its own, to be changed
        M = M + 1e-3 * abs(K)
    pencil, weights = hj.sparse_pencil(K, M), jnp.asarray(rng.standard_normal(K.shape[0]))
    accurate = hj.BlockLanczos(tolerance=1e-10, block=4)  # differences divide errors of the values by 4e-5
    run = jax.jit(jax.value_and_grad(lambda pencil: loss(pencil, k, weights, accurate)))
    gradient = run(pencil)[1]
    h = 2e-5
    for change in directions(pencil, rng):
        along = sum(jnp.vdot(g, c) for g, c in zip(jax.tree.leaves(gradient), jax.tree.leaves(change), strict=True))
        ends = [run(jax.tree.map(lambda p, c, s=s: p + s * h * c, pencil, change))[0] for s in (-1, 1)]
        np.testing.assert_allclose(along, (ends[1] - ends[0]) / (2 * h), rtol=1e-6, atol=2e-6)


@pytest.mark.slow
def test_sums_over_eigenvectors_by_hand_are_right_or_nan():
    """The 3-cycle, whose second eigenvalue is double until a potential splits it."""
    pencil = hj.sparse_pencil(3 * np.eye(3) - 1.0)

    def pairs(potential):
        return hj.eigsh(pencil.with_stiffness(pencil.stiffness.plus(potential)), k=3)

    def by_hand(potential):
        return jnp.sum(jnp.exp(-(p := pairs(potential)).eigenvalues) * p.vectors[:, 0] ** 2)

    def signature(potential):
        return hj.hks(pairs(potential), [1.0])[0, 0]

    split = jnp.array([0.0, 0.1, 0.3])
    np.testing.assert_allclose(jax.grad(by_hand)(split), jax.grad(signature)(split), rtol=1e-9)
    right = jax.grad(signature)(jnp.zeros(3))
    np.testing.assert_allclose(right, [-0.27401098, -0.04625686, -0.04625686], rtol=1e-6)
    assert jnp.isnan(jax.grad(by_hand)(jnp.zeros(3))).all()
    assert jnp.isnan(jax.jvp(by_hand, (jnp.zeros(3),), (split,))[1])
    total = jax.grad(lambda potential: jnp.sum(pairs(potential).eigenvalues))(jnp.zeros(3))
    np.testing.assert_allclose(total, 1, rtol=1e-12)


@pytest.mark.slow
def test_forward_mode_traced_and_batched(rng):
    pencil, weights = hj.sparse_pencil(*indefinite(150)), jnp.asarray(rng.standard_normal(150))
    run = jax.jit(lambda pencil: loss(pencil, 12, weights))
    change = next(directions(pencil, rng))
    value, along = jax.jvp(run, (pencil,), (change,))
    np.testing.assert_allclose(value, loss(pencil, 12, weights), rtol=1e-10)
    # One after the other, what the first loss compiled serves all of them.
    moved = [jax.tree.map(lambda p, c, h=h: p + h * c, pencil, change) for h in (-2e-5, 2e-5)]
    ends = [loss(each, 12, weights) for each in moved]
    np.testing.assert_allclose(along, (ends[1] - ends[0]) / 4e-5, rtol=1e-6, atol=2e-6)
    several = pencil.stiffness.entries * jnp.asarray([[1.0], [1.1]])
    batch = jax.vmap(lambda entries: run(eqx.tree_at(lambda p: p.stiffness.entries, pencil, entries)))(several)
    np.testing.assert_allclose(batch[0], value, rtol=1e-10)
    other = eqx.tree_at(lambda p: p.stiffness.entries, pencil, several[1])
    np.testing.assert_allclose(batch[1], loss(other, 12, weights), rtol=1e-8)


def test_what_is_refused():
    K, M = indefinite(60)
    skewed = K.tolil()
    skewed[3, 5] = 0.3
    with pytest.raises(ValueError, match=r"K: not symmetric: entry \((3, 5|5, 3)\)"):
        hj.eigsh(skewed, M, 3)
    almost = K.tolil()
    almost[3, 4] += 1e-9
    with pytest.raises(ValueError, match=r"entry .* differs from it by 1e-09, more than 2.2e-13 of"):
        hj.eigsh(almost, k=3)
    with pytest.raises(ValueError, match=r"M: got the number 6; .* If this is k, pass k=6"):
        hj.eigsh(K, 6)
    with pytest.raises(ValueError, match=r"K: got float128, .* \.astype\(np.float64\)"):
        hj.eigsh(K.astype(np.longdouble), k=3)
    for given in ((aslinearoperator(K),), (K, aslinearoperator(M))):
        with unchecked(), pytest.raises(TypeError, match=r"[KM]: got a LinearOperator; expected a matrix with entries"):
            hj.eigsh(*given, k=3)
    with pytest.raises(ValueError, match=r"M: got shape \(59, 59\); expected \(60, 60\), the shape of K"):
        hj.eigsh(K, sp.eye(59).tocsr() + sp.eye(59, k=1) + sp.eye(59, k=-1), 3)
    with pytest.raises(ValueError, match=r"M: got a matrix with \d+ negative eigenvalue"):
        hj.eigsh(M, K, 3)
    with pytest.raises(ValueError, match="M: 1 of its 60 diagonal entries are not positive"):
        hj.eigsh(K, np.append(np.ones(59), 0.0), 3)
    with pytest.raises(ValueError, match=r"K: 1 of .* entries are NaN"):
        hj.eigsh(sp.diags([1.0, np.nan, 2.0]).tocsr(), k=1)
    with pytest.raises(ValueError, match="K: got complex"):
        hj.eigsh(K * 1j, k=1)
    with pytest.raises(ValueError, match="k: got 61; expected an integer from 1 to 60"):
        hj.eigsh(K, M, 61)
    with pytest.raises(ValueError, match="K: its indices are traced"):
        jax.jit(lambda m: hj.eigsh(m, k=1).eigenvalues)(BCOO.fromdense(jnp.eye(3)))


def test_a_cut_multiple_eigenvalue_is_told():
    with pytest.warns(hj.AccuracyWarning, match=r"k = 3 cuts a multiple eigenvalue: the last 2"):
        hj.eigsh(lattice(12), k=3)


def turned(values) -> np.ndarray:
    """A full matrix of these eigenvalues."""
    frame = np.linalg.qr(np.random.default_rng(0).standard_normal((len(values), len(values))))[0]
    matrix = frame @ np.diag(values) @ frame.T
    return (matrix + matrix.T) / 2


BOTTOMS = {  # a matrix, the number of copies of its lowest eigenvalue, a k that cuts it
    "a turned matrix": (lambda: turned([1.0, 1, 7, 7]), 2, 1),
    "copies of a chain": (lambda: paths(3, 20).toarray(), 3, 2),
    "copies of a chain far from zero": (lambda: paths(3, 20).toarray() - 2 * np.eye(60), 3, 2),
    "a high multiplicity": (lambda: turned([3.0] * 20 + [5.0] * 5), 20, 12),
}


@pytest.mark.parametrize(("copies", "others", "k"), [(35, 20, 8), (50, 100, 25)])
def test_a_high_multiplicity_needs_a_larger_basis(copies, others, k):
    """ARPACK exhausts the Krylov space of its start vector before k copies are found."""
    matrix = turned([3.0] * copies + list(np.linspace(5, 9, others)))
    with pytest.warns(hj.AccuracyWarning, match="cuts a multiple eigenvalue"):
        pairs = hj.eigsh(matrix, k=k, solver="shift-invert")
    np.testing.assert_allclose(pairs.eigenvalues, 3.0, rtol=1e-12)
    assert pairs.converged.all()
    assert not pairs.unconfirmed


@pytest.mark.parametrize(
    ("name", "solver"),
    [
        pytest.param(name, solver, marks=() if (i, j) in ((0, 1), (1, 0), (2, 2)) else pytest.mark.slow)
        for i, name in enumerate(BOTTOMS)
        for j, solver in enumerate(["dense", "shift-invert", SOLVER])
    ],
)
def test_a_cut_lowest_eigenvalue_is_told(name, solver):
    """Its copies differ by rounding, of which no distance from the lowest of them tells."""
    made, copies, k = BOTTOMS[name]
    matrix = made()
    remedy = rf"k = {k} cuts a multiple eigenvalue: the last {k} pair.*Take the k that `count_eigenvalues` counts"
    with pytest.warns(hj.AccuracyWarning, match=remedy):  # and no other warning: those would be errors
        pairs = hj.eigenpairs(matrix, k, solver=solver, multiplet="drop")
    assert pairs.cut_multiplet == k
    above = float(pairs.eigenvalues[0]) + 1e-3
    assert hj.count_eigenvalues(matrix, above) == copies  # the advice
    whole = hj.eigenpairs(matrix, copies, solver=solver)
    assert whole.cut_multiplet == 0
    if copies - k <= 8:
        assert hj.eigenpairs(matrix, k, solver=solver, multiplet="complete").kept.sum() == copies
    # What is reported does not depend on how unknowns are numbered; the complete signature does not either.
    order = np.random.default_rng(1).permutation(len(matrix))
    other = hj.eigenpairs(matrix[np.ix_(order, order)], copies, solver=solver)
    np.testing.assert_allclose(hj.hks(other, [0.5])[0], hj.hks(whole, [0.5])[0][order], rtol=1e-9)


@pytest.mark.parametrize(
    ("solver", "dtype"),
    [
        ("dense", np.float32),
        (SOLVER, np.float64),
        pytest.param("dense", np.float64, marks=pytest.mark.slow),
        pytest.param(SOLVER, np.float32, marks=pytest.mark.slow),
    ],
)
def test_a_cut_lowest_eigenvalue_is_known_under_jit(solver, dtype):
    pencil = hj.sparse_pencil(paths(3, 12).astype(dtype))

    @eqx.filter_jit
    def kept(pencil, k, choice):
        pairs = hj.eigenpairs(pencil, k, solver=solver, multiplet=choice)
        return pairs.cut_multiplet, pairs.kept.sum()

    assert kept(pencil, 2, "report") == (2, 2)
    assert kept(pencil, 4, "drop") == (0, 3)


def test_a_circulant_raises_no_false_alarm():
    column = np.random.default_rng(0).standard_normal(128)
    matrix = scipy.linalg.circulant((column + np.roll(column[::-1], 1)) / 2)  # its eigenvalues are double, but for two
    with pytest.warns(hj.AccuracyWarning, match="k = 1 cuts a multiple eigenvalue"):
        pairs = hj.eigenpairs(matrix, 1, solver="shift-invert")
    assert pairs.result == hj.RESULTS.successful
    assert pairs.eigenvalues[0] == pytest.approx(np.linalg.eigvalsh(matrix)[0], rel=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["mirror", "mean"])
def test_a_count_at_an_eigenvalue_of_a_doubled_domain_is_refused(boundary):
    """The pivot that vanishes there has a sign, by which one part was counted within and another without."""
    for seed in (4, 5):
        rng = np.random.default_rng(seed)
        shape = tuple(int(n) for n in rng.integers(5, 8, 2))
        mask = np.ones(shape, bool)
        mask[0, 0] = boundary == "mirror"
        grid = hj.Grid(shape, tuple(rng.uniform(0.1, 0.3, 2).round(3)), mask=mask)
        pencil = hj.assemble(hj.TensorField(grid, np.broadcast_to(np.eye(2), (*shape, 2, 2))), boundary)
        dense = [[np.asarray(m.to_dense()) for m in (part.stiffness, part.mass)] for part in pencil.parts]
        exact = np.sort(np.concatenate([scipy.linalg.eigh(K, M, eigvals_only=True) for K, M in dense]))
        for i in range(2, 8):
            with pytest.raises(ValueError, match=r"below: got .* too close to an eigenvalue"):
                hj.count_eigenvalues(pencil, exact[i])
            beside = exact[i] * (1 - 1e-5)
            assert hj.count_eigenvalues(pencil, beside) == (exact < beside).sum()


@pytest.mark.slow
def test_a_nearly_incompressible_body_is_located_by_few_factorisations(monkeypatch):
    """Its largest eigenvalue is 1e10 times as large as those wanted, of which rounding separates few from zero."""
    mesh = MeshTet.init_tensor(*(np.linspace(0, 1, 5),) * 3)
    basis = Basis(mesh, ElementVector(ElementTetP1()))
    mass = BilinearForm(lambda u, v, _: dot(u, v)).assemble(basis)
    pencil = hj.sparse_pencil(linear_elasticity(1e9, 1.0).assemble(basis), mass)
    K, M = pencil.stiffness.to_scipy().toarray(), pencil.mass.to_scipy().toarray()
    exact, shifts, counting = scipy.linalg.eigh(K, M, eigvals_only=True), [], inertia._counting

    def counted(pencil, probes):
        count = counting(pencil, probes)
        return lambda shift: (shifts.append(float(shift)), count(shift))[1]

    monkeypatch.setattr(inertia, "_counting", counted)
    low, above, number = map(float, inertia.locate(pencil, 4, 8))
    assert len(shifts) < 20
    assert low < exact[0]
    assert number == np.sum(exact < above)


def twelve_graphs() -> sp.csc_matrix:
    """The Laplacian of twelve equal graphs: all eigenvalues have twelve copies, and zero lies far below the others."""
    edges = sp.random(75, 75, 0.16, random_state=0).tocsr()
    edges = edges + edges.T + sp.diags([np.ones(74), np.ones(74)], [1, -1])
    edges.setdiag(0)
    return sp.kron(sp.eye(12), sp.diags(np.asarray(edges.sum(axis=1)).ravel()) - edges).tocsc()


@pytest.mark.slow
def test_more_copies_than_a_block_has_columns():
    K = twelve_graphs()
    exact, held = np.linalg.eigvalsh(K.toarray())[:36], hj.sparse_pencil(K)
    for solve in (hj.eigsh, eqx.filter_jit(hj.eigsh)):
        pairs = solve(held, k=36, solver=hj.BlockLanczos())
        check(pairs, K, None, exact)


def laplacian(edges) -> sp.csr_matrix:
    edges = sp.csr_matrix(edges)
    return (sp.diags(np.asarray(edges.sum(axis=1)).ravel()) - edges).tocsr()


def star(n: int) -> sp.csr_matrix:
    ends = np.zeros(n - 1, int), np.arange(1, n)
    return laplacian(sp.coo_matrix((np.ones(2 * n - 2), np.c_[ends, ends[::-1]]), (n, n)))


def isolated(n: int, m: int) -> sp.csr_matrix:
    """The Laplacian of n vertices without an edge, and of a random graph of m."""
    edges = sp.random(m, m, 4 / m, random_state=0) > 0
    return laplacian(sp.block_diag([sp.csr_matrix((n, n)), (edges + edges.T).astype(float)]))


def paths(count: int, length: int) -> sp.csr_matrix:
    ones = np.ones(length - 1)
    return sp.kron(sp.eye(count), laplacian(sp.diags([ones, ones], [1, -1]))).tocsr()


SIMPLE_SPECTRA = {
    "one far below a bulk": (lambda: sp.diags(np.append(0.5, np.linspace(1, 2, 1999))).tocsr(), 6),
    "three hardly below a bulk": (lambda: sp.diags(np.append([1 - 7e-5] * 3, np.linspace(1, 2, 997))).tocsr(), 6),
    "nothing but zero": (lambda: sp.csr_matrix((300, 300)), 6),
    "a star": (lambda: star(401), 6),
    "isolated vertices": (lambda: isolated(80, 500), 6),
    "a complete graph": (lambda: laplacian(np.ones((200, 200))), 6),
    "as many as there are components": (lambda: paths(40, 20), 40),
    "six rigid modes alone": (lambda: elastic_body(), 6),
}


@pytest.mark.filterwarnings("ignore:k = 25 cuts a multiple eigenvalue")
@pytest.mark.parametrize("lowest", [-1e4, -1e8])
def test_an_eigenvalue_far_below_hides_no_others(lowest):
    """Twenty copies of zero, and simple eigenvalues: the search near zero finds few copies at first."""
    exact = np.concatenate([[lowest], np.zeros(20), 1e-3 * np.arange(1, 1980)])
    pairs = hj.eigsh(sp.diags(exact).tocsr(), None, 25)
    np.testing.assert_allclose(pairs.eigenvalues, exact[:25], atol=1e-15 * abs(lowest) + 1e-10)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:k = 6 cuts a multiple eigenvalue")
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in ("a star", "nothing but zero") else pytest.mark.slow) for n in SIMPLE_SPECTRA],
)
def test_spectra_that_are_hard_for_lanczos_alone(name):
    """Wide gaps, few different eigenvalues, many copies, and nothing but zeros, of which no size is known."""
    given, k = SIMPLE_SPECTRA[name]
    K, M = given() if name.startswith("six") else (given(), None)
    exact = scipy.linalg.eigh(K.toarray(), None if M is None else M.toarray(), eigvals_only=True)
    pairs = hj.eigsh(K, M, k, solver=hj.BlockLanczos())
    np.testing.assert_allclose(pairs.eigenvalues, exact[:k], atol=1e-11 * max(exact[-1], 1))
    weighted = np.asarray(pairs.vectors) if M is None else (M @ np.asarray(pairs.vectors).T).T
    np.testing.assert_allclose(pairs.vectors @ weighted.T, np.eye(k), atol=1e-9)
    assert pairs.result == hj.RESULTS.successful


def test_a_vector_found_twice_has_not_converged(rng):
    pencil, k = hj.sparse_pencil(lattice(12).astype(np.float32)), 13
    pairs = hj.eigsh(pencil, k=k)
    vectors = pairs.vectors.at[9].set(pairs.vectors[8])
    twice = measure_pairs(pencil, vectors, pairs.eigenvalues)[2]
    np.testing.assert_array_equal(twice, np.arange(k) == 9)
    matrices = SimpleNamespace(stiffness=pencil.stiffness.to_scipy(), mass=pencil.mass.to_scipy())
    on_host = measured_on_host(matrices, np.asarray(vectors), np.asarray(pairs.eigenvalues))
    np.testing.assert_array_equal(on_host[2], twice)


@pytest.mark.slow
def test_adjacency_matrices_in_float32():
    """Their diagonal is zero, which shows no level of rounding, and counts close to zero are uncertain."""
    links = np.triu(np.random.default_rng(3).random((300, 300)) < 0.2, 1)
    matrix = -(links + links.T).astype(np.float32)
    exact = np.linalg.eigvalsh(matrix.astype(float))
    low, above, count = map(float, locate(hj.sparse_pencil(matrix), 4, 8))
    assert 2 * exact[0] < low < exact[0]
    assert count == np.sum(exact < above) <= 8
    assert hj.eigsh(matrix, k=5, solver="dense").converged.all()
    star = np.zeros((10, 10))
    star[0, 1:] = star[1:, 0] = 1
    with pytest.raises(ValueError, match=r"1 eigenvalues are below \S+ and 9 are below"):
        hj.count_eigenvalues(star, 0.0)


@pytest.mark.slow
def test_in_float32_none_is_missing_though_as_many_are_found():
    """Once two rows were equal, an eigenvalue missing, and the pairs certified."""
    n = 4 * 287
    line = sp.diags([-1.0, 2, -1], [-1, 0, 1], shape=(287, 287))
    factor = sp.random(n, n, 1 / n, random_state=3)
    K, M = (m.tocsr().astype(np.float32) for m in (sp.kron(sp.eye(4), line), factor @ factor.T + sp.eye(n)))
    exact = scipy.linalg.eigh(K.toarray().astype(float), M.toarray(), eigvals_only=True)[:41]
    pairs = hj.eigsh(K, M, 41, solver=hj.BlockLanczos())
    np.testing.assert_allclose(pairs.eigenvalues, exact, atol=1e-5)
    np.testing.assert_allclose(pairs.vectors @ (M @ np.asarray(pairs.vectors).T), np.eye(41), atol=1e-4)


@pytest.mark.filterwarnings("ignore:.*are uncertain. rounding of the matrices to float64")
@pytest.mark.filterwarnings("ignore:k = 4 cuts a multiple eigenvalue")
@pytest.mark.parametrize(("solver", "rtol"), [("shift-invert", 1e-6), ("dense", 1e-2)])
def test_small_eigenvalues_beside_a_large_entry_are_not_zero(solver, rtol):
    """A penalty fixes a node. Eigenvalues below 4ε times the penalty are accurate, because eigenvectors are 0 there."""
    K = sp.diags([np.full(59, -1.0), np.full(60, 2.0), np.full(59, -1.0)], [-1, 0, 1]).tolil()
    K[59, 59] = 1.0
    fixed = scipy.linalg.eigvalsh(K.toarray()[1:, 1:])[:4]
    K[0, 0] += 1e12
    pairs = hj.eigsh(K.tocsr(), k=4, solver=solver)
    np.testing.assert_allclose(pairs.eigenvalues, fixed, rtol=rtol)
    uncertain = np.asarray(pairs.uncertain)
    assert ((np.abs(pairs.eigenvalues - fixed) < 0.01 * fixed) | uncertain).all()


def test_the_zero_of_a_graph_laplacian_stays_zero():
    K = sp.diags([np.full(59, -1.0), np.r_[1, np.full(58, 2.0), 1], np.full(59, -1.0)], [-1, 0, 1])
    pairs = hj.eigsh(K.tocsr(), k=3)
    assert pairs.eigenvalues[0] == 0
    assert not pairs.uncertain.any()
