"""The eigensolver for grids against dense linear algebra: factorisation, inertia, slices, certificate."""

import warnings
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from fields import flat, random_spd

import hks_jax as hj
from hks_jax.eigen.lanczos import krylov_basis as bases
from hks_jax.eigen.lanczos.block_lanczos import expected
from hks_jax.eigen.lanczos.slicing import SlicingPlan, crowded, cut, first_state, make_room, search
from hks_jax.linear import accelerators
from hks_jax.linear.dissection import dissect
from hks_jax.linear.multifrontal import factorise


def mask(shape):
    """Two components, one with a hole."""
    inside = np.ones(shape, bool)
    inside[:4, :5] = False
    inside[shape[0] // 2, :] = False
    inside[4:6, 8:10] = False
    return inside


CASES = {
    "neumann": ((26, 21), "neumann", "consistent"),
    "dirichlet lumped": ((19, 26), "dirichlet", "lumped"),
    "torus": ((24, 22), "periodic", "consistent"),
    "periodic, neumann": ((24, 20), ("periodic", "neumann"), "consistent"),
    "dirichlet, periodic": ((20, 24), (("neumann", "dirichlet"), "periodic"), "consistent"),
    "mask": ((25, 27), "neumann", "consistent"),
    "3d": ((6, 9, 10), ("periodic", "dirichlet", "neumann"), "lumped"),
}


def grid_of(name):
    shape = CASES[name][0]
    return hj.Grid(shape, 0.1, mask=mask(shape), components="all") if name == "mask" else hj.Grid(shape, 0.1)


def problem(rng, name, spread=1.0):
    shape, boundary, mass = CASES[name]
    return hj.assemble(hj.TensorField(grid_of(name), random_spd(rng, shape, spread)), boundary, mass)


def dense_matrices(pencil):
    return np.asarray(pencil.stiffness.to_dense()), np.asarray(pencil.mass.to_dense())


@pytest.mark.parametrize("n", [32, 64])
def test_separators_halve_a_grid_so_that_batches_need_no_padding(n):
    dissection = dissect(hj.assemble(flat((n, n), (1.0, 1.0))).pattern)
    assert dissection.levels[0].own.shape == (1, 2 * n)
    assert dissection.padding.size == 0


@pytest.mark.parametrize("name", [n if n == "mask" else pytest.param(n, marks=pytest.mark.slow) for n in CASES])
def test_factorisation_solves_and_counts(rng, name):
    pencil = problem(rng, name)
    K, M = dense_matrices(pencil)
    spectrum = scipy.linalg.eigh(K, M, eigvals_only=True)
    run = jax.jit(factorise)
    for below in (0, 3, 40, K.shape[0]):
        ends = np.concatenate([[-1.0], spectrum, [2 * spectrum[-1]]])[below : below + 2]
        shift = 0.7 * ends[0] + 0.3 * ends[1]
        factor = run(dissect(pencil.pattern), pencil.shifted(jnp.asarray(shift)))
        assert int(factor.negative) == below
        rhs = rng.standard_normal((K.shape[0], 3))
        reference = np.linalg.solve(K - shift * M, rhs)
        np.testing.assert_allclose(factor.solve(jnp.asarray(rhs)), reference, atol=1e-9 * np.abs(reference).max())


def check_against_dense(pencil, pairs):
    """Same spectrum, M-orthonormal eigenvectors, and a certificate that counts right."""
    K, M = dense_matrices(pencil)
    spectrum = scipy.linalg.eigh(K, M, eigvals_only=True)
    values, vectors = np.asarray(pairs.eigenvalues), np.asarray(pairs.vectors)
    np.testing.assert_allclose(values, spectrum[: pairs.k], atol=1e-9 * spectrum[pairs.n_null])
    np.testing.assert_allclose(vectors @ M @ vectors.T, np.eye(pairs.k), atol=1e-7)
    assert pairs.converged.all()
    bound = float(pairs.complete_below)
    assert bound > values[-1]
    assert np.sum(spectrum < bound) >= pairs.k
    # The kernel does not depend on the basis within multiplets.
    first = np.flatnonzero(np.diff(spectrum) > 1e-6 * spectrum[pairs.n_null])
    whole = first[first < pairs.k][-1] + 1
    exact = scipy.linalg.eigh(K, M)[1][:, :whole]
    atol = 1e-5 * np.abs(exact).max() ** 2
    np.testing.assert_allclose(vectors[:whole].T @ vectors[:whole], exact @ exact.T, atol=atol)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mask", "torus", "3d"])
def test_pairs_agree_with_dense_ones(rng, name):
    pencil = problem(rng, name)
    # Slices so small that several are needed.
    check_against_dense(pencil, hj.eigenpairs(pencil, 60, solver=hj.BlockLanczos(block=4, slice_size=20)))


@pytest.mark.slow
def test_multiplicities_beyond_the_block_are_complete():
    # Twelve equal squares: every eigenvalue at least twelvefold, those of symmetric pairs of modes 24-fold.
    inside = np.zeros((27, 36), bool)
    for i in range(3):
        for j in range(4):
            inside[9 * i : 9 * i + 8, 9 * j : 9 * j + 8] = True
    grid = hj.Grid((27, 36), 0.1, mask=inside, components="all")
    pencil = hj.assemble(hj.TensorField(grid, np.broadcast_to(np.eye(2), (27, 36, 2, 2))))
    pairs = hj.eigenpairs(pencil, 72, solver=hj.BlockLanczos(block=4, slice_size=30))
    assert pairs.n_null == 12
    check_against_dense(pencil, pairs)
    multiplicities = np.diff(np.flatnonzero(np.diff(np.asarray(pairs.eigenvalues), prepend=-1, append=1e9) > 1e-6))
    np.testing.assert_array_equal(multiplicities, [12, 24, 12, 24])


@pytest.mark.slow
def test_torus_multiplets_and_certificate():
    pencil = hj.assemble(flat((32, 32), (1.0, 1.0), (True, True)), "periodic")
    pairs = hj.eigenpairs(pencil, 57, solver="block-lanczos")
    check_against_dense(pencil, pairs)
    assert pairs.solver_name == "block-lanczos"
    assert "none missed" in pairs.summary()


@pytest.mark.slow
@pytest.mark.parametrize("domain", ["torus", "mirror", "mesh"])
def test_eigenvalues_are_counted_without_being_computed(rng, domain):
    if domain == "torus":
        pencil = hj.assemble(flat((20, 20), (1.0, 1.0), (True, True)), "periodic")
    elif domain == "mirror":
        pencil = hj.assemble(hj.TensorField(hj.Grid((14, 13), 0.1), random_spd(rng, (14, 13))), "mirror")
    else:
        pencil = hj.assemble(hj.examples.bumpy_torus_mesh(12))
    spectrum = np.sort(
        np.concatenate([scipy.linalg.eigh(*dense_matrices(part), eigvals_only=True) for part in pencil.parts])
    )
    for count in (0, 1, 5, 25):
        shift = np.concatenate([[-1e-3 * spectrum[-1]], spectrum])[count : count + 2].mean()
        assert int(hj.count_eigenvalues(pencil, shift)) == np.sum(spectrum < shift)


@pytest.mark.parametrize("size", [pytest.param(1.0, marks=pytest.mark.slow), 1e-9])
@pytest.mark.parametrize(("dtype", "accuracy"), [(jnp.float64, 1e-15), (jnp.float32, 1e-6)])
def test_components_on_a_basis_in_pieces(rng, dtype, accuracy, size):
    if accelerators.at_hand():
        pytest.skip("on accelerators the basis is one array")
    write = jax.jit(bases.write)
    n, filled = 500, 268  # two pieces, and a little of the third; the fourth is empty
    q, _ = np.linalg.qr(rng.standard_normal((n, 400)))
    vectors, x = jnp.asarray(q.T[:filled], dtype), jnp.asarray(q[:, 380:384], dtype)
    basis = bases.begin(vectors[:100], 400, 4)
    assert [len(piece.rows) for piece in basis] == [128, 128, 128, 16]
    for row in range(100, filled, 4):
        basis = write(basis, vectors[row : row + 4].T, jnp.asarray(row))
    x = x + size * vectors[::20].T @ jnp.asarray(rng.standard_normal((14, 4)), dtype)
    parts = jax.jit(bases.within)(basis, x, filled)
    np.testing.assert_allclose(vectors @ (x - parts), 0, atol=accuracy * np.linalg.norm(x, axis=0).max())
    mix = rng.standard_normal((3, 400))
    mix[:, filled:] = 0
    np.testing.assert_allclose(
        bases.combined(jnp.asarray(mix, dtype), basis), mix[:, :filled] @ q.T[:filled], atol=1e-5
    )


def test_a_block_becomes_orthonormal(rng):
    """The second block has columns that are small, nearly dependent, dependent or zero; five stay independent."""
    weights = jnp.asarray(rng.uniform(0.5, 2, 100))

    def mass(x):
        return weights[:, None] * x

    x = rng.standard_normal((100, 8)) * 10.0 ** rng.uniform(-3, 3, 8)
    y, image, factor = bases.orthonormal(mass, jnp.asarray(x))
    np.testing.assert_allclose(y.T @ mass(y), np.eye(8), atol=1e-13)
    np.testing.assert_allclose(image, mass(y), atol=1e-13)
    sizes = np.abs(x).max(axis=0)
    np.testing.assert_allclose(y @ factor.T / sizes, x / sizes, atol=1e-13)
    x[:, 5] = x[:, 2] + 1e-13 * x[:, 5]
    x[:, 6] = x[:, 0] - 3 * x[:, 1]
    x[:, 7] = 0
    y, _, factor = bases.orthonormal(mass, jnp.asarray(x))
    values = np.linalg.eigvalsh(y.T @ mass(y))
    assert values[0] > -1e-13
    assert values[-1] < 1 + 1e-6
    np.testing.assert_allclose(values[-5:], 1, atol=1e-6)
    sizes = np.abs(x).max(axis=0).clip(1e-9)
    np.testing.assert_allclose(y @ factor.T / sizes, x / sizes, atol=1e-6)


def test_eigenvalues_found_beyond_those_wanted_are_forgotten():
    plan = SlicingPlan(wanted=5, block=2, slice_size=5, max_slices=9, tolerance=1e-8, nulls=1)
    values = jnp.asarray(np.random.default_rng(0).permutation(plan.capacity).astype(float))
    problem = expected(hj.assemble(flat((12, 12), (1.0, 1.0))), plan)
    state, _ = jax.eval_shape(partial(first_state, plan=plan), problem)
    state = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), state)
    state = state._replace(values=values, known=jnp.asarray(plan.capacity))
    assert crowded(plan, state)
    state, vectors = make_room(plan, state, values[:, None] * jnp.ones((1, 144)))
    assert not crowded(plan, state)
    np.testing.assert_array_equal(state.values[: int(state.known)], np.arange(int(state.known)))
    np.testing.assert_array_equal(vectors[:, 0][: int(state.known)], np.arange(int(state.known)))
    assert np.isinf(state.values[int(state.known) :]).all()


