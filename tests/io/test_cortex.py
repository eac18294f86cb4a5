"""Surfaces in volumes: FreeSurfer's and GIFTI's coordinates, and a fibre that runs along both."""

import nibabel
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hks_jax as hj
from hks_jax.cli import main

FIBRE = np.array([0.6, 0.0, 0.8])
ALONG, ACROSS = 1.7e-3, 0.3e-3
TENSOR = ACROSS * np.eye(3) + (ALONG - ACROSS) * np.outer(FIBRE, FIBRE)


def oblique(handed):
    turn = Rotation.from_euler("zyx", [20, -35, 50], degrees=True).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = turn @ np.diag([handed * 1.5, 2.0, 2.5])
    affine[:3, 3] = [40.0, -25.0, 12.0]
    return affine


@pytest.fixture(params=[1, -1])
def volume(request, tmp_path):
    """One fibre through an oblique volume of either hand, as NIfTI: components along the voxel axes."""
    affine = oblique(request.param)
    turn = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    tensors = np.broadcast_to(turn.T @ TENSOR @ turn, (12, 11, 10, 3, 3))
    lengths = tuple(np.linalg.norm(affine[:3, :3], axis=0))
    whole = hj.io.TensorVolume(tensors, lengths, (0.0,) * 3, None, affine, length_unit="mm", unit="mm²/s")
    hj.io.save_tensors(tmp_path / "d.nii.gz", whole)
    return tmp_path / "d.nii.gz", affine


def square(affine):
    """A square through the middle of the volume, one of whose sides runs along the fibre."""
    side = np.linspace(-4, 4, 9)
    x, y = np.meshgrid(side, side, indexing="ij")
    middle = affine[:3, :3] @ [5.5, 5, 4.5] + affine[:3, 3]
    places = middle + x.reshape(-1, 1) * FIBRE + y.reshape(-1, 1) * np.array([0.8, 0.0, -0.6])
    a = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate([np.stack([a, a + 9, a + 1], -1), np.stack([a + 9, a + 10, a + 1], -1)])
    return places, faces


def freesurfer(path, places, faces, affine):
    """Write coordinates of FreeSurfer's own, as of an image with this affine."""
    header = nibabel.MGHImage(np.zeros((12, 11, 10), np.float32), affine).header
    own = nibabel.affines.apply_affine(header.get_vox2ras_tkr() @ np.linalg.inv(affine), places)
    info = {"head": np.array([2, 0, 20], np.int32), "valid": "1  # volume info valid", "filename": "orig.mgz"}
    info |= {"volume": np.array([12, 11, 10]), "voxelsize": header["delta"], "cras": header["Pxyz_c"]}
    info |= dict(zip(("xras", "yras", "zras"), header["Mdc"], strict=True))
    nibabel.freesurfer.write_geometry(path, own, faces, create_stamp="made for a test", volume_info=info)


