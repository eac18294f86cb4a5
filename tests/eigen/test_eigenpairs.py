"""Eigenpairs against exact spectra, and the report on their quality."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from annotations import unchecked
from fields import flat, random_spd

import hks_jax as hj


def axis_eigenvalues(condition, length: float, n: int) -> np.ndarray:
    """The exact eigenvalues of −d²/dx² on an interval or circle."""
    i = np.arange(n)
    if condition == "periodic":
        return (2 * np.pi * ((i + 1) // 2) / length) ** 2
    shift = {"neumann": 0, "dirichlet": 1, ("neumann", "dirichlet"): 0.5, ("dirichlet", "neumann"): 0.5}[condition]
    return (np.pi * (i + shift) / length) ** 2


def exact(boundary, lengths, k: int) -> np.ndarray:
    axes = [axis_eigenvalues(c, a, 3 * k) for c, a in zip(boundary, lengths, strict=True)]
    return np.sort(np.add.reduce(np.meshgrid(*axes, indexing="ij")).ravel())[:k]


CASES = [
    (("neumann", "neumann"), (1.0, 1.3)),
    (("dirichlet", "dirichlet"), (1.0, 1.3)),
    (("periodic", "periodic"), (1.0, 1.3)),
    (("periodic", "neumann"), (1.0, 1.3)),
    ((("neumann", "dirichlet"), "neumann"), (1.0, 1.3)),
    ((("dirichlet", "neumann"), ("neumann", "dirichlet")), (1.0, 1.3)),
    (("neumann", "dirichlet", "periodic"), (1.0, 1.3, 1.7)),
]


@pytest.mark.parametrize(
    ("boundary", "lengths", "mass"),
    [(*case, "consistent") for case in CASES] + [(*CASES[0], "lumped"), (*CASES[6], "lumped")],
)
def test_second_order_convergence_to_the_exact_spectrum(boundary, lengths, mass):
    k, periodic = 6, tuple(c == "periodic" for c in boundary)
    sizes = (10, 20) if len(lengths) == 2 else (5, 9)
    errors = []
    for n in sizes:
        shape = tuple(n if wraps else n + 1 for wraps in periodic)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", hj.AccuracyWarning)  # multiplets that k = 6 may cut do not matter here
            pairs = hj.eigenpairs(flat(shape, lengths, periodic), k, boundary, "dense", mass)
        truth = exact(boundary, lengths, k)
        errors.append(np.max(np.abs(pairs.eigenvalues - truth) / np.maximum(truth, 1)))
    order = np.log(errors[0] / errors[1]) / np.log(sizes[1] / sizes[0])
    assert 1.7 < order < 2.3


@pytest.mark.parametrize(
    "boundary", ["dirichlet", *(pytest.param(b, marks=pytest.mark.slow) for b in ("neumann", ("periodic", "neumann")))]
)
def test_hks_converges_at_second_order_to_theta_sums(boundary):
    lengths, t = (1.0, 1.3), 0.05
    names = (boundary,) * 2 if isinstance(boundary, str) else boundary

    def theta(condition, length, x):
        i = np.arange(1, 60)[:, None]
        decay = np.exp(-t * (np.pi * i / length) ** 2)
        if condition == "periodic":
            return np.full_like(x, (1 + 2 * np.sum(np.exp(-t * (2 * np.pi * i / length) ** 2))) / length)
        if condition == "neumann":
            return (1 + 2 * np.sum(decay * np.cos(np.pi * i * x / length) ** 2, axis=0)) / length
        return 2 * np.sum(decay * np.sin(np.pi * i * x / length) ** 2, axis=0) / length

    errors = []
    for n in (10, 20):
        periodic = tuple(c == "periodic" for c in names)
        field = flat(tuple(n if w else n + 1 for w in periodic), lengths, periodic)
        pairs = hj.eigenpairs(field, hj.assemble(field, boundary).space.n_dof, boundary)
        truth = np.multiply.outer(*[theta(c, a, x) for c, a, x in zip(names, lengths, field.grid.axes, strict=True)])
        errors.append(np.abs(hj.hks(pairs, [t])[0] - truth).max())
    assert 1.8 < np.log2(errors[0] / errors[1]) < 2.3


@pytest.mark.parametrize(
    ("boundary", "mass"),
    [
        ("neumann", "consistent"),
        pytest.param("dirichlet", "lumped", marks=pytest.mark.slow),
        (("periodic", "neumann"), "lumped"),
        pytest.param("mirror", "consistent", marks=pytest.mark.slow),
        pytest.param("neumann", "lumped", marks=pytest.mark.slow),
        pytest.param("dirichlet", "consistent", marks=pytest.mark.slow),
        pytest.param(("periodic", "neumann"), "consistent", marks=pytest.mark.slow),
        pytest.param("mirror", "lumped", marks=pytest.mark.slow),
    ],
)
def test_solvers_agree(rng, boundary, mass):
    mask = np.ones((13, 14), dtype=bool)
    mask[:4, 9:] = False
    field = hj.TensorField(hj.Grid((13, 14), 0.1, mask=mask), random_spd(rng, (13, 14)))
    dense = hj.eigenpairs(field, 30, boundary, "dense", mass)
    sparse = hj.eigenpairs(field, 30, boundary, "shift-invert", mass)
    assert (dense.solver_name, sparse.solver_name) == ("dense", "shift-invert")
    assert dense.converged.all()
    assert sparse.converged.all()
    np.testing.assert_allclose(sparse.eigenvalues, dense.eigenvalues, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(sparse.next_eigenvalue, dense.next_eigenvalue, rtol=1e-10)
    times = 4 * np.log(10) / dense.eigenvalues[np.array([5, 1])]
    np.testing.assert_allclose(hj.hks(sparse, times), hj.hks(dense, times), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("solver", ["dense", "shift-invert"])
def test_mass_orthonormal_with_true_residuals(rng, solver):
    field = hj.TensorField(hj.Grid((9, 10)), random_spd(rng, (9, 10)))
    pairs = hj.eigenpairs(field, 12, solver=solver)
    K, M, phi = pairs.pencil.stiffness.to_dense(), pairs.pencil.mass.to_dense(), pairs.vectors.T
    np.testing.assert_allclose(phi.T @ M @ phi, np.eye(12), atol=1e-11)
    residual = np.linalg.norm(K @ phi - M @ phi * pairs.eigenvalues, axis=0) / np.linalg.norm(M @ phi, axis=0)
    scale = np.maximum(pairs.eigenvalues, pairs.eigenvalues[1])
    np.testing.assert_allclose(pairs.residuals, residual / scale, rtol=1e-3, atol=1e-14)
    assert pairs.residuals.max() < 1e-10
    assert pairs.eigenfunctions.shape == (12, 9, 10)


def test_zero_modes_are_exact_one_per_natural_component():
    mask = np.zeros((12, 12), dtype=bool)
    mask[:4] = mask[5:8] = mask[9:] = True
    grid = hj.Grid((12, 12), mask=mask, components="all")
    field = hj.TensorField(grid, np.broadcast_to(np.eye(2), (12, 12, 2, 2)))
    pairs = hj.eigenpairs(field, 9)
    assert pairs.n_null == 3
    np.testing.assert_array_equal(pairs.eigenvalues[:3], 0)
    assert pairs.eigenvalues[3] > 0.01
    # Large times: heat stays in its component, 1/area each.
    late = hj.hks(pairs, [1e4])[0]
    np.testing.assert_allclose(late[[0, 6, 10], 5], [1 / 33, 1 / 22, 1 / 22], rtol=1e-12)
    # A Dirichlet side takes the zero mode from the component that it touches, and from no other.
    pinned = hj.eigenpairs(field, 9, (("dirichlet", "neumann"), "neumann"))
    assert pinned.n_null == 2
    assert pinned.eigenvalues[2] > 0.01


def test_nan_outside_the_mask_zero_on_dirichlet_nodes(rng):
    mask = np.ones((9, 9), dtype=bool)
    mask[:3, :3] = False
    mask[2, 0] = True  # inside the mask, but a corner of no complete element
    field = hj.TensorField(hj.Grid((9, 9), mask=mask, components="all"), random_spd(rng, (9, 9)))
    functions = np.asarray(hj.eigenpairs(field, 5, (("neumann", "dirichlet"), "neumann")).eigenfunctions)
    mask[2, 0] = False
    np.testing.assert_array_equal(np.isnan(functions), np.broadcast_to(~mask, functions.shape))
    np.testing.assert_array_equal(functions[:, -1], 0)


@pytest.mark.parametrize("solver", [pytest.param("dense", marks=pytest.mark.slow), "shift-invert"])
@pytest.mark.parametrize("boundary", ["dirichlet", pytest.param("mirror", marks=pytest.mark.slow)])
def test_jit_and_vmap_give_the_looped_result(rng, solver, boundary):
    grid = hj.Grid((7, 8))
    batch = jnp.asarray(np.stack([random_spd(rng, (7, 8)) for _ in range(3)]))

    def signature(T):
        return hj.hks(hj.eigenpairs(hj.TensorField(grid, T), 10, boundary, solver), jnp.array([1.0, 3.0]))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)
        looped = jnp.stack([signature(T) for T in batch])
    np.testing.assert_allclose(jax.jit(signature)(batch[0]), looped[0], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(jax.vmap(signature)(batch), looped, rtol=1e-8, atol=1e-12)


def two_squares() -> hj.TensorField:
    mask = np.ones((4, 9), dtype=bool)
    mask[:, 4] = False
    return hj.TensorField(hj.Grid((4, 9), mask=mask, components="all"), np.broadcast_to(np.eye(2), (4, 9, 2, 2)))


def test_a_cut_multiplet_is_reported():
    field = flat((12, 12), (1.0, 1.0))  # λ₁ = λ₂ by symmetry
    with pytest.warns(hj.AccuracyWarning, match="eigenspace. Take the k that `count_eigenvalues` counts just"):
        hj.eigenpairs(two_squares(), 1)
    with pytest.warns(hj.AccuracyWarning, match="k = 2 cuts a multiple eigenvalue: the last 1 pair.*Take k = 1 or"):
        pairs = hj.eigenpairs(field, 2)
    assert pairs.cut_multiplet == 1
    assert hj.eigenpairs(field, 3).cut_multiplet == 0
    assert hj.eigenpairs(field, 144).next_eigenvalue == np.inf


def test_all_copies_of_a_highly_multiple_eigenvalue_are_found():
    """Nine separate equal squares: every eigenvalue at least nine-fold, which plain Lanczos misses."""
    mask = np.zeros((18, 18), dtype=bool)
    for i, j in np.ndindex(3, 3):
        mask[6 * i : 6 * i + 5, 6 * j : 6 * j + 5] = True
    grid = hj.Grid(mask.shape, mask=mask, components="all")
    field = hj.TensorField(grid, np.broadcast_to(np.eye(2), (18, 18, 2, 2)))
    dense, sparse = (hj.eigenpairs(field, 27, solver=name) for name in ("dense", "shift-invert"))
    np.testing.assert_allclose(sparse.eigenvalues, dense.eigenvalues, atol=1e-10)
    np.testing.assert_allclose(hj.hks(sparse, [4.0]), hj.hks(dense, [4.0]), rtol=1e-9)


def test_a_barrier_of_slow_diffusion_takes_no_digits():
    """Its metric D⁻¹ has nearly all of the volume, by which the solver once chose its shift."""
    diffusivity = np.tile(np.eye(2), (41, 41, 1, 1))
    diffusivity[19:21] *= 1e-11
    field = hj.TensorField.from_diffusion(hj.Grid.from_bounds(0, 1, (41, 41)), diffusivity, operator="fick")
    pairs = hj.eigenpairs(field, 12, solver="shift-invert")
    assert pairs.converged.all()
    pencil = hj.assemble(field)
    exact = scipy.linalg.eigh(pencil.stiffness.to_dense(), pencil.mass.to_dense(), eigvals_only=True)[:12]
    np.testing.assert_allclose(pairs.eigenvalues, exact, atol=1e-9)


def test_unconverged_pairs_are_reported_not_hidden(rng):
    field = hj.TensorField(hj.Grid((20, 20)), random_spd(rng, (20, 20), 3.0))
    with pytest.warns(hj.AccuracyWarning, match="of 30 eigenpairs did not converge .*or a larger basis"):
        pairs = hj.eigenpairs(field, 30, solver=hj.ShiftInvert(max_restarts=1, basis=32))
    assert not pairs.converged.all()
    assert np.isnan(pairs.eigenvalues).any()


def test_nan_from_traced_tensors_is_reported():
    grid = hj.Grid((4, 4))

    @jax.jit
    def solve(T):
        return hj.eigenpairs(hj.TensorField(grid, T), 3, solver="shift-invert")

    assert not solve(-jnp.broadcast_to(jnp.diag(jnp.array([1.0, -1.0])), (4, 4, 2, 2))).converged.any()


def test_progress_is_reported(rng):
    told = []
    field = hj.TensorField(hj.Grid((20, 20)), random_spd(rng, (20, 20)))
    hj.eigenpairs(field, 40, solver="shift-invert", progress=told.append)
    assert told[0] == "factorising"
    counts = [[int(word) for word in text.split() if word.isdecimal()] for text in told if "solves" in text]
    assert [solves // 25 for solves, _ in counts] == [i + 1 for i in range(len(counts))]
    assert all(solves <= expected < 2 * (counts[-1][0] + 25) for solves, expected in counts)
    assert all(text.seconds_left > 0 for text in told if "solves" in text)


def test_auto_chooses_by_size_and_says_so(rng):
    assert hj.eigenpairs(flat((10, 11), (1.0, 1.1)), 5).solver_name == "dense"
    assert hj.eigenpairs(flat((50, 51), (1.0, 1.1)), 5).solver_name == "shift-invert"
    text = hj.eigenpairs(flat((10, 11), (1.0, 1.1)), 5).summary()
    assert "5 eigenpairs of 110 by dense" in text
    assert "5 of 5 converged" in text


@pytest.mark.parametrize("k", [0, -1, 2.5, 31, None, float("nan")])
def test_k_out_of_range(k):
    remedy = r"\. Use a smaller k or a finer grid$" if k == 31 else "degrees of freedom$"
    with unchecked(), pytest.raises(ValueError, match=f"k: got {k}; expected an integer from 1 to 30, .*{remedy}"):
        hj.eigenpairs(flat((5, 6), (1.0, 1.0)), k)


def test_bad_settings_are_named():
    field = flat((5, 6), (1.0, 1.0))
    with pytest.raises(ValueError, match="solver: got 'magic'; expected \"auto\", 'dense', 'shift-invert'"):
        hj.eigenpairs(field, 3, solver="magic")
    with pytest.raises(ValueError, match="shift-invert solver computes at most 29 of 30 pairs"):
        hj.eigenpairs(field, 29, solver="shift-invert")
    with pytest.raises(ValueError, match="a pencil has them already"):
        hj.eigenpairs(hj.assemble(field), 3, "dirichlet")
    np.testing.assert_allclose(
        hj.eigenpairs(hj.assemble(field, "dirichlet"), 3).eigenvalues, hj.eigenpairs(field, 3, "dirichlet").eigenvalues
    )


@pytest.mark.parametrize(("boundary", "mass"), [("neumann", "consistent"), ("mean", "lumped")])
def test_equations_of_masked_nodes_are_not_among_the_pairs(rng, boundary, mass):
    """Most nodes being inside, the rest have equations of their own; few pairs or nearly all, none is of them."""
    mask = np.ones((12, 13), bool)
    mask[:3, :4] = mask[9:, 10:] = False
    field = hj.TensorField(hj.Grid(mask.shape, mask=mask), random_spd(rng, mask.shape))
    exact = hj.eigenpairs(field, 120, boundary, "dense", mass)
    for k in (15, 120):
        pairs = hj.eigenpairs(field, k, boundary, "shift-invert", mass)
        assert pairs.vectors.shape == (k, mask.sum())
        np.testing.assert_allclose(pairs.eigenvalues, exact.eigenvalues[:k], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(("mass", "sign"), [("lumped", 1), ("lumped", -1), ("consistent", -1)])
def test_equations_of_nodes_outside_a_mask_are_above_the_spectrum_s_beginning(mass, sign):
    """A negative potential or −K moves the spectrum below zero, and the separate equations with it."""
    n, k = 44, 4
    grid = hj.Grid((n, n), mask=np.hypot(*(np.indices((n, n)) - (n - 1) / 2)) <= n / 2 - 0.5)
    pencil = hj.assemble(hj.TensorField(grid, np.tile(np.eye(2), (n, n, 1, 1))), mass=mass, potential=-30.0)
    if sign < 0:
        pencil = pencil.with_stiffness(pencil.stiffness.with_flat(-pencil.stiffness.flat()))
    assert pencil.size < n**2
    pairs = hj.eigenpairs(pencil, k, solver="shift-invert")
    dense = pencil.stiffness.to_dense(), pencil.mass.to_dense()
    np.testing.assert_allclose(pairs.eigenvalues, scipy.linalg.eigh(*dense, subset_by_index=[0, k - 1])[0], rtol=1e-10)
    assert (jnp.abs(pairs.vectors).max(axis=1) > 0).all()


@pytest.mark.filterwarnings("ignore:k = 5 cuts a multiple eigenvalue")
@pytest.mark.filterwarnings("ignore:.*solver could not confirm that it missed no")  # for K = 0
@pytest.mark.parametrize("mass", ["consistent", "lumped"])
@pytest.mark.parametrize("c", [2.0, -2.0, 0.0])
def test_equations_of_nodes_outside_a_mask_are_apart_from_a_spectrum_of_one_number(mass, c):
    n, k = 16, 5
    grid = hj.Grid((n, n), mask=np.hypot(*(np.indices((n, n)) - (n - 1) / 2)) <= n / 2 - 0.5)
    pencil = hj.assemble(hj.TensorField(grid, np.tile(np.eye(2), (n, n, 1, 1))), mass=mass)
    K, M = pencil.stiffness, pencil.mass
    zero = K.with_flat(jnp.zeros_like(K.flat()))
    multiple = zero.plus(c * M.diagonal()) if mass == "lumped" else K.with_flat(c * M.flat())
    pairs = hj.eigenpairs(pencil.with_stiffness(multiple), k, solver="shift-invert")
    np.testing.assert_allclose(pairs.eigenvalues, np.full(k, c), atol=1e-12)
    np.testing.assert_allclose(pairs.vectors @ M.apply(pairs.vectors).T, np.eye(k), atol=1e-12)
