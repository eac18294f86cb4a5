"""Metrics from mechanics: deformation gradients, whose curvature is known, and indefinite tensors such as stress."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.special
from annotations import unchecked

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import TensorVolume, find_invalid, positive_tensors, read_tensors, repair_tensors

TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def rotations(angles):
    return np.cos(angles)[..., None, None] * np.eye(2) + np.sin(angles)[..., None, None] * TURN


# ------------------------------------------------------------------------------------------------ deformation


def ring_eigenvalues(inner, outer, angle, count):
    """The Neumann eigenvalues of a sector of a ring, from the cross products of Bessel functions' derivatives."""
    found = [0.0]
    for m in range(8):
        nu = m * np.pi / angle

        def cross(x, nu=nu):
            jv, yv = scipy.special.jvp, scipy.special.yvp
            return jv(nu, inner * x) * yv(nu, outer * x) - jv(nu, outer * x) * yv(nu, inner * x)

        x = np.linspace(0.3, 14, 2000)
        values = cross(x)
        signs = np.flatnonzero(values[1:] * values[:-1] < 0)
        found += [scipy.optimize.brentq(cross, x[i], x[i + 1]) ** 2 for i in signs]
    return np.sort(found)[:count]


@pytest.mark.slow
def test_a_compatible_gradient_has_the_spectrum_of_the_deformed_body():
    """A rectangle (r, θ) bent to a quarter of a ring; F is the gradient of y = r (cos θ, sin θ)."""
    grid = hj.Grid.from_bounds((1, 0), (2, np.pi / 2), (24, 36))
    r, theta = np.moveaxis(grid.nodes, -1, 0)
    c, s = np.cos(theta), np.sin(theta)
    F = np.stack([np.stack([c, -r * s], -1), np.stack([s, r * c], -1)], -2)
    field = hj.TensorField.from_deformation(grid, F)
    assert np.abs(hj.gaussian_curvature(field)[3:-3, 3:-3]).max() < 1e-3
    found = hj.eigenpairs(field, 12).eigenvalues
    expected, h = ring_eigenvalues(1, 2, np.pi / 2, 12), 2 * grid.spacing[1]
    assert (found[1:] > expected[1:]).all()
    assert (found <= expected * (1 + expected * h**2 / 12) + 1e-9).all()  # as accurate as bilinear functions are
    # Where the body is turned further, from place to place as one likes, nothing changes: C = FᵀF does not.
    turned = hj.TensorField.from_deformation(grid, rotations(3 * r * theta) @ F)
    np.testing.assert_allclose(turned.tensors, field.tensors, atol=1e-12)


@pytest.mark.slow
def test_growth_that_no_plane_can_hold_has_its_known_curvature():
    """A plate that grows by 2/(1 + r²) wants to be a sphere: K = 1, and 4πt·HKS = 1 + t/3 + t²/15 + … inside."""
    grid = hj.Grid.from_bounds(-1.2, 1.2, (49, 49))
    growth = 2 / (1 + np.sum(grid.nodes**2, axis=-1))
    F = growth[..., None, None] * rotations(2 * grid.nodes[..., 0])  # the rotation is of no account
    field = hj.TensorField.from_deformation(grid, F)
    middle = (24, 24)
    K = hj.gaussian_curvature(field)
    np.testing.assert_allclose(K[8:-8, 8:-8], 1, atol=0.02)
    t = 0.1
    signature = 4 * np.pi * t * hj.hks_spectrum_free(field, [t])[0][middle]
    # The grid's own error is about 0.04 h²/t, h = 0.1 in the metric: 0.004.
    assert float(signature) == pytest.approx(1 + t / 3 + t**2 / 15, abs=0.008)
    undone = hj.TensorField.from_deformation(grid, F / growth[..., None, None])
    assert np.abs(hj.gaussian_curvature(undone)).max() < 1e-9


def test_a_gradient_into_space_gives_the_metric_of_the_surface():
    grid = hj.Grid.from_bounds(-1, 1, (5, 6))
    x, y = np.moveaxis(grid.nodes, -1, 0)
    one, zero = np.ones_like(x), np.zeros_like(x)
    F = np.stack([np.stack([one, zero], -1), np.stack([zero, one], -1), np.stack([2 * x, y], -1)], -2)
    field = hj.TensorField.from_deformation(grid, F)
    np.testing.assert_allclose(field.tensors[..., 0, 1], 2 * x * y)
    np.testing.assert_allclose(field.tensors[..., 0, 0], 1 + 4 * x**2)


