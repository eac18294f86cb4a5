"""Valid files in unusual variants are read, or refused by a message that names the reason and a remedy."""

import gzip

import numpy as np
import pytest

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import read_mask, read_tensors

nib = pytest.importorskip("nibabel")
AFFINE = np.diag([2.0, 2.0, 3.0, 1.0])
D = 1e-3 * np.array([[1.5, 0.2, 0.1], [0.2, 0.8, 0.0], [0.1, 0.0, 0.6]])


def nifti(path, shape=(5, 4, 3), affine=AFFINE):
    """Write tensors D as a symmetric-matrix image."""
    image = nib.Nifti1Image(np.broadcast_to(D[np.tril_indices(3)], (*shape, 1, 6)), affine)
    image.header.set_intent(1005, (3,))
    nib.save(image, path)
    return path


# ------------------------------------------------------------------------------------------------------ images


@pytest.mark.parametrize("kind", [nib.Nifti1Image, nib.Nifti2Image])
def test_compression_is_known_by_the_content_not_the_name(tmp_path, kind):
    path = nifti(tmp_path / "t.nii")
    nib.save(kind.from_image(nib.load(path)), path)
    plain = path.read_bytes()
    expected = read_tensors(path)
    path.write_bytes(gzip.compress(plain))
    np.testing.assert_array_equal(read_tensors(path).tensors, expected.tensors)
    (tmp_path / "t.nii.gz").write_bytes(plain)
    np.testing.assert_array_equal(read_tensors(tmp_path / "t.nii.gz").affine, expected.affine)


def test_a_voxel_size_of_zero_is_told(tmp_path):
    path = nifti(tmp_path / "t.nii")
    content = bytearray(path.read_bytes())
    content[254:256] = (0).to_bytes(2, "little")  # sform_code; the qform remains
    content[252:254] = (1).to_bytes(2, "little")
    path.write_bytes(content)
    assert read_tensors(path).spacing == (2, 2, 3)
    content[84:88] = bytes(4)  # pixdim[2]
    path.write_bytes(content)
    with pytest.warns(UserWarning, match="voxel size 0 along y and no sform; the size 1 is assumed. Correct"):
        assert read_tensors(path).spacing == (2, 1, 3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_shear_in_nrrd_is_told(tmp_path, dimension):
    nrrd = pytest.importorskip("nrrd")
    directions = np.eye(dimension)
    directions[1, :2] = np.sin(np.pi / 6), np.cos(np.pi / 6)
    count = dimension * (dimension + 1) // 2
    data = np.broadcast_to(np.eye(dimension)[np.triu_indices(dimension)], (*(4,) * dimension, count))
    header = {
        "space dimension": dimension,
        "space directions": [[np.nan] * dimension, *directions.tolist()],
        "kinds": [f"{dimension}D-symmetric-matrix", *["space"] * dimension],
        "measurement frame": np.eye(dimension),
    }
    nrrd.write(str(tmp_path / "t.nrrd"), np.moveaxis(data, -1, 0), header, index_order="F")
    notes = " ".join(read_tensors(tmp_path / "t.nrrd").notes)
    assert "the voxel axes are not orthogonal (two meet at 60°), and the shear is ignored" in notes


@pytest.mark.parametrize("high", [255, 1000, np.float32(1 / 255) * 254.99])
def test_masks_of_zero_and_another_number(tmp_path, high):
    mask = np.indices((5, 4, 3)).sum(axis=0) % 3 > 0
    values = np.where(mask, high, 0)
    nib.save(nib.Nifti1Image(values.astype(np.float32), AFFINE), tmp_path / "m.nii")
    np.save(tmp_path / "m.npy", values)
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(D, (5, 4, 3, 3, 3)), mask=values)
    for read in (read_mask, lambda path: read_tensors(path).mask):
        for name in ("m.nii", "m.npy") if read is read_mask else ("t.npz",):
            with pytest.warns(UserWarning, match=f"{name}.*the values are 0 and {high:g}; {high:g} is read as inside"):
                np.testing.assert_array_equal(read(tmp_path / name), mask)
    for wrong in (np.where(mask, 2 * high, high), -values, values / (2 * high), values + np.indices(mask.shape)[0]):
        np.save(tmp_path / "m.npy", wrong)
        with pytest.raises(ValueError, match=r"m\.npy: got dtype .* with values other than 0 and 1"):
            read_mask(tmp_path / "m.npy")


def test_tables_of_numbers_with_a_byte_order_mark(tmp_path):
    directions = np.concatenate([np.eye(3), (np.eye(3) + np.roll(np.eye(3), 1, axis=0)) / np.sqrt(2)])
    b = np.repeat([0.0, 1000.0], [1, 6])
    directions = np.concatenate([np.zeros((1, 3)), directions])
    signal = np.exp(-b * np.einsum("na,ab,nb->n", directions, D, directions))
    images = np.broadcast_to(1000 * signal, (4, 3, 2, 7))
    nib.save(nib.Nifti1Image(images, np.diag([-2.0, 2, 2, 1])), tmp_path / "d.nii")
    for name, table in (("bval", b[None]), ("bvec", directions.T)):
        np.savetxt(tmp_path / name, table, encoding="utf-8-sig")
        assert (tmp_path / name).read_bytes().startswith(b"\xef\xbb\xbf")
    volume = hj.io.fit_dwi(*(tmp_path / name for name in ("d.nii", "bval", "bvec")), np.ones((4, 3, 2), bool))
    np.testing.assert_allclose(volume.tensors[0, 0, 0], D, atol=1e-8)


def test_voxels_without_an_element_are_counted(tmp_path, capsys):
    mask = np.zeros((7, 4, 3), bool)
    mask[:4], mask[6, 3, 2] = True, True
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(np.eye(3), (7, 4, 3, 3, 3)), mask=mask)
    assert main(["hks", str(tmp_path / "t.npz"), "-o", str(tmp_path / "out"), "-k", "4", "--times", "1"]) == 0
    assert "1 voxels of the mask are left out, because they belong to no element" in capsys.readouterr().err


# ---------------------------------------------------------------------------------------------------- surfaces


def test_two_point_sets_in_gifti_are_named(tmp_path):
    triangle = nib.gifti.GiftiDataArray(np.array([[0, 1, 2]], np.int32), "NIFTI_INTENT_TRIANGLE")
    points = [
        nib.gifti.GiftiDataArray(
            np.eye(3, dtype=np.float32), "NIFTI_INTENT_POINTSET", meta={"AnatomicalStructureSecondary": name}
        )
        for name in ("GrayWhite", "Pial")
    ]
    nib.save(nib.gifti.GiftiImage(darrays=[*points, triangle]), tmp_path / "s.surf.gii")
    with pytest.raises(ValueError, match=r"gii: got 2 sets of points \(GrayWhite, Pial\); expected one. Write each"):
        hj.io.read_mesh(tmp_path / "s.surf.gii")


def test_a_surface_that_leaves_the_volume_is_told_in_options(tmp_path, capsys):
    sphere = hj.examples.sphere_mesh(2)
    volume = nifti(tmp_path / "t.nii", affine=nib.affines.from_matvec(AFFINE[:3, :3], [5, 0, 0]))
    path = hj.io.save(tmp_path / "s.ply", np.zeros(len(sphere.vertices)), sphere)
    command = ["hks", str(path), "--tensors", str(volume), "-o", str(tmp_path / "out")]
    assert main([*command, "--metric", "inverse"]) == 2
    said = capsys.readouterr().err
    assert "Pass a larger --mask, or pass --inside with the vertices inside the mask" in said
    assert "in_space" not in said
