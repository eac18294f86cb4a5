"""Exact derivatives of signatures and eigenpairs against differences, and against paths without an eigensolver."""

import warnings
from functools import partial
from itertools import islice
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from annotations import unchecked
from differences import directional, heat_kernel_by_contour
from fields import random_spd

import hks_jax as hj
from hks_jax.eigen.adjoints.complement import attainable
from hks_jax.eigen.adjoints.factorised_adjoint import FactorisedAdjoint
from hks_jax.eigen.quality import indistinct
from hks_jax.linear.dissection import dissect

SHAPE = (10, 10)
GRID = hj.Grid(SHAPE, 0.1)
TIMES = jnp.array([0.003, 0.03, 0.3])  # under-resolved by the grid and by k; resolved; large
SOLVERS = ["dense", "shift-invert"]

pytestmark = pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")


def symmetric(rng, shape):
    a = rng.standard_normal((*shape, len(shape), len(shape)))
    return jnp.asarray(a + np.swapaxes(a, -1, -2)) / 2


def identity(shape):
    return jnp.broadcast_to(jnp.eye(len(shape)), (*shape, len(shape), len(shape)))


def rotationally_symmetric():
    squared = np.sum((GRID.nodes - 0.45) ** 2, axis=-1)
    return jnp.asarray((1 + 2 * np.exp(-10 * squared))[..., None, None] * np.eye(2))


FIELDS = {
    "generic": lambda rng: jnp.asarray(random_spd(rng, SHAPE)),
    "identity": lambda rng: identity(SHAPE),
    "noise 1e-6": lambda rng: identity(SHAPE) + 1e-6 * symmetric(rng, SHAPE),
    "noise 1e-9": lambda rng: identity(SHAPE) + 1e-9 * symmetric(rng, SHAPE),
    "noise 1e-12": lambda rng: identity(SHAPE) + 1e-12 * symmetric(rng, SHAPE),
    "rotational": lambda rng: rotationally_symmetric(),
}


def check(f, x, direction, rtol=1e-7, adjoint=1e-12, step=4e-3):
    """Forward and reverse mode of f (any output, NaN where it likes) along one direction, against differences."""
    # On the host, but for f: of every operation on a new shape a program would be compiled.
    value, slope = map(np.asarray, jax.jvp(f, (x,), (direction,)))
    probe = np.random.default_rng(1).standard_normal(value.shape)
    x, direction = np.asarray(x), np.asarray(direction)
    forward = np.nansum(probe * slope)
    _, pullback = jax.vjp(f, x)
    reverse = np.vdot(pullback(np.where(np.isnan(value), 0, probe))[0], direction)
    assert forward == pytest.approx(reverse, abs=adjoint * np.nansum(np.abs(probe * slope)))
    assert reverse == pytest.approx(directional(lambda x: np.nansum(probe * f(x)), x, direction, step), rel=rtol)


def hks_of(tensors, k=20, solver="dense", boundary="neumann", mass="consistent", grid=GRID, times=TIMES):
    pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k, boundary, solver, mass)
    return jnp.sqrt(times).reshape(-1, *[1] * len(grid.shape)) * hj.hks(pairs, times)


# 60 cuts a multiple eigenvalue of the square.
TRUNCATIONS = [("generic", 60), ("identity", 58)]


QUICK = [("rotational", 20, "dense"), ("generic", 60, "shift-invert")]
CASES = [(*case, solver) for case in [(name, 20) for name in FIELDS] + TRUNCATIONS for solver in SOLVERS]


@pytest.mark.parametrize(
    ("name", "k", "solver"),
    [case if case in QUICK else pytest.param(*case, marks=pytest.mark.slow) for case in CASES],
)
def test_hks_against_differences(rng, name, k, solver):
    tensors = FIELDS[name](rng)
    assert hj.eigenpairs(hj.TensorField(GRID, tensors), k, solver="dense").cut_multiplet == 0
    check(partial(hks_of, k=k, solver=solver), tensors, 0.1 * symmetric(rng, SHAPE))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["identity", "generic", "noise 1e-9"])
def test_truncated_hks_against_contour_integrals(rng, name):
    """The gradient at every node, from linear solves differentiated by JAX itself: no eigensolver anywhere."""
    tensors, k, times = FIELDS[name](rng), 20, TIMES[1:]
    pairs = hj.eigenpairs(hj.TensorField(GRID, tensors), k)
    ends = float(pairs.eigenvalues[-1]), float(pairs.next_eigenvalue)
    probe = jnp.asarray(rng.standard_normal((2, *SHAPE)))

    def reference(tensors):
        pencil = hj.assemble(hj.TensorField(GRID, tensors))
        kernel = heat_kernel_by_contour(pencil.stiffness.to_dense(), pencil.mass.to_dense(), times, *ends)
        return jnp.sum(probe * jnp.diagonal(kernel, axis1=1, axis2=2).reshape(2, *SHAPE))

    value, expected = jax.value_and_grad(reference)(tensors)
    for solver in SOLVERS:

        def loss(tensors, solver=solver):
            return jnp.sum(probe * hj.hks(hj.eigenpairs(hj.TensorField(GRID, tensors), k, solver=solver), times))

        ours, gradient = jax.value_and_grad(loss)(tensors)
        assert ours == pytest.approx(float(value), rel=1e-9)
        assert jnp.linalg.norm(gradient - expected) < 1e-8 * jnp.linalg.norm(expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["identity", "noise 1e-9"])
