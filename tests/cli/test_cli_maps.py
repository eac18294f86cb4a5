"""The commands modes and smooth write what the library computes, on voxels, slices, surfaces and tetrahedra."""

import csv
import json
import re
from xml.etree import ElementTree

import nibabel as nib
import numpy as np
import pytest
from fields import random_spd

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import TensorVolume, save_tensors

SHAPE = (8, 7, 5)
AFFINE = np.array([[0, -2.0, 0, 5], [2.0, 0, 0, -3], [0, 0, -3.0, 1], [0, 0, 0, 1]])
D = 1e-3 * np.array([[1.5, 0.2, 0.1], [0.2, 0.8, 0.0], [0.1, 0.0, 0.6]])
MASK = np.hypot(*(np.indices(SHAPE)[:2] - 3.5)) < 4.2


@pytest.fixture
def tensors(tmp_path):
    values = np.where(MASK[..., None, None], D * (1 + 0.1 * np.indices(SHAPE)[0][..., None, None]), 0)
    return str(
        save_tensors(
            tmp_path / "t.nii.gz", TensorVolume(values, (2.0, 2.0, 3.0), (0.0,) * 3, affine=AFFINE, length_unit="mm")
        )
    )


@pytest.fixture
def series(tmp_path):
    """Two maps of noise, unmeasured at one voxel of the mask and outside the mask."""
    values = np.random.default_rng(0).normal(size=(*SHAPE, 2))
    values[~MASK] = values[3, 3, 2] = np.nan
    nib.save(nib.Nifti1Image(values, AFFINE), tmp_path / "bold.nii.gz")
    return str(tmp_path / "bold.nii.gz"), np.moveaxis(values, -1, 0)


def rows(path):
    with open(path, encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream, delimiter="\t"))


def surface(path):
    mesh = hj.examples.sphere_mesh(2)
    meta = {"AnatomicalStructurePrimary": "CortexRight"}
    kinds = (("POINTSET", "FLOAT32", mesh.vertices), ("TRIANGLE", "INT32", mesh.faces))
    arrays = [
        nib.gifti.GiftiDataArray(np.asarray(x, d.lower()), f"NIFTI_INTENT_{kind}", f"NIFTI_TYPE_{d}", meta=meta)
        for kind, d, x in kinds
    ]
    nib.save(nib.gifti.GiftiImage(darrays=arrays), path)
    return mesh


