"""Fick's operator div(D∇u): own finite volumes, scikit-fem, closed forms, and every function that knows the metric."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import skfem
from annotations import unchecked
from differences import directional
from fields import random_spd
from solids import box

import hks_jax as hj

pytestmark = pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")


def diffusivities(grid, ratio=3.0, rate=2.0):
    """Smooth tensors that turn, with a determinant that varies."""
    x, d = grid.nodes, grid.dimension
    angle = rate * (x[..., 0] - x[..., 1] / 2)
    frame = np.broadcast_to(np.eye(d), (*grid.shape, d, d)).copy()
    frame[..., 0, 0] = frame[..., 1, 1] = np.cos(angle)
    frame[..., 0, 1], frame[..., 1, 0] = -np.sin(angle), np.sin(angle)
    values = np.exp(np.stack([np.sin(rate * x[..., a] + a) for a in range(d)], axis=-1)) * [ratio, 1.0, 2.0][:d]
    return np.einsum("...ia,...a,...ja->...ij", frame, values, frame)


def fick(grid, D, **settings):
    return hj.TensorField.from_diffusion(grid, D, operator="fick", **settings)


def slab(n=21, m=7):
    """A fast half and a slow half: D = I up to the middle node and 10 I beyond."""
    grid = hj.Grid((n, m), (1 / (n - 1),) * 2)
    D = np.tile(np.eye(2), (n, m, 1, 1))
    D[n // 2 + 1 :] *= 10
    return grid, D


def steady(pencil, shape):
    """The solution of Ku = 0 that is 1 on the first side and 0 on the last."""
    K, n = pencil.stiffness.to_dense(), shape[-1]
    u = np.concatenate([np.ones(n), np.zeros(len(K) - n)])
    inner = slice(n, len(K) - n)
    u[inner] = np.linalg.solve(K[inner, inner], -K[inner, :n] @ np.ones(n))
    return u.reshape(shape)


def of_lines(D, span=1.0, across=0.0):
    """Stiffness and mass of −(Du′)′ + across·D u by finite volumes, for D at the middles of equal cells."""
    h, between = span / len(D), 2 / (1 / D[1:] + 1 / D[:-1])
    matrix = np.diag(np.concatenate([[0], between]) + np.concatenate([between, [0]]))
    matrix -= np.diag(between, 1) + np.diag(between, -1)
    return matrix / h + across * h * np.diag(D), h


def test_the_slab_conducts_as_fick_says():
    """Of 21 × 7 nodes, D = I and 10 I: Fick's steady state, spread of heat and λ₁, and those of the metric D⁻¹."""
    grid, D = slab()
    fields = {"inverse": hj.TensorField.from_diffusion(grid, D, metric="inverse"), "fick": fick(grid, D)}
    known = {  # the steady state at the interface, the share of heat in the fast half at t = 0.02 and at the end, λ₁
        "inverse": (0.500, 0.201, 0.096, 29.0),
        "fick": (0.098, 0.659, 0.475, 15.6),
    }
    for name, field in fields.items():
        pencil = hj.assemble(field)
        pairs = hj.eigenpairs(pencil, pencil.size, solver="dense")
        source = np.zeros(grid.shape)
        source[10] = 1.0
        weight = np.asarray(pencil.mass @ jnp.ones(pencil.size)).reshape(grid.shape)
        heat = weight * np.asarray(hj.heat_flow(pairs, [0.02, 20.0], source))
        shares = heat[:, 11:].sum((1, 2)) / heat.sum((1, 2))
        interface = steady(pencil, grid.shape)[10, 3]
        np.testing.assert_allclose((interface, *shares), known[name][:3], atol=6e-4, err_msg=name)
        np.testing.assert_allclose(pairs.eigenvalues[1], known[name][3], atol=0.01)
    np.testing.assert_allclose([pencil.measure, (pencil.mass @ jnp.ones(pencil.size)).sum()], 0.3, rtol=1e-13)


