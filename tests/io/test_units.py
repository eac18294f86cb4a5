"""Units: of lengths and of diffusivities, read from headers, told, doubted and kept."""

import json
import re
from dataclasses import replace

import derivatives as tree
import nibabel as nib
import numpy as np
import pytest
from annotations import unchecked

from hks_jax.cli import main
from hks_jax.io import TensorVolume, questions, read_mask, read_tensors, save, save_tensors
from hks_jax.io.masks import read_labels
from hks_jax.io.units import b_value_question, millimetres, unit_in

SHAPE = (8, 7, 5)
D = 1e-3 * np.array([[1.2, 0.2, 0.1], [0.2, 0.6, 0.0], [0.1, 0.0, 0.3]])  # mm²/s; its mean diffusivity is 7e-4
NIFTI = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]


def write(path, unit, voxel, scale=1.0, dtype=np.float64):
    """Write the tensor D everywhere as NIfTI whose voxels have the size `voxel`, in a unit by nibabel's name."""
    components = np.broadcast_to(np.stack([D[i, j] for i, j in NIFTI]) * scale, (*SHAPE, 1, 6))
    image = nib.Nifti1Image(components.astype(dtype), np.diag([-voxel, voxel, voxel, 1.0]))
    image.header.set_intent("symmetric matrix", (3,))
    image.header.set_xyzt_units(unit)
    nib.save(image, path)
    return path


