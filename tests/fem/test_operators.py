"""Potentials, densities and forms of one's own: exact spectra, scikit-fem's assembly, differences, refusals."""

from math import comb

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skfem
from annotations import unchecked
from differences import directional
from fields import flat, random_spd
from scipy.optimize import brentq
from skfem.helpers import dot, grad
from skfem.models.elasticity import linear_elasticity
from solids import box

import hks_jax as hj

pytestmark = pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")

TIMES = [0.2, 1.0]


def euclidean(n, length, d=2, mask=None):
    grid = hj.Grid.from_bounds(-length, length, (n,) * d, mask=mask)
    return hj.TensorField(grid, np.broadcast_to(np.eye(d), (*grid.shape, d, d)))


def square(x):
    return x @ x


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3])
def test_harmonic_oscillator(d):
    """−Δ + |x|² has the eigenvalues d + 2n, with the multiplicities of the monomials of degree n."""
    sizes, levels, errors = {2: (19, 37), 3: (9, 13)}[d], 3 if d == 2 else 2, []
    counts = [comb(level + d, d) for level in range(levels)]
    exact = np.repeat(d + 2.0 * np.arange(levels), np.diff([0, *counts]))
    for n in sizes:
        pencil = hj.assemble(euclidean(n, 5.0, d), "dirichlet", potential=square)
        pairs = hj.eigenpairs(pencil, counts[-1], throw=True)
        assert not pairs.unconfirmed
        errors.append(np.abs(pairs.eigenvalues - exact).max())
    assert [hj.count_eigenvalues(pencil, d + 2 * level + 1) for level in range(levels)] == counts
    order = np.log(errors[0] / errors[1]) / np.log((sizes[1] - 1) / (sizes[0] - 1))
    assert 1.7 < order < 2.4