def test_gradients_of_deformations_under_transformations():
    grid = hj.Grid((4, 5))
    F = np.broadcast_to(np.array([[1.2, 0.3], [0.1, 0.9]]), (4, 5, 2, 2)).copy()

    def loss(F):
        return jnp.sum(jnp.cos(hj.TensorField.from_deformation(grid, F).tensors))

    found = jax.jit(jax.grad(loss))(jnp.asarray(F))
    step = 1e-6 * np.eye(1, 80, 7).reshape(F.shape)
    assert float(found.ravel()[7]) == pytest.approx(float(loss(F + step) - loss(F - step)) / 2e-6, rel=1e-6)
    C = F[0, 0].T @ F[0, 0]
    single = hj.TensorField.from_deformation(grid, F.astype(np.float32)).tensors
    assert single.dtype == np.float32
    np.testing.assert_allclose(single[0, 0], C, rtol=1e-6)


def test_bad_gradients_are_refused():
    grid, F = hj.Grid((4, 5)), np.broadcast_to(np.eye(2), (4, 5, 2, 2)).copy()
    with pytest.raises(ValueError, match=r"F: got shape \(4, 5, 1, 2\); expected .* = \(4, 5, 2, 2\)"):
        hj.TensorField.from_deformation(grid, F[:, :, :1])
    F[1, 2] = np.diag([1.0, -1.0])
    with pytest.raises(ValueError, match=r"F: 1 of 20 .*is -1 at node \(1, 2\)\); .*F\[\.\.\., i, j\] is ∂yᵢ/∂xⱼ"):
        hj.TensorField.from_deformation(grid, F)
    F[1, 2] = np.nan
    with pytest.raises(ValueError, match="FᵀF: 1 of 20 tensors are NaN"):
        hj.TensorField.from_deformation(grid, F)
    outside = np.ones((4, 5), bool)
    outside[:2] = False
    hj.TensorField.from_deformation(hj.Grid((4, 5), mask=outside), F)  # outside the mask nothing is asked


# ------------------------------------------------------------------------------------------------ indefinite tensors


def plate_with_a_hole(n=32, radius=0.3):
    """Kirsch's stress of a wide plate under unit tension along x, around a hole; and the mask of the plate."""
    grid = hj.Grid.from_bounds(-1, 1, (n, n))
    x, y = np.moveaxis(grid.nodes, -1, 0)
    r, a = np.hypot(x, y), np.arctan2(y, x)
    mask = r > radius
    q = (radius / np.where(mask, r, 1)) ** 2
    rr = (1 - q) / 2 + (1 - 4 * q + 3 * q**2) / 2 * np.cos(2 * a)
    tt = (1 + q) / 2 - (1 + 3 * q**2) / 2 * np.cos(2 * a)
    rt = -(1 + 2 * q - 3 * q**2) / 2 * np.sin(2 * a)
    Q = rotations(a)
    S = Q @ np.stack([np.stack([rr, rt], -1), np.stack([rt, tt], -1)], -2) @ np.swapaxes(Q, -1, -2)
    return grid, mask, np.where(mask[..., None, None], S, 0)


GRID, MASK, STRESS = plate_with_a_hole()


def test_the_maps_are_those_of_the_eigenvalues():
    grid = hj.Grid(GRID.shape, GRID.spacing, GRID.origin, MASK)
    values, vectors = np.linalg.eigh(STRESS[MASK])
    for how, number, mapped in (("exp", 2.0, np.exp(values / 2)), ("shift", 1.5, values + 1.5)):
        field = hj.TensorField.from_indefinite(grid, STRESS, how, number)
        expected = (vectors * mapped[:, None]) @ np.swapaxes(vectors, 1, 2)
        np.testing.assert_allclose(field.tensors[MASK], expected, atol=1e-12)
        volume = TensorVolume(STRESS, GRID.spacing, GRID.origin, MASK)
        np.testing.assert_allclose(positive_tensors(volume, how, number).tensors[MASK], expected, atol=1e-12)
    traced = jax.jit(lambda s: hj.TensorField.from_indefinite(grid, STRESS, "exp", s).tensors)(2.0)
    np.testing.assert_allclose(traced[MASK], hj.TensorField.from_indefinite(grid, STRESS, "exp", 2.0).tensors[MASK])


