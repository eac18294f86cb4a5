"""P2 elements, straight and curved: scikit-fem's matrices, orders of convergence, derivatives, refusals."""

from math import factorial, prod

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skfem
from annotations import unchecked
from scipy.spatial import cKDTree
from scipy.special import jn_zeros
from skfem.models.poisson import laplace, mass
from solids import box

import hks_jax as hj
from hks_jax.fem.elements import _quadratic_rule

pytestmark = pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")


def on_sphere(x):
    return x / jnp.linalg.norm(x)


def middles(mesh):
    return np.asarray(mesh.vertices)[mesh.triangulation.edges].mean(axis=1)


def disc(refinements):
    plane = skfem.MeshTri.init_circle(refinements)
    return hj.SurfaceMesh(np.pad(plane.p.T, [(0, 0), (0, 1)]), plane.t.T)


def rounded(mesh):
    """The middles of edges, those of the rim on the unit circle."""
    places, rim = middles(mesh), mesh.triangulation.boundary_edges
    return np.where(rim[:, None], places / np.linalg.norm(places, axis=1, keepdims=True), places)


@pytest.mark.parametrize("d", [2, 3])
def test_the_rule_is_exact_for_degree_five(d):
    """∫ Πxᵢ^nᵢ over the unit simplex is Πnᵢ!/(d + Σnᵢ)!."""
    points, weights = _quadratic_rule(d)
    assert (weights > 0).all()
    for powers in np.ndindex(*(6,) * d):
        if sum(powers) <= 5:
            exact = prod(map(factorial, powers)) / factorial(d + sum(powers))
            assert weights @ np.prod(points[:, 1:] ** np.array(powers), axis=1) == pytest.approx(exact, rel=1e-13)


@pytest.mark.parametrize("boundary", ["neumann", "dirichlet"])
@pytest.mark.parametrize("solid", [False, True])
def test_agrees_with_scikit_fem(rng, solid, boundary):
    if solid:
        vertices, cells = box((3, 3, 3), (1.0, 2.0, 0.7))
        vertices = vertices + 0.04 * rng.standard_normal(vertices.shape)
        ours, theirs = hj.TetMesh(vertices, cells), skfem.MeshTet(vertices.T, cells.T, sort_t=False)
        basis = skfem.Basis(theirs, skfem.ElementTetP2())
    else:
        theirs = skfem.MeshTri().refined(2)
        ours = hj.SurfaceMesh(np.pad(theirs.p.T, [(0, 0), (0, 1)]), theirs.t.T)
        basis = skfem.Basis(theirs, skfem.ElementTriP2())
    nodes = np.concatenate([ours.vertices, middles(ours)])
    distance, place = cKDTree(basis.doflocs.T).query(nodes[:, : theirs.dim()])
    assert distance.max() < 1e-12
    pencil = hj.assemble(ours, boundary, degree=2)
    kept = place[pencil.space.free]
    if boundary == "dirichlet":
        assert sorted(place[~pencil.space.free]) == sorted(basis.get_dofs().all())
    for matrix, form in ((pencil.stiffness, laplace), (pencil.mass, mass)):
        expected = form.assemble(basis)[kept][:, kept]
        assert abs(matrix.to_scipy() - expected).max() < 1e-12 * abs(expected).max()


def orders(errors):
    return np.log2(errors[0] / errors[1])


@pytest.mark.slow
def test_sphere_and_its_order():
    """l(l + 1): fourth order with curved sides, second with straight ones; nodes in the middles of edges are nodes."""
    curved, straight = [], []
    for frequency in (2, 4):
        mesh = hj.examples.sphere_mesh(frequency)
        exact = np.repeat([2.0, 6.0], [3, 5])
        pairs = hj.eigenpairs(hj.assemble(mesh, degree=2, midpoints=on_sphere), 9)
        curved.append(np.abs(pairs.eigenvalues[1:] - exact).max())
        straight.append(np.abs(hj.eigenpairs(hj.assemble(mesh, degree=2), 9).eigenvalues[1:] - exact).max())
    assert orders(curved) > 3.5
    assert 1.8 < orders(straight) < 2.5
    assert curved[1] < 2e-3
    assert pairs.eigenvalues[0] == 0
    signature = hj.hks(pairs, [0.5])[0]
    assert signature.shape == (len(mesh.vertices) + len(mesh.triangulation.edges),)
    series = sum((2 * order + 1) * np.exp(-order * (order + 1) * 0.5) for order in range(3)) / (4 * np.pi)
    np.testing.assert_allclose(signature, series, rtol=5e-3)


