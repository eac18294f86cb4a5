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
from hks_jax.eigen import basis as bases
from hks_jax.eigen.dissection import dissect
from hks_jax.eigen.multifrontal import factorise
from hks_jax.eigen.slicing import Plan, crowded, cut, first_state, make_room, search
from hks_jax.eigen.symmetric_inverse import by_eigenvalues, by_elimination


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


def problem(rng, name, spread=1.0):
    shape, boundary, mass = CASES[name]
    grid = hj.Grid(shape, 0.1, mask=mask(shape), components="all") if name == "mask" else hj.Grid(shape, 0.1)
    return hj.assemble(hj.TensorField(grid, random_spd(rng, shape, spread)), boundary, mass)


def dense_matrices(pencil):
    return np.asarray(pencil.stiffness.to_dense()), np.asarray(pencil.mass.to_dense())


@pytest.mark.parametrize("inverse", [by_eigenvalues, by_elimination])
@pytest.mark.parametrize("n", [1, 7, 32, 75])
def test_inverse_and_inertia_of_an_indefinite_matrix(rng, inverse, n):
    a = rng.standard_normal((3, n, n))
    a = a + np.swapaxes(a, 1, 2)
    inverted, pivots = inverse(jnp.asarray(a))
    np.testing.assert_allclose(inverted @ a, np.broadcast_to(np.eye(n), a.shape), atol=1e-9)
    np.testing.assert_array_equal((pivots < 0).sum(axis=1), (np.linalg.eigvalsh(a) < 0).sum(axis=1))


@pytest.mark.parametrize("n", [32, 64])
def test_separators_halve_a_grid_so_that_batches_need_no_padding(n):
    dissection = dissect(hj.assemble(flat((n, n), (1.0, 1.0))).space)
    assert dissection.levels[0].own.shape == (1, 2 * n)
    assert dissection.padding.size == 0


@pytest.mark.parametrize("name", CASES)
def test_factorisation_solves_and_counts(rng, name):
    pencil = problem(rng, name)
    K, M = dense_matrices(pencil)
    spectrum = scipy.linalg.eigh(K, M, eigvals_only=True)
    run = jax.jit(factorise)
    for below in (0, 3, 40, K.shape[0]):
        ends = np.concatenate([[-1.0], spectrum, [2 * spectrum[-1]]])[below : below + 2]
        shift = 0.7 * ends[0] + 0.3 * ends[1]
        factor = run(dissect(pencil.space), pencil, shift)
        assert int(factor.negative) == below
        rhs = rng.standard_normal((3, K.shape[0]))
        reference = np.linalg.solve(K - shift * M, rhs.T).T
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


@pytest.mark.parametrize("name", ["torus", "mask", "3d"])
def test_pairs_agree_with_dense_ones(rng, name):
    pencil = problem(rng, name)
    # Slices so small that several are needed.
    check_against_dense(pencil, hj.eigenpairs(pencil, 60, solver=hj.BlockLanczos(block=4, slice_size=20)))


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


def test_torus_multiplets_and_certificate():
    pencil = hj.assemble(flat((32, 32), (1.0, 1.0), (True, True)), "periodic")
    pairs = hj.eigenpairs(pencil, 57, solver="block-lanczos")
    check_against_dense(pencil, pairs)
    assert pairs.solver_name == "block-lanczos"
    assert "none missed" in pairs.summary()


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


@pytest.mark.parametrize("size", [1.0, 1e-9])
@pytest.mark.parametrize(("dtype", "accuracy"), [(jnp.float64, 1e-15), (jnp.float32, 1e-6)])
def test_components_on_a_basis_in_pieces(rng, dtype, accuracy, size):
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
    np.testing.assert_allclose(vectors @ (x - parts.T), 0, atol=accuracy * np.linalg.norm(x, axis=0).max())
    mix = rng.standard_normal((3, 400))
    mix[:, filled:] = 0
    np.testing.assert_allclose(
        bases.combined(jnp.asarray(mix, dtype), basis), mix[:, :filled] @ q.T[:filled], atol=1e-5
    )


