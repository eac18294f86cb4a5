"""The matrix-free eigensolver for grids against dense linear algebra: grids, polynomials, pairs, derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from fields import flat, random_spd

import hks_jax as hj
from hks_jax.eigen.filter import chebyshev_filter
from hks_jax.eigen.filter.coarsening import coarsen, interpolate
from hks_jax.eigen.filter.polynomial import MOST_DEGREE, Band, correction, upper_end
from hks_jax.eigen.filter.subspace_iteration import GridFilter
from hks_jax.eigen.quality import rounding_of_quotients
from hks_jax.fem.box import cropped
from hks_jax.fem.nodal import nodal_pencil, to_columns, to_rows
from hks_jax.linear.host_matrices import near_zero


def masked(shape):
    inside = np.ones(shape, bool)
    inside[:3, :4] = False
    inside[shape[0] // 2 + 2, 5:7] = False
    return inside


CASES = {
    "neumann": ((10, 9, 11), "neumann", "consistent"),
    "torus, lumped": ((9, 10, 8), "periodic", "lumped"),
    "mixed, mask": ((11, 12, 9), ("neumann", ("dirichlet", "neumann"), "periodic"), "consistent"),
    "2d": ((30, 27), ("periodic", "neumann"), "consistent"),
}


def problem(name, dtype=np.float64):
    shape, boundary, mass = CASES[name]
    grid = hj.Grid(shape, 0.1, mask=masked(shape) if "mask" in name else None)
    x = grid.nodes
    waves = [np.sin(3 * x[..., a] + (a + 1) * x[..., a - 1]) for a in range(len(shape))]
    factor = np.exp(0.5 * np.stack(waves, -1))[..., None] * np.eye(len(shape))
    factor[..., 0, 1] = 0.6 * waves[0]
    tensors = (np.swapaxes(factor, -1, -2) @ factor).astype(dtype)
    return hj.assemble(hj.TensorField(grid, tensors), boundary, mass)


def dense_matrices(pencil):
    return np.asarray(pencil.stiffness.to_dense()), np.asarray(pencil.mass.to_dense())


@pytest.mark.parametrize("name", [n if n == "mixed, mask" else pytest.param(n, marks=pytest.mark.slow) for n in CASES])
def test_products_in_columns_equal_the_operators(rng, name):
    pencil = problem(name)
    space = pencil.space
    x = rng.standard_normal((3, space.n_dof))
    columns = to_columns(space.extend(jnp.asarray(x), outside=0.0).reshape(3, -1), space.node_shape)
    nodal = nodal_pencil(pencil)
    for matrix, of_nodal, y in zip(
        (pencil.stiffness, pencil.mass), (nodal.stiffness, nodal.mass), nodal.products()(columns), strict=True
    ):
        again = space.restrict(to_rows(y).reshape(3, *space.node_shape))
        np.testing.assert_allclose(again, matrix.apply(jnp.asarray(x)), atol=1e-13)
        np.testing.assert_array_equal(of_nodal @ columns, y)


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["neumann", pytest.param("periodic", marks=pytest.mark.slow)])
def test_a_metric_that_the_grid_hardly_resolves(boundary):
    # On the hill, modes of a node's length have lumped quotients below the wanted eigenvalues: without further terms
    # for the inverse of the mass they would take the place of the wanted ones.
    n, k = 10, 44
    grid = hj.Grid((n,) * 3, 2 / n, origin=(-1.0,) * 3)

    def metric(u):
        wide = jnp.exp(jnp.sum(jnp.cos(jnp.pi * (u + jnp.array([0.4, 0.4, 0.0])))) - 3)
        narrow = jnp.exp(6 * (jnp.sum(jnp.cos(jnp.pi * (u - jnp.array([0.5, 0.4, 0.0])))) - 3))
        return (1 + 3 * wide + 3 * narrow) * jnp.eye(3)

    field = hj.TensorField.from_function(metric, grid)
    pairs = hj.eigenpairs(field, k, boundary, solver=hj.ChebyshevFilter(max_rounds=16))
    assert pairs.converged.all()
    expected = scipy.linalg.eigh(*dense_matrices(pairs.pencil), eigvals_only=True, subset_by_index=[0, k - 1])
    np.testing.assert_allclose(pairs.eigenvalues, expected, atol=1e-9 * expected[-1])


@pytest.mark.parametrize(
    ("shape", "boundary"),
    [
        pytest.param((6, 9), "neumann", marks=pytest.mark.slow),
        pytest.param((7, 8), "periodic", marks=pytest.mark.slow),
        pytest.param((13, 10), "periodic", marks=pytest.mark.slow),
        ((6, 9), (("dirichlet", "neumann"), "periodic")),
        ((7, 8), (("dirichlet", "neumann"), "periodic")),
    ],
)
def test_a_coarse_pencil_is_the_fine_one_between_interpolated_functions(rng, shape, boundary):
    mask = np.ones(shape, bool)
    mask[2:4, 3] = False
    grid = hj.Grid(shape, 0.1, mask=mask)
    pencil = hj.assemble(hj.TensorField(grid, random_spd(rng, shape)), boundary)
    fine = nodal_pencil(pencil)
    coarse = jax.jit(coarsen)(fine)
    n = coarse.free.size
    raise_to = jax.jit(interpolate)
    basis = raise_to(fine, np.eye(n).reshape(*coarse.shape, n))
    product = jax.jit(lambda matrix, columns: matrix @ columns)
    for of_fine, of_coarse in ((fine.stiffness, coarse.stiffness), (fine.mass, coarse.mass)):
        image = product(of_fine, basis)
        expected = np.reshape(basis, (-1, n)).T @ np.reshape(image, (-1, n))
        found = product(of_coarse, np.eye(n).reshape(*coarse.shape, n)).reshape(n, n)
        np.testing.assert_allclose(found, expected, atol=1e-12)
    # Constants, where nothing is eliminated, stay constants.
    if boundary == "neumann":
        constant = raise_to(fine, np.ones((*coarse.shape, 1)))[..., 0]
        reached = np.asarray(constant)[np.asarray(fine.free)]
        assert np.isin(np.round(reached, 12), [0, 1]).all()
        assert (reached == 1).mean() > 0.9


@pytest.mark.parametrize(("name", "masks"), [("neumann", 0), ("mixed, mask", 2)])
def test_the_compiler_computes_nothing_with_the_grid(name, masks):
    """It would fold what is computed with constants, one element at a time, and warn where that takes long."""
    pencil = problem(name)
    traced = jax.make_jaxpr(lambda p: coarsen.__wrapped__(nodal_pencil(p)))(pencil)
    large = [var for var, value in zip(traced.jaxpr.constvars, traced.consts, strict=True) if np.size(value) > 64]
    uses = {equation.primitive.name for equation in traced.eqns if set(map(id, large)) & set(map(id, equation.invars))}
    assert (len(large), uses) == (masks, {"optimization_barrier"} if masks else set())


@pytest.mark.parametrize(
    ("shape", "boundary", "smaller"),
    [
        pytest.param((40, 30, 20), "neumann", (24, 20, 16), marks=pytest.mark.slow),
        pytest.param((40, 30, 20), "dirichlet", (24, 20, 16), marks=pytest.mark.slow),
        ((40, 30, 20), (("dirichlet", "neumann"), "periodic", ("neumann", "dirichlet")), (24, 30, 16)),
        ((60, 50), ("periodic", "neumann", "dirichlet"), (60, 32)),
        ((20, 18), "neumann", (20, 18)),
    ],
)
@pytest.mark.filterwarnings("ignore:boundary.*which the mask does not reach")
def test_a_cropped_grid_has_the_same_matrices(rng, shape, boundary, smaller):
    centre, radii = [10, *(n // 2 for n in shape[1:])], [10.5, *(0.28 * n for n in shape[1:])]
    away = (np.moveaxis(np.indices(shape), 0, -1) - centre) / radii
    grid = hj.Grid(shape, 0.1, mask=(away**2).sum(axis=-1) < 1, components="largest")
    pencil = hj.assemble(hj.TensorField(grid, random_spd(rng, shape)), boundary)
    small = cropped(pencil)
    assert small.space.node_shape == smaller
    for name in ("stiffness", "mass"):
        matrices = (getattr(each, name).to_scipy().toarray() for each in (pencil, small))
        np.testing.assert_array_equal(*matrices)
    np.testing.assert_array_equal(pencil.space.null_labels, small.space.null_labels)


@pytest.mark.slow
def test_the_correction_is_the_polynomial_it_is_derived_from(rng):
    pencil = problem("torus, lumped")
    nodal = nodal_pencil(pencil)
    K, M = dense_matrices(pencil)
    spectrum, vectors = scipy.linalg.eigh(K, M)
    high = float(upper_end(nodal))
    assert spectrum[-1] <= high < 1.2 * spectrum[-1]
    low, value, degree = spectrum[60], spectrum[25], 9
    band = Band(jnp.asarray(low), jnp.asarray(high))

    def polynomial(z):
        s = (2 * z - high - low) / (high - low)
        return np.polynomial.chebyshev.chebval(s, [0] * degree + [1])

    x = rng.standard_normal(spectrum.size)
    residual = to_columns(jnp.asarray(K @ x - value * (M @ x))[None], nodal.shape)
    found = x + to_rows(correction(nodal, band, residual, jnp.full(1, value), jnp.asarray(degree)))[0]
    expected = vectors @ (polynomial(spectrum) / polynomial(value) * (vectors.T @ (M @ x)))
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())
    gain = float(band.degree_for(jnp.asarray(value), abs(polynomial(value))))
    assert gain == pytest.approx(degree)


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "2d" else pytest.mark.slow) for n in CASES])
def test_pairs_equal_the_dense_ones(name):
    pencil = problem(name)
    k = 24
    rounds = []
    pairs = hj.eigenpairs(pencil, k, solver=hj.ChebyshevFilter(block=8), progress=rounds.append)
    assert pairs.converged.all()
    assert pairs.residuals.max() <= 1e-8
    expected = scipy.linalg.eigh(*dense_matrices(pencil), subset_by_index=[0, k - 1])[0]
    np.testing.assert_allclose(pairs.eigenvalues, expected, atol=1e-11 * expected[-1])
    gram = pairs.vectors @ pencil.mass.apply(pairs.vectors).T
    np.testing.assert_allclose(gram, np.eye(k), atol=1e-10)
    assert any("of 25 pairs" in text for text in rounds)
    assert sum("of 25 pairs" in text for text in rounds) <= (5 if name == "2d" else 8)


def with_island(n, side):
    """Return a field on an ellipse, and on a square of nodes that coarse grids lack."""
    x, y = np.indices((n, n)) / n
    mask = ((x - 0.5) / 0.42) ** 2 + ((y - 0.42) / 0.32) ** 2 < 1
    mask[-11 : side - 11, -11 : side - 11] = True
    tensors = np.broadcast_to(np.diag([1.0, 1.3]), (n, n, 2, 2))
    return hj.TensorField(hj.Grid((n, n), 1 / n, mask=mask, components="all"), tensors)


def test_coarse_grids_have_nodes_in_every_component():
    for side, shapes in ((0, [120, 60, 30]), (3, [120, 60])):
        pencil = hj.assemble(with_island(120, side))
        grids = chebyshev_filter._nested(pencil, hj.ChebyshevFilter(block=8).plan(7, pencil))
        assert [grid.shape[0] for grid in grids] == shapes


@pytest.mark.slow
@pytest.mark.parametrize("fields", [{}, {"potential": 3.0}], ids=["null vectors", "potential"])
def test_no_eigenvalue_of_a_small_component_is_missed(fields):
    pencil = hj.assemble(with_island(120, 3), **fields)
    pairs = hj.eigenpairs(pencil, 6, solver=hj.ChebyshevFilter(block=8))
    np.testing.assert_allclose(
        pairs.eigenvalues, hj.eigenpairs(pencil, 6, solver="shift-invert").eigenvalues, atol=1e-9
    )


@pytest.mark.slow
def test_residuals_are_relative_to_the_first_positive_eigenvalue():
    """Two components have two zero eigenvalues; beside a Dirichlet side there is none, and the first may be small."""
    mask = np.ones((48, 48), bool)
    mask[23] = False
    halves = hj.TensorField(
        hj.Grid(mask.shape, 1 / 48, mask=mask, components="all"), np.tile(np.eye(2), (48, 48, 1, 1))
    )
    door = np.tile(np.eye(2), (48, 48, 1, 1))
    door[3:5] *= 1e-4
    room = hj.TensorField.from_diffusion(hj.Grid((48, 48), 1 / 48), door, operator="fick")
    for field, boundary in ((halves, "neumann"), (room, (("dirichlet", "neumann"), "neumann"))):
        told = []
        pairs = hj.eigenpairs(field, 12, boundary, hj.ChebyshevFilter(block=8), progress=told.append)
        assert pairs.converged.all()
        assert sum("of 13 pairs" in text for text in told) <= 6
    pairs = hj.eigenpairs(halves, 2, solver=hj.ChebyshevFilter(block=8))  # all pairs are null vectors
    assert pairs.converged.all()


def test_a_filter_changes_only_blocks_with_a_vector_that_is_not_accurate():
    pencil = problem("2d")
    nodal = nodal_pencil(pencil)
    grid = GridFilter(nodal, upper_end(nodal), hj.ChebyshevFilter(block=8).plan(8, pencil))
    state = grid.from_random(pencil.volume)
    chosen = grid.choose(jnp.zeros(()), state)
    for allowed, changed in ((0.9, False), (1.1, True)):
        # Only the last vector of the first block is less accurate than the others are allowed to be.
        limits = jnp.full(16, jnp.inf).at[7].set(state.residuals[7] / allowed)
        found = grid.filter_block(chosen._replace(allowed=limits), *jnp.zeros(2, int), jnp.copy(state.vectors))
        assert np.any(found[:8] != state.vectors[:8]) == changed
        np.testing.assert_array_equal(found[8:], state.vectors[8:])


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["mean", "dirichlet"])
def test_pairs_of_similar_tensors_are_a_start(rng, boundary):
    shape, k, told = (12, 11, 10), 16, []
    grid, tensors = hj.Grid(shape, 0.1, mask=masked(shape)), random_spd(rng, shape, 0.2)
    solver = hj.ChebyshevFilter(block=8, tolerance=1e-4, keep_spare=True)

    def solve(tensors, start=None):
        told.clear()
        field = hj.TensorField(grid, tensors)
        pairs = hj.eigenpairs(field, k, boundary, solver, start=start, progress=told.append)
        assert pairs.converged.all()
        return pairs, sum("round" in text for text in told)

    first, _ = solve(tensors)
    again, rounds = solve(tensors, first)
    assert rounds == 0
    np.testing.assert_allclose(again.eigenvalues, first.eigenvalues, rtol=1e-9, atol=1e-9)
    other = tensors * (1 + 0.03 * rng.standard_normal(shape)[..., None, None])
    cold, many = solve(other)
    started, few = solve(other, first)
    assert few <= 0.7 * many
    np.testing.assert_allclose(started.eigenvalues, cold.eigenvalues, rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="start: got pairs on nodes of the shapes"):
        hj.eigenpairs(hj.TensorField(hj.Grid((12, 11)), random_spd(rng, (12, 11), 0.2)), k, solver=solver, start=first)


@pytest.mark.slow
def test_a_start_is_a_constant_under_jit_and_in_derivatives(rng):
    shape, k, t = (9, 8, 10), 8, jnp.array([0.15])
    solver, grid = hj.ChebyshevFilter(block=4, keep_spare=True), hj.Grid(shape, 0.1)
    tensors = jnp.asarray(random_spd(rng, shape, 0.3))

    def loss(tensors, start):
        pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k, solver=solver, start=start)
        return jnp.sum(hj.hks(pairs, t) ** 2)

    start = hj.eigenpairs(hj.TensorField(grid, tensors), k, solver=solver)
    plain, started = (jax.jit(jax.value_and_grad(loss))(1.1 * tensors, each) for each in (None, start))
    np.testing.assert_allclose(started[0], plain[0], rtol=1e-9)
    np.testing.assert_allclose(started[1], plain[1], atol=1e-7 * float(jnp.abs(plain[1]).max()))


@pytest.mark.slow
def test_multiplicities_of_a_cube_are_complete():
    n, k = 16, 29
    field = flat((n, n, n), (1.0, 1.0, 1.0))
    pairs = hj.eigenpairs(field, k, solver=hj.ChebyshevFilter(block=8))
    # Q1 on a uniform grid separates: (K₁⊗M₁⊗M₁ + …) has the sums of the intervals' own discrete eigenvalues.
    angles = np.pi * np.arange(n) / (n - 1)
    line = 6 * (n - 1) ** 2 * (1 - np.cos(angles)) / (2 + np.cos(angles))
    expected = np.sort((line[:, None, None] + line[:, None] + line).ravel())[:k]
    np.testing.assert_allclose(pairs.eigenvalues, expected, atol=1e-10 * expected[-1])


@pytest.mark.slow
def test_single_precision_where_a_coarse_grid_has_fewer_low_modes_than_vectors():
    # The random start on 8³ nodes leaves 32 vectors so dependent that rounding makes their Gram matrix indefinite.
    field, k, told = flat((16, 16, 16), (1.0, 1.1, 1.23)), 10, []
    single = hj.TensorField(field.grid, np.float32(field.tensors))
    pairs = hj.eigenpairs(single, k, solver=hj.ChebyshevFilter(tolerance=1e-4, block=32), progress=told.append)
    assert told[0] == "grid 8 × 8 × 8"
    assert pairs.converged.all()
    exact = hj.eigenpairs(field, k, solver="shift-invert").eigenvalues
    np.testing.assert_allclose(pairs.eigenvalues, exact, atol=1e-4)


@pytest.mark.slow
def test_rounding_of_quotients_is_what_the_host_computes_in_double_precision():
    pencil = problem("mixed, mask", np.float32)
    pairs = hj.eigenpairs(pencil, 12)
    chosen = np.arange(1, 12)
    _, changes, _ = near_zero(pencil, np.asarray(pairs.vectors)[chosen], accurate=False)
    np.testing.assert_allclose(rounding_of_quotients(pencil, pairs.vectors, chosen), changes, rtol=1e-5)


@pytest.mark.slow
def test_traced_batched_and_in_single_precision():
    pencil = problem("2d")
    k, solver = 24, hj.ChebyshevFilter(block=8)
    plain = hj.eigenpairs(pencil, k, solver=solver).eigenvalues
    scaled = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), pencil)
    batch = jax.jit(jax.vmap(lambda p: hj.eigenpairs(p, k, solver=solver).eigenvalues))(scaled)
    np.testing.assert_allclose(batch, np.stack([plain, plain]), rtol=1e-9, atol=1e-9)
    single = hj.eigenpairs(problem("2d", np.float32), k, solver=solver)
    assert single.eigenvalues.dtype == np.float32
    assert single.converged.all()
    np.testing.assert_allclose(single.eigenvalues, plain, rtol=2e-4, atol=1e-4)


@pytest.mark.slow
def test_gradient_equals_the_dense_one(rng):
    shape, k, times = (9, 8, 10), 8, jnp.array([0.15, 0.4])
    tensors = jnp.asarray(random_spd(rng, shape, 0.3))
    weights = rng.standard_normal((2, *shape))

    def loss(solver, tensors):
        pairs = hj.eigenpairs(hj.TensorField(hj.Grid(shape, 0.1), tensors), k, solver=solver)
        return jnp.sum(weights * hj.hks(pairs, times))

    found = jax.grad(partial(loss, hj.ChebyshevFilter(block=4)))(tensors)
    expected = jax.grad(partial(loss, "dense"))(tensors)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


def test_bad_settings_and_meshes_are_refused():
    for settings in ({"block": 0}, {"max_rounds": 0}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            hj.ChebyshevFilter(**settings)
    with pytest.raises(ValueError, match="grid"):
        hj.eigenpairs(hj.examples.bumpy_torus_mesh(20), 1, solver="chebyshev-filter")
    with pytest.raises(ValueError, match="at most"):
        hj.eigenpairs(problem("neumann"), 400, solver="chebyshev-filter")


@pytest.mark.slow
def test_too_few_rounds_are_reported():
    with pytest.warns(hj.AccuracyWarning, match="did not converge"):
        pairs = hj.eigenpairs(problem("neumann"), 24, solver=hj.ChebyshevFilter(block=8, max_rounds=1))
    assert not pairs.converged.all()


@pytest.mark.slow
def test_derivatives_on_a_coarse_grid_of_many_modes(rng):
    """The consistent mass takes modes far above the lumped band, which must not make the preconditioner indefinite."""
    grid, weights = hj.Grid((8, 8, 8), 1.0), jnp.asarray(rng.standard_normal((8, 8, 8)))
    boundary = (("neumann", "dirichlet"), "neumann", "neumann")

    def loss(tensors, solver):
        pairs = hj.eigenpairs(hj.TensorField(grid, tensors), 39, boundary, solver, multiplet="drop")
        return jnp.sum(weights * hj.hks(pairs, [4.0]))

    tensors = jnp.broadcast_to(jnp.eye(3), (8, 8, 8, 3, 3))
    expected = jax.grad(loss)(tensors, "dense")
    found = jax.jit(jax.grad(loss), static_argnums=1)(tensors, hj.ChebyshevFilter(block=8))
    assert jnp.linalg.norm(found - expected) < 1e-9 * jnp.linalg.norm(expected)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("low", [0.0, 1e-12, 1e-3])
def test_degrees_are_bounded_however_wide_the_band(dtype, low):
    """Without a bound a band that begins at rounding, as on a long thin domain, is filtered for hours."""
    degree = Band(jnp.asarray(low, dtype), jnp.asarray(1.0, dtype)).degree_for(jnp.zeros((), dtype), 1e5)
    exact = np.arccosh(1e5) / np.arccosh(1 + 2 * low / (1 - low)) if low else np.inf
    assert degree == pytest.approx(min(exact, MOST_DEGREE), rel=1e-4)


@pytest.mark.slow
def test_rounds_in_steps_give_the_same_and_say_what_is_left(monkeypatch):
    pencil, k, solver, told = problem("2d"), 24, hj.ChebyshevFilter(block=8), []
    whole = hj.eigenpairs(pencil, k, solver=solver)
    monkeypatch.setattr(chebyshev_filter, "_LARGE", 0)
    stepwise = hj.eigenpairs(pencil, k, solver=solver, progress=told.append)
    np.testing.assert_allclose(stepwise.eigenvalues, whole.eigenvalues, rtol=1e-12, atol=1e-12)
    assert any("% of the products" in text for text in told)
    first, last = (next(text for text in told if f"round {i}" in text) for i in (1, 3))
    assert first.seconds_left is None  # nothing is known of its pace
    assert last.seconds_left > 0


@pytest.mark.slow
def test_what_is_left_of_rounds_that_converge_evenly(monkeypatch):
    """Four rounds of 10 s each divide the residual by ten; the last two filter half as many pairs."""
    clock = iter([0.0, 10.0, 20.0])
    monkeypatch.setattr(chebyshev_filter.time, "perf_counter", lambda: next(clock))
    left = chebyshev_filter.Pace(9e3)
    assert left.seconds_left() is None
    assert left.seconds_left(100, 100) is None
    left.round_done(9e2)
    assert left.seconds_left() == pytest.approx(30.0)
    assert left.seconds_left(50, 100) == pytest.approx(25.0)
    left.round_done(9e1)
    assert left.seconds_left() == pytest.approx(20.0)
    assert left.seconds_left(25, 50) == pytest.approx(7.5)  # half of this round, and one more as short
    monkeypatch.setattr(chebyshev_filter.time, "perf_counter", lambda: 0.0)
    stuck = chebyshev_filter.Pace(4.5)
    stuck.round_done(5.0)
    assert stuck.seconds_left() is None  # of what does not converge nothing is promised