@pytest.mark.slow
def test_disc_and_its_order():
    exact = np.sort([jn_zeros(0, 1)[0], *[jn_zeros(1, 1)[0]] * 2, *[jn_zeros(2, 1)[0]] * 2]) ** 2
    errors = {True: [], False: []}
    for refinements in (2, 3):
        mesh = disc(refinements)
        for curved in (True, False):
            pencil = hj.assemble(mesh, "dirichlet", degree=2, midpoints=rounded(mesh) if curved else None)
            errors[curved].append(np.abs(hj.eigenpairs(pencil, 5).eigenvalues / exact - 1).max())
    assert orders(errors[True]) > 3.4
    assert 1.8 < orders(errors[False]) < 2.5


@pytest.mark.slow
def test_ball_and_its_order():
    """π² under Dirichlet conditions: a function moves the middles of edges on the boundary alone."""
    errors = []
    for n in (2, 4):
        pencil = hj.assemble(hj.examples.ball_mesh(n), "dirichlet", degree=2, midpoints=on_sphere)
        errors.append(abs(float(hj.eigenpairs(pencil, 1).eigenvalues[0]) / np.pi**2 - 1))
    assert orders(errors) > 3.2


@pytest.mark.slow
def test_derivative_by_the_places_of_nodes():
    """λ falls by the square of the length: x·∂λ/∂x = −2λ over vertices and middles (Euler)."""
    mesh = disc(1)
    places = jnp.asarray(rounded(mesh))

    def lowest(vertices, places):
        moved = hj.SurfaceMesh(vertices, mesh.faces)
        return hj.eigenpairs(hj.assemble(moved, "dirichlet", degree=2, midpoints=places), 1).eigenvalues[0]

    value, slopes = jax.jit(jax.value_and_grad(lowest, (0, 1)))(mesh.vertices, places)
    total = jnp.vdot(slopes[0], mesh.vertices) + jnp.vdot(slopes[1], places)
    assert total == pytest.approx(-2 * float(value))


def test_fields_and_forms_of_degree_two(rng):
    """Values at the vertices are linear between them; a form of one's own has the same matrices."""
    mesh = hj.examples.sphere_mesh(2)
    V = rng.normal(size=len(mesh.vertices))
    filled = np.concatenate([V, V[mesh.triangulation.edges].mean(axis=1)])

    def own(u, v, w):
        return u.grad @ w.inverse @ v.grad + w["V"] * u.value * v.value

    settings = {"degree": 2, "midpoints": on_sphere}
    pencil = hj.assemble(mesh, potential=V, **settings)
    for other in (
        hj.assemble(mesh, potential=filled, **settings),
        hj.assemble_forms(mesh, own, fields={"V": V}, **settings),
    ):
        assert abs(other.stiffness.to_scipy() - pencil.stiffness.to_scipy()).max() < 1e-13


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"degree": 3}, "degree: got 3; expected 1 or 2"),
        ({"midpoints": on_sphere}, "midpoints: got positions with degree=1"),
        ({"degree": 2, "mass": "lumped"}, "row sums at the vertices are not positive"),
        ({"degree": 2, "midpoints": np.zeros((3, 3))}, r"midpoints: got shape \(3, 3\); expected \(120, 3\)"),
    ],
)
def test_what_does_not_fit_is_refused(settings, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        hj.assemble(hj.examples.sphere_mesh(2), **settings)


def test_cells_turned_inside_out_are_refused():
    mesh = hj.examples.ball_mesh(1)
    places = middles(mesh)
    places[0] += [3.0, 0.0, 0.0]
    with pytest.raises(ValueError, match="midpoints: got positions that fold or invert cells"):
        hj.assemble(mesh, degree=2, midpoints=places)
