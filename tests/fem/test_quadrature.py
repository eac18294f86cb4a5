"""Quadrature points at which the leading error of heat kernel signatures cancels."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import directional
from fields import flat, random_spd

import hks_jax as hj

CANCELLING = "cancelling"
TIMES = np.array([1.5, 3, 6, 12])


def of_symbols(tensor, quadrature):
    """Errors of the signature of a flat torus at t = TIMES·√|T|, from what the matrices do to plane waves.

    So many nodes that the torus is no different from the plane.
    """
    d = len(tensor)
    n, grid = 64 if d == 2 else 40, hj.Grid((4,) * d)
    pencil = hj.assemble(
        hj.TensorField(grid, np.broadcast_to(tensor, (*grid.shape, d, d))), "periodic", quadrature=quadrature
    )
    theta = np.stack(np.meshgrid(*[2 * np.pi * np.arange(n) / n] * d), -1)
    waves = [np.cos(theta @ offset) for offset in product((-1, 0, 1), repeat=d)]
    corner = (slice(None), *(1,) * d)
    stiffness, mass = (
        np.tensordot(matrix.coefficients[corner], waves, 1) for matrix in (pencil.stiffness, pencil.mass)
    )
    read = 1.0 if pencil.row_sums is None else (1 + mass / float(pencil.row_sums[0])) / 2
    root = np.sqrt(np.linalg.det(tensor))
    return np.array(
        [
            np.mean(np.exp(-t * root * stiffness / mass) * read**2 / mass) * (4 * np.pi * t * root) ** (d / 2) - 1
            for t in TIMES
        ]
    )


def turned(values, *angles):
    """A tensor of these eigenvalues, turned in one plane after the other."""
    frame = np.eye(len(values))
    for axis, angle in enumerate(angles):
        turn, c, s = np.eye(len(values)), np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        turn[np.ix_((axis, axis + 1), (axis, axis + 1))] = [[c, -s], [s, c]]
        frame = frame @ turn
    return frame @ np.diag(values) @ frame.T


# The first four are those of the derivation's table, measured with another program.
@pytest.mark.parametrize(
    ("tensor", "expected", "times_better"),
    [
        (np.eye(2), (9.9e-3, 2.2e-3, 5.4e-4, 1.3e-4), 25),
        (np.diag([1.0, 4.0]), (2.4e-2, 5.1e-3, 1.2e-3, 2.8e-4), 15),
        (turned([1.0, 4.0], 45), (1.4e-2, 3.2e-3, 7.9e-4, 2.0e-4), 13),
        (turned([1.0, 10.0], 30), (2.3e-2, 5.4e-3, 1.4e-3, 3.5e-4), 50),
        (turned([1.0, 2.0, 3.0], 40, 60), None, 10),
        (turned([1.0, 1.0, 5.0], 40, 55), None, 7),
    ],
)
def test_the_leading_error_of_constant_tensors_cancels(tensor, expected, times_better):
    found = of_symbols(tensor, CANCELLING)
    if expected is not None:
        np.testing.assert_allclose(found, expected, rtol=0.05)
    # Of fourth order in the spacing, where that of Gauss is of second.
    assert 3.8 < found[2] / found[3] < 4.5
    assert np.abs(of_symbols(tensor, "gauss")[3]) > times_better * np.abs(found[3])
    # And `truncation` knows.
    d = len(tensor)
    grid = hj.Grid((4,) * d)
    field = hj.TensorField(grid, np.broadcast_to(tensor, (*grid.shape, d, d)))
    resolution = hj.assemble(field, "periodic", quadrature=CANCELLING).resolution
    estimate = (np.ravel(resolution.dispersion)[0] / np.sqrt(np.linalg.det(tensor)) / TIMES[3]) ** resolution.order
    assert 0.5 < found[3] / estimate < 2


def test_signatures_are_read_at_the_nodes():
    # On a torus of 8 × 9 nodes all pairs give what the symbols of so many waves give.
    field = flat((8, 9), (8.0, 9.0), (True, True))
    pairs = hj.eigenpairs(field, 72, "periodic", quadrature=CANCELLING)
    theta = np.meshgrid(2 * np.pi * np.arange(8) / 8, 2 * np.pi * np.arange(9) / 9, indexing="ij")
    masses = [1 - (1 - np.cos(each)) / 6 for each in theta]
    mass = masses[0] * masses[1]
    stiffness = sum((2 - 2 * np.cos(each)) * other for each, other in zip(theta, masses[::-1], strict=True))
    expected = np.mean(np.exp(-2 * stiffness / mass) * ((1 + mass) / 2) ** 2 / mass)
    np.testing.assert_allclose(hj.hks(pairs, [2.0]), expected, rtol=1e-10)
    kernel = np.asarray(hj.heat_kernel(pairs, [2.0], [3, 4]))[0, 0]
    np.testing.assert_allclose(kernel[3, 4], expected, rtol=1e-10)
    # The flow sums the kernel over the nodes.
    u = np.cos(np.arange(72.0)).reshape(8, 9)
    np.testing.assert_allclose(np.asarray(hj.heat_flow(pairs, [2.0], u))[0, 3, 4], np.sum(kernel * u), rtol=1e-10)
    decay = np.exp(-2 * np.asarray(pairs.eigenvalues))
    sum_of_squares = np.tensordot(decay, np.square(pairs.eigenfunctions), 1)
    np.testing.assert_allclose(sum_of_squares, expected, rtol=1e-10)


@pytest.mark.slow
def test_the_mirrored_domain_is_a_torus_of_twice_the_size():
    n, spacing = 5, (0.5, 0.3)
    x = np.arange(n)
    one = np.exp(0.5 * np.cos(np.pi * x / (n - 1)))[:, None] + 0.2 * np.cos(np.pi * x / (n - 1)) ** 2
    tensors = one[..., None, None] * np.diag([1.0, 3.0])
    around = np.r_[x, x[-2:0:-1]]
    whole = hj.TensorField(hj.Grid((8, 8), spacing), tensors[np.ix_(around, around)])
    torus = hj.eigenpairs(whole, 64, "periodic", quadrature=CANCELLING)
    mirror = hj.eigenpairs(hj.TensorField(hj.Grid((n, n), spacing), tensors), 64, "mirror", quadrature=CANCELLING)
    np.testing.assert_allclose(mirror.eigenvalues, torus.eigenvalues, atol=1e-10)
    np.testing.assert_allclose(hj.hks(mirror, [0.3]), np.asarray(hj.hks(torus, [0.3]))[:, :n, :n], rtol=1e-10)
    np.testing.assert_allclose(
        np.sum(np.square(mirror.eigenfunctions), axis=0),
        np.sum(np.square(torus.eigenfunctions), axis=0)[:n, :n],
        rtol=1e-10,
    )


def test_potentials_and_densities_are_taken_at_the_points_of_the_mass(rng):
    field = hj.TensorField(hj.Grid((4, 5)), random_spd(rng, (4, 5)))
    plain = hj.assemble(field, "periodic", quadrature=CANCELLING)
    # A constant potential moves all eigenvalues by as much, and a constant density none.
    other = hj.assemble(field, "periodic", potential=3.0, density=2.0, quadrature=CANCELLING)
    expected = 2 * plain.stiffness.coefficients + 6 * plain.mass.coefficients
    np.testing.assert_allclose(other.stiffness.coefficients, expected, atol=1e-12)
    np.testing.assert_allclose(other.mass.coefficients, 2 * plain.mass.coefficients, atol=1e-12)
    pairs, others = (hj.eigenpairs(pencil, 20) for pencil in (plain, other))
    np.testing.assert_allclose(others.eigenvalues, pairs.eigenvalues + 3, rtol=1e-10)
    np.testing.assert_allclose(hj.hks(others, [8.0]), np.exp(-24) / 2 * hj.hks(pairs, [8.0]), rtol=1e-10)


@pytest.mark.slow
def test_spacings_are_tensors_of_another_size(rng):
    tensors, spacing = random_spd(rng, (4, 3, 3)), np.array([0.5, 2.0, 0.3])
    scaled = tensors * spacing[:, None] * spacing
    one, other = (
        hj.assemble(hj.TensorField(hj.Grid((4, 3, 3), h), T), quadrature=CANCELLING)
        for h, T in ((tuple(spacing), tensors), (1.0, scaled))
    )
    np.testing.assert_allclose(one.stiffness.coefficients, other.stiffness.coefficients, atol=1e-12)
    np.testing.assert_allclose(one.mass.coefficients, other.mass.coefficients, atol=1e-12)
    # Nor does it matter which axis is the first.
    turned_round = np.moveaxis(tensors, 0, 2)[..., [1, 2, 0], :][..., [1, 2, 0]]
    grid = hj.Grid((3, 3, 4), tuple(np.roll(spacing, -1)))
    round_pairs = hj.eigenpairs(hj.TensorField(grid, turned_round), 20, quadrature=CANCELLING)
    pairs = hj.eigenpairs(one, 20)
    np.testing.assert_allclose(round_pairs.eigenvalues, pairs.eigenvalues, atol=1e-10)
    np.testing.assert_allclose(hj.hks(pairs, [4.0])[0], np.moveaxis(hj.hks(round_pairs, [4.0])[0], 2, 0), rtol=1e-9)


@pytest.mark.parametrize(
    ("d", "dtype"),
    [
        (2, np.float32),
        (3, np.float64),
        pytest.param(3, np.float32, marks=pytest.mark.slow),
        pytest.param(2, np.float64, marks=pytest.mark.slow),
    ],
)
def test_only_constants_have_no_energy(d, dtype):
    # Eigenvalues of 1 to 10⁴ in the cells' diagonal: there the points would meet in the centre, or leave the cell.
    long = np.ones(d) / np.sqrt(d)
    tensors = np.eye(d) + 1e4 * np.outer(long, long)
    field = hj.TensorField(hj.Grid((3,) * d), np.broadcast_to(tensors, (*(3,) * d, d, d)).astype(dtype))
    for sign in (1, -1):
        given = field.tensors if sign == 1 else jnp.linalg.inv(field.tensors)
        pencil = hj.assemble(hj.TensorField(field.grid, given), quadrature=CANCELLING)
        values = np.linalg.eigvalsh(np.asarray(pencil.stiffness.to_dense(), np.float64))
        tolerance = np.finfo(dtype).eps * values[-1]
        assert abs(values[0]) < 10 * tolerance
        assert values[1] > (10 * tolerance if dtype == np.float64 else -10 * tolerance)
        assert np.linalg.eigvalsh(np.asarray(pencil.mass.to_dense(), np.float64))[0] > 0


MASK = np.ones((5, 4), bool)
MASK[:2, 2:] = False


@pytest.mark.parametrize(
    "boundary", [*(pytest.param(b, marks=pytest.mark.slow) for b in ("neumann", "mean")), ("dirichlet", "periodic")]
)
def test_signatures_on_a_mask_are_the_sums_of_squares(rng, boundary):
    mask = np.ones((7, 6), bool)
    mask[:2, 3:] = False
    field = hj.TensorField(hj.Grid((7, 6), mask=mask), random_spd(rng, (7, 6), 0.3))
    pairs = hj.eigenpairs(field, 5, boundary, "dense", quadrature=CANCELLING)
    solve = jax.jit(lambda T: hj.eigenpairs(hj.TensorField(field.grid, T), 5, boundary, "dense", quadrature=CANCELLING))
    dense = solve(field.tensors)
    expected = np.sum(np.exp(-9 * dense.eigenvalues)[:, None, None] * dense.eigenfunctions**2, axis=0)
    np.testing.assert_allclose(hj.hks(pairs, [9.0])[0], expected, rtol=1e-7)
    squares = np.sum(np.exp(-9 * pairs.eigenvalues)[:, None, None] * pairs.eigenfunctions**2, axis=0)
    np.testing.assert_allclose(squares, expected, rtol=1e-7)


def reading(grid, boundary, interpolation="linear", k=6):
    """A number that depends on signatures, kernels and flows of a field."""

    def value(tensors):
        field = hj.TensorField(grid, tensors, interpolation)
        pairs = hj.eigenpairs(field, k, boundary, "dense", quadrature=CANCELLING)
        weights = jnp.where(grid.inside, jnp.cos(jnp.arange(grid.inside.size, dtype=float)).reshape(grid.shape), 0)

        def total(x):
            return jnp.sum(weights * jnp.where(grid.inside, x, 0))

        return total(hj.hks(pairs, jnp.array([0.5, 2.0]))) + total(hj.heat_flow(pairs, jnp.array([0.7]), weights))

    return value


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
@pytest.mark.parametrize(
    ("grid", "boundary", "interpolation"),
    [
        (hj.Grid((5, 4), (0.8, 1.1), mask=MASK), "mean", "log-euclidean"),
        (hj.Grid((3, 4)), ("mirror", "dirichlet"), "linear"),
        (
            hj.Grid((3, 3, 3), (1.0, 0.7, 1.2), mask=np.arange(27).reshape(3, 3, 3) > 0),
            ("periodic", *["neumann"] * 2),
            "linear",
        ),
    ],
)
def test_gradients_agree_with_differences(rng, grid, boundary, interpolation):
    d = grid.dimension
    tensors = jnp.asarray(random_spd(rng, grid.shape))
    direction = rng.standard_normal(tensors.shape)
    direction = jnp.asarray(0.1 * (direction + np.swapaxes(direction, -1, -2)))
    direction = jnp.where(grid.inside[..., None, None], direction, 0)
    value = jax.jit(reading(grid, boundary, interpolation, 6 if d == 2 else 8))
    expected = float(directional(value, tensors, direction))
    _, forward = jax.linearize(value, tensors)
    assert forward(direction) == pytest.approx(expected, rel=1e-7)
    (gradient,) = jax.linear_transpose(forward, tensors)(jnp.ones(()))
    assert jnp.vdot(gradient, direction) == pytest.approx(expected, rel=1e-7)
    assert not gradient[~grid.inside].any()


@pytest.mark.slow
def test_batches_agree_with_a_loop_also_in_single_precision(rng):
    batch = jnp.asarray(np.stack([random_spd(rng, (4, 5)) for _ in range(2)]))

    def signature(T):
        pairs = hj.eigenpairs(hj.TensorField(hj.Grid((4, 5)), T), 20, solver="dense", quadrature=CANCELLING)
        return hj.hks(pairs, jnp.asarray([1.5, 4.0], T.dtype))

    expected = np.stack([signature(T) for T in batch])
    np.testing.assert_allclose(jax.jit(jax.vmap(signature))(batch), expected, rtol=1e-10)
    single = jax.jit(jax.vmap(signature))(batch.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, rtol=1e-4)


def test_what_it_does_not_take_is_refused():
    field = flat((4, 4), (1.0, 1.0))
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    mesh = hj.SurfaceMesh(vertices, np.array([[0, 1, 2]]))
    with pytest.raises(ValueError, match='quadrature: got "cancelling" with a mesh'):
        hj.assemble(mesh, quadrature=CANCELLING)
    with pytest.raises(ValueError, match='quadrature: got "cancelling" with a lumped mass'):
        hj.eigenpairs(field, 3, mass="lumped", quadrature=CANCELLING)
    with pytest.raises(ValueError, match="quadrature: a pencil has"):
        hj.eigenpairs(hj.assemble(field), 3, quadrature=CANCELLING)
    pencil = hj.assemble(field, quadrature=CANCELLING)
    for method in (hj.hks_spectrum_free, hj.colouring):
        with pytest.raises(ValueError, match='quadrature "cancelling"'):
            method(pencil, [0.1])