@pytest.mark.slow
def test_finite_well_has_its_bound_states_below_zero():
    """V = −8 for |x₁| < 1, on elements; with y periodic the states are those of the line, plus (2πm/L)²."""
    n, periodic, depth = 65, 16, 8.0
    grid = hj.Grid((n, periodic), (8 / (n - 1), 3.0 / periodic), (-4.0, 0.0))
    field = hj.TensorField(grid, np.broadcast_to(np.eye(2), (n, periodic, 2, 2)))
    middles = np.abs(grid.axes[0][1:] + grid.axes[0][:-1]) / 2
    well = np.broadcast_to(np.where(middles < 1, -depth, 0.0)[:, None], (n - 1, periodic))

    def even(k):
        return k * np.tan(k) - np.sqrt(depth - k**2)

    def odd(k):
        return -k / np.tan(k) - np.sqrt(depth - k**2)

    exact = [brentq(even, 0.1, 1.5) ** 2 - depth, brentq(odd, 1.6, 2.8) ** 2 - depth]
    exact = np.sort([energy + wave for energy in exact for wave in (0, *[(2 * np.pi / 3) ** 2] * 2)])
    exact = exact[exact < 0]
    pencil = hj.assemble(field, ("dirichlet", "periodic"), potential=well)
    bound = int(hj.count_eigenvalues(pencil, 0.0))
    assert bound == exact.size
    pairs = hj.eigenpairs(pencil, bound)
    np.testing.assert_allclose(pairs.eigenvalues, exact, atol=0.15)
    assert pairs.eigenvalues[0] == pytest.approx(exact[0], rel=0.01)
    at_zero = hj.hks(pairs, [1.0])[0, :, 0]
    assert np.argmax(at_zero) == n // 2
    assert at_zero[n // 2] > np.exp(6) / 12


@pytest.mark.slow
def test_gaussian_weight_has_hermite_polynomials_for_eigenfunctions():
    """−ρ⁻¹ div(ρ∇·), ρ = exp(−|x|²): 2n; as an argument and as a form."""
    field = euclidean(25, 4.0)

    def gauss(x):
        return jnp.exp(-x @ x)

    def stiffness(u, v, w):
        return w["weight"] * (u.grad @ w.inverse @ v.grad)

    def mass(u, v, w):
        return w["weight"] * u.value * v.value

    pencil = hj.assemble(field, density=gauss)
    own = hj.assemble_forms(field, stiffness, mass, fields={"weight": gauss})
    for name in ("stiffness", "mass"):
        np.testing.assert_allclose(getattr(own, name).coefficients, getattr(pencil, name).coefficients, atol=1e-15)
    assert pencil.volume == pytest.approx(64)
    exact = np.repeat(2.0 * np.arange(4), np.arange(1, 5))
    pairs = hj.eigenpairs(pencil, 10, solver="shift-invert")
    assert pairs.eigenvalues[0] == 0
    np.testing.assert_allclose(pairs.eigenvalues, exact, atol=0.3)
    np.testing.assert_allclose(hj.eigenpairs(own, 10).eigenvalues, pairs.eigenvalues, atol=1e-7)
    nodal = hj.assemble(field, density=np.exp(-np.square(field.grid.nodes).sum(-1)))
    np.testing.assert_allclose(hj.eigenpairs(nodal, 6).eigenvalues, exact[:6], atol=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("mass", ["consistent", "lumped"])
@pytest.mark.parametrize("solver", ["shift-invert", "chebyshev-filter"])
def test_solvers_for_positive_matrices_count_from_the_potential_s_minimum(rng, solver, mass):
    """Also where it is far below the spectrum, and where all of it is far above zero; with derivatives."""
    n, spike = (25, 0) if solver == "chebyshev-filter" else (15, -3e4)
    field, noise = euclidean(n, 3.0), rng.normal(size=(n, n))
    for offset in (-40, 1e4):
        V = np.square(field.grid.nodes).sum(-1) + offset
        V[n // 2, n // 2] += spike * (offset < 0)
        pencil = hj.assemble(field, "dirichlet", mass, potential=V)
        pairs, exact = (hj.eigenpairs(pencil, 6, solver=each, throw=True) for each in (solver, "dense"))
        np.testing.assert_allclose(pairs.eigenvalues, exact.eigenvalues, rtol=1e-8)

    def trace(s, solver):
        pencil = hj.assemble(field, "dirichlet", mass, potential=V - 1e4 + s * noise)
        return hj.heat_trace(hj.eigenpairs(pencil, 6, solver=solver), [0.5])[0]

    slopes = [jax.grad(trace)(0.0, each) for each in (solver, "dense")]
    assert slopes[0] == pytest.approx(float(slopes[1]), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["neumann", "mirror"])
@pytest.mark.parametrize("potential", [None, lambda x: 3 * x[0] - 2])
def test_densities_and_potentials_with_other_solvers_and_without_a_spectrum(potential, boundary):
    density = {"density": lambda x: 1.5 + jnp.sin(x[0])}
    pencil = hj.assemble(euclidean(25, 2.0), boundary, potential=potential, **density)
    some, expected = (hj.eigenpairs(pencil, 10, solver=each).eigenvalues for each in ("chebyshev-filter", "dense"))
    np.testing.assert_allclose(some, expected, rtol=1e-6, atol=1e-12)
    pencil = hj.assemble(euclidean(13, 2.0), boundary, potential=potential, **density)
    everything = hj.eigenpairs(pencil, sum(part.size for part in pencil.parts))
    for method in ("colouring", "selected-inversion"):
        found = hj.hks_spectrum_free(pencil, [0.1, 0.3], method=method)
        np.testing.assert_allclose(found, hj.hks(everything, [0.1, 0.3]), rtol=1e-3)


@pytest.mark.slow
def test_derivatives_of_signatures_by_potential_and_density(rng):
    """Forward and reverse, under jit and vmap, against differences; V in the nodes, ρ on the elements."""
    field = hj.TensorField(hj.Grid((7, 8)), random_spd(rng, (7, 8), 0.5))
    V, rho = jnp.asarray(rng.normal(size=(7, 8))), jnp.asarray(rng.uniform(0.5, 2, (6, 7)))
    dV, drho = jnp.asarray(rng.normal(size=V.shape)), jnp.asarray(rng.normal(size=rho.shape))

    def signature(s, tensors=field.tensors):
        pencil = hj.assemble(hj.TensorField(field.grid, tensors), potential=V + s * dV, density=rho + 0.1 * s * drho)
        return hj.hks(hj.eigenpairs(pencil, 12), TIMES)[:, 3, 4]

    slope = directional(signature, jnp.zeros(()), jnp.ones(()), 1e-2)
    np.testing.assert_allclose(jax.jvp(jax.jit(signature), (0.0,), (1.0,))[1], slope, rtol=1e-6)
    mapped = jax.vmap(jax.jacrev(signature))(jnp.zeros(2))
    np.testing.assert_allclose(mapped, [slope] * 2, rtol=1e-6)
    turn = jnp.asarray(random_spd(rng, (7, 8)) - random_spd(rng, (7, 8)))
    by_tensors = jax.jacrev(lambda T: signature(0.0, T))(field.tensors)
    slope = directional(lambda s: signature(0.0, field.tensors + s * turn), jnp.zeros(()), jnp.ones(()), 1e-3)
    np.testing.assert_allclose(jnp.einsum("t...ij,...ij->t", by_tensors, turn), slope, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("sign", [-1, 1])
def test_doubled_domain_with_a_potential(rng, sign):
    """The four problems of "mirror", each with an origin of its own, make up the torus with the potential reflected."""
    n = 9
    field = flat((n, n), (1.0, 1.0))
    V = sign * 300 * rng.random((n, n))
    torus = flat((2 * n - 2,) * 2, (2.0, 2.0), (True, True))
    index = np.r_[0:n, n - 2 : 0 : -1]
    expected = hj.eigenpairs(hj.assemble(torus, "periodic", potential=V[np.ix_(index, index)]), 20)
    pairs = hj.eigenpairs(hj.assemble(field, "mirror", potential=V), 20)
    np.testing.assert_allclose(pairs.eigenvalues, expected.eigenvalues, rtol=1e-9)
    assert not pairs.unconfirmed
    np.testing.assert_allclose(hj.hks(pairs, [0.01]), hj.hks(expected, [0.01])[:, :n, :n], rtol=1e-8)
    mean = hj.assemble(field, "mean", potential=V)
    parts = [hj.eigenpairs(part, 10).eigenvalues for part in mean.parts]
    np.testing.assert_allclose(hj.eigenpairs(mean, 10).eigenvalues, np.sort(np.concatenate(parts))[:10], rtol=1e-9)
    slope = jax.grad(lambda V: hj.heat_trace(hj.eigenpairs(hj.assemble(field, "mirror", potential=V), 8), [0.01])[0])(V)
    assert np.isfinite(slope).all()


@pytest.mark.slow
def test_masks_hide_what_lies_outside(rng):
    mask = np.ones((9, 9), bool)
    mask[:4, :5] = False
    field = hj.TensorField(hj.Grid((9, 9), mask=mask), random_spd(rng, (9, 9)))
    V = rng.normal(size=(9, 9))

    def energy(V):
        pencil = hj.assemble(field, "dirichlet-rim", potential=V, density=lambda x: 1 / (x[0] + x[1] - 3.5))
        return jnp.sum(hj.eigenpairs(pencil, 4).eigenvalues)

    hidden = np.where(mask, V, np.nan)
    assert energy(hidden) == energy(V)
    gradient = jax.grad(energy)(hidden)
    assert np.isfinite(gradient).all()
    assert (gradient[~mask] == 0).all()


@pytest.mark.parametrize("solid", [False, True])
def test_fields_on_meshes_agree_with_scikit_fem(rng, solid):
    if solid:
        vertices, cells = box((3, 4, 3), (1.0, 2.0, 0.7))
        theirs, element, constant = skfem.MeshTet(vertices.T, cells.T, sort_t=False), skfem.ElementTetP1(), "TetP0"
        mesh = hj.TetMesh(vertices, cells)
    else:
        theirs, element, constant = skfem.MeshTri().refined(2), skfem.ElementTriP1(), "TriP0"
        vertices, cells = theirs.p.T, theirs.t.T
        mesh = hj.SurfaceMesh(np.pad(vertices, [(0, 0), (0, 1)]), cells)
    nodal, of_cells = rng.normal(size=len(vertices)), rng.uniform(1, 2, len(cells))
    basis = skfem.Basis(theirs, element, intorder=2)
    held = {
        "V": basis.interpolate(nodal),
        "rho": basis.with_element(getattr(skfem, f"Element{constant}")()).interpolate(of_cells),
    }
    stiffness = skfem.BilinearForm(lambda u, v, w: w["rho"] * (dot(grad(u), grad(v)) + w["V"] * u * v))
    mass = skfem.BilinearForm(lambda u, v, w: w["rho"] * u * v)
    pencil = hj.assemble(mesh, potential=nodal, density=of_cells)
    # Theirs and ours are different rules of degree two, and V u v is of degree three.
    assert abs(pencil.mass.to_scipy() - mass.assemble(basis, **held)).max() < 1e-14
    weighted = hj.assemble(mesh, density=of_cells)
    plain = stiffness.assemble(basis, **{**held, "V": 0 * held["V"]})
    assert abs(weighted.stiffness.to_scipy() - plain).max() < 1e-13
    constant = hj.assemble(mesh, potential=-2.5, density=of_cells).stiffness.to_scipy()
    assert abs(constant - plain + 2.5 * weighted.mass.to_scipy()).max() < 1e-13
    moments = np.ones(len(vertices)) @ pencil.stiffness.to_scipy() @ np.ones(len(vertices))
    assert moments == pytest.approx(np.sum(stiffness.assemble(basis, **held).toarray()))


def elasticity(u, v, w):
    strain, other = (u.grad + u.grad.T) / 2, (v.grad + v.grad.T) / 2
    return 2 * w["mu"] * jnp.sum(strain * other) + w["lam"] * jnp.trace(u.grad) * jnp.trace(v.grad)


@pytest.mark.slow
@pytest.mark.parametrize("domain", ["grid", "tetrahedra"])
def test_elasticity_agrees_with_scikit_fem_and_has_rigid_modes(rng, domain):
    fields = {"mu": 1.3, "lam": 0.7}
    if domain == "grid":
        ours = flat((4, 5), (1.0, 1.2))
        theirs, element = skfem.MeshQuad.init_tensor(*ours.grid.axes), skfem.ElementQuad1()
        steps = np.array(ours.grid.spacing)[:, None]
        order, modes = np.ravel_multi_index(np.rint(theirs.p / steps).astype(int), (4, 5)), 3
    else:
        vertices, cells = box((3, 3, 3), (1.0, 2.0, 0.7))
        ours, theirs = hj.TetMesh(vertices, cells), skfem.MeshTet(vertices.T, cells.T, sort_t=False)
        element, order, modes = skfem.ElementTetP1(), np.arange(len(vertices)), 6
    c = theirs.dim()
    basis = skfem.Basis(theirs, skfem.ElementVector(element), intorder=3)
    expected = linear_elasticity(Lambda=0.7, Mu=1.3).assemble(basis).toarray()
    place = np.empty(expected.shape[0], int)
    for component in range(c):
        place[basis.nodal_dofs[component]] = order * c + component
    held = np.zeros_like(expected)
    held[np.ix_(place, place)] = expected
    pencil = hj.assemble_forms(ours, elasticity, fields=fields, components=c)
    assert np.abs(pencil.stiffness.to_dense() - held).max() < 1e-13
    pairs = hj.eigenpairs(pencil, modes + 3, throw=True)
    np.testing.assert_array_equal(pairs.eigenvalues[:modes], 0)
    assert pairs.eigenvalues[modes] > 0.1
    assert pairs.complete_below > pairs.eigenvalues[-1] - 1e-6
    nodes = ours.grid.shape if domain == "grid" else (len(ours.vertices),)
    assert pairs.eigenfunctions.shape == (modes + 3, *nodes, c)

    def stiff(mu):
        moved = hj.assemble_forms(ours, elasticity, fields={**fields, "mu": mu}, components=c)
        return jnp.sum(jnp.exp(-hj.eigenpairs(moved, modes + 2).eigenvalues))

    mu = 1.3 + 0.2 * rng.random(nodes)
    direction = rng.normal(size=nodes)
    slope = directional(lambda s: stiff(mu + s * direction), 0.0, 1.0, 1e-3)
    assert jnp.vdot(jax.jit(jax.grad(stiff))(jnp.asarray(mu)), direction) == pytest.approx(float(slope), rel=1e-5)


@pytest.mark.slow
def test_components_know_masks_and_boundaries(rng):
    """Functions whose components do not mix have every scalar eigenvalue once for each."""
    mask = np.ones((8, 7), bool)
    mask[:3, :3] = False
    field = hj.TensorField(hj.Grid((8, 7), mask=mask), random_spd(rng, (8, 7)))

    def apart(u, v, w):
        return jnp.sum((u.grad @ w.inverse) * v.grad)

    for boundary, mass in (("dirichlet-rim", "consistent"), (("periodic", "neumann"), "lumped")):
        scalar = hj.eigenpairs(field, 4, boundary, mass=mass).eigenvalues
        pairs = hj.eigenpairs(hj.assemble_forms(field, apart, mass, boundary, components=2), 8)
        np.testing.assert_allclose(pairs.eigenvalues, np.repeat(scalar, 2), atol=1e-9)
        assert pairs.eigenfunctions.shape == (8, 8, 7, 2)
        assert np.isnan(pairs.eigenfunctions[:, 0, 0]).all()


@pytest.mark.slow
def test_forms_on_a_surface_see_space(rng):
    """The gradient is tangential, and the metric that of the mesh, whatever the order of a triangle's vertices."""
    torus = hj.examples.bumpy_torus_mesh(8)
    tensors = random_spd(rng, (len(torus.faces), 1, 1))[:, 0, 0]
    mesh = hj.SurfaceMesh.from_tensors(torus.vertices, torus.faces, tensors, "tensor", at="faces")
    turned = hj.SurfaceMesh.from_tensors(torus.vertices, np.roll(torus.faces, 1, 1), tensors, "tensor", at="faces")

    def anisotropic(u, v, w):
        return u.value * v.value + 0.1 * w.x[2] ** 2 * (w["along"] @ u.grad) * (w["along"] @ v.grad)

    fields = {"along": rng.normal(size=(len(mesh.vertices), 3))}
    built_in = hj.assemble(mesh)
    own = hj.assemble_forms(mesh, lambda u, v, w: u.grad @ w.inverse @ v.grad, anisotropic, fields=fields)
    assert abs(own.stiffness.to_scipy() - built_in.stiffness.to_scipy()).max() < 1e-12
    other = hj.assemble_forms(turned, mass=anisotropic, fields=fields)
    assert abs(own.mass.to_scipy() - other.mass.to_scipy()).max() < 1e-12
    pairs = hj.eigenpairs(own, 5)
    assert pairs.eigenvalues[0] == 0
    assert (pairs.eigenvalues[1:] < hj.eigenpairs(built_in, 5).eigenvalues[1:]).all()
    with unchecked(), pytest.raises(ValueError, match="mass: got a matrix with 64 negative"):
        hj.eigenpairs(hj.assemble_forms(mesh, mass=lambda u, v, w: -u.value * v.value), 3)


@pytest.mark.slow
def test_what_is_true_of_the_laplacian_alone_is_left_out():
    pencil = hj.assemble(euclidean(17, 4.0), potential=square)
    pairs = hj.eigenpairs(pencil, 10)
    with pytest.raises(ValueError, match="problem: got an operator with a potential"):
        hj.weyl_count(pencil, [3.0])
    estimate = hj.truncation(pairs, [0.3])
    assert np.isnan(estimate.resolution_bias[0])
    everything = hj.heat_trace(hj.eigenpairs(pencil, 17**2), [0.3])[0]
    assert estimate.tail[0] == pytest.approx(float(1 - hj.heat_trace(pairs, [0.3])[0] / everything), rel=0.3)
    own = hj.assemble_forms(euclidean(5, 4.0), lambda u, v, w: u.value * v.value)
    with pytest.raises(ValueError, match="solver: got 'chebyshev-filter', which needs a positive semidefinite"):
        hj.eigenpairs(own, 3, solver="chebyshev-filter")
    with pytest.raises(ValueError, match="its null space is unknown"):
        hj.hks_spectrum_free(own, [0.1])
    without = hj.hks_spectrum_free(pencil, [0.1, 0.3], method="selected-inversion")
    np.testing.assert_allclose(without, hj.hks(hj.eigenpairs(pencil, 17**2), [0.1, 0.3]), rtol=1e-8)


FLAT = flat((6, 6), (5.0, 5.0))


def first_order(u, v, w):
    return u.value * v.grad[0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"potential": np.zeros((3, 4))}, r"potential: got shape \(3, 4\); expected \(6, 6\), one per node, \(5, 5\)"),
        ({"potential": np.zeros((6, 6, 2))}, "potential: got shape .* expected one number at each place"),
        ({"potential": 1j}, "potential: got complex numbers"),
        (
            {"potential": np.full((6, 6), np.nan)},
            r"potential: 36 of 36 values are NaN or infinite \(the first is nan at node \(0, 0\)",
        ),
        ({"density": -1.0}, "density: 1 of 1 values are not positive"),
        (
            {"density": np.eye(6)},
            r"density: 30 of 36 values are not positive \(the first is 0 at node \(0, 1\)\)\. Raise them",
        ),
        ({"density": lambda x: x[0] - 2}, r"density: 40 of 100 values are not positive \(the first is -1.78868 at x ="),
        (
            {"stiffness": first_order},
            r"stiffness: not symmetric: entry \(1, 7\) is 0.333333, and entry \(7, 1\) differs",
        ),
        ({"stiffness": lambda u, v, w: u.grad}, r"<lambda>: the form returns float64 of shape \(2,\); expected one"),
        ({"stiffness": lambda u, v, w: u.value**2 * v.value}, "not linear in u"),
        ({"stiffness": lambda u, v, w: v.value * v.value}, "<lambda>: got a form that does not depend on u"),
        ({"stiffness": lambda u, v, w: w["young"]}, "a form reads 'young'; the fields are none"),
        ({"stiffness": "laplace"}, "stiffness: got str; expected a form"),
        ({"mass": "full"}, 'mass: got \'full\'; expected "consistent" or "lumped"$'),
        ({"mass": first_order}, "mass: got .*first_order.*; expected .*`assemble_forms` takes a form of your own"),
        ({"stiffness": elasticity, "mass": "full"}, 'mass: got \'full\'; expected "consistent", "lumped" or a form'),
        ({"fields": {}, "components": 2}, "stiffness: got none with components > 1"),
        ({"stiffness": elasticity, "components": 2, "boundary": "mirror"}, 'got "mirror" with components'),
        ({"degree": 2}, "degree, midpoints: got degree 2 and no midpoints for a grid"),
    ],
)
def test_bad_operators_are_refused(settings, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        (hj.assemble_forms if settings.keys() & {"stiffness", "fields"} else hj.assemble)(FLAT, **settings)


def test_what_cannot_be_looked_at_becomes_nan():
    field = flat((5, 5), (1.0, 1.0))
    unsymmetric = jax.jit(lambda s: hj.assemble_forms(field, first_order, fields={"s": s}).stiffness.coefficients)
    assert np.isnan(unsymmetric(1.0)).any()
    with pytest.raises(
        ValueError, match="stiffness: the form closes over traced arrays or numbers; pass all of them as fields="
    ):
        jax.grad(lambda c: hj.assemble_forms(field, lambda u, v, w: c * u.value * v.value).stiffness.flat()[0])(1.0)
    negative = jax.jit(lambda rho: hj.eigenpairs(hj.assemble(field, density=rho), 3).result)
    assert negative(-1.0) == hj.RESULTS.not_finite