def test_full_spectrum_against_the_matrix_exponential(rng, name):
    tensors, shape, times = FIELDS[name](rng)[:6, :6], (6, 6), TIMES
    grid, probe = hj.Grid(shape, 0.1), jnp.asarray(rng.standard_normal((3, 6, 6)))

    def reference(tensors):
        pencil = hj.assemble(hj.TensorField(grid, tensors))
        K, M = pencil.stiffness.to_dense(), pencil.mass.to_dense()
        generator = jnp.linalg.solve(M, K)
        kernels = [jax.scipy.linalg.expm(-t * generator) @ jnp.linalg.inv(M) for t in times]
        return jnp.sum(probe * jnp.stack([jnp.diagonal(kernel).reshape(shape) for kernel in kernels]))

    def loss(tensors):
        return jnp.sum(probe * hj.hks(hj.eigenpairs(hj.TensorField(grid, tensors), 36), times))

    expected, gradient = jax.grad(reference)(tensors), jax.grad(loss)(tensors)
    assert jnp.linalg.norm(gradient - expected) < 1e-9 * jnp.linalg.norm(expected)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("boundary", "mass", "solver"),
    [
        pytest.param("dirichlet", "consistent", "shift-invert", marks=pytest.mark.slow),
        pytest.param("dirichlet", "lumped", "dense", marks=pytest.mark.slow),
        (("periodic", ("neumann", "dirichlet")), "consistent", "dense"),
        pytest.param(("mirror", "neumann"), "lumped", "dense", marks=pytest.mark.slow),
        pytest.param(("mirror", "periodic"), "consistent", "shift-invert", marks=pytest.mark.slow),
    ],
)
def test_every_boundary_and_mask(rng, boundary, mass, solver):
    mask = np.ones((8, 9), dtype=bool)
    mask[:3, 5:] = False
    grid = hj.Grid((8, 9), 0.15, mask=mask)
    f = partial(hks_of, k=14, solver=solver, boundary=boundary, mass=mass, grid=grid)
    check(f, jnp.asarray(random_spd(rng, (8, 9), 0.5)), 0.1 * symmetric(rng, (8, 9)), step=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["neumann", pytest.param("mirror", marks=pytest.mark.slow)])
def test_the_cube(rng, boundary):
    grid, solver = hj.Grid((4, 4, 4), 0.2), "dense" if boundary == "mirror" else "shift-invert"
    pairs = hj.eigenpairs(hj.TensorField(grid, identity(grid.shape)), 25, boundary, "dense", multiplet="complete")
    k = int(pairs.kept.sum())  # a cube's eigenvalues have up to six copies
    f = partial(hks_of, k=k, solver=solver, boundary=boundary, grid=grid)
    check(f, identity(grid.shape), 0.1 * symmetric(rng, grid.shape))


@pytest.mark.parametrize(
    ("solver", "dtype"),
    [
        pytest.param("block-lanczos", jnp.float64, marks=pytest.mark.slow),
        pytest.param("chebyshev-filter", jnp.float32, marks=pytest.mark.slow),
        pytest.param("block-lanczos", jnp.float32, marks=pytest.mark.slow),
        pytest.param("chebyshev-filter", jnp.float64, marks=pytest.mark.slow),
        pytest.param("shift-invert", jnp.float32, marks=pytest.mark.slow),
        pytest.param("shift-invert", jnp.float64, marks=pytest.mark.slow),
    ],
)
def test_along_the_tensors_themselves(solver, dtype):
    """HKS(t; cT) = HKS(t/c; T)/c in the plane, by any solver: projected, the right-hand sides are rounding alone."""
    nodes = jnp.asarray(hj.Grid((24, 24), 1 / 23).nodes)
    tensors = (1 + jnp.sin(3 * nodes[..., 0] + nodes[..., 1]) / 2)[..., None, None] * jnp.eye(2)
    tensors, grid, times = tensors.astype(dtype), hj.Grid((24, 24), 1 / 23), jnp.array([0.05, 0.5], dtype)

    def f(tensors):
        return hks_of(tensors, 10, solver, grid=grid, times=times)

    value, along = jax.jvp(f, (tensors,), (tensors,))
    rate = jax.jvp(lambda t: hks_of(tensors, 10, "dense", grid=grid, times=t), (times,), (times,))[1]
    rounding = float(jnp.finfo(dtype).eps)
    # `hks_of` is √t HKS(t).
    np.testing.assert_allclose(along, -(value + (rate - value / 2)), atol=3e3 * rounding * float(value.max()))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [pytest.param(jnp.float64, marks=pytest.mark.slow), jnp.float32])