def of_one_half(pencil):
    """Return the eigenvalues of one side of the first separator: where K − σM has a singular front."""
    dissection = dissect(pencil.pattern)
    # The own nodes of one half of all fronts below the first separator are the nodes on one side of it.
    half = np.concatenate([level.own[: len(level.own) // 2].ravel() for level in dissection.levels[1:]])
    half = half[half < pencil.space.n_dof]
    K, M = (matrix[np.ix_(half, half)] for matrix in dense_matrices(pencil))
    return scipy.linalg.eigh(K, M, eigvals_only=True)


@pytest.mark.slow
def test_a_shift_where_a_front_is_singular_is_moved(rng):
    pencil = problem(rng, "neumann")
    dissection = dissect(pencil.pattern)
    singular = of_one_half(pencil)[5]
    plan = hj.BlockLanczos(block=4).plan(20, pencil.space.n_null)
    whole = expected(pencil, plan)
    state, vectors = first_state(whole, plan)
    state = state._replace(shift=jnp.asarray(singular))
    _, searchable, (state, vectors) = cut(whole, dissection, plan, state, vectors)
    assert not searchable
    assert state.moved == 1
    assert state.below == -1
    assert 0.8 * singular < state.shift < singular
    factor, searchable, both = cut(whole, dissection, plan, state, vectors)
    assert searchable
    state, _ = search(whole, factor, plan, both)
    assert state.known > 0
    assert np.isfinite(state.start).all()


@pytest.mark.slow
def test_counts_are_right_at_eigenvalues_of_parts_of_the_domain(rng):
    """Without pivots that are bounded and tried out, a third of these counts is wrong."""
    grid = hj.Grid((16, 16), 1 / 15)
    pencil = hj.assemble(hj.TensorField(grid, random_spd(rng, (16, 16), 0.5)))
    spectrum = scipy.linalg.eigh(*dense_matrices(pencil), eigvals_only=True)
    shifts = of_one_half(pencil)
    counts = jax.jit(lambda shifts: jax.lax.map(partial(hj.count_eigenvalues, pencil), shifts))(jnp.asarray(shifts))
    true = np.sum(spectrum < shifts[:, None], axis=1)
    assert np.mean(counts == true) > 0.95
    np.testing.assert_array_equal(counts[counts != true], -1)
    assert int(hj.count_eigenvalues(pencil, float(shifts[3]))) == true[3]
    with pytest.raises(
        ValueError, match=r"below: got .* is too close to an eigenvalue; \d+ .* Use one of these two bounds"
    ):
        hj.count_eigenvalues(pencil, 0.0)
    # On which side of an eigenvalue a number is that agrees with it to rounding, factorisations may see differently.
    at_one = jax.jit(partial(hj.count_eigenvalues, pencil))
    assert int(at_one(0.0)) in (-1, 0, 1)
    assert int(at_one(float(spectrum[20]))) in (-1, 20, 21)


@pytest.mark.slow
def test_a_count_at_a_square_of_unit_metric():
    """A shift at which the elimination without pivots counts 72."""
    assert int(hj.count_eigenvalues(flat((16, 16), (15.0, 15.0)), 3.6491651253263275)) == 63


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "spacing", "k"), [((3, 97), (0.0167, 0.808), 7), ((4, 200), (0.01, 1.0), 7)])
def test_domains_much_longer_than_wide(shape, spacing, k):
    field = hj.TensorField(hj.Grid(shape, spacing), jnp.broadcast_to(jnp.eye(2), (*shape, 2, 2)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)  # rounding leaves residuals above the tolerance
        pairs = hj.eigenpairs(field, k, solver="block-lanczos")
    length, h = (shape[1] - 1) * spacing[1], spacing[1]
    angle = np.pi * np.arange(k) * h / length
    exact = 6 / h**2 * (1 - np.cos(angle)) / (2 + np.cos(angle))  # of linear elements in one dimension
    np.testing.assert_allclose(pairs.eigenvalues, exact, atol=1e-6 * exact[1])
    assert pairs.complete_below > exact[-1]


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1e2, 1e4])
def test_a_dumbbell_whose_first_eigenvalue_is_tiny(ratio):
    """Two squares and a bridge along which 1/ratio is conducted: right, or told by a warning and by the result code."""
    shape = (33, 16)
    metric = np.broadcast_to(np.eye(2), (*shape, 2, 2)).copy()
    metric[13:20] *= np.diag([ratio, 1 / ratio])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        pairs = hj.eigenpairs(hj.TensorField(hj.Grid(shape, 0.1), metric), 9, solver="block-lanczos")
    reference = scipy.linalg.eigh(*dense_matrices(pairs.pencil), eigvals_only=True)
    right = np.allclose(pairs.eigenvalues, reference[:9], rtol=1e-6, atol=1e-13 * reference[-1])
    assert right if ratio == 1e2 else right or told
    assert bool(pairs.result == hj.RESULTS.successful) == (not told)
    assert not told or not np.isfinite(pairs.eigenvalues).all() or pairs.complete_below > 0