def gifti(path, places, faces, affine):
    """Write coordinates of their own, with the transformation to those of the scanner."""
    own = (places - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T
    system = nibabel.gifti.GiftiCoordSystem(0, 1, affine)
    points = nibabel.gifti.GiftiDataArray(own.astype(np.float32), "NIFTI_INTENT_POINTSET", coordsys=system)
    triangles = nibabel.gifti.GiftiDataArray(faces.astype(np.int32), "NIFTI_INTENT_TRIANGLE")
    nibabel.save(nibabel.gifti.GiftiImage(darrays=[points, triangles]), path)


@pytest.mark.parametrize(("name", "write"), [("lh.white", freesurfer), ("lh.white.surf.gii", gifti)])
def test_a_fibre_on_a_surface_through_an_oblique_volume(tmp_path, volume, name, write):
    image, affine = volume
    places, faces = square(affine)
    write(tmp_path / name, places, faces, affine)
    mesh = hj.io.read_mesh(tmp_path / name, in_space=True)
    np.testing.assert_allclose(mesh.vertices, places, atol=1e-4)
    assert np.abs(np.asarray(hj.io.read_mesh(tmp_path / name).vertices) - places).max() > 5
    sampled = hj.io.sample_tensors(hj.io.read_tensors(image, frame="voxel"), mesh.vertices)
    np.testing.assert_allclose(sampled, np.broadcast_to(TENSOR, sampled.shape), atol=1e-9)
    # A square of 8 mm: along the fibre the lowest eigenvalue is π²D/64.
    metric = hj.SurfaceMesh.from_tensors(mesh.vertices, mesh.faces, sampled, "inverse")
    lowest = hj.eigenpairs(metric, 2, solver="dense", multiplet="drop").eigenvalues[1]
    np.testing.assert_allclose(lowest, np.pi**2 * ACROSS / 64, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("volume", [1, -1], indirect=True)
def test_the_command_line_and_what_is_refused(tmp_path, volume, capsys):
    image, affine = volume
    places, faces = square(affine)
    freesurfer(tmp_path / "lh.white", places, faces, affine)
    options = ["--metric", "inverse", "-k", "6", "--times", "5000", "-q", "--frame", "voxel"]
    command = ["hks", str(tmp_path / "lh.white"), "--tensors", str(image), *options]
    assert main([*command, "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "hks.vtu").exists()
    assert main([*command, "-o", str(tmp_path / "out"), "--noise", "0.05"]) == 0
    with np.load(tmp_path / "out" / "hks.npz") as found:
        assert found["noise_maps"].shape == (6, 1, 81)
        relative = found["deviation"] / found["hks"]
    assert ((relative > 0) & (relative < 0.05)).all()
    assert main([*command, "-o", str(tmp_path / "no"), "--array", "D"]) != 0
    assert "--tensors, --array: got both" in capsys.readouterr().err
    tensors = hj.io.read_tensors(image, frame="voxel")
    with pytest.raises(ValueError, match=r"points: got 81 of 81 points without a voxel inside .* in_space=True"):
        hj.io.sample_tensors(tensors, hj.io.read_mesh(tmp_path / "lh.white").vertices + 100)
    nibabel.freesurfer.write_geometry(tmp_path / "rh.white", places, faces, create_stamp="made for a test")
    with pytest.raises(ValueError, match="does not state the position of its volume"):
        hj.io.read_mesh(tmp_path / "rh.white", in_space=True)


@pytest.mark.slow
def test_a_spot_on_a_surface_is_smoothed_along_the_fibre(tmp_path, volume):
    """The mean over the surface's axes of the squared FWHM is the square of the number given, in mm."""
    image, affine = volume
    places, faces = square(affine)
    freesurfer(tmp_path / "lh.white", places, faces, affine)
    np.save(tmp_path / "spot.npy", np.arange(81.0) == 40)
    command = ["smooth", str(tmp_path / "spot.npy"), "--mesh", str(tmp_path / "lh.white"), "--tensors", str(image)]
    assert main([*command, "--frame", "voxel", "--fwhm", "2", "-o", str(tmp_path / "out"), "-q"]) == 0
    spread = nibabel.load(tmp_path / "out" / "smoothed.func.gii").darrays[0].data.astype(np.float64)
    mesh = hj.SurfaceMesh.from_tensors(places, faces, np.tile(TENSOR, (81, 1, 1)), operator="fick")
    np.testing.assert_allclose(spread, hj.smooth(mesh, np.arange(81.0) == 40, 2.0), atol=1e-4)
    weights = spread * np.asarray(hj.assemble(mesh, mass="lumped").mass.diagonal())
    away = places - places[40]
    covariance = np.einsum("v,vx,vy->xy", weights / weights.sum(), away, away)
    _, sizes, _ = np.linalg.svd(covariance)
    assert np.sqrt(8 * np.log(2) * sizes[:2].sum() / 2) == pytest.approx(2, rel=0.03)
    frame = np.linalg.svd(away, full_matrices=False)[2][:2]
    tangential = frame @ TENSOR @ frame.T
    shape = frame @ covariance @ frame.T
    np.testing.assert_allclose(shape / np.trace(shape), tangential / np.trace(tangential), atol=0.03)