def test_gradients_by_symmetric_weights_on_a_torus(dtype):
    """Reverse mode: cotangents of eigenvectors that are multiples of Mφ, which projections turn into rounding."""
    grid, solver = hj.Grid((22, 22), 1 / 22), hj.ChebyshevFilter(block=8)

    def total(tensors, solver):
        return jnp.sum(hks_of(tensors, 5, solver, "periodic", "lumped", grid, jnp.array([0.05], dtype)))

    tensors = identity((22, 22)).astype(dtype)
    expected = jax.grad(total)(tensors, "dense")
    found = jax.grad(total)(tensors, solver)
    assert jnp.linalg.norm(found - expected) < max(1e3 * jnp.finfo(dtype).eps, 1e-9) * jnp.linalg.norm(expected)


def disc_with_a_dent():
    """A disc whose metric is 5000 times smaller near a point."""
    grid = hj.Grid((40, 40), 2 / 39, (-1, -1))
    x, y = np.moveaxis(grid.nodes, -1, 0)
    factor = np.exp(-np.log(5000) * np.exp(-8 * ((x - 0.3) ** 2 + y**2)))
    return hj.Grid(grid.shape, grid.spacing, grid.origin, x**2 + y**2 < 1), factor


def square_with_a_dent(n):
    """A square whose metric is 10⁴ times smaller at 4 × 4 nodes."""
    grid, dent = hj.Grid((n, n), 1 / (n - 1)), (slice(n // 2 - 2, n // 2 + 2),) * 2
    factor = 1 + 0.3 * np.sin(grid.nodes @ [3, 1])
    factor[dent] /= 1e4
    return grid, factor


@pytest.mark.parametrize(
    ("case", "k", "least"),
    [
        (partial(square_with_a_dent, 20), 7, 0.5),
        (partial(square_with_a_dent, 24), 7, 1),
        pytest.param(disc_with_a_dent, 20, 0.1, marks=pytest.mark.slow),
    ],
    ids=["square", "finer square", "disc"],
)
def test_float32_gradients_where_rounding_could_exceed_gaps(rng, case, k, least):
    """The largest eigenvalue, which bounds rounding, is that of the dent; the lowest ones are far more accurate."""
    grid, factor = case()
    tensors, probe = factor[..., None, None] * np.eye(2), np.where(grid.inside, rng.standard_normal(grid.shape), 0)

    def loss(tensors):
        pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k, solver="shift-invert")
        signature = hj.hks(pairs, jnp.array([0.02], tensors.dtype))[0]
        return jnp.sum(jnp.where(grid.inside, probe.astype(tensors.dtype) * signature, 0)), pairs

    (expected, _), (found, pairs) = (
        jax.grad(loss, has_aux=True)(jnp.asarray(tensors, dtype)) for dtype in (jnp.float64, jnp.float32)
    )
    found, expected, bound = map(np.asarray, (found, expected, indistinct(pairs.pencil, pairs.eigenvalues.dtype)))
    assert bound > least * pairs.eigenvalues[-1]  # gaps, or the whole spectrum
    assert np.linalg.norm(found - expected) < 1e-4 * np.linalg.norm(expected)


class TestGradientsByAField:
    """docs/derivatives.md: the gradient by a tensor is symmetric, also where the field is made outside the loss."""

    grid = hj.Grid((6, 5), (0.1, 0.12))
    weights = np.random.default_rng(0).standard_normal((6, 5))
    # Diagonal tensors, of whose elements ∂K/∂T₁₂ and ∂K/∂T₂₁ differ most.
    tensors = np.einsum("...a,ab->...ab", 1 + 0.3 * np.sin(30 * grid.nodes), np.eye(2))

    def of_field(self, field):
        return jnp.sum(self.weights * hj.hks(hj.eigenpairs(field, 5), jnp.array([0.03]))[0])

    def inside(self, tensors):
        return self.of_field(hj.TensorField(self.grid, tensors))

    @pytest.mark.slow
    def test_symmetric_and_equal_to_that_of_a_field_made_inside(self):
        field = hj.TensorField(self.grid, self.tensors)
        expected = jax.grad(self.inside)(jnp.asarray(self.tensors))
        for gradient in (jax.grad, lambda f: jax.jit(jax.grad(f))):
            (found,) = jax.tree.leaves(gradient(self.of_field)(field))
            np.testing.assert_array_equal(found, np.swapaxes(found, -1, -2))
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
        batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), field)
        (both,) = jax.tree.leaves(jax.vmap(jax.grad(self.of_field))(batch))
        np.testing.assert_allclose(both[1], expected, rtol=1e-10, atol=1e-10)

    @pytest.mark.slow
    def test_adding_to_both_components_changes_the_function_by_twice_the_gradient(self):
        field, one = hj.TensorField(self.grid, self.tensors), np.zeros((6, 5, 2, 2))
        (gradient,) = jax.tree.leaves(jax.grad(self.of_field)(field))
        one[3, 2, 0, 1] = one[3, 2, 1, 0] = 1
        slope = directional(self.inside, self.tensors, one)
        assert slope == pytest.approx(2 * float(gradient[3, 2, 0, 1]), rel=1e-7)
        one[3, 2, 1, 0] = 0  # an unsymmetric change acts by its symmetric part
        change = eqx.tree_at(lambda f: f._tensors, field, jnp.asarray(one))
        assert jax.jvp(self.of_field, (field,), (change,))[1] == pytest.approx(float(slope) / 2, rel=1e-7)

    @pytest.mark.slow
    @pytest.mark.parametrize("optimiser", [optax.sgd(1e-2), optax.sgd(1e-3, momentum=0.9)])
    def test_ten_steps(self, optimiser):
        def descend(loss, x):
            state, gradient = optimiser.init(x), jax.jit(jax.grad(loss))
            for _ in range(10):
                change, state = optimiser.update(gradient(x), state)
                x = eqx.apply_updates(x, change)
            return x

        field = descend(self.of_field, hj.TensorField(self.grid, self.tensors))
        tensors = descend(self.inside, jnp.asarray(self.tensors))
        assert np.abs(tensors - self.tensors).max() > 0.05
        np.testing.assert_allclose(field._tensors, tensors, rtol=1e-9, atol=1e-9)
        assert self.of_field(field) == pytest.approx(float(self.inside(tensors)), rel=1e-10)
        dense = hj.assemble(field).stiffness.to_dense()
        np.testing.assert_allclose(dense, dense.T, atol=1e-14)

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", [hj.SurfaceMesh, pytest.param(hj.TetMesh, marks=pytest.mark.slow)])
    def test_by_the_metric_of_a_mesh(self, kind):
        vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.2]], float)
        cells = [[0, 1, 2, 3], [4, 2, 1, 3]] if kind is hj.TetMesh else [[0, 1, 2], [2, 1, 4], [0, 3, 1]]
        metric = kind(vertices, cells).metric * (1 + jnp.arange(float(len(cells))))[:, None, None]

        def of_mesh(mesh):
            return jnp.sum(jnp.arange(5.0) * hj.hks(hj.eigenpairs(mesh, 5), jnp.array([0.3]))[0])

        mesh = kind(vertices, cells, metric)
        expected = jax.grad(lambda metric: of_mesh(kind(vertices, cells, metric)))(metric)
        found = jax.grad(of_mesh)(mesh)._metric
        np.testing.assert_array_equal(found, np.swapaxes(found, -1, -2))
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
        # A skew part changes no result.
        skew = jnp.broadcast_to(0.2 * jnp.asarray(np.triu(np.ones(metric.shape[1:]), 1)), metric.shape)
        bent = eqx.tree_at(lambda m: m._metric, mesh, metric + skew - skew.mT)
        for f in (of_mesh, jax.jit(of_mesh)):
            assert f(bent) == pytest.approx(float(of_mesh(mesh)), rel=1e-12)