@pytest.mark.slow
def test_traced_and_batched(rng):
    field = hj.TensorField(hj.Grid((26, 22), 0.1), random_spd(rng, (26, 22)))
    solve = partial(hj.eigenpairs, k=20, solver=hj.BlockLanczos(block=4, slice_size=14))
    said = []
    plain = solve(field, progress=said.append)
    assert len(said) >= 2
    assert "of 21 eigenpairs" in said[-1]
    tensors = jnp.stack([field.tensors, 1.1 * field.tensors])
    batched = jax.jit(jax.vmap(lambda T: solve(hj.TensorField(field.grid, T))))(tensors)
    np.testing.assert_allclose(batched.eigenvalues[0], plain.eigenvalues, atol=1e-9)
    assert batched.converged.all()
    assert (batched.complete_below > batched.eigenvalues[:, -1]).all()


@pytest.mark.slow
def test_mirrored_domain(rng):
    field = hj.TensorField(hj.Grid((26, 22), 0.1), random_spd(rng, (26, 22)))
    mirrored = hj.eigenpairs(field, 20, ("mirror", "neumann"), hj.BlockLanczos(block=4, slice_size=14))
    reference = hj.eigenpairs(field, 20, ("mirror", "neumann"), "dense")
    np.testing.assert_allclose(mirrored.eigenvalues, reference.eigenvalues, atol=1e-9)
    assert mirrored.complete_below > mirrored.eigenvalues[-1]