def test_the_slab_converges_to_the_transmission_problem():
    """Towards 1/11 at the interface, and λ₁ of tan(k/2) k + 10 tan(q/2) q = 0 with q = k/√10; the kink is order 1."""

    def condition(k):
        q = k / np.sqrt(10)
        return k * np.tan(k / 2) + 10 * q * np.tan(q / 2)

    exact = scipy.optimize.brentq(condition, np.pi + 1e-6, 6.0) ** 2, 1 / 11
    errors = []
    for n in (41, 81, 161):
        grid, D = slab(n, 3)
        pencil = hj.assemble(fick(grid, D))
        found = hj.eigenpairs(pencil, 2).eigenvalues[1], steady(pencil, grid.shape)[n // 2, 1]
        errors.append(np.abs(np.subtract(found, exact)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(np.abs(orders - 1) < 0.15), orders


def test_spectrum_agrees_with_finite_volumes():
    """D = a(x) diag(1, 2): modes f(x) cos(πmy) with −(af′)′ + 2π²m² af = λf, by 800 cells; order 2."""

    def a(x):
        return np.exp(np.sin(3 * x))

    middles = (np.arange(800) + 0.5) / 800
    exact = []
    for m in range(4):
        matrix, h = of_lines(a(middles), across=2 * (np.pi * m) ** 2)
        exact.append(scipy.linalg.eigh(matrix / h, eigvals_only=True, subset_by_index=[0, 5]))
    exact, errors = np.sort(np.concatenate(exact))[:8], []
    for n in (13, 25):
        grid = hj.Grid.from_bounds(0, 1, (n, n))
        D = a(grid.nodes[..., 0])[..., None, None] * np.diag([1.0, 2.0])
        pairs = hj.eigenpairs(fick(grid, D), 8)
        errors.append(np.abs(pairs.eigenvalues[1:] / exact[1:] - 1).max())
    assert 1.8 < np.log2(errors[0] / errors[1]) < 2.2
    assert errors[1] < 0.01


@pytest.mark.parametrize("shape", [(6, 8), (4, 5, 6)])
def test_agrees_with_scikit_fem(rng, shape):
    """K = ∫∇φ·D∇ψ and M = ∫φψ of multilinear D, which the Gauss points integrate exactly."""
    d = len(shape)
    grid, D = hj.Grid(shape, (0.3, 0.7, 0.5)[:d], (1.0, -2.0, 0.5)[:d]), random_spd(rng, shape)
    mesh = (skfem.MeshQuad if d == 2 else skfem.MeshHex).init_tensor(*grid.axes)
    basis = skfem.Basis(mesh, skfem.ElementQuad1() if d == 2 else skfem.ElementHex1(), intorder=4)
    index = np.rint((mesh.p.T - grid.origin) / grid.spacing).astype(int)
    numbers = np.ravel_multi_index(tuple(index.T), shape)
    nodal, order = D.reshape(-1, d, d)[numbers], np.argsort(numbers)
    parts = {f"d{a}{b}": basis.interpolate(nodal[:, a, b]) for a in range(d) for b in range(d)}

    @skfem.BilinearForm
    def stiffness(u, v, w):
        return sum(w[f"d{a}{b}"] * u.grad[b] * v.grad[a] for a in range(d) for b in range(d))

    @skfem.BilinearForm
    def mass(u, v, _):
        return u * v

    pencil = hj.assemble(fick(grid, D))
    for ours, form in ((pencil.stiffness, stiffness), (pencil.mass, mass)):
        theirs = form.assemble(basis, **(parts if form is stiffness else {})).toarray()[order][:, order]
        np.testing.assert_allclose(ours.to_dense(), theirs, rtol=0, atol=1e-13 * np.abs(theirs).max())
    np.testing.assert_allclose(pencil.measure, np.prod(grid.spacing) * np.prod(np.array(shape) - 1), rtol=1e-13)


@pytest.mark.slow
def test_constant_diffusivity_has_one_operator():
    """Where |D| is constant, Fick's operator is that of the metric D⁻¹; only the unit of the raw signature differs."""
    grid, D = hj.Grid((9, 11), (0.1, 0.1)), np.array([[3.0, 1.0], [1.0, 2.0]])
    of_metric = hj.TensorField.from_diffusion(grid, np.tile(D, (9, 11, 1, 1)), metric="inverse")
    for interpolation, mass, quadrature in (
        ("linear", "consistent", "gauss"),
        ("log-euclidean", "lumped", "gauss"),
        ("linear", "consistent", "cancelling"),
    ):
        field = fick(grid, np.tile(D, (9, 11, 1, 1)), interpolation=interpolation)
        one, other = (
            hj.eigenpairs(hj.assemble(each, "mean", mass, quadrature=quadrature), 40) for each in (of_metric, field)
        )
        np.testing.assert_allclose(other.eigenvalues, one.eigenvalues, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(hj.hks(other, [0.01]) * 5**0.5, hj.hks(one, [0.01]), rtol=1e-9)
        for scale in ("flat", "volume"):
            expected = hj.hks(one, [0.01], scale)
            np.testing.assert_allclose(hj.hks(other, [0.01], scale), expected, rtol=1e-9)


def test_adjugate_has_the_stiffness_of_fick_in_3d_and_isotropic_stiffness_has_no_diffusivity_in_2d(rng):
    log = "log-euclidean"
    grid, D = hj.Grid((4, 3, 4)), random_spd(rng, (4, 3, 4))
    of_metric = hj.assemble(hj.TensorField.from_diffusion(grid, D, metric="adjugate", interpolation=log))
    ours = hj.assemble(fick(grid, D, interpolation=log)).stiffness.to_dense()
    np.testing.assert_allclose(of_metric.stiffness.to_dense(), ours, atol=1e-12)
    grid, D = hj.Grid((4, 5)), rng.uniform(1, 9, (4, 5))[..., None, None] * np.eye(2)
    one, other = (
        hj.assemble(hj.TensorField.from_diffusion(grid, each, metric="inverse")).stiffness.to_dense()
        for each in (D, np.ones_like(D) * np.eye(2))
    )
    np.testing.assert_allclose(one, other, atol=1e-14)


def ring(shape):
    mask = np.ones(shape, bool)
    mask[tuple(slice(n // 2 - 1, n // 2 + 1) for n in shape)] = False
    return mask


@pytest.mark.parametrize(
    ("shape", "boundary", "interpolation", "masked"),
    [
        pytest.param((7, 8), "neumann", "linear", False, marks=pytest.mark.slow),
        pytest.param((8, 8), "mean", "linear", True, marks=pytest.mark.slow),
        pytest.param((7, 8), ("periodic", "dirichlet"), "log-euclidean", False, marks=pytest.mark.slow),
        pytest.param((4, 5, 4), "neumann", "linear", False, marks=pytest.mark.slow),
    ],
)
def test_derivatives_with_respect_to_the_diffusivity(rng, shape, boundary, interpolation, masked):
    grid = hj.Grid(shape, (0.2,) * len(shape), mask=ring(shape) if masked else None)
    D, direction = diffusivities(grid), random_spd(rng, shape)
    D[~grid.inside] = np.nan
    weights, times = rng.standard_normal((3, *shape)), [0.02, 0.1]

    def loss(D):
        pairs = hj.eigenpairs(fick(grid, D, interpolation=interpolation), 10, boundary, solver="dense")
        maps = [jnp.where(grid.inside, hj.hks(pairs, times, scale), 0) for scale in ("raw", "flat", "volume")]
        sums = sum(jnp.sum(w * each) for w, each in zip(weights, maps, strict=True))
        return sums + pairs.pencil.volume + jnp.sum(jnp.log(pairs.eigenvalues[4:8]))

    exact = directional(loss, D, direction)
    for gradient in (jax.grad(loss)(D), jax.jit(jax.grad(loss))(D)):
        known = jnp.where(jnp.asarray(grid.inside)[..., None, None], gradient, 0)
        np.testing.assert_allclose(jnp.sum(known * direction), exact, rtol=2e-7)
        np.testing.assert_array_equal(np.asarray(gradient)[~grid.inside], 0)
    tangent = jax.jvp(loss, (jnp.asarray(D),), (jnp.asarray(direction),))[1]
    np.testing.assert_allclose(tangent, exact, rtol=2e-7)


@pytest.mark.parametrize(
    "solver",
    ["shift-invert", *(pytest.param(each, marks=pytest.mark.slow) for each in ("block-lanczos", "chebyshev-filter"))],
)
def test_every_solver_finds_the_same_pairs(solver):
    shape = (31, 30) if solver == "chebyshev-filter" else (15, 14)
    grid = hj.Grid(shape, (0.1, 0.1), mask=ring(shape))
    field = fick(grid, diffusivities(grid))
    pairs, exact = (hj.eigenpairs(field, 8, solver=each) for each in (solver, "dense"))
    assert pairs.n_null == 1
    np.testing.assert_allclose(pairs.eigenvalues, exact.eigenvalues, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(hj.hks(pairs, [0.05], "flat"), hj.hks(exact, [0.05], "flat"), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_signature_without_eigenpairs(unit):
    """In any unit of D: tolerances are relative to (4πt)^(−d/2)/√|D|."""
    grid = hj.Grid((14, 13), (0.1, 0.1))
    field = fick(grid, unit * diffusivities(grid))
    pairs = hj.eigenpairs(field, 182, solver="dense")
    time = [0.003 / unit]
    exact = hj.hks(pairs, time, "flat")
    weight = pairs.pencil.density * 4 * np.pi * time[0]
    for mass, method in (("consistent", "selected-inversion"), ("consistent", "colouring"), ("lumped", "colouring")):
        of_mass = exact
        if mass == "lumped":
            of_mass = hj.hks(hj.eigenpairs(hj.assemble(field, mass="lumped"), 182, solver="dense"), time, "flat")
        found = weight * hj.hks_spectrum_free(field, time, mass=mass, method=method)
        np.testing.assert_allclose(found, of_mass, atol=1e-4)
    auto = hj.hks_auto(hj.eigenpairs(field, 40), [time[0], 20 * time[0]], "flat")
    np.testing.assert_allclose(auto.values[0], exact[0], atol=2e-4)


def test_normalisations_tend_to_one():
    """ "flat" at small times away from the boundary, "volume" at large times; a density has its own volume, too."""
    grid = hj.Grid((21, 21), (0.1, 0.1))
    field = fick(grid, diffusivities(grid, 2.0, 0.8))
    pairs = hj.eigenpairs(field, 441, solver="dense")
    inner = hj.hks(pairs, [0.03], "flat")[0, 6:-6, 6:-6]
    assert np.abs(inner - 1).max() < 0.1
    few = hj.eigenpairs(field, 4)
    np.testing.assert_allclose(hj.hks(few, [100.0], "volume"), 1, rtol=1e-9)
    weighted = hj.eigenpairs(hj.assemble(field, density=1 + grid.nodes[..., 0]), 4)
    np.testing.assert_allclose(hj.hks(weighted, [100.0], "volume"), 1, rtol=1e-9)
    assert weighted.pencil.measure > 1.5 * few.pencil.measure


def test_the_first_order_in_time_is_not_the_curvature_alone():
    """4πt√|D|·HKS = 1 + t (K/3 − ∇²ρ/ρ) + … with ρ = |D|^¼, here for D = exp(f) I on a torus."""
    n, t = 24, 0.2
    grid = hj.Grid((n, n), (2 * np.pi / n,) * 2)
    x, y = np.moveaxis(grid.nodes, -1, 0)
    a = np.exp(0.3 * np.sin(x) + 0.2 * np.cos(y))
    laplacian, squared = -0.3 * np.sin(x) - 0.2 * np.cos(y), (0.3 * np.cos(x)) ** 2 + (0.2 * np.sin(y)) ** 2
    field = fick(grid, a[..., None, None] * np.eye(2), interpolation="log-euclidean")
    pencil = hj.assemble(field, "periodic", quadrature="cancelling")
    found = (hj.hks(hj.eigenpairs(pencil, n * n, solver="dense"), [t], "flat")[0] - 1) / t
    expected = a * laplacian / 2 / 3 - a * (laplacian / 2 + squared / 4)
    np.testing.assert_allclose(found, expected, atol=0.02)
    assert np.abs(expected).max() > 0.25


def test_weyl_counts_by_the_metric_and_not_by_the_flat_volume():
    grid = hj.Grid((25, 25), (0.08, 0.08))
    field = fick(grid, 0.01 * diffusivities(grid))
    pencil = hj.assemble(field)
    pairs = hj.eigenpairs(pencil, 300, solver="dense")
    number = np.sum(np.asarray(pairs.eigenvalues) < 3.0)
    np.testing.assert_allclose(hj.weyl_count(pencil, [3.0], field), number, rtol=0.1)
    assert pencil.measure < 0.05 * pencil.volume
    few, times = hj.eigenpairs(pencil, 60, solver="dense"), [0.5, 2.0]
    missing = 1 - hj.heat_trace(few, times) / hj.heat_trace(pairs, times)
    np.testing.assert_allclose(hj.truncation(few, times).tail, missing, rtol=0.25, atol=1e-3)


@pytest.mark.slow
def test_resolution_estimate_follows_the_measured_error():
    """The median error of the signature on coarse grids is 1/3 to 3 times the estimate, for Fick's operator, too."""
    fine = hj.Grid((65, 65), (2 / 64,) * 2)
    times = [0.02, 0.2]
    exact = hj.hks(hj.eigenpairs(fick(fine, diffusivities(fine)), 300), times)
    for n, step in ((17, 4), (33, 2)):
        grid = hj.Grid((n, n), (2 / (n - 1),) * 2)
        pairs = hj.eigenpairs(fick(grid, diffusivities(grid)), 200)
        error = np.median(np.abs(hj.hks(pairs, times) / exact[:, ::step, ::step] - 1), axis=(1, 2))
        ratio = error / np.asarray(hj.truncation(pairs, times).resolution_bias)
        assert np.all((ratio > 1 / 3) & (ratio < 3)), ratio


def test_copies_of_a_field_keep_the_operator():
    grid = hj.Grid((5, 6), (0.1, 0.1))
    field = fick(grid, diffusivities(grid))
    wide = hj.reflect(field, 2)
    assert wide.operator == field.with_tensors(field.tensors).operator == jax.tree.map(jnp.array, field).operator
    np.testing.assert_allclose(hj.assemble(wide).measure, 0.8 * 0.9, rtol=1e-12)


@pytest.mark.slow
def test_functions_of_fields_and_pairs_know_the_operator():
    grid = hj.Grid((11, 12), (0.1, 0.1))
    field = fick(grid, diffusivities(grid))
    np.testing.assert_allclose(
        hj.boundary_influence(field, [0.05], 20)[0],
        hj.boundary_influence(hj.eigenpairs(field, 40, "mean"), [0.05])[0],
        atol=1e-3,
    )
    D = diffusivities(grid)
    noise = hj.TensorNoise.relative(D, 0.02)
    bars = hj.uncertainty(lambda D: hj.hks(hj.eigenpairs(fick(grid, D), 30), [0.05], "flat"), D, noise)
    # Noise of the local D is divided out; without the factor √|D| it would be about 2 %.
    assert bars.deviation.shape == (1, 11, 12)
    grid = hj.Grid((7, 8), (0.16, 0.16))
    field = fick(grid, diffusivities(grid))
    target = hj.hks(hj.eigenpairs(field, 30), [0.05, 0.2])
    fit = hj.fit_metric(field.with_tensors(1.1 * field.tensors), target, [0.05, 0.2], "conformal", k=30)
    assert fit.field.operator == "fick"
    assert fit.misfit < 1e-3


def test_meshes_integrate_over_space():
    """Tetrahedra against scikit-fem; a tilted surface against the same plane; P2 and the nodal √|D|."""
    vertices, cells = box((3, 4, 3))
    D = diffusivities(hj.Grid((3, 4, 3), (0.5, 1 / 3, 0.5))).reshape(-1, 3, 3)
    solid = hj.TetMesh.from_tensors(vertices, cells, D, operator="fick", at="vertices")
    mesh = skfem.MeshTet(vertices.T, cells.T)
    means = D[cells].mean(axis=1)

    @skfem.BilinearForm
    def stiffness(u, v, w):
        return np.einsum("kij,jkq,ikq->kq", means, u.grad, v.grad)

    basis = skfem.Basis(mesh, skfem.ElementTetP1(), intorder=2)
    pencil = hj.assemble(solid)
    np.testing.assert_allclose(pencil.stiffness.to_dense(), stiffness.assemble(basis).toarray(), atol=1e-13)
    np.testing.assert_allclose(pencil.measure, 1, rtol=1e-13)
    np.testing.assert_allclose(hj.assemble(solid, degree=2).measure, 1, rtol=1e-13)

    plane = skfem.MeshTri().refined(2)
    flat = np.concatenate([plane.p.T, np.zeros((plane.p.shape[1], 1))], axis=1)
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    rate = np.exp(flat[:, 0])
    tilted = turn @ (rate[:, None, None] * np.diag([1.0, 4.0, 1.0])) @ turn.T
    surface = hj.SurfaceMesh.from_tensors(flat @ turn.T, plane.t.T, tilted, operator="fick")
    of_cells = rate[plane.t.T].mean(axis=1)

    @skfem.BilinearForm
    def in_plane(u, v, w):
        return of_cells[:, None] * (u.grad[0] * v.grad[0] + 4 * u.grad[1] * v.grad[1])

    theirs = in_plane.assemble(skfem.Basis(plane, skfem.ElementTriP1())).toarray()
    for degree in (1, 2):
        pencil = hj.assemble(surface, degree=degree)
        np.testing.assert_allclose(pencil.measure, 1, rtol=1e-13)
        np.testing.assert_allclose(pencil.density[: len(rate)], 2 * rate, rtol=0.15)
        if degree == 1:
            np.testing.assert_allclose(pencil.stiffness.to_dense(), theirs, atol=1e-12)


def test_own_forms_are_integrated_over_space():
    grid = hj.Grid((5, 6), (0.2, 0.3))
    field = fick(grid, diffusivities(grid))
    own = hj.assemble_forms(field, _energy, _product)
    ours = hj.assemble(field)
    for name in ("stiffness", "mass"):
        np.testing.assert_allclose(getattr(own, name).to_dense(), getattr(ours, name).to_dense(), atol=1e-13)


def _energy(u, v, w):
    return u.grad @ w.inverse @ v.grad


def _product(u, v, w):
    return u.value * v.value


def test_messages():
    grid, D = slab(9, 8)
    field = fick(grid, D)
    assert "operator='fick'" in repr(field)
    with pytest.raises(ValueError, match=r'metric: got \'inverse\' with operator="fick".*Leave one of them out'):
        hj.TensorField.from_diffusion(grid, D, metric="inverse", operator="fick")
    with (
        unchecked(),
        pytest.raises(ValueError, match=r'operator: got \'flick\'; expected "laplace-beltrami" or "fick"'),
    ):
        hj.TensorField.from_diffusion(grid, D, operator="flick")
    for name, of in (
        ("the expansion", lambda: hj.hks_expansion(field, [0.1])),
        ("∇²", lambda: hj.laplace_beltrami(field, jnp.ones((9, 8)))),
    ):
        with pytest.raises(ValueError, match=rf"operator='fick', but {name}.*belongs to the Laplace–Beltrami operator"):
            of()
    for pencil in (hj.assemble(field), hj.assemble(field.with_tensors(D), density=2.0)):
        with pytest.raises(ValueError, match=r"volume element is not that of its metric.*your own coefficients"):
            hj.heat_coefficients(hj.eigenpairs(pencil, 4), 1)