def octahedron_sphere(levels=2):
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(levels):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        middle = len(vertices) + inverse.reshape(-1, 3)
        a, b, c = faces.T
        ab, bc, ca = middle.T
        faces = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, faces


PRECISE = hj.BlockLanczos(block=4, adjoint=hj.FactorisedAdjoint(1e-12))
SLOW = [pytest.param(*case, marks=pytest.mark.slow) for case in (("dense", 2), (PRECISE, 3))]


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "levels"), [*SLOW, ("shift-invert", 2)])
def test_mesh_by_vertices_and_by_face_metrics(rng, solver, levels):
    """A sphere with the octahedron's symmetry: nearly every eigenvalue is multiple."""
    vertices, faces = octahedron_sphere(levels)
    times = jnp.array([0.1, 1.0])

    def by_vertices(vertices):
        return hj.hks(hj.eigenpairs(hj.SurfaceMesh(vertices, faces), 16, solver=solver), times)

    def by_metric(metric):
        mesh = hj.SurfaceMesh(vertices, faces, metric)
        return hj.hks(hj.eigenpairs(mesh, 16, solver=solver), times)

    direction = jnp.asarray(rng.standard_normal(vertices.shape))
    check(by_vertices, jnp.asarray(vertices), 0.02 * direction)
    metric = hj.SurfaceMesh(vertices, faces).metric
    noise = 0.05 * metric * jnp.asarray(rng.standard_normal((len(faces), 1, 1)))
    check(by_metric, metric, noise)
    np.testing.assert_allclose(by_metric(metric), by_vertices(jnp.asarray(vertices)), rtol=1e-12)


SIGNATURES = {
    "hks by trace": lambda p: hj.hks(p, TIMES, "heat-trace"),
    "hks by volume": lambda p: hj.hks(p, TIMES, "volume"),
    "heat kernel": lambda p: hj.heat_kernel(p, TIMES, [(2, 3), (7, 7)]),
    "heat trace": lambda p: hj.heat_trace(p, TIMES),
    "wks": lambda p: hj.wks(p, [2.5, 3.5], 0.4),
    "wks by default": lambda p: hj.wks(p)[::20],
    "scale-invariant": lambda p: hj.scale_invariant_hks(p, 4, 32),
    "diffusion distance": lambda p: hj.diffusion_distance(p, TIMES, (2, 3)),
    "Varadhan's distance": lambda p: hj.varadhan_distance(p, TIMES, (2, 3)),
    "biharmonic distance": lambda p: hj.biharmonic_distance(p, [(2, 3), (0, 0)]),
    "shape DNA": lambda p: hj.shape_dna(p)[1:3].sum(),
    "default times": lambda p: hj.hks(p, hj.default_times(p, 3)),
    "custom": lambda p: hj.spectral_signature(
        p, lambda a, x: 1 / (a["shift"] + x) ** 2, {"shift": jnp.array([1.0, 9.0])}
    ),
    "custom columns": lambda p: hj.spectral_signature(p, lambda a, x: jnp.tanh(x / a), jnp.array([5.0, 50.0]), (1, 1)),
}