@pytest.mark.slow
def test_gradient_equals_the_dense_one(rng):
    grid = hj.Grid((24, 22), 0.1)
    tensors = jnp.asarray(random_spd(rng, grid.shape))

    def loss(tensors, solver):
        return jnp.sum(hj.hks(hj.eigenpairs(hj.TensorField(grid, tensors), 15, solver=solver), [0.2, 0.5]) ** 2)

    dense = jax.grad(loss)(tensors, "dense")
    np.testing.assert_allclose(jax.grad(loss)(tensors, "block-lanczos"), dense, atol=1e-8 * np.abs(dense).max())


@pytest.mark.slow
def test_float32_finds_what_rounding_allows(rng):
    grid = hj.Grid((24, 22), 0.1)
    tensors = random_spd(rng, grid.shape)
    with jax.enable_x64(False):
        field = hj.TensorField(grid, jnp.asarray(tensors, jnp.float32))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", hj.AccuracyWarning)  # a residual may be at the limit of rounding, or beyond
            values = hj.eigenpairs(field, 15, solver="block-lanczos").eigenvalues
        assert values.dtype == jnp.float32
    reference = hj.eigenpairs(hj.TensorField(grid, tensors), 15, solver="dense").eigenvalues
    np.testing.assert_allclose(values, reference, atol=1e-3 * reference[1])


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["block-lanczos", pytest.param("chebyshev-filter", marks=pytest.mark.slow)])
def test_float32_tensors_where_float64_is_enabled(rng, solver):
    grid = hj.Grid((24, 22), 0.1)
    tensors = random_spd(rng, grid.shape)
    reference = hj.eigenpairs(hj.TensorField(grid, tensors), 5, solver="dense").eigenvalues

    @jax.jit
    def values(tensors):
        return hj.eigenpairs(hj.TensorField(grid, tensors), 5, solver=solver).eigenvalues

    single = jnp.asarray(tensors, jnp.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)
        plain = hj.eigenpairs(hj.TensorField(grid, single), 5, solver=solver).eigenvalues
    for found in (plain, values(single)):
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, reference, atol=1e-3 * reference[1])


