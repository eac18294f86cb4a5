"""Smoothing along the tissue: Gaussian spread, the total, the identity with the heat flow of all eigenpairs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked
from fields import random_spd

import hks_jax as hj


def moments(grid, u):
    """The total, and the covariance of the positions, with weights u."""
    x = grid.nodes.reshape(-1, grid.dimension)
    w = np.asarray(u).ravel()
    away = x - (w @ x) / w.sum()
    return w.sum(), np.einsum("n,na,nb->ab", w, away, away) / w.sum()


@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_point_spreads_as_the_gaussian_of_its_tensor(d):
    """The covariance is 2Dt, and the mean over the axes of the squared FWHM is the square of the number given."""
    n, h, fwhm = (45, 2.0, 20.0) if d == 2 else (17, 2.0, 7.0)
    D = 1e-3 * np.array([[1.5, 0.4, 0.1], [0.4, 0.7, 0.0], [0.1, 0.0, 0.5]])[:d, :d]
    grid = hj.Grid((n,) * d, h)
    field = hj.TensorField.from_diffusion(grid, np.broadcast_to(D, (*grid.shape, d, d)), operator="fick")
    spot = np.zeros(grid.shape)
    spot[(n // 2,) * d] = 1
    spread = np.asarray(hj.smooth(field, spot, fwhm))
    weights = np.asarray(hj.assemble(field, mass="lumped").mass.diagonal()).reshape(grid.shape)
    total, covariance = moments(grid, weights / h**d * spread)
    t = fwhm**2 / (16 * np.log(2) * np.trace(D) / d)
    assert total == pytest.approx(1, rel=1e-9)
    np.testing.assert_allclose(covariance, 2 * D * t, rtol=0.05, atol=1e-2)
    assert np.sqrt(8 * np.log(2) * np.trace(covariance) / d) == pytest.approx(fwhm, rel=0.02)
    if d == 2:
        away = (grid.nodes - grid.nodes[n // 2, n // 2]) @ np.linalg.inv(np.linalg.cholesky(2 * D * t)).T
        gaussian = np.exp(-(away**2).sum(axis=-1) / 2) / (2 * np.pi * np.sqrt(np.linalg.det(2 * D * t))) * h**2
        assert np.abs(spread - gaussian).max() < 0.05 * gaussian.max()


@pytest.mark.parametrize(
    "boundary", ["neumann", pytest.param("dirichlet", marks=pytest.mark.slow), ("neumann", "mirror")]
)
def test_the_flow_of_all_eigenpairs_and_the_total(boundary, rng):
    shape, mask = (7, 6), np.ones((7, 6), bool)
    mask[5:, 4:] = False
    D = random_spd(rng, shape)
    field = hj.TensorField.from_diffusion(hj.Grid(shape, (1.0, 1.5), mask=mask), D, operator="fick")
    f = np.where(mask, rng.standard_normal((2, *shape)), np.nan)
    found = np.asarray(hj.smooth(field, f, 3.0, boundary))
    plain = boundary if boundary == "dirichlet" else "neumann"
    pencil = hj.assemble(field, plain, "lumped")
    pairs = hj.eigenpairs(pencil, pencil.size, solver="dense")
    mean = np.trace(D[mask], axis1=-2, axis2=-1).mean() / 2
    expected = hj.heat_flow(pairs, [9 / (16 * np.log(2) * mean)], f)[0]
    np.testing.assert_allclose(found, expected, atol=1e-8)
    if plain == "neumann":
        weights = np.asarray(pencil.space.extend(pencil.mass.diagonal(), outside=0.0))
        before, after = (np.sum(weights * np.where(mask, x, 0), axis=(1, 2)) for x in (f, found))
        np.testing.assert_allclose(after, before, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("boundary", ["neumann", "periodic", "mirror", "mean", "dirichlet"])
def test_the_total_is_kept_but_under_dirichlet_conditions(boundary, rng):
    """Also for maps at the boundary, and under Fick's operator with tensors that vary."""
    shape = (8, 7)
    field = hj.TensorField.from_diffusion(hj.Grid(shape, (1.0, 1.5)), random_spd(rng, shape), operator="fick")
    spot = np.zeros(shape)
    spot[0, 0] = 1
    f = np.stack([spot, 1 + rng.random(shape), 1e-3 * np.ones(shape)])
    found = np.asarray(hj.smooth(field, f, 4.0, boundary))
    pencil = hj.assemble(field, boundary, "lumped").parts[0]
    weights = np.asarray(pencil.space.extend(pencil.mass.diagonal()))
    before, after = (np.nansum(weights * x, axis=(1, 2)) for x in (f, found))
    if boundary == "dirichlet":
        assert (after[1:] < 0.9 * before[1:]).all()
    else:
        np.testing.assert_allclose(after, before, rtol=1e-6)


def test_a_series_is_smoothed_in_blocks_that_are_reported(rng):
    """The maps of a long series are those smoothed one by one; the texts count them to the end."""
    shape = (6, 5)
    field = hj.TensorField.from_diffusion(hj.Grid(shape), random_spd(rng, shape), operator="fick")
    f, texts = rng.standard_normal((2, 20, *shape)), []
    found = hj.smooth(field, f, 3.0, progress=texts.append)
    assert found.shape == f.shape
    np.testing.assert_allclose(found[1, 19], hj.smooth(field, f[1, 19], 3.0), atol=1e-12)
    np.testing.assert_allclose(found, jax.jit(lambda u: hj.smooth(field, u, 3.0))(f), atol=1e-12)
    assert texts == ["14 of 40 maps", "28 of 40 maps", "40 of 40 maps"]
    assert texts[0].seconds_left > 0
    assert texts[-1].seconds_left == 0
    hj.smooth(field, f[0, :3], 3.0, progress=texts.append)
    assert len(texts) == 3  # a few maps need no report