MULTIPLE = ["heat kernel", "heat trace", "wks", "scale-invariant", "diffusion distance", "custom"]


@pytest.mark.parametrize(
    ("name", "at"),
    [pytest.param(name, "generic", marks=pytest.mark.slow) for name in SIGNATURES]
    + [pytest.param(n, "rotational", marks=[] if n == "heat kernel" else pytest.mark.slow) for n in MULTIPLE],
)
def test_every_signature_against_differences(rng, name, at):
    signature = SIGNATURES[name]

    def f(tensors):
        return signature(hj.eigenpairs(hj.TensorField(GRID, tensors), 20, solver="dense"))

    tensors = FIELDS[at](rng)
    assert hj.eigenpairs(hj.TensorField(GRID, tensors), 20, solver="dense").cut_multiplet == 0
    # Default times and energies follow λ₁, which has a kink where it is multiple: there the mean of the one-sided
    # derivatives is meant, and extrapolation gains nothing.
    kink = at == "rotational" and name == "scale-invariant"
    check(f, tensors, 0.1 * symmetric(rng, SHAPE), step=5e-4 if kink else 2e-3, rtol=1e-5 if kink else 1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "hks by volume",
        "hks by trace",
        "wks",
        "diffusion distance",
    ],
)
def test_masked_signatures_in_reverse_mode(rng, name):
    """NaN outside the mask must not leak into the cotangents of what a signature is scaled by."""
    mask = np.ones((8, 9), dtype=bool)
    mask[:3, 5:] = False
    grid = hj.Grid((8, 9), 0.15, mask=mask)

    def f(tensors):
        return SIGNATURES[name](hj.eigenpairs(hj.TensorField(grid, tensors), 14, "dirichlet", "dense", "lumped"))

    check(f, jnp.asarray(random_spd(rng, (8, 9), 0.5)), 0.1 * symmetric(rng, (8, 9)), step=2e-3)


