"""The HKS belongs to the surface, not to the chart: reparametrised metrics, meshes, rotated coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import random_spd
from scipy.interpolate import RegularGridInterpolator

import hks_jax as hj

PERIOD = 2 * np.pi
TIMES = [0.3, 1.0]


def embedded_torus(x):
    ring = 1.5 + 0.7 * jnp.cos(x[1])
    return jnp.stack([ring * jnp.cos(x[0]), ring * jnp.sin(x[0]), (0.7 + 0.2 * jnp.cos(x[0])) * jnp.sin(x[1])])


def chart(y):
    """A periodic change of coordinates that shears and stretches."""
    return jnp.stack([y[0] + 0.3 * jnp.sin(y[0]) + 0.2 * jnp.sin(y[1]), y[1] + 0.25 * jnp.cos(y[0] + y[1])])


def pulled_back(parametrisation, n):
    def metric(x):
        jacobian = jax.jacfwd(parametrisation)(x)
        return jacobian.T @ jacobian

    return hj.TensorField.from_function(metric, hj.Grid((n, n), PERIOD / n))


def torus_mesh(n):
    u = np.stack(np.meshgrid(*[np.arange(n) * PERIOD / n] * 2, indexing="ij"), -1).reshape(-1, 2)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a, b, c, d = ((x % n) * n + y % n for x, y in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return hj.SurfaceMesh(jax.vmap(embedded_torus)(jnp.asarray(u)), faces)


def differences(other, sizes=(16, 32)):
    """Relative difference of `other`'s HKS at the nodes u = chart(y) from the plain chart's, for each size."""
    result = []
    for n in sizes:
        pairs = hj.eigenpairs(pulled_back(embedded_torus, n), 120, "periodic")
        plain = np.asarray(hj.hks(pairs, TIMES))
        theirs, nodes = other(n)
        wrapped = np.pad(plain, [(0, 0), (0, 1), (0, 1)], mode="wrap")
        axis = np.arange(n + 1) * PERIOD / n
        ours = np.stack([RegularGridInterpolator((axis, axis), w, method="cubic")(nodes % PERIOD) for w in wrapped])
        result.append(np.abs(theirs - ours).max() / ours.max())
    return result


def reparametrised(n):
    field = pulled_back(lambda y: embedded_torus(chart(y)), n)
    nodes = jax.vmap(jax.vmap(chart))(jnp.asarray(field.grid.nodes))
    return hj.hks(hj.eigenpairs(field, 120, "periodic"), TIMES), nodes


def triangulated(n):
    signature = hj.hks(hj.eigenpairs(torus_mesh(n), 120), TIMES)
    return np.asarray(signature).reshape(-1, n, n), hj.Grid((n, n), PERIOD / n).nodes


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:k =", "ignore:2 of 2|1 of 2")
@pytest.mark.parametrize("other", [pytest.param(reparametrised, marks=pytest.mark.slow), triangulated])
def test_same_surface_same_signature_to_discretisation_order(other):
    coarse, fine = differences(other)
    assert 1.6 < np.log2(coarse / fine) < 2.6
    assert fine < 0.02


@pytest.mark.slow
def test_permuted_and_flipped_axes_move_the_signature_with_them(rng):
    tensors = random_spd(rng, (5, 6, 7))
    plain = hj.hks(hj.eigenpairs(hj.TensorField(hj.Grid((5, 6, 7), (1, 2, 3)), tensors), 60), [10.0])[0]
    order = (2, 0, 1)
    permuted = np.transpose(tensors, (*order, 3, 4))[..., order, :][..., order]
    moved = hj.hks(hj.eigenpairs(hj.TensorField(hj.Grid(permuted.shape[:3], (3, 1, 2)), permuted), 60), [10.0])[0]
    np.testing.assert_allclose(moved, np.transpose(plain, order), rtol=1e-9)
    sign = np.diag([-1.0, 1.0, 1.0])
    flipped = sign @ tensors[::-1] @ sign
    moved = hj.hks(hj.eigenpairs(hj.TensorField(hj.Grid((5, 6, 7), (1, 2, 3)), flipped), 60), [10.0])[0]
    np.testing.assert_allclose(moved, plain[::-1], rtol=1e-9)


def test_spacing_and_metric_are_interchangeable(rng):
    tensors = random_spd(rng, (6, 7))
    scale = np.diag([2.0, 0.5])
    fine = hj.eigenpairs(hj.TensorField(hj.Grid((6, 7), (2.0, 0.5)), tensors), 20)
    unit = hj.eigenpairs(hj.TensorField(hj.Grid((6, 7)), scale @ tensors @ scale), 20)
    np.testing.assert_allclose(fine.eigenvalues, unit.eigenvalues, rtol=1e-10, atol=1e-12)