def info(capsys, *arguments):
    assert main(["info", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


# ---------------------------------------------------------------------------------------------------- lengths


@pytest.mark.parametrize(
    ("unit", "voxel", "expected"), [("micron", 150.0, 0.15), ("meter", 2e-3, 2.0), ("mm", 2.0, 2.0), ("unknown", 2, 2)]
)
def test_lengths_of_nifti_are_in_mm(tmp_path, capsys, unit, voxel, expected):
    read = read_tensors(write(tmp_path / "t.nii.gz", unit, voxel))
    np.testing.assert_allclose(read.spacing, [expected] * 3, rtol=1e-6)
    np.testing.assert_allclose(read.affine, np.diag([-expected, expected, expected, 1]), rtol=1e-6)
    assert read.length_unit == "mm"
    assert any(", which the file declares, to mm" in note for note in read.notes) == (unit in ("micron", "meter"))
    # What is written of it is in mm, and says so.
    for path in (save(tmp_path / "v.nii.gz", np.ones(SHAPE), read), save_tensors(tmp_path / "w.nii.gz", read)):
        header = nib.load(path).header
        assert header.get_xyzt_units()[0] == "mm"
        np.testing.assert_allclose(header.get_zooms()[:3], [expected] * 3, rtol=1e-6)
    # Times go with the square of lengths.
    same = info(capsys, write(tmp_path / "mm.nii.gz", "mm", expected))
    assert info(capsys, tmp_path / "t.nii.gz")["suits"]["inverse"] == pytest.approx(same["suits"]["inverse"], rel=1e-5)


def test_masks_and_labels_that_lost_the_unit_lie_where_the_tensors_do(tmp_path):
    read = read_tensors(write(tmp_path / "t.nii", "micron", 150.0))
    twice = replace(read, tensors=np.concatenate([read.tensors] * 2, axis=2))
    values = np.zeros(SHAPE, np.uint8)
    values[2:5] = 1
    for unit, voxel in (("unknown", 150.0), ("micron", 150.0), ("mm", 0.15)):  # as nibabel writes it, and right
        image = nib.Nifti1Image(values, np.diag([-voxel, voxel, voxel, 1.0]))
        image.header.set_xyzt_units(unit)
        nib.save(image, tmp_path / "m.nii")
        np.testing.assert_array_equal(read_mask(tmp_path / "m.nii", read.affine), values == 1)
        np.testing.assert_array_equal(read_labels(tmp_path / "m.nii", read), values)
        with pytest.raises(ValueError, match=r"with the image's affine; .* cropped or resampled without its affine"):
            read_labels(tmp_path / "m.nii", twice)
    image.header.set_xyzt_units("meter")
    nib.save(image, tmp_path / "m.nii")
    with pytest.raises(ValueError, match="the affine displaces this image"):
        read_mask(tmp_path / "m.nii", read.affine)


@pytest.mark.parametrize("axis", range(3))
def test_labels_in_two_dimensions_lie_in_the_plane_of_the_slice(tmp_path, axis):
    read = read_tensors(write(tmp_path / "t.nii", "mm", 2.0))
    plane, others = read.slice(axis, 3), [a for a in range(3) if a != axis]
    values = np.arange(np.prod(plane.shape)).reshape(plane.shape)
    affine = plane.affine[:, [*others, axis, 3]]
    nib.save(nib.Nifti1Image(values.astype(np.uint8), affine), tmp_path / "m.nii")
    np.testing.assert_array_equal(read_labels(tmp_path / "m.nii", plane), values)
    for on in (read.slice(axis, 2), read):
        with pytest.raises(ValueError, match="put the labels and the image on different voxels"):
            read_labels(tmp_path / "m.nii", on)
    nib.save(nib.Nifti1Image((values > 3).astype(np.uint8), affine), tmp_path / "m.nii")
    with pytest.raises(ValueError, match="the affine displaces this image"):
        read_mask(tmp_path / "m.nii", read.affine)


def test_six_images_in_micrometres(tmp_path):
    for i, j in NIFTI:
        image = nib.Nifti1Image(np.full(SHAPE, D[i, j]), np.diag([-150.0, 150.0, 150.0, 1.0]))
        image.header.set_xyzt_units("micron")
        nib.save(image, tmp_path / f"dt{'xyz'[i]}{'xyz'[j]}.nii")
    np.testing.assert_allclose(read_tensors(tmp_path / "dtxx.nii").spacing, [0.15] * 3, rtol=1e-6)


def test_a_unit_that_nifti_does_not_have_is_refused(tmp_path):
    image = nib.load(write(tmp_path / "t.nii", "mm", 2.0))
    image.header["xyzt_units"] = 5
    nib.save(image, tmp_path / "t2.nii")
    with pytest.raises(ValueError, match=r"t2\.nii: got the code 5 for the unit of length"):
        read_tensors(tmp_path / "t2.nii")


@pytest.mark.parametrize(("unit", "factor"), [("microns", 1e-3), ("m", 1e3), ("um", 1e-3), ("mm", 1.0), ("cm", 10.0)])
@pytest.mark.parametrize("placed", [True, False])
def test_lengths_of_nrrd_are_in_mm(tmp_path, unit, factor, placed):
    nrrd = pytest.importorskip("nrrd")
    tensors = np.broadcast_to(D[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]][:, None, None, None], (6, *SHAPE))
    if placed:
        header = {
            "space": "right-anterior-superior",
            "space units": [unit] * 3,
            "space directions": np.concatenate([np.full((1, 3), np.nan), 3 * np.eye(3)]),
            "space origin": np.array([1.0, 2.0, 3.0]),
        }
    else:
        header = {"spacings": [np.nan, 3.0, 3.0, 3.0], "units": ["", *[unit] * 3]}
    nrrd.write(str(tmp_path / "t.nrrd"), tensors.copy(), {**header, "kinds": ["3D-symmetric-matrix", *["space"] * 3]})
    read = read_tensors(tmp_path / "t.nrrd")
    np.testing.assert_allclose(read.spacing, [3 * factor] * 3)
    assert read.length_unit == "mm"
    assert (f"lengths converted from {unit}, which the file declares, to mm" in read.notes) == (unit != "mm")
    if placed:
        np.testing.assert_allclose(read.affine[:3, 3], factor * np.array([1, 2, 3]))
        nrrd.write(
            str(tmp_path / "m.nrrd"),
            np.ones(SHAPE, np.uint8),
            {**header, "space directions": 3 * np.eye(3)} | {"kinds": ["space"] * 3},
        )
        assert read_mask(tmp_path / "m.nrrd", read.affine).all()
        with pytest.raises(ValueError, match="got 'inches'; expected one of mm, cm, m, um, nm"):
            millimetres("t.nrrd: space units", "inches")
    again = read_tensors(save_tensors(tmp_path / "again.nrrd", read))
    assert (again.length_unit, again.spacing) == ("mm", pytest.approx(read.spacing))


def test_voxels_that_no_scan_has_are_asked_about(tmp_path):
    assert questions(read_tensors(write(tmp_path / "t.nii", "mm", 2.0))) == ()
    (question,) = questions(read_tensors(write(tmp_path / "t.nii", "meter", 2.0)))
    assert "Wrong unit of length? The voxel sizes are 2000 × 2000 × 2000 mm" in question
    assert "150 × 150 × 150 mm" in questions(read_tensors(write(tmp_path / "t.nii", "unknown", 150.0)))[0]


# ---------------------------------------------------------------------------------------------------- diffusivities

# What 7e-4 mm²/s is in each unit.
NUMBERS = [("m2/s", 1e-6), ("um2/s", 1e6), ("um2/ms", 1e3), ("cm2/s", 1e-2)]


@pytest.mark.parametrize(("unit", "scale"), NUMBERS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_wrong_unit_is_asked_about_and_can_be_told(tmp_path, unit, scale, dtype):
    path = write(tmp_path / "t.nii", "mm", 2.0, scale, dtype)
    (question,) = questions(read_tensors(path))
    assert f"Wrong unit? The median mean diffusivity is {7e-4 * scale:.3g} mm²/s" in question
    assert f'If the numbers are in {unit}, the median is 0.0007: try unit="{unit}"' in question
    told = read_tensors(path, unit=unit)
    np.testing.assert_allclose(told.tensors, np.broadcast_to(D, (*SHAPE, 3, 3)), rtol=1e-6)
    assert (told.unit, told.tensors.dtype) == ("mm²/s", dtype)
    assert questions(told) == ()
    # It is kept, and not converted twice.
    for name in ("a.nii.gz", "a.npz"):
        kept = read_tensors(save_tensors(tmp_path / name, told))
        assert (kept.unit, kept.length_unit) == ("mm²/s", "mm")
        with pytest.raises(ValueError, match=r"unit: .* declares its unit, .* in mm²/s now\. Leave this"):
            read_tensors(tmp_path / name, unit=unit)


@pytest.mark.parametrize(("unit", "scale"), [("mm2/s", 1.0), ("um2/ms", 1e-3), ("mm^2/s", 1.0)])
def test_the_unit_in_an_npz_has_the_name_that_the_argument_has(tmp_path, unit, scale):
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(D / scale, (*SHAPE, 3, 3)), unit=unit, length_unit="mm")
    read = read_tensors(tmp_path / "t.npz")
    np.testing.assert_allclose(read.tensors[0, 0, 0], D)
    assert read.unit == "mm²/s"
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(D, (*SHAPE, 3, 3)), unit="furlong")
    with pytest.raises(ValueError, match=r"t\.npz: unit: got 'furlong'; expected one of mm2/s, um2/ms"):
        read_tensors(tmp_path / "t.npz")