def test_to_first_order_the_curvature_of_elastic_stress_vanishes():
    """K = (div div S − ∇² tr S)/2s + O(s⁻²), and elastic stress without forces in the body has neither."""
    grid = hj.Grid.from_bounds((0.5, 0.5), (1.0, 1.0), (41, 41))  # beside the hole
    x, y = np.moveaxis(grid.nodes, -1, 0)
    of_airy = np.stack([np.stack([6 * x * y, -3 * x**2], -1), np.stack([-3 * x**2, 0 * x], -1)], -2)  # Airy's x y³ …
    trace = of_airy + np.stack([np.stack([x**2, 0 * x], -1), np.stack([0 * x, x**2], -1)], -2)
    inner = (slice(4, -4), slice(4, -4))
    for s in (1e3, 1e4):
        elastic = hj.gaussian_curvature(hj.TensorField.from_indefinite(grid, of_airy, "exp", s))[inner]
        assert np.abs(elastic).max() < 100 / s**2
        other = hj.gaussian_curvature(hj.TensorField.from_indefinite(grid, trace, "exp", s))[inner]
        # div div (x²I) − ∇² tr (x²I) = 2 − 4
        np.testing.assert_allclose(other, -1 / s, atol=100 / s**2)


def test_indefinite_tensors_are_refused_with_the_maps(tmp_path, capsys):
    grid = hj.Grid(GRID.shape, GRID.spacing, GRID.origin, MASK)
    with pytest.raises(ValueError, match="from_indefinite"):
        hj.TensorField(grid, STRESS)
    with unchecked(), pytest.raises(ValueError, match=r'"exp" \(exp.*"shift".*There is no default'):
        hj.TensorField.from_indefinite(grid, STRESS)
    with pytest.raises(ValueError, match=r"number: got None; how=.* requires the scale"):
        hj.TensorField.from_indefinite(grid, STRESS, "exp")
    least = np.linalg.eigvalsh(STRESS[MASK]).min()
    with pytest.raises(ValueError, match=rf"least eigenvalue is {least:g}; expected more than {-least:g}"):
        hj.TensorField.from_indefinite(grid, STRESS, "shift", 0.1)
    with pytest.raises(ValueError, match=r"the scale 0\.01 for .* the metric is singular in float64"):
        hj.TensorField.from_indefinite(grid, STRESS, "exp", 0.01)

    file, out = tmp_path / "stress.npz", tmp_path / "out"
    np.savez(file, tensors=STRESS, mask=MASK, spacing=GRID.spacing, origin=GRID.origin)
    arguments = ["hks", str(file), "-o", str(out), "-q", "-k", "5", "--times", "1"]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    for words in ("naturally indefinite", "exp(S/s) with a scale s", f"shift c > {-least:.3g}", "--positive"):
        assert words in error
    assert main(["info", str(file)]) == 0
    said = capsys.readouterr().out
    assert "--positive" in said
    assert "takes" not in said  # no k and t of tensors that are no metric
    assert main([*arguments, "--positive", "exp", "--metric", "tensor"]) == 2
    assert "such as exp:2e6" in capsys.readouterr().err
    assert main([*arguments, "--positive", "shift:0.5"]) == 2
    assert "--positive: got the shift 0.5 for tensors whose least eigenvalue" in capsys.readouterr().err
    assert main([*arguments, "--positive", "exp:2", "--repair", "clip"]) == 2
    assert "got both" in capsys.readouterr().err


@pytest.mark.slow
def test_stress_on_the_command_line(tmp_path):
    file, out = tmp_path / "stress.npz", tmp_path / "out"
    np.savez(file, tensors=STRESS, mask=MASK, spacing=GRID.spacing, origin=GRID.origin)
    arguments = ["hks", str(file), "-o", str(out), "-q", "-k", "5", "--times", "1", "--positive", "shift:1.5"]
    assert main(arguments) == 0
    grid = hj.Grid(GRID.shape, GRID.spacing, GRID.origin, MASK)
    pairs = hj.eigenpairs(hj.TensorField.from_indefinite(grid, STRESS, "shift", 1.5), 5, "mean")
    with np.load(out / "hks.npz") as read:
        np.testing.assert_allclose(read["hks"], hj.hks(pairs, [1.0], "flat"), rtol=1e-9)


def test_repairing_more_than_a_few_is_a_warning(tmp_path):
    volume = TensorVolume(STRESS, GRID.spacing, GRID.origin, MASK)
    count, of = int(find_invalid(volume).sum()), int(MASK.sum())
    assert count > 0.05 * of
    with pytest.warns(hj.AccuracyWarning, match=rf"repair: {count} of {of} tensors \({count / of:.0%}\).*exp\(S/s\)"):
        repair_tensors(volume, "clip")
    np.savez(tmp_path / "t.npz", tensors=np.where(MASK[..., None, None], STRESS, np.nan))
    with pytest.warns(hj.AccuracyWarning, match="repair"):
        read_tensors(tmp_path / "t.npz", repair="mask")