def test_modes_and_coefficients_of_a_series_are_those_of_the_library(tensors, series, tmp_path, capsys):
    name, maps = series
    out = tmp_path / "out"
    assert main(["modes", tensors, "-o", str(out), "--operator", "fick", "-k", "12", "--map", name, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["settings"]["boundary"] == "neumann"
    assert (out / "modes.png").stat().st_size > 5000
    volume = hj.io.read_tensors(tensors)
    volume = volume.with_mask(MASK)
    field = hj.TensorField.from_diffusion(volume.grid("all"), volume.tensors, operator="fick")
    pairs = hj.eigenpairs(field, 12)
    image = nib.load(out / "modes.nii.gz")
    modes = np.moveaxis(image.get_fdata(), -1, 0)
    np.testing.assert_allclose(image.affine, AFFINE)
    np.testing.assert_array_equal(np.isnan(modes[0]), ~MASK)
    expected = np.asarray(pairs.eigenfunctions)
    sign = np.sign(np.nansum(modes * expected, axis=(1, 2, 3)))
    np.testing.assert_allclose(sign[:, None, None, None] * modes, expected, atol=1e-5)
    table, sidecar = rows(out / "modes.tsv"), json.loads((out / "modes.json").read_text())
    found = hj.energy(pairs, maps)
    np.testing.assert_allclose([float(row["eigenvalue"]) for row in table], pairs.eigenvalues, rtol=1e-6, atol=1e-18)
    assert table[0]["wavelength"] == "n/a"
    assert sidecar["Wavelengths"][0] is None
    assert sidecar["LengthUnits"] == "mm"
    np.testing.assert_allclose(sidecar["Wavelengths"][1:], found.wavelength[1:], rtol=1e-6)
    c = np.array([[float(row[f"map_{i}"]) for row in rows(out / "coefficients.tsv")] for i in (1, 2)])
    np.testing.assert_allclose(c * sign, hj.decompose(pairs, maps), rtol=1e-4, atol=1e-5)
    explained = [float(row["explained"]) for row in rows(out / "energies.tsv")]
    np.testing.assert_allclose(explained, np.asarray(found.explained).mean(axis=0), atol=1e-6)
    projected = np.moveaxis(nib.load(out / "reconstruction.nii.gz").get_fdata(), -1, 0)
    np.testing.assert_allclose(projected, hj.reconstruct(pairs, hj.decompose(pairs, maps)), atol=1e-4)


@pytest.mark.slow
def test_a_slice_reads_its_part_of_a_volume_of_maps_and_saved_pairs_serve(tensors, series, tmp_path):
    name, _ = series
    read = [tensors, "--slice", "z=3", "--operator", "fick", "-k", "8", "-q"]
    assert main(["hks", *read, "-o", str(tmp_path / "pairs"), "--save-pairs", "--boundary", "neumann"]) == 0
    saved = str(tmp_path / "pairs" / "pairs.npz")
    assert main(["modes", *read, "-o", str(tmp_path / "a"), "--map", name]) == 0
    assert main(["modes", saved, "-o", str(tmp_path / "b"), "--map", name, "-q"]) == 0
    first, second = (
        [abs(float(row["map_2"])) for row in rows(tmp_path / folder / "coefficients.tsv")] for folder in "ab"
    )
    np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-9)
    image = nib.load(tmp_path / "b" / "reconstruction.nii.gz")
    assert image.shape == (8, 7, 1, 2)
    assert np.isnan(image.get_fdata()).all(axis=-1).sum() == (~MASK[..., 3]).sum()


@pytest.mark.slow
def test_surfaces_and_tetrahedra(tmp_path, capsys):
    mesh = surface(tmp_path / "s.surf.gii")
    np.save(tmp_path / "x.npy", np.asarray(mesh.vertices)[:, 0])
    out = tmp_path / "out"
    assert main(["modes", str(tmp_path / "s.surf.gii"), "-o", str(out), "-k", "9", "-q"]) == 0
    modes = np.stack([array.data for array in nib.load(out / "modes.func.gii").darrays])
    assert modes.shape == (9, 42)
    assert json.loads((out / "modes.json").read_text())["LengthUnits"] == "mm"
    again = ["modes", str(tmp_path / "s.surf.gii"), "-o", str(tmp_path / "two"), "-k", "9", "-q", "--map"]
    assert main([*again, str(out / "modes.func.gii")]) == 0
    c = [[float(row[f"map_{i}"]) for i in range(1, 10)] for row in rows(tmp_path / "two" / "coefficients.tsv")]
    gram = np.abs(np.array(c).T @ np.array(c))
    np.testing.assert_allclose(gram, np.eye(9), atol=1e-5)
    assert main([*again, str(tmp_path / "x.npy")]) == 0
    assert not (tmp_path / "two" / "modes.nii.gz").exists()
    # The coordinate x is a mode of the sphere: the first three after the constant.
    assert float(rows(tmp_path / "two" / "energies.tsv")[3]["explained"]) > 0.99
    ball = hj.examples.ball_mesh(2)
    hj.io.save(tmp_path / "ball.vtu", np.zeros(len(ball.vertices)), ball)
    assert main(["modes", str(tmp_path / "ball.vtu"), "-o", str(tmp_path / "three"), "-k", "5", "-q"]) == 0
    arrays = hj.io.read_mesh_arrays(tmp_path / "three" / "modes.vtu")
    assert len(arrays) == 5
    assert not (tmp_path / "three" / "modes.func.gii").exists()
    assert all((tmp_path / folder / "modes.png").stat().st_size > 5000 for folder in ("out", "two", "three"))


def test_maps_that_are_refused(tensors, series, tmp_path, capsys):
    _, maps = series
    values = np.moveaxis(maps, 0, -1)
    mine, shifted = AFFINE.copy(), AFFINE.copy()
    shifted[0, 3] += 1
    nib.save(nib.Nifti1Image(values, shifted), tmp_path / "shifted.nii.gz")
    nib.save(nib.Nifti1Image(values[:-1], mine), tmp_path / "small.nii.gz")
    some = values.copy()
    some[4, 4, 1, 0] = np.nan
    nib.save(nib.Nifti1Image(some, mine), tmp_path / "some.nii.gz")
    np.save(tmp_path / "flat.npy", np.ones((3, 3)))
    surface(tmp_path / "s.surf.gii")
    out = tmp_path / "out"
    read = ["modes", tensors, "-o", str(out), "--operator", "fick", "-k", "5", "-q", "--map"]
    calls = {
        "shifted.nii.gz": "the affines put the maps and the image on different voxels.*The affines .*6.0.* and .*5.0",
        "small.nii.gz": r"got maps of shape \(7, 7, 5\) with the image's affine",
        "some.nii.gz": "--map: got 1 nodes with NaN in only some of 2 maps",
        "flat.npy": r"got maps of shape \(3, 3\); expected \(8, 7, 5\), or \(8, 7, 5, 'n'\)",
        "none.nii.gz": "none.nii.gz",
    }
    for file, message in calls.items():
        assert main([*read, str(tmp_path / file)]) == 2
        assert re.search(message, capsys.readouterr().err), file
    of_mesh = ["modes", str(tmp_path / "s.surf.gii"), "-o", str(out), "-k", "5", "-q", "--map"]
    assert main([*of_mesh, str(tmp_path / "flat.npy")]) == 2
    assert "expected one number for each of the 42 vertices" in capsys.readouterr().err
    assert main([*of_mesh, str(tmp_path / "s.surf.gii")]) == 2
    assert "got no arrays of values" in capsys.readouterr().err
    assert not out.exists()
    out.mkdir()
    np.save(out / "modes.npy", np.ones(SHAPE))
    assert main([*read, str(out / "modes.npy")]) == 2
    assert "modes.npy: this input file would be replaced by the output" in capsys.readouterr().err


@pytest.mark.slow
def test_a_surface_in_gives_a_surface_out(tmp_path):
    """FreeSurfer's surface and map in; values in GIFTI out, in the order of the vertices, with their times."""
    mesh = surface(tmp_path / "s.surf.gii")
    vertices = np.asarray(mesh.vertices)
    nib.freesurfer.write_geometry(str(tmp_path / "lh.white"), vertices, mesh.faces)
    thickness = 2 + vertices[:, 0] + 0.3 * vertices[:, 1] ** 2
    nib.freesurfer.write_morph_data(str(tmp_path / "lh.thickness"), thickness)
    folder, white = tmp_path / "out", str(tmp_path / "lh.white")
    assert main(["hks", white, "-o", str(folder), "-k", "9", "--times", "0.5", "1", "-q"]) == 0
    image = nib.load(folder / "hks.func.gii")
    with np.load(folder / "hks.npz") as found:
        np.testing.assert_allclose([array.data for array in image.darrays], found["hks"], rtol=1e-6)
    assert [array.meta["Name"] for array in image.darrays] == ["hks_0_t0.5", "hks_1_t1"]
    assert {array.data.dtype for array in image.darrays} == {np.dtype("float32")}
    assert json.loads(image.meta["provenance"])["settings"]["k"] == 9
    assert image.meta["AnatomicalStructurePrimary"] == "CortexLeft"
    assert hj.io.read_mesh(folder / "hks.vtu").faces.shape == mesh.faces.shape
    series = ElementTree.parse(folder / "hks.pvd").getroot().findall("Collection/DataSet")
    assert [float(each.get("timestep")) for each in series] == [0.5, 1]
    for each, array in zip(series, image.darrays, strict=True):
        values = hj.io.read_mesh_arrays(folder / each.get("file"))["hks"]
        np.testing.assert_allclose(values, array.data, rtol=1e-6)
    read = hj.io.read_maps(tmp_path / "lh.thickness", mesh)
    np.testing.assert_allclose(read, thickness[None], rtol=1e-6)
    np.testing.assert_allclose(hj.io.read_maps(folder / "hks.vtu", mesh), [a.data for a in image.darrays], rtol=1e-6)
    # Cleaning may number the vertices anew, and other formats have values themselves.
    assert main(["hks", white, "-o", str(folder), "-k", "9", "--times", "0.5", "-q", "--clean"]) == 0
    assert not (folder / "hks.func.gii").exists()
    assert not (folder / "hks.pvd").exists()  # for one time, and no files of an earlier series stay
    assert not (folder / "hks.0.vtu").exists()
    assert main(["modes", white, "-o", str(folder), "-k", "9", "--map", str(tmp_path / "lh.thickness"), "-q"]) == 0
    projected = nib.load(folder / "reconstruction.func.gii").darrays[0].data
    pairs = hj.eigenpairs(hj.SurfaceMesh(vertices.astype(np.float32).astype(np.float64), mesh.faces), 9)
    np.testing.assert_allclose(projected, hj.reconstruct(pairs, hj.decompose(pairs, thickness)), rtol=1e-5)
    content = (tmp_path / "lh.thickness").read_bytes()
    (tmp_path / "lh.thickness").write_bytes(content[:-8])
    with pytest.raises(ValueError, match="expected one number for each of the 42 vertices"):
        hj.io.read_maps(tmp_path / "lh.thickness", mesh)


def smoothed_on(path, mesh, f, *more):
    """Return the map that the command smooths, from the npz and from the image."""
    np.save(path / "f.npy", f)
    out = path / "out"
    options = ["--mesh", str(mesh), "--fwhm", "0.8", "-o", str(out), "-q", *more]
    assert main(["smooth", str(path / "f.npy"), *options]) == 0
    assert (out / "smoothed.png").stat().st_size > 5000
    with np.load(out / "smoothed.npz") as found:
        return found["smoothed"]


@pytest.mark.slow
def test_maps_are_smoothed_on_a_surface(tmp_path, rng, capsys):
    mesh = surface(tmp_path / "s.surf.gii")
    vertices = np.asarray(mesh.vertices).astype(np.float32).astype(np.float64)
    inside = vertices[:, 2] > -0.4
    np.save(tmp_path / "inside.npy", inside)
    f = rng.standard_normal((2, 42))
    found = smoothed_on(tmp_path, tmp_path / "s.surf.gii", f, "--inside", str(tmp_path / "inside.npy"))
    cap = hj.SurfaceMesh(vertices, mesh.faces, mask=inside)
    np.testing.assert_allclose(found, hj.smooth(cap, f, 0.8), atol=1e-12)
    image = nib.load(tmp_path / "out" / "smoothed.func.gii")
    assert image.meta["AnatomicalStructurePrimary"] == "CortexRight"
    maps = np.stack([array.data for array in image.darrays])
    np.testing.assert_allclose(maps, found, atol=1e-6)
    again = ["smooth", str(tmp_path / "f.npy"), "--fwhm", "0.8", "-o", str(tmp_path / "out"), "-q"]
    calls = {
        "--tensors: got no file; expected the diffusion tensors": [],
        "--boundary: got 'periodic'; expected neumann, dirichlet, mean": ["--boundary", "periodic"],
        "--slice: this option is for tensors on a grid": ["--slice", "z=1"],
        "--frame: this option is for tensors on a grid": ["--frame", "voxel"],
        "--array: got 'D'; expected one of the arrays": ["--array", "D"],
    }
    for message, options in calls.items():
        on = ["--mesh", str(tmp_path / "s.surf.gii")] * bool(options)
        assert main([*again, *on, *options]) == 2
        assert message in capsys.readouterr().err
    f[1, 7] = np.nan
    np.save(tmp_path / "f.npy", f)
    assert main([*again, "--mesh", str(tmp_path / "s.surf.gii")]) == 2
    assert "NaN or infinite values at 1 vertices inside the mask" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["neumann", "dirichlet"])
