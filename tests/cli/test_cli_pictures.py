"""The commands spectrum, curvature and plot, end to end."""

import csv
import json
from dataclasses import replace

import nibabel as nib
import numpy as np
import pytest
from matplotlib.image import imread

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.cli import outputs as outputs_module
from hks_jax.io import Result, TensorVolume, save, save_tensors

SHAPE = (14, 12)


def error_of(capsys, code, *words):
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert " error: " in lines[0]
    for word in words:
        assert word in lines[0]
    return code


def png_size(path):
    data = path.read_bytes()
    assert data[:4] == b"\x89PNG"
    return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])


@pytest.fixture
def sphere(tmp_path):
    """The unit sphere in its stereographic chart, K = 1, in a mask without a corner."""
    field = hj.examples.sphere_field(SHAPE[0], 0.6)
    mask = np.ones((SHAPE[0],) * 2, bool)
    mask[:2, :2] = False
    h = field.grid.spacing
    np.savez(tmp_path / "sphere.npz", tensors=field.tensors, spacing=h, origin=[-0.6, -0.6], mask=mask)
    return tmp_path / "sphere.npz"


# --- spectrum -----------------------------------------------------------------------------------------------


def test_spectrum_end_to_end(sphere, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["spectrum", str(sphere), "-o", str(out), "-k", "20", "-q", "--json"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    summary = json.loads(captured.out)
    names = ["report.json", "spectrum.csv", "spectrum.npz", "spectrum.png"]
    assert summary["files"] == [str(out / name) for name in names]
    with np.load(sphere) as read:
        field = hj.TensorField(hj.Grid((14, 14), read["spacing"], read["origin"], read["mask"]), read["tensors"])
    expected = np.asarray(hj.eigenpairs(field, 20).eigenvalues)
    np.testing.assert_allclose(summary["eigenvalues"], expected, rtol=1e-9, atol=1e-12)
    with open(out / "spectrum.csv", newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["index"] for row in rows] == [str(i) for i in range(20)]
    assert [float(row["eigenvalue"]) for row in rows] == summary["eigenvalues"]  # every digit
    with np.load(out / "spectrum.npz") as read:
        assert sorted(read) == ["eigenvalues", "residuals", "weyl_counts"]
        assert np.abs(read["weyl_counts"] - np.arange(20)).max() < 4
    assert summary["eigenpairs"]["k"] == summary["settings"]["k"] == 20
    settings = ["boundary", "components", "dtype", "interpolation", "k", "metric", "operator", "solver"]
    assert sorted(summary["settings"]) == settings
    assert summary["volume"] == pytest.approx(float(hj.assemble(field).volume))
    assert min(png_size(out / "spectrum.png")) > 300


def test_spectrum_errors(sphere, tmp_path, capsys, monkeypatch):
    out = ["-o", str(tmp_path / "out"), "-q"]
    assert error_of(capsys, main(["spectrum", str(sphere), *out, "-k", "0"]), "k: got 0") == 2
    assert error_of(capsys, main(["spectrum", "tensor.nii.gz", *out]), "--metric: choose the metric") == 2

    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(outputs_module, "versions", fail)
    assert error_of(capsys, main(["spectrum", str(sphere), *out, "-k", "20"]), "disk full") == 1
    assert not (tmp_path / "out").exists()


# --- curvature ----------------------------------------------------------------------------------------------


def test_curvature_end_to_end(sphere, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["curvature", str(sphere), "-o", str(out), "-q", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    names = ["curvature.npz", "curvature.png", "report.json"]
    assert summary["files"] == [str(out / name) for name in names]
    with np.load(out / "curvature.npz") as read:
        K, mask = read["curvature"], read["mask"]
    np.testing.assert_array_equal(np.isfinite(K), mask)
    np.testing.assert_allclose(K[mask], 1, atol=0.35)  # at the rim, the curvature is of third order
    assert np.median(K[mask]) == pytest.approx(1, abs=0.01)
    found = summary["curvature"]
    assert found["nodes"] == mask.sum()
    assert found["least"] == K[mask].min()
    with np.load(sphere) as read:
        field = hj.TensorField(hj.Grid(mask.shape, read["spacing"], mask=mask), read["tensors"])
    assert found["total"] == pytest.approx(float(hj.assemble(field).volume), rel=5e-2)
    # and the picture of the result
    assert (
        main(["plot", str(out / "curvature.npz"), "-o", str(tmp_path / "K.png"), "--cmap", "RdBu_r", "--range=-2,2"])
        == 0
    )
    assert min(png_size(tmp_path / "K.png")) > 300


@pytest.mark.slow
def test_the_total_curvature_obeys_gauss_and_bonnet(tmp_path, capsys):
    """On a zone of the unit sphere in latitude and longitude, ∫K = 2π(cos θ₀ − cos θ₁); sides have half cells."""
    n, m, low, high = 41, 48, 0.3, 2.6
    theta = np.linspace(low, high, n)[:, None]
    tensors = np.zeros((n, m, 2, 2))
    tensors[..., 0, 0], tensors[..., 1, 1] = 1, np.sin(theta) ** 2
    spacing = [(high - low) / (n - 1), 2 * np.pi / m]
    path, out = tmp_path / "zone.npz", ["-o", str(tmp_path / "out"), "-q", "--json", "--periodic", "y"]
    np.savez(path, tensors=tensors, spacing=spacing)
    assert main(["curvature", str(path), *out]) == 0
    found = json.loads(capsys.readouterr().out)["curvature"]
    assert found["total"] == pytest.approx(2 * np.pi * (np.cos(low) - np.cos(high)), rel=2e-3)
    mask = np.ones((n, m), bool)
    mask[4, 4] = mask[9, 4] = False  # too few nodes between these two
    np.savez(path, tensors=tensors, spacing=spacing, mask=mask)
    assert main(["curvature", str(path), *out]) == 0
    found = json.loads(capsys.readouterr().out)["curvature"]
    assert found["lacking"] > 0
    assert "total" not in found


@pytest.mark.slow
def test_curvature_of_a_slice_of_a_volume(tmp_path, capsys):
    tensors = np.zeros((12, 11, 3, 3, 3))
    x = np.arange(12)[:, None, None]
    tensors[..., 0, 0] = tensors[..., 2, 2] = 1e-3
    tensors[..., 1, 1] = 1e-3 * np.cosh(0.2 * x) ** 2  # in the slice dx² + cosh²(0.2x) dy², times 1e-3: K = −0.04/1e-3
    affine = np.diag([1.0, 1, 3, 1])
    path = save_tensors(tmp_path / "t.nii.gz", TensorVolume(tensors, (1.0, 1, 3), (0.0,) * 3, affine=affine))
    arguments = ["curvature", str(path), "-o", str(tmp_path / "out"), "-q", "--metric", "tensor"]
    assert error_of(capsys, main(arguments), "--slice", "two dimensions") == 2
    assert not (tmp_path / "out").exists()
    assert main([*arguments, "--slice", "z=1"]) == 0
    image = nib.load(tmp_path / "out" / "curvature.nii.gz")
    assert image.shape == (12, 11, 1)
    np.testing.assert_allclose(image.get_fdata()[..., 0], -40, rtol=0.25)
    np.testing.assert_allclose(image.get_fdata()[3:-3, 3:-3, 0], -40, rtol=1e-3)
    np.testing.assert_allclose(image.affine @ [0, 0, 0, 1], [0, 0, 3, 1])


# --- plot ---------------------------------------------------------------------------------------------------


@pytest.fixture
def result(tmp_path):
    """A result as ``hks-jax hks`` writes it."""
    times, x = np.array([0.1, 1.0, 10.0, 100.0]), np.indices(SHAPE)[0]
    mask = x < 10
    volume = TensorVolume(np.broadcast_to(np.eye(2), (*SHAPE, 2, 2)), (0.5, 1.0), (1.0, 2.0), mask)
    values = np.where(mask, (1 + x) / times[:, None, None], np.nan)
    return save(tmp_path / "hks.npz", values, volume, name="hks", extra={"times": times, "eigenvalues": np.arange(9.0)})


@pytest.mark.parametrize(
    ("arguments", "times"),
    [
        ([], [0.1, 1, 10, 100]),
        (["--times", "10", "0.101", "--range", "shared", "--unit", "s", "--title", "two"], [0.1, 10]),
        (["--times", "auto:3", "--quantiles", "0.1,0.9", "--cmap", "cividis"], [0.1, 10, 100]),
        (["--points", "1.5,4", "3,7", "--scaled"], [0.1, 1, 10, 100]),
    ],
)
def test_plot_draws_what_is_asked_for(result, tmp_path, capsys, arguments, times):
    picture = tmp_path / "deep" / "p.png"
    assert main(["plot", str(result), "-o", str(picture), "--json", "--dpi", "60", *arguments]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["times"] == times
    assert summary["files"] == [str(picture)]
    assert min(png_size(picture)) > 100
    assert [p.name for p in picture.parent.iterdir()] == ["p.png"]


@pytest.mark.slow
@pytest.mark.parametrize("points", [[], ["--points", "1.5,4", "3,7"]])
def test_a_raw_signature_is_scaled_once_and_a_flat_one_never(result, tmp_path, capsys, points):
    raw = Result.read(result)
    drawn = {}
    for normalisation, values in (("raw", raw.values), ("flat", raw.values * raw.flat_scale), ("volume", raw.values)):
        folder, report = tmp_path / normalisation, {"settings": {"normalisation": normalisation}}
        folder.mkdir()
        replace(raw, values=values, report=report).save(folder / "hks", "")
        for scaled in ([], ["--scaled"]):
            code = main(["plot", str(folder), "-o", str(tmp_path / "p.png"), "--dpi", "60", "-q", *points, *scaled])
            drawn[normalisation, bool(scaled)] = code or imread(tmp_path / "p.png")
    np.testing.assert_allclose(drawn["raw", True], drawn["flat", True], atol=0.02)
    np.testing.assert_array_equal(drawn["flat", False], drawn["flat", True])
    assert not np.array_equal(drawn["raw", False], drawn["raw", True])
    assert drawn["volume", True] == 2
    assert "--scaled: got " in capsys.readouterr().err


def test_plot_of_a_volume(tmp_path, capsys):
    volume = TensorVolume(np.broadcast_to(np.eye(3), (6, 5, 4, 3, 3)), (1.0,) * 3, (0.0,) * 3)
    values = np.random.default_rng(0).random((2, 6, 5, 4))
    path = save(tmp_path / "hks.npz", values, volume, name="hks", extra={"times": [1.0, 2.0]})
    for more in ([], ["--slice", "x=2"], ["--through"], ["--through", "1,2,3"], ["--points", "1,2,3"]):
        assert main(["plot", str(path), "-o", str(tmp_path / "p.png"), *more]) == 0
    capsys.readouterr()
    for more, words in (
        (["--slice", "x=6"], "--slice: index: got x = 6; expected 0 … 5"),
        (["--points", "1,2"], "expected 3 coordinates"),
        (["--slice", "x=2", "--through", "1,2,3"], "--slice: --through draws three slices"),
        (["--slice", "x=2", "--points", "1,2,3"], "--slice: --points draws curves"),
    ):
        assert error_of(capsys, main(["plot", str(path), "-o", str(tmp_path / "p.png"), *more]), words) == 2


def test_three_slices_have_the_colours_of_all_times(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("hks_jax.plot.save_figure", lambda figure, *_, **__: drawn.append(figure))
    volume = TensorVolume(np.broadcast_to(np.eye(3), (6, 5, 4, 3, 3)), (1.0,) * 3, (0.0,) * 3, affine=np.eye(4))
    values = np.random.default_rng(0).random((3, 6, 5, 4))
    path = save(tmp_path / "hks.npz", values, volume, name="hks", extra={"times": [1.0, 2.0, 3.0], "z": 3 * values})
    main(
        [
            "plot",
            str(path),
            "-o",
            str(tmp_path / "p.png"),
            "--through",
            "1,2,3",
            "--times",
            "1",
            "3",
            "--range",
            "shared",
            "-q",
        ]
    )
    images = [ax.images[0] for ax in drawn[0].axes if ax.images]
    assert len(images) == 6
    assert len({image.get_clim() for image in images}) == 1
    assert {"L", "R", "P", "A", "I", "S"} <= {text.get_text() for ax in drawn[0].axes for text in ax.texts}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--times", "5"], ["--times: got 5", "0.1, 1, 10, 100"]),
        (["--range", "3,1"], ["--range: got '3,1'"]),
        (["--quantiles", "1,2"], ["--quantiles", "from 0 to 1"]),
        (["--cmap", "rainbows"], ["--cmap: got 'rainbows'"]),
        (["--points", "90,90"], ["points: got (90.0, 90.0) outside"]),
        (["--points", "6.5,4"], ["outside the grid or its mask"]),
        (["--slice", "z=1"], ["is a slice"]),
        (["--array", "wks"], ["the arrays eigenvalues, hks", "expected wks"]),
        (["-o", "picture.docx"], ["--output: got picture.docx", "png"]),
    ],
)
def test_plot_errors_are_one_line_and_leave_nothing(result, tmp_path, capsys, arguments, words):
    before = sorted(tmp_path.iterdir())
    assert error_of(capsys, main(["plot", str(result), "-o", str(tmp_path / "p.png"), *arguments]), *words) == 2
    assert sorted(tmp_path.iterdir()) == before


def test_help_has_examples(capsys):
    for command in ("spectrum", "curvature", "plot"):
        assert main([command, "--help"]) == 0
        assert f"  hks-jax {command} " in capsys.readouterr().out