SHARP = {
    "step": (lambda a, x: jax.nn.sigmoid((a - x) / 0.01), 8.0),
    "root": (lambda a, x: jnp.exp(-a * jnp.sqrt(x)), 0.3),
    "constant": (lambda a, x: a, 2.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["root", "step", "constant"])
def test_filters_with_sharp_transitions_or_no_derivative_at_zero(rng, name):
    function, parameter = SHARP[name]

    def f(tensors):
        return hj.spectral_signature(hj.eigenpairs(hj.TensorField(GRID, tensors), 20), function, jnp.array([parameter]))

    check(f, FIELDS["generic"](rng), 0.1 * symmetric(rng, SHAPE), step=1e-3)


def rise(t, x):
    return t * x * jnp.exp(-t * x)


@pytest.mark.parametrize(("k", "t"), [(1, 0.1), (20, 200.0)])
@pytest.mark.parametrize("signature", ["custom", "by time"])
def test_filters_that_vanish_at_zero_have_a_slope_there(signature, k, t):
    """A constant potential c adds c to each eigenvalue and changes no eigenvector, so Σ f(λᵢ)φᵢ² has Σ f'(λᵢ)φᵢ²."""
    flat, times = hj.TensorField(hj.Grid((12, 12), 1 / 11), identity((12, 12))), jnp.array([t])

    def of_potential(c):
        pairs = hj.eigenpairs(hj.assemble(flat, potential=c), k)
        if signature == "custom":
            return hj.spectral_signature(pairs, rise, times)[0], pairs
        return jax.jvp(lambda t: hj.hks(pairs, t)[0], (times,), (-times,))[1], pairs

    _, slope, pairs = jax.jvp(of_potential, (jnp.zeros(()),), (jnp.ones(()),), has_aux=True)
    slopes = jax.vmap(jax.grad(partial(rise, t)))(pairs.eigenvalues)
    np.testing.assert_allclose(slope, np.tensordot(slopes, pairs.eigenfunctions**2, 1), rtol=1e-9)


@pytest.mark.slow
def test_parameters_of_the_filters(rng):
    tensors = FIELDS["rotational"](rng)
    pairs = hj.eigenpairs(hj.TensorField(GRID, tensors), 20)
    check(lambda t: hj.hks(pairs, t), TIMES, 0.1 * TIMES)
    check(lambda e: hj.wks(pairs, e, 0.4), jnp.array([2.5, 3.5]), jnp.array([1.0, -0.5]))
    check(lambda s: hj.wks(pairs, [2.5, 3.5], s), jnp.asarray(0.4), jnp.asarray(0.1))
    check(lambda t: hj.heat_kernel(pairs, t, (3, 3)), TIMES, 0.1 * TIMES)

    def both(x):  # the tensors and the times move together
        return hks_of(tensors + x * symmetric(np.random.default_rng(5), SHAPE), times=TIMES * jnp.exp(x))

    check(both, jnp.asarray(0.0), jnp.asarray(0.1))


def rate(tensors):
    """The derivative of the HKS by log t."""
    return jax.jvp(lambda t: hks_of(tensors, times=t), (TIMES,), (TIMES,))[1]


@pytest.mark.slow
def test_second_derivatives_are_right_or_refused(rng):
    tensors, direction = FIELDS["rotational"](rng), 0.1 * symmetric(rng, SHAPE)

    def loss(tensors, times):
        return jnp.sum(hks_of(tensors, times=times) ** 2)

    for second in (
        lambda: jax.jvp(lambda T: jax.grad(loss)(T, TIMES), (tensors,), (direction,)),
        lambda: jax.grad(lambda T: jnp.vdot(jax.grad(loss)(T, TIMES), direction))(tensors),
        lambda: jax.jvp(lambda T: jax.jvp(lambda T: loss(T, TIMES), (T,), (direction,))[1], (tensors,), (direction,)),
        lambda: jax.jit(jax.hessian(lambda x: loss(tensors + x * direction, TIMES)))(0.0),
        lambda: jax.grad(lambda T: jnp.sum(jax.grad(loss, 1)(T, TIMES)))(tensors),
    ):
        with pytest.raises(NotImplementedError, match=r"second derivatives .* are not implemented"):
            second()
    # In the times, in the times after the tensors, and by jvp in the tensors after the times, they are right.
    check(lambda t: jax.jvp(lambda T: loss(T, t), (tensors,), (direction,))[1], TIMES, 0.1 * TIMES)
    check(rate, tensors, direction)
    by_times = jax.jacfwd(lambda t: jax.grad(loss)(tensors, t))(TIMES)
    inside = jax.jvp(lambda t: jax.grad(loss)(tensors, t), (TIMES,), (jnp.ones(3),))[1]
    np.testing.assert_allclose(jnp.sum(by_times, axis=-1), inside, rtol=1e-10, atol=1e-10)
    check(lambda t: jnp.vdot(jax.grad(loss)(tensors, t), direction), TIMES, 0.1 * TIMES)
    pairs = hj.eigenpairs(hj.TensorField(GRID, tensors), 20)
    second = jax.hessian(lambda t: jnp.sum(hj.hks(pairs, t)[:, 2, 3]))(TIMES)
    exact = jnp.sum(
        jnp.square(pairs.eigenvalues * pairs.eigenfunctions[:, 2, 3]) * jnp.exp(-TIMES[:, None] * pairs.eigenvalues), 1
    )
    np.testing.assert_allclose(second, jnp.diag(exact), rtol=1e-10, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_batched_equals_looped_and_jitted_equals_eager(rng, solver):
    batch = jnp.stack([FIELDS["generic"](rng), FIELDS["identity"](rng)])
    gradient = jax.grad(lambda T: jnp.sum(hks_of(T, solver=solver) ** 2))
    looped = jnp.stack([gradient(T) for T in batch])
    scale = float(jnp.max(jnp.abs(looped)))
    np.testing.assert_allclose(jax.vmap(gradient)(batch), looped, atol=1e-9 * scale)
    np.testing.assert_allclose(jax.jit(gradient)(batch[1]), looped[1], atol=1e-9 * scale)


@pytest.mark.slow
def test_sparse_derivatives_are_as_good_as_dense_ones(rng):
    """48² nodes, k = 60, every solver setting at its default."""
    grid, k = hj.Grid((48, 48), 1 / 47), 60
    tensors, direction = jnp.asarray(random_spd(rng, (48, 48), 0.5)), 0.1 * symmetric(rng, (48, 48))
    times = jnp.array([0.02, 0.1])
    probe = jnp.asarray(rng.standard_normal((2, 48, 48)))

    def slope(solver):
        def loss(T):
            return jnp.sum(probe * hj.hks(hj.eigenpairs(hj.TensorField(grid, T), k, solver=solver), times))

        return float(jnp.vdot(jax.grad(loss)(tensors), direction))

    # Differences of values would be less exact: their error is that of single vectors, divided by the step.
    assert slope("shift-invert") == pytest.approx(slope("dense"), rel=1e-9)


@pytest.mark.slow
def test_eigenvalues_and_simple_eigenvectors(rng):
    tensors, direction = FIELDS["generic"](rng), 0.1 * symmetric(rng, SHAPE)
    for solver in SOLVERS:

        def f(tensors, solver=solver):
            pairs = hj.eigenpairs(hj.TensorField(GRID, tensors), 20, solver=solver)
            fixed = pairs.vectors * jnp.sign(pairs.vectors[:, :1])
            return jnp.concatenate([pairs.eigenvalues[:, None], fixed], axis=1)

        check(f, tensors, direction, rtol=1e-6, adjoint=1e-10, step=2e-3)


def test_eigenvalues_within_a_cluster_are_finite_and_right_in_sum(rng):
    direction = 0.1 * symmetric(rng, SHAPE)

    def pairs_at(T):
        return hj.eigenpairs(hj.TensorField(GRID, T), 20)

    def total(T):
        return jnp.sum(pairs_at(T).eigenvalues)

    check(total, identity(SHAPE), direction)
    # The eigenvectors of a multiple eigenvalue have no derivative, which is told by NaN; those of simple ones have.
    values = np.asarray(pairs_at(identity(SHAPE)).eigenvalues)
    tangent = jax.jvp(lambda T: pairs_at(T).vectors, (identity(SHAPE),), (direction,))[1]
    alone = (np.abs(values[:, None] - values) < 1e-6).sum(axis=1) == 1
    assert 3 < alone.sum() < 10
    np.testing.assert_array_equal(np.isfinite(tangent).all(axis=1), alone)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["dense", pytest.param("shift-invert", marks=pytest.mark.slow)])
def test_a_cut_cluster_is_completed_or_dropped(rng, solver):
    tensors, direction = identity(SHAPE), 0.1 * symmetric(rng, SHAPE)

    def signature(T, k, multiplet):
        return hj.hks(hj.eigenpairs(hj.TensorField(GRID, T), k, solver=solver, multiplet=multiplet), TIMES)

    expected = {"drop": 4, "complete": 6}  # k = 5 cuts λ = 4π²(1, 0), (0, 1)
    for multiplet, k in expected.items():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            pairs = hj.eigenpairs(hj.TensorField(GRID, tensors), 5, solver=solver, multiplet=multiplet)
        assert pairs.kept.sum() == k
        assert f"{k} of them kept" in pairs.summary()
        assert hj.default_times(pairs, 2)[0] == pytest.approx(float(4 * np.log(10) / pairs.eigenvalues[k - 1]))
        np.testing.assert_allclose(signature(tensors, 5, multiplet), signature(tensors, k, "report"), rtol=1e-9)
        for mode in (jax.jvp, jax.jit(jax.jvp, static_argnums=0)):
            got = mode(partial(signature, k=5, multiplet=multiplet), (tensors,), (direction,))[1]
            truth = jax.jvp(partial(signature, k=k, multiplet="report"), (tensors,), (direction,))[1]
            np.testing.assert_allclose(got, truth, rtol=1e-8, atol=1e-8)
    with (
        unchecked(),
        pytest.raises(ValueError, match='multiplet: got \'keep\'; expected "report", "drop" or "complete"'),
    ):
        hj.eigenpairs(hj.TensorField(GRID, tensors), 5, multiplet="keep")


def small_rectangles():
    """Grids of few nodes, whose symmetry exhausts Krylov spaces: T = I but in one of three, and a k that cuts nothing.

    In the first, residuals became pure rounding, of which an inner product was negative, and the gradient NaN.
    """
    yield hj.Grid((7, 8), (0.2153, 0.1970)), identity((7, 8)), "dirichlet", 16
    for seed in range(8):
        rng = np.random.default_rng(seed)
        shape, boundary = tuple(int(n) for n in rng.integers(5, 9, 2)), ("neumann", "dirichlet")[seed % 2]
        grid = hj.Grid(shape, tuple(rng.uniform(0.1, 0.3, 2).round(4)))
        factor = 1 + (seed % 3 == 2) * 0.5 * np.sin(3 * grid.nodes[..., :1, None])
        yield grid, identity(shape) * factor, boundary, 12 if boundary == "neumann" else 6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "count"),
    [
        ("shift-invert", 1),
        ("shift-invert", 9),
        (hj.ShiftInvert(adjoint=hj.HostAdjoint(1e-15)), 9),
    ],
)
def test_gradients_on_small_symmetric_domains_are_finite(solver, count):
    """Against the dense solver's, which solve no linear system."""
    for grid, tensors, boundary, k in islice(small_rectangles(), count):
        probe = np.random.default_rng(0).standard_normal(grid.shape)

        def loss(tensors, solver, grid=grid, boundary=boundary, k=k, probe=probe):
            pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k, boundary, solver)
            return jnp.nansum(probe * hj.hks(pairs, jnp.array([0.05]))[0])

        expected = jax.grad(loss)(tensors, "dense")
        found = jax.grad(loss)(tensors, solver)
        assert jnp.linalg.norm(found - expected) < 1e-8 * jnp.linalg.norm(expected)