def test_eigenvalues_found_beyond_those_wanted_are_forgotten():
    plan = Plan(wanted=5, block=2, slice_size=5, max_slices=9)
    values = jnp.asarray(np.random.default_rng(0).permutation(plan.capacity).astype(float))
    state = jax.eval_shape(partial(first_state, plan=plan), hj.assemble(flat((12, 12), (1.0, 1.0))))
    state = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), state)
    state = state._replace(
        values=values, vectors=values[:, None] * jnp.ones((1, 144)), known=jnp.asarray(plan.capacity)
    )
    assert crowded(plan, state)
    state = make_room(plan, state)
    assert not crowded(plan, state)
    np.testing.assert_array_equal(state.values[: int(state.known)], np.arange(int(state.known)))
    np.testing.assert_array_equal(state.vectors[:, 0][: int(state.known)], np.arange(int(state.known)))
    assert np.isinf(state.values[int(state.known) :]).all()


def test_a_shift_where_a_front_is_singular_is_moved(rng):
    pencil = problem(rng, "neumann")
    dissection = dissect(pencil.space)
    # The own nodes of one half of all fronts below the first separator are the nodes on one side of it.
    half = np.concatenate([level.own[: len(level.own) // 2].ravel() for level in dissection.levels[1:]])
    half = half[half < pencil.space.n_dof]
    K, M = (matrix[np.ix_(half, half)] for matrix in dense_matrices(pencil))
    singular = scipy.linalg.eigh(K, M, eigvals_only=True)[5]
    plan = hj.BlockLanczos(block=4).plan(20, pencil.space.n_dof)
    state = first_state(pencil, plan)._replace(shift=jnp.asarray(singular))
    for shift, moves in ((singular, 1), (0.97 * singular, 0)):
        assert state.shift == pytest.approx(shift, rel=1e-12)
        factor, here, state = cut(pencil, dissection, plan, state)
        assert here
        state = search(pencil, factor, plan, 1e-8, state)
        assert state.moved == moves
        assert (state.known > 0) == (moves == 0)
        assert np.isfinite(state.start).all()


def test_traced_and_batched(rng):
    field = hj.TensorField(hj.Grid((26, 22), 0.1), random_spd(rng, (26, 22)))
    solve = partial(hj.eigenpairs, k=20, solver=hj.BlockLanczos(block=4, slice_size=14))
    said = []
    plain = hj.eigenpairs(field, 20, solver=hj.BlockLanczos(block=4, slice_size=14, progress=said.append))
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


def test_gradient_equals_the_dense_one(rng):
    grid = hj.Grid((24, 22), 0.1)
    tensors = jnp.asarray(random_spd(rng, grid.shape))

    def loss(tensors, solver):
        return jnp.sum(hj.hks(hj.eigenpairs(hj.TensorField(grid, tensors), 15, solver=solver), [0.2, 0.5]) ** 2)

    dense = jax.grad(loss)(tensors, "dense")
    np.testing.assert_allclose(jax.grad(loss)(tensors, "block-lanczos"), dense, atol=1e-8 * np.abs(dense).max())


def test_float32_finds_what_rounding_allows(rng):
    grid = hj.Grid((24, 22), 0.1)
    tensors = random_spd(rng, grid.shape)
    with jax.enable_x64(False):
        field = hj.TensorField(grid, jnp.asarray(tensors, jnp.float32))
        values = hj.eigenpairs(field, 15, solver="block-lanczos").eigenvalues
        assert values.dtype == jnp.float32
    reference = hj.eigenpairs(hj.TensorField(grid, tensors), 15, solver="dense").eigenvalues
    np.testing.assert_allclose(values, reference, atol=1e-3 * reference[1])


def test_what_it_cannot_do_is_said(rng):
    pencil = problem(rng, "neumann")
    with pytest.raises(ValueError, match=r"k: the block-lanczos solver gives at most \d+ of 546 pairs"):
        hj.eigenpairs(pencil, 200, solver="block-lanczos")
    with pytest.raises(ValueError, match="block, slice_size: got 0"):
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
    grid = problem(rng, name).space.grid
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
