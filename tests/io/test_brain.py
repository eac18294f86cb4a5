"""A slice of a real brain, where its files lie beside the repository."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hks_jax as hj

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
TENSORS, MASK = DATA / "brain_tensor.nii.gz", DATA / "brain_mask.nii.gz"

pytestmark = pytest.mark.skipif(not TENSORS.exists(), reason=f"no brain data in {DATA}")

K = 60


@pytest.fixture(scope="module")
def plane():
    return hj.io.read_tensors(TENSORS, mask=MASK).slice("z", 14)


@pytest.fixture(scope="module")
def pairs(plane):
    field = hj.TensorField.from_diffusion(plane.grid(), plane.tensors.astype(np.float64), "inverse")
    return hj.eigenpairs(field, k=K)


def test_the_slice_is_one_component_of_positive_definite_tensors(plane):
    assert plane.shape == (128, 128)
    assert plane.order == "nifti"
    np.testing.assert_allclose(plane.spacing, 1.71875, rtol=1e-6)
    grid = plane.grid()  # raises for several components
    for metric in ("inverse", "tensor", "adjugate"):
        hj.TensorField.from_diffusion(grid, plane.tensors, metric)  # raises unless SPD
    assert np.linalg.eigvalsh(plane.tensors[plane.mask]).min() >= 0.9e-4  # mm²/s, as the data's description says


def test_all_eigenpairs_converge(pairs):
    values = np.asarray(pairs.eigenvalues)
    assert np.asarray(pairs.converged).all()
    assert values[0] == 0
    assert (np.diff(values) > 0).all()
    # Weyl's law for the area that the metric gives the slice: N(λ) ≈ area·λ/4π plus a boundary term, for Neumann.
    weyl = float(pairs.pencil.volume) * values[-1] / (4 * np.pi)
    assert 0.6 * K < weyl < K


def test_the_signature_is_positive_and_tends_to_the_reciprocal_area(plane, pairs):
    times = np.array([10.0, 30.0, 1000.0]) / float(pairs.eigenvalues[-1])
    times[-1] = 40 / float(pairs.eigenvalues[1])
    values = np.asarray(hj.hks(pairs, times))
    domain = np.isfinite(values[0])
    assert (values[:, domain] > 0).all()
    assert not domain[~plane.mask].any()
    assert domain.sum() > 0.99 * plane.mask.sum()
    np.testing.assert_allclose(values[-1, domain], 1 / float(pairs.pencil.volume), rtol=1e-10)
    # ∫ HKS = heat trace: the mass matrix's row sums weigh the nodes.
    weights = np.asarray(pairs.pencil.mass.to_scipy().sum(axis=1)).ravel()
    assert weights.size == domain.sum()
    np.testing.assert_allclose(values[:, domain] @ weights, hj.heat_trace(pairs, times), rtol=0.05)


def test_ventricles_hold_less_heat_than_the_tissue_around_them(plane, pairs):
    # Water diffuses about three times faster in the ventricles: heat leaves them sooner, and D⁻¹ makes them small.
    values = np.asarray(hj.hks(pairs, np.array([10.0]) / float(pairs.eigenvalues[-1])))[0]
    diffusivity = np.trace(plane.tensors, axis1=-2, axis2=-1) / 2
    ventricles = np.isfinite(values) & (diffusivity > 2e-3)
    deep = np.isfinite(values) & hj.io.erode(plane.mask, 8)
    tissue = deep & (diffusivity < 1.2e-3)
    assert ventricles.sum() > 50
    assert np.median(values[ventricles & deep]) < 0.8 * np.median(values[tissue])


@pytest.mark.slow
def test_the_mean_shows_the_tissue_up_to_the_rim(plane):
    field = hj.TensorField.from_diffusion(plane.grid(), plane.tensors.astype(np.float64), "inverse")
    diffusivity = np.median(np.trace(plane.tensors, axis1=-2, axis2=-1)[plane.mask] / 2)
    pairs = hj.eigenpairs(field, 160, "mean", "shift-invert")
    times = [14.0**2 / diffusivity]  # √(Dt) = 14 mm
    mean = np.asarray(hj.hks(pairs, times, "flat"))[0]
    natural = mean * (1 + np.asarray(hj.boundary_influence(pairs, times))[0])
    rim = pairs.space.domain & ~pairs.pencil.parts[1].space.free
    assert np.median(natural[rim]) > 2
    assert 0.9 < np.median(mean[rim]) < 1.3
    assert np.nanpercentile(natural, 98) > 2.2
    low, high = np.nanpercentile(mean, [2, 98])
    assert 0.7 < low < 0.85
    assert 1.1 < high < 1.3


def test_its_fibres_tell_mirrored_and_turned_tensors():
    """Of 27 000 anisotropic voxels, as they are, mirrored along each axis, and along the scanner's axes."""
    right = hj.io.read_tensors(TENSORS, mask=MASK)
    assert hj.io.questions(right) == ()
    for axis in range(3):
        signs = np.where(np.arange(3) == axis, -1, 1).astype(np.float32)
        mirrored = replace(right, tensors=right.tensors * np.outer(signs, signs))
        (question,) = hj.io.questions(mirrored)
        assert question.startswith("Wrong frame?")
        assert f"{'xyz'[axis]} axis reversed" in question or (axis == 0 and 'try frame="world"' in question)
    # Stored from the other side, the determinant is positive: FSL's axes are not the voxels' then.
    turned = replace(right, affine=right.affine @ np.diag([-1.0, 1, 1, 1]), mask=right.inside[::-1])
    signs = np.outer([-1, 1, 1], [-1, 1, 1]).astype(np.float32)
    (question,) = hj.io.questions(replace(turned, tensors=right.tensors[::-1]))
    assert 'try frame="fsl"' in question
    assert hj.io.questions(replace(turned, tensors=right.tensors[::-1] * signs)) == ()


def test_its_other_units_are_asked_about():
    right = hj.io.read_tensors(TENSORS, mask=MASK)
    assert "are in um2/s, the median is" in hj.io.questions(replace(right, tensors=right.tensors * 1e6))[0]
    assert "are in m2/s, the median is" in hj.io.questions(replace(right, tensors=right.tensors * 1e-6))[0]
