"""The command line on files: what is in them, other formats, and scans to signatures."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from matplotlib.image import imread

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.cli.outputs import write_outputs
from hks_jax.cli.progress import Progress
from hks_jax.io import TensorVolume, read_tensors, save_tensors
from hks_jax.io.formats import format_of
from hks_jax.io.result import Result
from hks_jax.io.volume import digest
from hks_jax.naming import argument, named_as_options, with_option

SHAPE = (14, 12, 5)
AFFINE = np.array([[0, -2.0, 0, 5], [2.0, 0, 0, -3], [0, 0, -3.0, 1], [0, 0, 0, 1]])
D = 1e-3 * np.array([[1.5, 0.2, 0.1], [0.2, 0.8, 0.0], [0.1, 0.0, 0.6]])


def disc():
    i, j, _ = (a / (n - 1) - 0.5 for a, n in zip(np.indices(SHAPE), SHAPE, strict=True))
    return i**2 + j**2 < 0.24


@pytest.fixture
def tensors(tmp_path):
    field = np.where(disc()[..., None, None], D * (1 + 0.1 * np.indices(SHAPE)[0][..., None, None]), 0)
    return save_tensors(
        tmp_path / "t.nii.gz", TensorVolume(field, (2.0, 2.0, 3.0), (0.0,) * 3, affine=AFFINE, length_unit="mm")
    )


@pytest.fixture
def scan(tmp_path):
    """A noise-free scan of the tensor D in the disc, but for one voxel that no diffusion explains."""
    directions = np.random.default_rng(0).normal(size=(13, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    b = np.array([0.0] + [1000.0] * 12)
    signal = 1000 * np.exp(-b * np.einsum("na,ab,nb->n", directions, D, directions))
    images = np.where(disc()[..., None], signal, 5.0)
    impossible = np.diag([-5e-4, 8e-4, 8e-4])
    images[7, 6, 3] = 1000 * np.exp(-b * np.einsum("na,ab,nb->n", directions, impossible, directions))
    nib.save(nib.Nifti1Image(images, AFFINE), tmp_path / "d.nii.gz")
    nib.save(nib.Nifti1Image(disc().astype(np.uint8), AFFINE), tmp_path / "m.nii.gz")
    np.savetxt(tmp_path / "b", b[None])
    np.savetxt(tmp_path / "g", (directions * [-1 if np.linalg.det(AFFINE) > 0 else 1, 1, 1]).T)
    return [str(tmp_path / "d.nii.gz"), "--bval", str(tmp_path / "b"), "--bvec", str(tmp_path / "g")]


def error_of(capsys, arguments):
    assert main(arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    errors = [line for line in lines if "error: " in line]
    assert len(errors) == 1
    assert "Traceback" not in "".join(lines)
    return errors[0]


@pytest.mark.slow
def test_a_scan_to_pictures_by_one_command(scan, tmp_path, capsys):
    out, mask = tmp_path / "out", str(tmp_path / "m.nii.gz")
    arguments = ["--mask", mask, "--slice", "z=3", "--metric", "inverse", "-k", "20", "--times", "2e4", "4e4"]
    assert main(["info", *scan, *arguments[:4]]) == 0
    assert "1 tensors are not positive definite: see --repair" in capsys.readouterr().out
    arguments += ["--repair", "nearest:1e-6"]
    assert main(["hks", *scan, "-o", str(out), "-q", *arguments]) == 0
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("warning: at 2 of 2 times, most nodes feel the boundary")
    assert sorted(file.name for file in out.iterdir()) == [
        "hks.json",
        "hks.nii.gz",
        "hks.npz",
        "hks.png",
        "report.json",
    ]
    report = json.loads((out / "report.json").read_text())
    assert report["input"]["order"] == "fit"
    assert report["input"]["notes"][0] == (
        "weighted least-squares fit to 13 of 13 images (1 at b = 0, 12 at b = 1000 s/mm²)"
    )
    repair = report["input"]["repair"]
    assert (repair["method"], repair["voxels"], repair["first"]) == ("nearest", 1, [[7, 6]])
    grid = hj.Grid(SHAPE[:2], 2.0, mask=disc()[..., 0])
    field = hj.TensorField.from_diffusion(grid, np.broadcast_to(D[:2, :2], (*SHAPE[:2], 2, 2)), "inverse")
    expected = hj.hks(hj.eigenpairs(field, 20, "mean"), [2e4, 4e4], "flat")
    with np.load(out / "hks.npz") as read:
        np.testing.assert_allclose(read["hks"], expected, rtol=1e-4)


def test_options_of_scans_and_tensors_do_not_mix(scan, tensors, tmp_path, capsys):
    out = ["-o", str(tmp_path / "out"), "--metric", "inverse"]
    assert "expected both for diffusion-weighted images" in error_of(capsys, ["hks", *scan[:3], *out])
    assert "--order: this option is for files of tensors" in error_of(capsys, ["hks", *scan, *out, "--order", "fsl"])
    assert "--b-max: this option is for diffusion-weighted" in error_of(
        capsys, ["hks", str(tensors), *out, "--b-max", "9"]
    )
    assert "--bval and --bvec" in error_of(capsys, ["hks", scan[0], *out])


# ---------------------------------------------------------------------------------------------------- info


def test_info_of_tensors(tensors, tmp_path, capsys):
    assert main(["info", str(tensors), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["format"], found["shape"], found["order"], found["frame"]) == (
        ".nii.gz",
        list(SHAPE),
        "nifti",
        "voxel",
    )
    assert found["inside"] == disc().sum()
    assert (found["components"], found["not_positive_definite"]) == (1, 0)
    assert any("with a zero tensor count as outside" in note for note in found["notes"])
    assert found["suits"]["inverse"]["k"] == 100  # what 'hks' takes for a volume
    values = np.linalg.eigvalsh(D)
    assert found["eigenvalues"]["least"] == pytest.approx(1.1 * values[0], rel=1e-5)
    assert found["eigenvalues"]["largest"] == pytest.approx(2.2 * values[-1], rel=1e-5)
    assert main(["info", str(tensors), "--slice", "z=1"]) == 0
    text = capsys.readouterr().out
    for words in (
        "tensors         14 × 12",
        "order, frame    nifti, voxel axes",
        "invalid         0",
        "metric inverse",
    ):
        assert words in text


def test_the_times_that_info_names_are_those_of_the_spectrum(tmp_path, capsys):
    """Against the eigenvalues of a flat rectangle, π²(i²/a² + j²/b²); Weyl's law leaves out a boundary term."""
    metric = np.broadcast_to(np.diag([2.0, 0.5]), (60, 80, 2, 2))
    np.savez(tmp_path / "t.npz", tensors=metric, spacing=[0.1, 0.2])
    assert main(["info", str(tmp_path / "t.npz"), "--json"]) == 0
    suits = json.loads(capsys.readouterr().out)["suits"]["tensor"]
    a, b = 59 * 0.1 * np.sqrt(2), 79 * 0.2 * np.sqrt(0.5)
    i, j = np.indices((100, 100))
    eigenvalues = np.sort((np.pi**2 * ((i / a) ** 2 + (j / b) ** 2)).ravel())
    assert suits["k"] == 200
    assert suits["least_time_of_k"] == pytest.approx(4.6 / eigenvalues[200], rel=0.2)  # where the tail is 1 %
    assert suits["time_by_size"] == pytest.approx(max(a, b) ** 2 / 4, rel=0.1)  # √t is half the longer side
    depth = (a + b - np.sqrt(a**2 + b**2)) / 4  # (a − 2d)(b − 2d) = ab/2, and exp(−d²/t) = 1/10
    assert suits["largest_time"] == pytest.approx(depth**2 / np.log(10), rel=0.1)
    assert suits["least_time"] == pytest.approx(6 * max(2 * 0.1**2, 0.5 * 0.2**2))
    for nodes, told in (80, False), (20, True):  # a sixteenth of the area, with the same spacing
        np.savez(tmp_path / "n.npz", tensors=metric[: 3 * nodes // 4, :nodes], spacing=[0.1, 0.2])
        assert main(["info", str(tmp_path / "n.npz")]) == 0
        (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("metric tensor"))
        assert line.endswith("No t satisfies both: the domain has too few nodes") == told
    needed = np.searchsorted(eigenvalues, 4.6 / suits["least_time"])
    assert suits["k_for_least_time"] == pytest.approx(needed, rel=0.2)


def test_what_info_names_of_a_masked_domain_is_of_its_pieces_and_of_the_mean(tmp_path, capsys):
    def suits(shape, corner):
        mask = np.zeros(shape, bool)
        mask[corner : corner + 30, corner : corner + 24] = mask[-4:, -4:] = True
        np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(np.eye(2), (*shape, 2, 2)), mask=mask)
        assert main(["info", str(tmp_path / "t.npz"), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["boundary"] == "mean"
        return found["suits"]["tensor"]

    assert suits((90, 80), 3) == (small := suits((45, 40), 1))
    assert small["time_by_size"] == pytest.approx((29 / 2) ** 2)
    grid = hj.Grid((30, 24))
    values = hj.eigenpairs(hj.TensorField(grid, np.broadcast_to(np.eye(2), (30, 24, 2, 2))), 200, "mean").eigenvalues
    assert small["time_by_size"] == pytest.approx(np.pi**2 / 4 / float(values[1]), rel=0.01)
    assert small["least_time_of_k"] == pytest.approx(4.6 / float(values[-1]), rel=0.25)


def test_info_of_invalid_tensors_and_meshes(tmp_path, capsys):
    field = np.broadcast_to(np.eye(2), (6, 6, 2, 2)).copy()
    field[2, 2] *= -1
    mask = np.ones((6, 6), bool)
    mask[3] = False
    np.savez(tmp_path / "t.npz", tensors=field, mask=mask)
    assert main(["info", str(tmp_path / "t.npz")]) == 0
    text = capsys.readouterr().out
    assert "1 tensors are not positive definite: see --repair" in text
    assert "components      2 (18, 12 nodes)" in text
    meshio = pytest.importorskip("meshio")
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    meshio.Mesh(square, [("triangle", np.array([[0, 1, 2], [0, 2, 3]]))]).write(tmp_path / "m.vtk")
    assert main(["info", str(tmp_path / "m.vtk")]) == 0
    text = capsys.readouterr().out
    for line in ("vertices          4", "triangles         2", "area              1", "boundary vertices 4"):
        assert f"{line}\n" in text
    ball = hj.examples.ball_mesh(3)
    meshio.Mesh(np.asarray(ball.vertices), [("tetra", ball.cells)]).write(tmp_path / "b.vtu")
    assert main(["info", str(tmp_path / "b.vtu")]) == 0
    text = capsys.readouterr().out
    volume = f"volume            {float(hj.assemble(ball).volume):.5g}"
    for line in ("vertices          147", "tetrahedra        540", "boundary vertices 92", volume):
        assert f"{line}\n" in text
    sphere = hj.examples.sphere_mesh(6)
    meshio.Mesh(np.asarray(sphere.vertices), [("triangle", np.asarray(sphere.faces))]).write(tmp_path / "s.vtu")
    assert main(["info", str(tmp_path / "s.vtu")]) == 0
    assert capsys.readouterr().out.endswith(", at which √t is half of the largest extent\n")  # it has no boundary
    assert "absent.nii: no such file" in error_of(capsys, ["info", str(tmp_path / "absent.nii")])


def test_info_of_results_says_what_they_are_and_how_to_draw_them(tensors, tmp_path, capsys):
    volume = read_tensors(tensors)
    report = {"settings": {"metric": "inverse", "normalisation": "flat"}}
    (tmp_path / "my out").mkdir()
    result = Result(volume, np.ones((8, *SHAPE)), np.arange(1.0, 9.0), report=report)
    result.save(tmp_path / "my out" / "hks", ".nii.gz")
    replace(result, values=np.ones((1, *SHAPE)), times=np.zeros(0), name="curvature").save(tmp_path / "K", "")
    for name in ("my out", "my out/hks.npz", "my out/hks.nii.gz"):
        assert main(["info", str(tmp_path / name)]) == 0
        text = capsys.readouterr().out
        assert "result          heat kernel signature\n" in text
        assert "times           1 s (√(Dt) = " in text
        assert "normalisation   flat\n" in text
        assert f"hks-jax plot '{tmp_path / 'my out' / 'hks.npz'}' -o picture.png\n" in text
    assert main(["info", str(tmp_path / "K.npz"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["result"], found["times"], found["to draw it"]) == (
        "Gaussian curvature",
        [],
        f"hks-jax plot {tmp_path / 'K.npz'} -o picture.png",
    )


# ------------------------------------------------------------------------------------------------------ meshes


@pytest.mark.slow
def test_signature_of_a_solid_with_tensors_at_its_vertices(tmp_path, capsys):
    meshio = pytest.importorskip("meshio")
    ball = hj.examples.ball_mesh(3)
    x = np.asarray(ball.vertices)
    tensors = np.eye(3) * (1.5 + x[:, 0])[:, None, None]
    meshio.Mesh(x, [("tetra", ball.cells)], point_data={"D": tensors.reshape(-1, 9)}).write(tmp_path / "b.vtu")
    command = [
        "hks",
        str(tmp_path / "b.vtu"),
        "-o",
        str(tmp_path / "out"),
        "-k",
        "30",
        "--times",
        "0.3",
        "0.6",
        "--quiet",
    ]
    expected = {}
    for name, more in (("of space", []), ("inverse", ["--array", "D", "--metric", "inverse"])):
        assert main([*command, *more]) == 0
        mesh = hj.TetMesh.from_tensors(x, ball.cells, tensors, "inverse") if more else ball
        expected[name] = hj.hks(hj.eigenpairs(mesh, 30), [0.3, 0.6], "flat")
        with np.load(tmp_path / "out" / "hks.npz") as found:
            np.testing.assert_allclose(found["hks"], expected[name], rtol=1e-8)
            np.testing.assert_array_equal(found["cells"], ball.cells)
    read = hj.io.read_mesh_arrays(tmp_path / "out" / "hks.vtu")
    np.testing.assert_allclose(list(read.values()), expected["inverse"], rtol=1e-8)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["input"]["tetrahedra"] == 540
    assert report["input"]["boundary_vertices"] == 92
    assert report["input"]["tensors"] == {"array": "D", "at": "vertices", "order": "matrix"}
    assert "suits" not in report["input"]  # times of the metric of space
    assert (tmp_path / "out" / "hks.png").stat().st_size > 5000
    capsys.readouterr()
    assert main(["info", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().out
    assert "--labels LABELS" in told
    assert "hks-jax plot" not in told  # draws grids only
    affine = np.diag([0.6, 0.6, 0.6, 1.0])
    affine[:3, 3] = -1.2
    np.savez(tmp_path / "t.npz", tensors=np.tile(1e-3 * np.eye(3), (5, 5, 5, 1, 1)), affine=affine)
    assert main([*command, "--tensors", str(tmp_path / "t.npz"), "--metric", "inverse", "--times", "300", "600"]) == 0
    found = json.loads((tmp_path / "out" / "report.json").read_text())["input"]["tensors"]
    assert (found["source"], found["sha256"]) == (str(tmp_path / "t.npz"), digest(tmp_path / "t.npz"))
    assert json.loads((tmp_path / "out" / "hks.vtu.json").read_text())["tensors_sha256"] == found["sha256"]

    of_tensors = ["--array", "D", "--metric", "inverse"]
    assert main([*command, *of_tensors, "--noise", "0.01"]) == 0
    bars = hj.uncertainty(
        lambda D: hj.hks(hj.eigenpairs(hj.TetMesh.from_tensors(x, ball.cells, D, "inverse"), 30), [0.3, 0.6], "flat"),
        tensors,
        hj.TensorNoise.relative(tensors, 0.01),
        method="resample",
    )
    with np.load(tmp_path / "out" / "hks.npz") as found:
        np.testing.assert_allclose(found["deviation"], bars.deviation, rtol=1e-6)

    def refused(message, *more):
        assert main([*command, *more]) == 2
        assert message in capsys.readouterr().err

    refused("--noise: this option needs tensors; saved", "--noise", "0.1")
    refused("--noise: got 'roughness'; expected a number", *of_tensors, "--noise", "roughness")
    refused("--metric: this option needs tensors, but without --array", "--metric", "tensor")
    refused("--interpolation: this option needs tensors", "--interpolation", "log-euclidean")
    refused("--metric: the tensors of the mesh need a metric", "--array", "D")
    refused(
        "--array: got 'E'; expected one of the arrays at the vertices: D; at the cells: none",
        "--array",
        "E",
        "--metric",
        "tensor",
    )
    refused("--slice: this option is for tensors on a grid; leave it out for a mesh", "--slice", "z=1")
    refused("--boundary: got 'mirror'; expected neumann, dirichlet, mean", "--boundary", "mirror")
    refused("--array: got 'D' with 9 components", "--array", "D", "--metric", "tensor", "--order", "vtk")


def test_signature_of_a_surface_without_some_vertices(tmp_path, capsys):
    meshio = pytest.importorskip("meshio")
    sphere = hj.examples.sphere_mesh(3)
    meshio.Mesh(np.asarray(sphere.vertices), [("triangle", sphere.faces)]).write(tmp_path / "s.vtk")
    inside = np.asarray(sphere.vertices)[:, 2] > -0.4
    lines = ["#!ascii label", str(inside.sum()), *(f"{number} 0 0 0 0" for number in np.flatnonzero(inside))]
    (tmp_path / "inside.label").write_text("\n".join(lines) + "\n")
    cap = hj.SurfaceMesh(sphere.vertices, sphere.faces, mask=inside)
    expected = hj.hks(hj.eigenpairs(cap, 12, "mean"), [0.5], "flat")
    more = ["--inside", str(tmp_path / "inside.label"), "--boundary", "mean", "-k", "12", "--times", "0.5", "-q"]
    assert main(["hks", str(tmp_path / "s.vtk"), "-o", str(tmp_path / "out"), *more]) == 0
    with np.load(tmp_path / "out" / "hks.npz") as found:
        np.testing.assert_allclose(found["hks"], expected, rtol=1e-5)
    picture = imread(tmp_path / "out" / "hks.png")[..., :3]
    assert np.ptp(picture[:, : picture.shape[1] // 2], axis=-1).max() > 0.3  # the surface has colours
    np.testing.assert_allclose(hj.io.Result.read(tmp_path / "out").values, expected, rtol=1e-5)
    np.save(tmp_path / "none.npy", np.zeros(len(inside), bool))
    for words, text in (
        (["--inside", str(tmp_path / "none.npy")], "--inside: 0 of 92 vertices are inside"),
        ([str(tmp_path / "s.vtk")], "FILE: got 2 files; expected one mesh"),
    ):
        assert main(["hks", str(tmp_path / "s.vtk"), *words, "-o", str(tmp_path / "out"), "-q"]) == 2
        assert text in capsys.readouterr().err
    np.save(tmp_path / "labels.npy", 7 + (np.asarray(sphere.vertices)[:, 0] > 0))
    assert main(["explore", str(tmp_path / "out"), "--labels", str(tmp_path / "labels.npy"), "-q"]) == 0


@pytest.mark.parametrize("suffix", ["label", "npy"])
def test_a_mask_has_the_numbering_of_the_file_before_cleaning(tmp_path, capsys, suffix):
    """A vertex without a face is removed first, so that all others have another number than in the file."""
    sphere = hj.examples.sphere_mesh(3)
    vertices = np.concatenate([[[5.0, 5, 5]], sphere.vertices])
    inside = vertices[:, 2] > -0.4
    path, mask, out = tmp_path / "s.off", tmp_path / f"inside.{suffix}", tmp_path / "out"
    rows = [" ".join(map(repr, row.tolist())) for row in vertices] + [f"3 {a} {b} {c}" for a, b, c in sphere.faces + 1]
    path.write_text("\n".join([f"OFF\n{len(vertices)} {len(sphere.faces)} 0", *rows]) + "\n")
    if suffix == "npy":
        np.save(mask, inside)
    else:
        lines = ["#!ascii label", str(inside.sum()), *(f"{number} 0 0 0 0" for number in np.flatnonzero(inside))]
        mask.write_text("\n".join(lines) + "\n")
    cap = hj.SurfaceMesh(sphere.vertices, sphere.faces, mask=inside[1:])
    expected = hj.hks(hj.eigenpairs(cap, 6), [0.5], "flat")
    more = ["-o", str(out), "-k", "6", "--times", "0.5", "-q", "--inside", str(mask)]
    assert main(["hks", str(path), *more, "--clean"]) == 0
    with np.load(out / "hks.npz") as found:
        np.testing.assert_allclose(found["hks"], expected, rtol=1e-4)
    np.save(tmp_path / "labels.npy", np.ones(len(vertices), int))  # of the vertices before
    assert main(["explore", str(out), "--labels", str(tmp_path / "labels.npy"), "-q"]) == 2
    assert "(93,); expected (92,), one for each vertex of the result. Cleaning" in capsys.readouterr().err


def test_a_mask_excludes_bad_triangles_of_a_file(tmp_path):
    """Outside the mask, a vertex is NaN and a triangle is degenerate; no cleaning is needed."""
    sphere = hj.examples.sphere_mesh(3)
    vertices, faces = np.array(sphere.vertices), np.array(sphere.faces)
    inside = vertices[:, 2] > -0.4
    low = np.argsort(vertices[:, 2])
    vertices[low[0]] = np.nan
    faces = np.concatenate([faces, [[low[1], low[1], low[2]]]])
    np.save(tmp_path / "inside.npy", inside)
    rows = [" ".join(map(repr, row.tolist())) for row in vertices] + [f"3 {a} {b} {c}" for a, b, c in faces]
    path, out = tmp_path / "s.off", tmp_path / "out"
    path.write_text("\n".join([f"OFF\n{len(vertices)} {len(faces)} 0", *rows]) + "\n")
    with pytest.raises(ValueError, match="vertices: 1 are NaN"):
        hj.io.read_mesh(path)
    cap = hj.SurfaceMesh(sphere.vertices, sphere.faces, mask=inside)
    np.testing.assert_array_equal(hj.io.read_mesh(path, mask=inside).faces, cap.faces)
    more = ["-o", str(out), "-k", "6", "--times", "0.5", "-q", "--inside", str(tmp_path / "inside.npy")]
    assert main(["hks", str(path), *more]) == 0
    with np.load(out / "hks.npz") as found:
        np.testing.assert_allclose(found["hks"], hj.hks(hj.eigenpairs(cap, 6), [0.5], "flat"), rtol=1e-4)


# ---------------------------------------------------------------------------------------------------- convert


def test_convert_to_every_format_and_back(tensors, tmp_path, capsys):
    original = read_tensors(tensors)
    for library, name in (("nrrd", "t.nrrd"), ("vtkmodules", "t.vti"), ("numpy", "t.npz"), ("nibabel", "t.nii")):
        try:
            __import__(library)
        except ImportError:
            continue
        assert main(["convert", str(tensors), str(tmp_path / name), "-q"]) == 0
        read = read_tensors(tmp_path / name)
        np.testing.assert_allclose(read.tensors, original.tensors, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(read.affine, original.affine)
        if name != "t.nii":
            np.testing.assert_array_equal(read.mask, disc())
    assert capsys.readouterr().err == ""
    assert main(["spectrum", str(tmp_path / "t.npz"), "-o", str(tmp_path / "out"), "-q"]) == 2
    assert "--metric: choose the metric of the diffusion tensors" in capsys.readouterr().err


def test_convert_orders_masks_and_repairs(tmp_path, capsys):
    field = np.broadcast_to(D, (*SHAPE, 3, 3)).copy()
    field[7, 6, 2] *= -1
    fsl = [field[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    nib.save(nib.Nifti1Image(np.stack(fsl, -1), AFFINE), tmp_path / "fsl.nii.gz")
    np.save(tmp_path / "m.npy", disc())
    arguments = ["convert", str(tmp_path / "fsl.nii.gz"), str(tmp_path / "t.nii.gz")]
    assert "does not declare their order" in error_of(capsys, arguments)
    arguments += ["--order", "fsl", "--mask", str(tmp_path / "m.npy")]
    assert main(arguments) == 0
    captured = capsys.readouterr()
    worst = f"worst eigenvalue {-np.linalg.eigvalsh(D).max():.3g}"
    assert f"warning: 1 tensors are not positive definite, {worst}; written unchanged, see --repair" in captured.err
    assert captured.out == f"{tmp_path / 't.nii.gz'}\n"
    assert main([*arguments, "--repair", "nearest", "-q", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["files"] == [str(tmp_path / "t.nii.gz")]
    assert (summary["order"], summary["repair"]["voxels"], summary["not_positive_definite"]) == ("fsl", 1, 0)
    image = nib.load(tmp_path / "t.nii.gz")
    assert int(image.header["intent_code"]) == 1005
    read = read_tensors(tmp_path / "t.nii.gz")
    sign = np.array([-1.0 if np.linalg.det(AFFINE) > 0 else 1.0, 1, 1])  # FSL's first axis
    np.testing.assert_allclose(read.tensors[7, 6, 2], D * np.outer(sign, sign), rtol=1e-6)
    assert not read.tensors[~disc()].any()
    record = json.loads(image.header.extensions[0].get_content())
    assert (record["order"], record["frame"], record["repair"]["voxels"]) == ("nifti", "voxel", 1)
    assert (record["source_order"], record["source_frame"]) == ("fsl", "fsl")


def test_convert_fits_scans_and_refuses_what_cannot_be(scan, tmp_path, capsys):
    target = tmp_path / "t.npz"
    assert (
        main(["convert", *scan, str(target), "--mask", str(tmp_path / "m.nii.gz"), "--repair", "nearest:1e-6", "-q"])
        == 0
    )
    np.testing.assert_allclose(
        read_tensors(target).tensors[disc()], np.broadcast_to(D, (disc().sum(), 3, 3)), rtol=1e-4, atol=1e-12
    )
    assert "expected a name that ends in .nii.gz" in error_of(capsys, ["convert", str(target), str(tmp_path / "t.mif")])
    assert "this input file would be replaced by the output" in error_of(capsys, ["convert", str(target), str(target)])
    before = sorted(tmp_path.iterdir())
    arguments = ["convert", str(target), str(tmp_path / "s.nii.gz"), "--slice", "z=9"]
    assert "--slice: index: got z = 9; expected 0 … 4" in error_of(capsys, arguments)
    arguments[-1] = "z=1"
    assert "NIfTI has no 2×2 tensors" in error_of(capsys, arguments)
    assert sorted(tmp_path.iterdir()) == before


def test_numpy_files_and_unsymmetric_matrices(tmp_path, capsys):
    field = np.broadcast_to(D, (*SHAPE, 3, 3)).copy()
    field[1, 2, 3, 0, 1] = 0
    np.save(tmp_path / "t.npy", field)
    assert main(["info", str(tmp_path / "t.npy"), "--spacing", "1", "2", "3"]) == 0
    text = capsys.readouterr().out
    assert "spacing         1 × 2 × 3" in text
    assert "1 tensors are not symmetric" in text
    error = error_of(capsys, ["convert", str(tmp_path / "t.npy"), str(tmp_path / "t.nii.gz")])
    assert "1 unsymmetric tensors, but this format stores only one half" in error


def test_volumes_without_an_element_and_of_eight_values(tmp_path, capsys):
    np.save(tmp_path / "t.npy", np.broadcast_to(D, (1, 1, 1, 3, 3)))
    assert main(["info", str(tmp_path / "t.npy"), "--spacing", "1", "1", "1"]) == 0
    text = capsys.readouterr().out
    assert "components      0: the domain is empty" in text
    assert "t ≥" not in text
    nib.save(nib.Nifti1Image(np.ones((3, 4, 5, 8)), np.eye(4)), tmp_path / "camino.nii.gz")
    assert "Camino writes an exit code and log S₀ before" in error_of(capsys, ["info", str(tmp_path / "camino.nii.gz")])


@pytest.mark.parametrize(("library", "suffix"), [("nrrd", ".nrrd"), ("vtkmodules", ".vti"), ("nibabel", ".nii.gz")])
def test_signatures_come_in_the_format_of_the_tensors(tensors, tmp_path, library, suffix):
    pytest.importorskip(library)
    volume = read_tensors(tensors)
    assert format_of(tmp_path / f"t{suffix}").image == suffix
    report = {"settings": {"k": 3, "metric": "inverse"}}
    volume = replace(volume, tensors=volume.tensors.astype(np.float32))
    influence = np.zeros((2, *SHAPE), np.float32)
    result = Result(
        volume, np.ones((2, *SHAPE)), np.array([1.0, 2.0]), np.arange(3.0), report, {"influence": influence}
    )
    out = tmp_path / "out"
    write_outputs(out, result, Progress(quiet=True), Path.touch, suffix)
    more = {".nii.gz": {"hks.json"}, ".vti": {"hks.pvd", "hks.pvd.json", "hks.0.vti", "hks.1.vti"}}.get(suffix, set())
    assert {file.name for file in out.iterdir()} == {f"hks{suffix}", "hks.npz", "hks.png", "report.json"} | more
    written = (out / f"hks{suffix}").read_bytes()
    assert suffix != ".nrrd" or (b"hks-jax " in written and b"influence" not in written)  # headers are text
    with np.load(out / "hks.npz") as read:
        record = json.loads(str(read["provenance"]))
        assert read["hks"].dtype == np.float32  # as the tensors are
    assert (record["command"], record["settings"], record["times"]) == (sys.argv, report["settings"], [1, 2])
    assert record["source"] == str(tensors)


def test_messages_name_arguments_in_python_and_options_on_the_command_line():
    def named():
        return [argument("array"), argument("frame", "fsl"), argument("b_max", 1500), argument("clean", True)]

    assert named() == ["array", 'frame="fsl"', "b_max=1500", "clean=True"]
    assert with_option("k: got 0; expected 1") == "k: got 0; expected 1"
    options = {"array": "--array", "frame": "--frame", "b_max": "--b-max", "clean": "--clean", "k": "-k"}
    with named_as_options(options | {"iterations": "--erode"}):
        assert named() == ["--array", "--frame fsl", "--b-max 1500", "--clean"]
        assert with_option("k: got 0; expected 1") == "-k: got 0; expected 1"
        assert with_option("iterations: got -1: too small") == "--erode: got -1: too small"
        assert with_option("file.nii: the frame") == "file.nii: the frame"
        assert argument("order") == "order"
    assert named()[0] == "array"


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        (["hks", "unit.npz", "--metric", "inverse", "--order", "nifti"], "--order: got 'nifti', but"),
        (["hks", "parts.npz"], "--mask: got 2 connected components (4, 4 nodes); expected one component. Pass "),
        (["hks", "parts.npz"], "Pass --components largest to keep the largest one, or --components all to keep all"),
        (["hks", "parts.npz", "--components", "largest", "-k", "0"], "-k: got 0; expected an integer"),
        (["hks", "parts.npz", "--erode", "-1"], "--erode: got -1"),
        (
            ["info", "six.nii.gz"],
            "and does not declare their order, which depends on the program. Pass --order, one of",
        ),
    ],
)
def test_remedies_of_the_library_are_options(tmp_path, capsys, monkeypatch, arguments, remedy):
    monkeypatch.chdir(tmp_path)
    tensors = np.tile(np.eye(2), (5, 2, 1, 1))
    np.savez("parts.npz", tensors=tensors, mask=np.arange(10).reshape(5, 2) // 2 != 2)
    np.savez("unit.npz", tensors=tensors, length_unit="mm")
    nib.save(nib.Nifti1Image(np.ones((3, 3, 3, 6)), np.eye(4)), "six.nii.gz")
    more = ["-o", "out"] * (arguments[0] == "hks")
    assert remedy in error_of(capsys, [*arguments, *more])


def test_help(capsys):
    for command in ("info", "convert", "hks"):
        assert main([command, "--help"]) == 0
        assert "examples:" in capsys.readouterr().out