def test_maps_are_smoothed_by_tensors_on_tetrahedra(boundary, tmp_path, rng):
    import meshio

    ball = hj.examples.ball_mesh(2)
    D = 1e-3 * random_spd(rng, (len(ball.vertices), 1, 1))[:, 0, 0]
    whole = meshio.Mesh(np.asarray(ball.vertices), [("tetra", ball.cells)], point_data={"D": D.reshape(-1, 9)})
    meshio.write(tmp_path / "heart.vtu", whole)
    f = rng.standard_normal(len(ball.vertices))
    for operator, settings in (("fick", {"operator": "fick"}), ("laplace-beltrami", {"metric": "inverse"})):
        more = ["--array", "D", "--operator", operator, "--boundary", boundary]
        found = smoothed_on(tmp_path, tmp_path / "heart.vtu", f, *more)
        mesh = hj.TetMesh.from_tensors(ball.vertices, ball.cells, D, **settings)
        np.testing.assert_allclose(found, hj.smooth(mesh, f, 0.8, boundary), atol=1e-10)
        np.testing.assert_allclose(hj.io.read_maps(tmp_path / "out" / "smoothed.vtu", mesh), found[None], atol=1e-6)


@pytest.mark.slow
def test_maps_are_smoothed_as_by_the_library(tensors, tmp_path, capsys):
    f = np.random.default_rng(1).normal(size=(*SHAPE, 2))
    series = nib.Nifti1Image(f, AFFINE)
    series.header.set_xyzt_units("mm", "msec")
    series.header.set_zooms((*series.header.get_zooms()[:3], 2500))
    nib.save(series, tmp_path / "bold.nii.gz")
    out, name = tmp_path / "out", str(tmp_path / "bold.nii.gz")
    volume = hj.io.read_tensors(tensors).with_mask(MASK)
    command = ["smooth", name, "--tensors", tensors, "-o", str(out), "-q"]
    fick, beltrami, rim = {"operator": "fick"}, {"metric": "inverse"}, "dirichlet-rim"
    for settings, boundary in ((fick, "neumann"), (beltrami, "neumann"), (fick, rim)):
        operator = settings.get("operator", "laplace-beltrami")
        assert main([*command, "--fwhm", "6", "--operator", operator, "--boundary", boundary]) == 0
        found = np.moveaxis(nib.load(out / "smoothed.nii.gz").get_fdata(), -1, 0)
        field = hj.TensorField.from_diffusion(volume.grid("all"), volume.tensors, **settings)
        np.testing.assert_allclose(found, hj.smooth(field, np.moveaxis(f, -1, 0), 6.0, boundary), atol=1e-5)
        assert (out / "smoothed.png").stat().st_size > 5000
    header = nib.load(out / "smoothed.nii.gz").header
    assert (header.get_zooms()[3], header.get_xyzt_units()[1]) == (2.5, "sec")
    assert main([*command, "--fwhm", "2"]) == 2
    assert "--fwhm: got 2 on a grid with the spacing 3, which does not resolve it" in capsys.readouterr().err
    f[3, 3, 2, 1] = np.nan
    nib.save(nib.Nifti1Image(f, AFFINE), tmp_path / "bold.nii.gz")
    assert main([*command, "--fwhm", "6"]) == 2
    assert "got NaN or infinite values at 1 voxels inside the mask" in capsys.readouterr().err
    assert main(["smooth", name, name, "--tensors", tensors, "--fwhm", "6", "-o", str(out)]) == 2
    assert "expected one file of maps" in capsys.readouterr().err
    assert main(["smooth", name, "--tensors", str(out / "smoothed.nii.gz"), "--fwhm", "6", "-o", str(out)]) == 2
    assert "this input file would be replaced" in capsys.readouterr().err