@pytest.mark.slow
def test_what_it_cannot_do_is_said(rng):
    pencil = problem(rng, "neumann")
    with pytest.raises(ValueError, match=r"k: got .* the block-lanczos solver computes at most \d+ of 546 pairs"):
        hj.eigenpairs(pencil, 200, solver="block-lanczos")
    with pytest.raises(ValueError, match="block: got 0"):
        hj.BlockLanczos(block=0)
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    mesh = hj.SurfaceMesh(vertices, np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]))
    with pytest.raises(ValueError, match="block-lanczos"):
        hj.eigenpairs(mesh, 2, solver="block-lanczos")
    broken = eqx.tree_at(lambda p: p.stiffness.coefficients, pencil, jnp.nan * pencil.stiffness.coefficients)
    with pytest.warns(hj.AccuracyWarning, match="did not converge"):
        hj.eigenpairs(broken, 5, solver="block-lanczos")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["neumann", "dirichlet lumped", "torus", "mask", "3d"])
def test_random_small_problems_miss_no_eigenvalue(rng, name):
    """200 problems in all, traced."""
    shape, boundary, mass = CASES[name]
    grid = grid_of(name)
    tensors = jnp.asarray([random_spd(rng, shape, spread) for spread in np.linspace(0.01, 2, 40)])

    def spectrum(tensors, solver):
        return hj.eigenpairs(hj.TensorField(grid, tensors), 40, boundary, solver, mass).eigenvalues

    def compare(tensors):
        return spectrum(tensors, hj.BlockLanczos(slice_size=20)), spectrum(tensors, "dense")

    values, reference = jax.jit(lambda T: jax.lax.map(compare, T))(tensors)
    n_null = 2 if name == "mask" else int(boundary in ("neumann", "periodic"))
    np.testing.assert_allclose(values / reference[:, n_null, None], reference / reference[:, n_null, None], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["neumann", "dirichlet", "periodic", ("periodic", "neumann"), "mask"])