def test_nothing_is_asked_where_nothing_can_be_said(tmp_path):
    assert questions(read_tensors(write(tmp_path / "t.nii", "mm", 2.0))) == ()
    odd = questions(read_tensors(write(tmp_path / "t.nii", "mm", 2.0, 1e4)))
    assert "No usual unit explains" in odd[0]
    # Lengths without a unit: stress, a metric, anything.
    assert questions(TensorVolume(np.broadcast_to(np.eye(3), (*SHAPE, 3, 3)), (1.0,) * 3, (0.0,) * 3)) == ()
    with unchecked(), pytest.raises(ValueError, match="unit: got 'furlong'; expected one of mm2/s, um2/ms"):
        read_tensors(tmp_path / "t.nii", unit="furlong")


def test_info_says_units_and_asks(tmp_path, capsys):
    path = str(write(tmp_path / "t.nii.gz", "micron", 150.0))
    assert main(["info", path]) == 0
    text = capsys.readouterr().out
    assert "spacing         0.15 × 0.15 × 0.15 mm\n" in text
    assert "voxel sizes 150 × 150 × 150 converted from um, which the file declares, to mm\n" in text
    assert f"median {np.linalg.eigvalsh(D)[1]:.3g} mm²/s (assumed)\n" in text
    assert "diffusivity     0.0007 mm²/s (assumed), the median" in text
    assert re.search(r"metric inverse  t ≥ [\d.e-]+ s \(√\(Dt\) = [\d.]+ mm\)", text)

    path = str(write(tmp_path / "t.nii.gz", "mm", 2.0, 1e6))
    assert main(["info", path]) == 0
    text = capsys.readouterr().out
    assert "question        Wrong unit? The median mean diffusivity is 700 mm²/s" in text
    assert ": try --unit um2/s\n" in text
    assert "diffusivity     700 (unit not declared)" in text
    assert main(["info", path, "--unit", "um2/s"]) == 0
    text = capsys.readouterr().out
    assert "diffusivity     0.0007 mm²/s, the median" in text
    assert "question" not in text
    assert info(capsys, path)["questions"][0].endswith("try --unit um2/s")


