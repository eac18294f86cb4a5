"""Three dimensions end to end: exact spectra, symmetry, isometry, mirror, mask, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import directional
from fields import random_spd
from scipy.interpolate import RegularGridInterpolator

import hks_jax as hj


def axis_eigenvalues(condition, length: float, n: int = 12) -> np.ndarray:
    """The exact eigenvalues of −d²/dx² on an interval."""
    i = np.arange(n)
    shift = {"neumann": 0, "dirichlet": 1, ("neumann", "dirichlet"): 0.5}[condition]
    return (np.pi * (i + shift) / length) ** 2


def exact(boundary, lengths, k: int) -> np.ndarray:
    axes = [axis_eigenvalues(c, a) for c, a in zip(boundary, lengths, strict=True)]
    return np.sort(np.add.reduce(np.meshgrid(*axes, indexing="ij")).ravel())[:k]


# ---------------------------------------------------------------------------------------------------- exact spectra


def unit_cube(n: int) -> hj.Grid:
    return hj.Grid((n, n, n), 1 / (n - 1))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:k = 60 cuts")
@pytest.mark.parametrize("boundary", [("neumann",) * 3, (("neumann", "dirichlet"), "dirichlet", "neumann")])
def test_second_order_convergence_to_the_exact_spectrum(boundary):
    lengths, k, errors = (1.0, 1.3, 1.7), 5, []
    truth = exact(boundary, lengths, k)
    for n in (7, 10):
        field = hj.TensorField(unit_cube(n), np.broadcast_to(np.diag(np.square(lengths)), (n, n, n, 3, 3)))
        values = hj.eigenpairs(field, 60, boundary, "dense").eigenvalues[:k]
        errors.append(np.max(np.abs(values - truth) / np.maximum(truth, 1)))
    assert np.log(errors[0] / errors[1]) / np.log(9 / 6) == pytest.approx(2, abs=0.3)


@pytest.mark.slow
def test_a_constant_anisotropic_metric_on_the_three_torus():
    """g = AᵀA on the periodic cube: plane waves exp(2πi n·x), λ = 4π² n·g⁻¹n."""
    A = np.array([[1.0, 0.3, -0.2], [0.0, 1.2, 0.25], [0.0, 0.0, 0.8]])
    waves = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    truth = np.sort(4 * np.pi**2 * np.einsum("na,ab,nb->n", waves, np.linalg.inv(A.T @ A), waves))[:7]
    errors = []
    for n in (6, 9):
        field = hj.TensorField(hj.Grid((n, n, n), 1 / n), np.broadcast_to(A.T @ A, (n, n, n, 3, 3)))
        pairs = hj.eigenpairs(field, 7, "periodic", "dense")
        errors.append(np.max(np.abs(pairs.eigenvalues[1:] / truth[1:] - 1)))
        assert pairs.pencil.volume == pytest.approx(np.linalg.det(A))
    assert np.log(errors[0] / errors[1]) / np.log(9 / 6) == pytest.approx(2, abs=0.3)


# ---------------------------------------------------------------------------------------------------- symmetry


IDENTITY = np.broadcast_to(np.eye(3), (7, 7, 7, 3, 3))


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["shift-invert", pytest.param("dense", marks=pytest.mark.slow)])
def test_multiplets_of_the_cube_are_complete(solver):
    """Neumann on a cube: n = (0,0,0), (1,0,0)×3, (1,1,0)×3, (1,1,1), (2,0,0)×3, (2,1,0)×6, …"""
    pairs = hj.eigenpairs(hj.TensorField(unit_cube(7), IDENTITY), 17, solver=solver)
    values = np.asarray(pairs.eigenvalues)
    assert pairs.cut_multiplet == 0
    sizes = np.diff(np.flatnonzero(np.diff(values, prepend=-1.0, append=np.inf) > 1e-6 * values[-1]))
    np.testing.assert_array_equal(sizes, [1, 3, 3, 1, 3, 6])
    # So the signature has the symmetry of the cube, whatever basis of a multiplet the solver found.
    signature = np.asarray(hj.hks(pairs, [0.2]))[0]
    for moved in (signature.transpose(1, 2, 0), signature.transpose(1, 0, 2), signature[::-1], signature[:, :, ::-1]):
        np.testing.assert_allclose(moved, signature, rtol=1e-9)
    with pytest.warns(hj.AccuracyWarning, match=r"k = 15 cuts a multiple eigenvalue: the last 4"):
        hj.eigenpairs(hj.TensorField(unit_cube(7), IDENTITY), 15, solver=solver)


@pytest.mark.slow
def test_an_isometry_moves_the_signature():
    """The box in other coordinates x = f(y), f a diffeomorphism of the box that keeps its sides."""

    def bent(y):
        bump = jnp.sin(jnp.pi * y)
        return y + 0.12 * bump * jnp.array([bump[1], bump[2], bump[0]])

    def metric(x):
        return jnp.diag(jnp.stack([1 + 0.5 * x[1], 1 + 0.3 * jnp.sin(3 * x[2]), 1.0 + 0 * x[0]]))

    def pulled_back(y):
        J = jax.jacfwd(bent)(y)
        return J.T @ metric(bent(y)) @ J

    t, differences = [0.1, 0.2], []
    for n in (7, 10):
        grid = unit_cube(n)
        fields = [jax.jit(jnp.vectorize(g, signature="(d)->(d,d)"))(grid.nodes) for g in (metric, pulled_back)]
        plain, moved = (np.asarray(hj.hks(hj.eigenpairs(hj.TensorField(grid, T), 60), t)) for T in fields)
        there = np.asarray(jnp.vectorize(bent, signature="(d)->(d)")(grid.nodes))
        expected = np.stack([RegularGridInterpolator(grid.axes, v, method="cubic")(there) for v in plain])
        differences.append(np.sqrt(np.mean((moved / expected - 1) ** 2)))
    assert np.log(differences[0] / differences[1]) / np.log(9 / 6) > 1.6
    assert differences[1] < 0.03


# ---------------------------------------------------------------------------------------------------- mirror and mask


@pytest.mark.slow  # quickly, and with the whole spectrum: test_boundary.py
def test_mirror_is_the_doubled_grid(rng):
    """Eight mixed problems on a box, the sparse solver on the torus of eight boxes: a truncated spectrum of both."""
    n, k = 5, 60
    field = diagonal_on_the_sides(rng, (n, n + 1, n))
    tensors = np.asarray(field.tensors)
    for axis in range(3):
        image = np.flip(tensors, axis).take(range(1, tensors.shape[axis] - 1), axis)
        sign = np.where(np.arange(3) == axis, -1.0, 1.0)
        tensors = np.concatenate([tensors, image * sign[:, None] * sign], axis)
    doubled = hj.TensorField(hj.Grid(tensors.shape[:3], field.grid.spacing), tensors)
    mirror, torus = hj.eigenpairs(field, k, "mirror"), hj.eigenpairs(doubled, k, "periodic", "shift-invert")
    assert len(mirror.pencil.parts) == 8
    np.testing.assert_allclose(mirror.eigenvalues, torus.eigenvalues, atol=1e-9 * float(torus.eigenvalues[-1]))
    times = 20 / mirror.eigenvalues[-1:]
    original = (slice(None), *[slice(m) for m in field.grid.shape])
    np.testing.assert_allclose(hj.hks(mirror, times), hj.hks(torus, times)[original], rtol=1e-6)


def diagonal_on_the_sides(rng, shape) -> hj.TensorField:
    """Random tensors, diagonal on the sides, where only such have a mirror image at the nodes."""
    tensors = random_spd(rng, shape, 0.5)
    for axis in range(3):
        for end in (0, -1):
            tensors[(slice(None),) * axis + (end,)] *= np.eye(3)
    return hj.TensorField(hj.Grid(shape, 0.2), tensors)


SHAPE = (5, 6, 7)
MASK = np.ones(SHAPE, bool)
MASK[:3, :3, 4:] = MASK[3:, :, :2] = False
GRID = hj.Grid(SHAPE, 0.25, mask=MASK)


@pytest.mark.slow
def test_outside_a_mask_there_is_nothing(rng):
    tensors = random_spd(rng, SHAPE)
    pairs = hj.eigenpairs(hj.TensorField(GRID, tensors), 40)
    signature = np.asarray(hj.hks(pairs, [0.5, 2.0]))
    assert np.isnan(signature[:, ~MASK]).all()
    assert (signature[:, MASK] > 0).all()
    other = np.where(MASK[..., None, None], tensors, np.nan)
    np.testing.assert_array_equal(hj.hks(hj.eigenpairs(hj.TensorField(GRID, other), 40), [0.5, 2.0]), signature)


# ---------------------------------------------------------------------------------------------------- derivatives


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
@pytest.mark.parametrize(
    ("solver", "boundary"),
    [
        ("dense", ("periodic", "dirichlet", "neumann")),
        pytest.param("shift-invert", "neumann", marks=pytest.mark.slow),  # quickly: test_derivatives.py, on the cube
    ],
)
def test_forward_and_reverse_derivatives_of_a_truncated_signature(rng, solver, boundary):
    times, weights = jnp.array([0.1, 0.5]), jnp.asarray(rng.standard_normal((2, *SHAPE)))
    tensors = jnp.asarray(random_spd(rng, SHAPE, 0.5))
    noise = rng.standard_normal(tensors.shape)
    direction = jnp.asarray(0.1 * (noise + np.swapaxes(noise, -1, -2)))

    @jax.jit
    def loss(tensors):
        pairs = hj.eigenpairs(hj.TensorField(GRID, tensors), 12, boundary, solver)
        return jnp.nansum(weights * hj.hks(pairs, times))

    gradient, forward = jax.grad(loss)(tensors), jax.jvp(loss, (tensors,), (direction,))[1]
    assert np.isfinite(gradient).all()
    assert not gradient[~MASK].any()
    reverse = jnp.vdot(gradient, direction)
    assert forward == pytest.approx(float(reverse), rel=1e-9)
    assert reverse == pytest.approx(float(directional(loss, tensors, direction)), rel=1e-7)