def test_varied_fields_agree_with_eigsh(rng, boundary):
    """20 problems: anisotropy 1 to 1000, discontinuous, noise; every boundary, a mask."""
    shape = (48, 44)
    angle = rng.uniform(0, np.pi, shape) if boundary == "dirichlet" else np.full(shape, 0.3)
    frames = np.stack([np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([-np.sin(angle), np.cos(angle)], -1)], -1)
    jump = np.where(np.arange(shape[0])[:, None] < 20, 1.0, 50.0) * np.ones(shape)
    diagonals = [
        np.stack([np.ones(shape), np.ones(shape)], -1),
        np.stack([np.full(shape, 30.0), np.ones(shape)], -1),
        np.stack([np.full(shape, 1000.0), np.ones(shape)], -1),
        np.stack([jump, 1 / jump], -1),
    ]
    for diagonal in diagonals:
        tensors = np.einsum("...ia,...a,...ja->...ij", frames, diagonal, frames)
        if boundary == "mask":
            grid = hj.Grid(shape, 0.02, mask=mask(shape), components="all")
            pencil = hj.assemble(hj.TensorField(grid, tensors))
        else:
            pencil = hj.assemble(hj.TensorField(hj.Grid(shape, 0.02), tensors), boundary)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", hj.AccuracyWarning)  # a cut multiplet
            ours, reference = (hj.eigenpairs(pencil, 60, solver=s) for s in ("block-lanczos", "shift-invert"))
        scale = np.maximum(reference.eigenvalues, reference.eigenvalues[reference.n_null])
        np.testing.assert_allclose(ours.eigenvalues / scale, reference.eigenvalues / scale, atol=1e-9)
        assert ours.converged.all()
        assert ours.complete_below > ours.eigenvalues[-1]