def test_commands_warn_of_a_wrong_unit(tmp_path, capsys):
    path = str(write(tmp_path / "t.nii.gz", "mm", 2.0, 1e-6))
    assert main(["convert", path, str(tmp_path / "out.nii.gz"), "-q"]) == 0
    assert "warning: Wrong unit? The median mean diffusivity is 7e-10 mm²/s" in capsys.readouterr().err
    assert main(["convert", path, str(tmp_path / "out.nii.gz"), "-q", "--unit", "m2/s"]) == 0
    assert capsys.readouterr().err == ""
    np.testing.assert_allclose(read_tensors(tmp_path / "out.nii.gz").tensors[0, 0, 0], D, rtol=1e-6)


@pytest.mark.parametrize("option", [["--unit", "um2/s"], ["--bvec-frame", "world"]])
def test_a_mesh_has_none_of_these_options(tmp_path, capsys, option):
    assert main(["hks", str(tmp_path / "heart.vtu"), "-o", str(tmp_path / "out"), *option]) == 2
    assert f"{option[0]}: this option is for tensors on a grid; leave it out for a mesh" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("largest", "unit"), [(1e9, "m2/s"), (1.0, "um2/ms"), (3.0, "um2/ms"), (1000.0, None), (30.0, None), (6e4, None)]
)
def test_b_values_in_another_unit(largest, unit):
    question = b_value_question(largest, "mm2/s")
    assert (f'pass unit="{unit}"' in question) if unit else question == ""
    assert f'pass unit="{unit or "mm2/s"}"' in b_value_question(largest, "cm2/s" if unit else "um2/s")


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        *[("mm^2/s", "mm2/s"), ("µm²·ms⁻¹", "um2/ms"), ("um^2.s^-1", "um2/s"), ("m2 s-1", "m2/s"), ("CM^2/s", "cm2/s")],
        *[("s", None), ("10^-3 mm^2/s", None), ("", None), ("mm2/ms", None)],
    ],
)
def test_units_of_sidecars_are_understood_in_usual_spellings(text, unit):
    assert unit_in(text) == unit


def test_a_unit_that_is_asked_for_overrides_the_sidecar(tmp_path):
    path = tree.bep16(tmp_path, "01", scale=1e3, unit="um^2/ms")
    np.testing.assert_allclose(read_tensors(path).tensors, tree.tensors(), rtol=1e-6, atol=1e-12)
    assert (read_tensors(path).unit, read_tensors(path, unit="um2/ms").notes) == ("mm²/s", read_tensors(path).notes)
    assert "tensors multiplied by 0.001 to convert them from um2/ms, which the sidecar declares, to mm²/s" in (
        read_tensors(path).notes
    )
    other = read_tensors(path, unit="um2/s")
    np.testing.assert_allclose(other.tensors, 1e-3 * tree.tensors(), rtol=1e-6, atol=1e-15)
    assert "the unit of the tensors is um2/s, as asked; the sidecar declares 'um^2/ms'" in other.notes
    unknown = read_tensors(tree.bep16(tmp_path, "02", unit="10^-3 mm^2/s"))
    assert unknown.unit == ""
    assert any("the Units '10^-3 mm^2/s' of the sidecar are ignored" in note for note in unknown.notes)


@pytest.mark.parametrize("name", ["t.nii.gz", "t.nrrd"])
def test_an_unknown_unit_of_length_stays_unknown(tmp_path, name):
    """Tensors of NumPy's files, such as a metric, have no unit; with lengths in mm, another unit would be suggested."""
    if name.endswith(".nrrd"):
        pytest.importorskip("nrrd")
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    volume = TensorVolume(np.broadcast_to(1e3 * D, (*SHAPE, 3, 3)), (2.0,) * 3, (0.0,) * 3, affine=affine)
    read = read_tensors(save_tensors(tmp_path / name, volume))
    assert (read.length_unit, questions(read)) == ("", ())
    known = read_tensors(save_tensors(tmp_path / name, replace(volume, length_unit="mm")))
    assert known.length_unit == "mm"
    assert questions(known)[0].startswith("Wrong unit?")
    if name.endswith(".gz"):
        save(tmp_path / name, np.ones(SHAPE), volume)
        assert nib.load(tmp_path / name).header.get_xyzt_units()[0] == "unknown"