def cap():
    """A part of a sphere."""
    whole = hj.examples.sphere_mesh(2)
    vertices = np.asarray(whole.vertices)
    return hj.SurfaceMesh, vertices, whole.faces, vertices[:, 2] > -0.4


def ball():
    whole = hj.examples.ball_mesh(2)
    return hj.TetMesh, np.asarray(whole.vertices), whole.cells, None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("made", "boundary"),
    [(cap, "neumann"), (cap, "mean"), (ball, "dirichlet")],
)
def test_the_flow_of_all_eigenpairs_of_a_mesh_and_the_total(made, boundary, rng):
    """The tensors are those of space; on a surface, their tangential parts have the mean diffusivity."""
    kind, vertices, cells, mask = made()
    D = 1e-3 * random_spd(rng, (len(vertices), 1, 1))[:, 0, 0]
    mesh = kind.from_tensors(vertices, cells, D, operator="fick", mask=mask)
    f, used = rng.standard_normal((2, len(vertices))), mesh.triangulation.used
    f[:, ~used] = np.nan
    found = np.asarray(hj.smooth(mesh, f, 0.9, boundary))
    plain = boundary if boundary == "dirichlet" else "neumann"
    pencil = hj.assemble(mesh, plain, "lumped")
    pairs = hj.eigenpairs(pencil, pencil.size, solver="dense")
    corners = vertices[mesh.triangulation.cells]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    frames, of_edges = np.linalg.qr(edges)
    sizes = np.abs(np.prod(np.diagonal(of_edges, axis1=1, axis2=2), axis=1))
    tangential = np.einsum("nxa,nxy,nya->n", frames, D[mesh.triangulation.cells].mean(axis=1), frames)
    mean = np.average(tangential / edges.shape[2], weights=sizes)
    expected = hj.heat_flow(pairs, [0.81 / (16 * np.log(2) * mean)], f)[0]
    np.testing.assert_allclose(found, expected, atol=1e-8)
    if plain == "neumann":
        weights = np.asarray(pencil.space.extend(pencil.mass.diagonal(), outside=0.0))
        before, after = (np.sum(weights * np.where(used, x, 0), axis=1) for x in (f, found))
        np.testing.assert_allclose(after, before, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_on_meshes_in_single_precision_and_derivatives(rng):
    mesh = hj.examples.sphere_mesh(4)
    x = np.asarray(mesh.vertices)[:, 0]
    # x is an eigenfunction of the sphere with the eigenvalue 2.
    factor = 2.0 ** (-2 * 0.5**2 / (16 * np.log(2) ** 2))
    np.testing.assert_allclose(hj.smooth(mesh, x, 0.5), factor * x, atol=0.01)
    D = random_spd(rng, (6, 5))
    field = hj.TensorField.from_diffusion(hj.Grid((6, 5)), D.astype(np.float32), operator="fick")
    f = rng.standard_normal((6, 5))
    single = hj.smooth(field, f, 3.0)
    assert single.dtype == np.float32
    double = hj.TensorField.from_diffusion(field.grid, D, operator="fick")
    whole = hj.smooth(double, f, 3.0)
    np.testing.assert_allclose(single, whole, atol=1e-5)
    # The flow is symmetric in the inner product with the mass.
    weights = np.asarray(hj.assemble(double, mass="lumped").mass.diagonal()).reshape(6, 5)
    g = jnp.asarray(rng.standard_normal((6, 5)))
    gradient = jax.jit(jax.grad(lambda u: jnp.sum(weights * g * hj.smooth(double, u, 3.0))))(jnp.asarray(f))
    np.testing.assert_allclose(gradient, weights * np.asarray(hj.smooth(double, g, 3.0)), atol=1e-10)


def test_smoothing_that_is_refused():
    field = hj.TensorField.from_diffusion(hj.Grid((6, 5), 2.0), np.tile(np.eye(2), (6, 5, 1, 1)), operator="fick")
    f = np.ones((6, 5))
    with pytest.raises(ValueError, match=r"fwhm: got 1.5 on a grid with the spacing 2, which does not resolve it"):
        hj.smooth(field, f, 1.5)
    with pytest.raises(ValueError, match=r"f: got shape \(5, 6\); expected \(6, 5\)"):
        hj.smooth(field, f.T, 6.0)
    with pytest.raises(ValueError, match=r"f: got 30 NaN or infinite values inside the mask"):
        hj.smooth(field, np.nan * f, 6.0)
    with pytest.raises(ValueError, match=r"fwhm: got -1.0; expected a finite number above 0"):
        hj.smooth(field, f, -1.0)
    with pytest.raises(
        ValueError, match=r"fwhm: got 0.1 on a mesh with the median edge 0.5823, which does not resolve"
    ):
        hj.smooth(hj.examples.sphere_mesh(2), np.ones(42), 0.1)
    with pytest.raises(ValueError, match="domain: got traced values"):
        jax.jit(lambda T: hj.smooth(hj.TensorField(field.grid, T), f, 6.0))(field.tensors)
    with unchecked(), pytest.raises(ValueError, match="fwhm: got traced values"):
        jax.jit(lambda width: hj.smooth(field, f, width))(6.0)
    with unchecked(), pytest.raises(ValueError, match="diffusivity: got traced values"):
        jax.jit(lambda D: hj.smooth(field, f, 6.0, diffusivity=D))(1.0)