@pytest.mark.slow
def test_solves_that_do_not_converge_are_nan_and_reported():
    """Twelve equal squares: twelve-fold eigenvalues, cut beyond what the guard pairs reach."""
    mask = np.zeros((18, 24), dtype=bool)
    for i, j in np.ndindex(3, 4):
        mask[6 * i : 6 * i + 5, 6 * j : 6 * j + 5] = True
    grid = hj.Grid(mask.shape, mask=mask, components="all")

    def loss(T, multiplet):
        pairs = hj.eigenpairs(hj.TensorField(grid, T), 13, solver="shift-invert", multiplet=multiplet)
        return jnp.nansum(hj.hks(pairs, [4.0]) ** 2 * jnp.arange(18.0)[:, None])

    tensors = identity(mask.shape)
    with pytest.warns(hj.AccuracyWarning, match=r"solves for \d+ of 13 eigenpairs did not converge.*multiplet='drop'"):
        gradient = jax.grad(loss)(tensors, "report")
    assert jnp.isnan(gradient[mask]).any()
    gradient = jax.grad(loss)(tensors, "drop")
    slope = jax.jvp(lambda T: loss(T, "drop"), (tensors,), (tensors,))[1]
    assert slope == pytest.approx(float(jnp.vdot(gradient, tensors)), rel=1e-9)


class Lowest(hj.Eigensolver):
    """A solver as a user would write one: nothing but its pairs."""

    name: ClassVar[str] = "lowest of all"
    tolerance: float = 1e-8

    def lowest(self, pencil, k, report=print):
        values, vectors = hj.eigh(pencil.stiffness.to_dense(), pencil.mass.to_dense())[:2]
        return values[:k], vectors[:, :k].T, jnp.asarray(jnp.inf)


PRECISELY = 1e-13
OTHER_ADJOINTS = {
    "a user's solver": Lowest(adjoint=hj.FactorisedAdjoint(PRECISELY)),
    "a user's solver, filtered": Lowest(adjoint=hj.FilteredAdjoint(PRECISELY, block=4)),
    "a user's solver, on the host": Lowest(adjoint=hj.HostAdjoint(PRECISELY)),
    "host's pairs, device's solves": hj.ShiftInvert(adjoint=hj.FactorisedAdjoint(PRECISELY)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if "," in n else ()) for n in OTHER_ADJOINTS])
def test_any_adjoint_serves_any_solver(rng, name):
    probe = jnp.asarray(rng.standard_normal(GRID.shape))

    def loss(tensors, solver):
        return jnp.vdot(probe, hj.hks(hj.eigenpairs(hj.TensorField(GRID, tensors), 12, solver=solver), [0.3])[0])

    tensors = FIELDS["generic"](rng)
    expected = jax.grad(loss)(tensors, "dense")
    np.testing.assert_allclose(
        jax.grad(loss)(tensors, OTHER_ADJOINTS[name]), expected, atol=1e-9 * jnp.abs(expected).max()
    )


@pytest.mark.slow
def test_moving_the_pairs_themselves_is_plain_differentiation(rng):
    pairs = hj.eigenpairs(hj.TensorField(GRID, FIELDS["generic"](rng)), 20)

    def shifted(x):
        import equinox as eqx

        return hj.hks(eqx.tree_at(lambda p: p.eigenvalues, pairs, pairs.eigenvalues + x), TIMES)

    check(shifted, jnp.asarray(0.0), jnp.asarray(1.0))


@pytest.mark.slow
def test_no_array_is_larger_than_the_eigenvectors_or_the_divided_differences(rng):
    """Neither N × N, nor entries × k × times: the memory of a gradient, read off its jaxpr."""
    shape, k, n_times = (24, 24), 20, 30
    grid, nodes = hj.Grid(shape, 0.1), 24 * 24

    def loss(T):
        pairs = hj.eigenpairs(hj.TensorField(grid, T), k, solver="shift-invert")
        return jnp.sum(hj.hks(pairs, jnp.linspace(0.1, 1, n_times)) ** 2)

    seen = set()

    def sizes(jaxpr):
        if id(jaxpr) in seen:
            return
        seen.add(id(jaxpr))
        for equation in jaxpr.eqns:
            yield from (v.aval.size for v in equation.outvars if hasattr(v.aval, "size"))
            for inner in jax.tree.leaves(equation.params, is_leaf=lambda p: hasattr(p, "eqns") or hasattr(p, "jaxpr")):
                if hasattr(inner, "jaxpr"):
                    yield from sizes(inner.jaxpr)
                elif hasattr(inner, "eqns"):
                    yield from sizes(inner)

    jaxpr = jax.make_jaxpr(jax.grad(loss))(jnp.asarray(random_spd(rng, shape)))
    guards = hj.ShiftInvert().guards(k, nodes)
    assembly = 4 * 4 * 4 * 4 * nodes  # element matrices with their quadrature points, whatever k is
    assert max(sizes(jaxpr.jaxpr)) <= max(nodes * (k + guards), n_times * max(nodes, k**2), assembly)


def test_in_float32_rows_are_grouped_for_the_accuracy_that_there_is():
    """So many factorisations as groups: `prepare` and `solve` must not group for different tolerances."""
    pencil = hj.assemble(hj.TensorField(hj.Grid((20, 20)), np.broadcast_to(np.eye(2), (20, 20, 2, 2))))
    dissection = dissect(pencil.pattern)

    def first_rows(tolerance, solves=1):
        return FactorisedAdjoint(tolerance, solves)._groups(dissection, 200, 200, np.dtype(np.float32))[0]

    asked = first_rows(1e-8)
    np.testing.assert_array_equal(asked, first_rows(attainable(1e-8, np.float32)))
    assert len(first_rows(1e-8, solves=100)) > len(asked)
