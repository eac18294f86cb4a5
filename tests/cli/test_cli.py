"""The command line, end to end: files in, files out, one line and a code for what goes wrong."""

import argparse
import io
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import equinox as eqx
import jax
import nibabel as nib
import numpy as np
import pytest
from fields import random_spd

import hks_jax as hj
from hks_jax.cli import COMMANDS, build_parser, demo, main
from hks_jax.cli import outputs as outputs_module
from hks_jax.cli.inputs import INPUTS
from hks_jax.cli.parsing import Times, boundary_conditions, parse_times
from hks_jax.cli.progress import Progress, bar, duration
from hks_jax.cli.reading import Reading
from hks_jax.eigen.solver import Status
from hks_jax.fem.boundary import default_boundary
from hks_jax.inverse.metric_fit import RESULTS
from hks_jax.inverse.search import OPTIMISERS
from hks_jax.inverse.signature import pairs_for
from hks_jax.inverse.unknowns import PARAMETRISATIONS
from hks_jax.io import TensorVolume, read_tensors, save_tensors
from hks_jax.io.json_files import tuples
from hks_jax.io.result import Result
from hks_jax.plot import signature

SHAPE = (14, 12)
QUIET_FILES = ["hks.npz", "hks.png", "report.json"]


def disc(shape=SHAPE):
    i, j = np.indices(shape)
    return ((i / (shape[0] - 1) - 0.5) ** 2 + (j / (shape[1] - 1) - 0.5) ** 2) < 0.24


def metric(shape=SHAPE):
    """A smooth metric that is nowhere isotropic."""
    x, y = (a / 10 for a in np.indices(shape))
    tensors = np.empty((*shape, 2, 2))
    tensors[..., 0, 0], tensors[..., 1, 1] = 2 + np.cos(x), 1.5 + 0.5 * np.sin(y)
    tensors[..., 0, 1] = tensors[..., 1, 0] = 0.3 * np.sin(x + y)
    return tensors


@pytest.fixture
def npz(tmp_path):
    np.savez(tmp_path / "field.npz", tensors=metric(), spacing=[0.5, 0.25], origin=[1.0, 2.0], mask=disc())
    return tmp_path / "field.npz"


@pytest.fixture
def nifti(tmp_path):
    """Diffusion tensors (14, 12, 5) in a disc, zero outside, with an affine that turns and flips."""
    tensors = np.zeros((*SHAPE, 5, 3, 3))
    tensors[..., :2, :2] = 1e-3 * metric()[:, :, None]
    tensors[..., 2, 2] = 1e-3
    tensors[~disc()] = 0
    affine = np.array([[0, -2.0, 0, 5], [2.0, 0, 0, -3], [0, 0, -3.0, 1], [0, 0, 0, 1]])
    volume = TensorVolume(tensors, (2.0, 2.0, 3.0), (0.0,) * 3, affine=affine)
    mask = nib.Nifti1Image(np.broadcast_to(disc()[..., None], (*SHAPE, 5)).astype(np.uint8), affine)
    nib.save(mask, tmp_path / "mask.nii.gz")
    return save_tensors(tmp_path / "tensor.nii.gz", volume)


def one_error(capsys, code, *words):
    """Assert that stderr ends in one line that holds the words, without a traceback."""
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("[")]
    assert len(lines) == 1, lines
    assert lines[0].startswith("hks-jax")
    assert "error: " in lines[0]
    for word in words:
        assert word in lines[0]
    return code


# ---------------------------------------------------------------------------------------------------- end to end


def test_npz_end_to_end_equals_the_library(npz, tmp_path, capsys):
    out = tmp_path / "deep" / "out"
    assert main(["hks", str(npz), "-o", str(out), "-k", "25", "--times", "0.7,2", "8"]) == 0
    assert sorted(file.name for file in out.iterdir()) == QUIET_FILES
    captured = capsys.readouterr()
    assert captured.out.split() == [str(out / name) for name in QUIET_FILES]
    for stage in (
        "reading",
        "boundary mean (the domain has a mask",
        "assembly",
        "eigenpairs: 25 of",
        "signature",
        "writing",
    ):
        assert stage in captured.err

    grid = hj.Grid(SHAPE, (0.5, 0.25), (1.0, 2.0), disc())
    expected = hj.hks(hj.eigenpairs(hj.TensorField(grid, metric()), 25, "mean"), [0.7, 2.0, 8.0], "flat")
    with np.load(out / "hks.npz") as read:
        np.testing.assert_allclose(read["hks"], expected, rtol=1e-9)
        np.testing.assert_array_equal(read["times"], [0.7, 2, 8])
        np.testing.assert_array_equal(read["mask"], disc())
        np.testing.assert_array_equal(read["input_tensors"], metric().astype(np.float32))
        assert read["eigenvalues"].shape == (25,)


@pytest.mark.slow
def test_ficks_operator_on_the_command_line(nifti, tmp_path, capsys):
    """Signature, saved pairs, pictures, tables, spectrum and fit; a metric beside it and curvature are refused."""
    out, again, times = tmp_path / "out", tmp_path / "again", ["--times", "6000", "20000"]
    read = [str(nifti), "--slice", "z=2", "--operator", "fick", "-q"]
    assert main(["hks", *read, "-o", str(out), "-k", "25", *times, "--save-pairs"]) == 0
    D = read_tensors(nifti).slice("z", 2).with_mask(disc())
    field = hj.TensorField.from_diffusion(D.grid(), np.asarray(D.tensors, float), operator="fick")
    pairs = hj.eigenpairs(field, 25, "mean")
    result = Result.read(out)
    np.testing.assert_allclose(result.values, hj.hks(pairs, [6e3, 2e4], "flat"), rtol=1e-5)
    np.testing.assert_allclose(result.values / result.to_flat, hj.hks(pairs, [6e3, 2e4]), rtol=1e-5)
    assert (result.settings["operator"], result.settings["metric"]) == ("fick", None)
    assert result.in_time
    assert result.lengths is not None
    assert signature.caption(result).endswith("Fick's operator")
    assert main(["hks", str(out / "pairs.npz"), "-o", str(again), "-q", *times, "--normalisation", "flat"]) == 0
    np.testing.assert_allclose(Result.read(again).values, hj.hks(pairs, [6e3, 2e4], "flat"), rtol=1e-5)
    assert main(["plot", str(out), "-o", str(tmp_path / "scaled.png"), "--scaled"]) == 0
    assert main(["explore", str(again)]) == 0
    assert '"fick": true' in (again / "explore.html").read_text().replace('":true', '": true')
    assert main(["info", str(out)]) == 0
    assert "operator        fick" in capsys.readouterr().out
    assert main(["spectrum", *read, "-o", str(tmp_path / "spectrum"), "-k", "12"]) == 0
    report = json.loads((tmp_path / "spectrum" / "report.json").read_text())
    assert report["settings"]["operator"] == "fick"
    np.testing.assert_allclose(report["eigenvalues"], hj.eigenpairs(field, 12).eigenvalues, rtol=1e-5, atol=1e-9)

    capsys.readouterr()
    both = ["--metric", "inverse"]
    for command in ("hks", "spectrum"):
        code = main([command, *read, "-o", str(tmp_path / "no"), *both])
        assert one_error(capsys, code, "--metric: got inverse with --operator fick", "Leave out --metric") == 2
    assert one_error(capsys, main(["curvature", *read, "-o", str(tmp_path / "no")]), "--operator: the curvature") == 2


@pytest.mark.slow
def test_a_fit_has_the_operator_of_its_target(tmp_path):
    """The diffusivity that a fit writes has the signature of the target."""
    x, y = np.moveaxis(FIT_GRID.nodes, -1, 0)
    D = np.exp(0.4 * np.sin(2 * x) * np.cos(3 * y))[..., None, None] * np.eye(2)
    field = hj.TensorField.from_diffusion(FIT_GRID, D, operator="fick")
    values = np.asarray(hj.hks(hj.eigenpairs(field, FIT_GRID.size), FIT_TIMES))
    record = json.dumps({"settings": {"boundary": "neumann", "operator": "fick"}})
    target = write_target(tmp_path / "hks.npz", values, provenance=record)
    out = tmp_path / "fitted"
    assert main(["fit", str(target), "-o", str(out), "--max-steps", "8", "-q", *FIT_ARGUMENTS]) == 0
    assert json.loads((out / "report.json").read_text())["settings"]["operator"] == "fick"
    assert np.linalg.norm(read_tensors(out / "tensors.npz").tensors - D) < 0.03 * np.linalg.norm(D)


def test_times_that_do_not_suit_the_domain_are_reported(npz, tmp_path):
    out = tmp_path / "out"
    assert main(["hks", str(npz), "-o", str(out), "-q", "-k", "25", "--times", "0.01", "2", "500"]) == 0
    warnings = json.loads((out / "report.json").read_text())["warnings"]
    assert any("at 2 of 3 times, most nodes feel the boundary: at t = 2, 500" in each for each in warnings)
    assert any("1 of 3 times are too small" in each for each in warnings)
    assert ["too few eigenpairs" in title for title in signature.titles_of(Result.read(out))] == [True, False, False]


@pytest.mark.slow
def test_report_says_what_was_done(npz, tmp_path, capsys):
    out = tmp_path / "out"
    # A time that 25 pairs do not resolve: the report carries the warning and a large truncation.
    arguments = ["-q", "--json", "-k", "25", "--times", "0.01", "2"]
    assert main(["hks", str(npz), "-o", str(out), *arguments]) == 0
    report = json.loads((out / "report.json").read_text())
    printed = json.loads(capsys.readouterr().out)
    assert printed.pop("files") == [str(out / name) for name in QUIET_FILES]
    assert printed == report
    assert report["settings"] == {
        "metric": "tensor",
        "operator": "laplace-beltrami",
        "interpolation": "linear",
        "k": 25,
        "boundary": "mean",
        "times": "explicit",
        "components": "raise",
        "solver": "auto",
        "normalisation": "flat",
        "method": "spectral",
        "dtype": "float64",
    }
    assert report["input"]["shape"] == list(SHAPE)
    assert report["input"]["voxels_inside"] == disc().sum()
    pairs = report["eigenpairs"]
    assert (pairs["k"], pairs["converged"], pairs["solver"], pairs["zero"]) == (25, 25, "dense", 1)
    assert 0 < pairs["worst_residual"] < 1e-8
    assert [entry["t"] for entry in report["times"]] == [0.01, 2]
    assert report["times"][0]["truncation"] > 0.1 > report["times"][1]["truncation"]
    # What is left out of the signature, relative to what is not.
    mean, worst = (
        np.array([each[name] for each in report["times"]]) for name in ("truncation", "truncation_worst_node")
    )
    assert (worst < 1).all()
    assert (worst / (1 - worst) > 1.2 * mean / (1 - mean)).all()
    assert all(each["lasting_bias"] <= each["resolution_bias"] for each in report["times"])
    assert any("too small for k" in warning for warning in report["warnings"])
    assert {"python", "jax", "numpy", "scipy", "hks-jax", "device"} <= set(report["versions"])
    assert {"reading", "assembly", "eigenpairs", "signature"} <= set(report["seconds"])


def test_a_masked_domain_has_the_mean_where_there_is_one():
    whole, corner, strip = np.ones((5, 6), bool), np.ones((5, 6), bool), np.zeros((5, 6), bool)
    corner[0, 0] = False
    strip[2:4] = True
    for inside, boundary, why in (
        (whole, "neumann", "no mask"),
        (corner, "mean", "a mask"),
        (strip, "neumann", "thin"),
    ):
        found, said = default_boundary(inside)
        assert (found, why in said) == (boundary, True)
        field = hj.TensorField(hj.Grid((5, 6), mask=inside), metric((5, 6)))
        assert hj.assemble(field, found).space.n_dof == inside.sum()
    with pytest.raises(ValueError, match='"mean" and "mirror" need inner nodes'):
        hj.assemble(field, "mean")


@pytest.mark.slow
def test_method_auto_reports_which_times_came_from_where(npz, tmp_path):
    out = tmp_path / "out"
    arguments = ["-k", "25", "--times", "0.1", "4", "--method", "auto"]
    assert main(["hks", str(npz), "-o", str(out), "-q", *arguments]) == 0
    report = json.loads((out / "report.json").read_text())
    method, (early, late) = report["method"], report["times"]
    assert (early["truncation"], early["truncation_worst_node"]) == (None, None)  # no eigenpairs, none omitted
    assert 0 <= late["truncation"] < 1e-4
    assert method["eigenpairs"] == [4]
    assert method["selected-inversion"] == [0.1]
    assert method["agreement"]["t"] == 4
    assert method["agreement"]["difference"] < 1e-4
    field = hj.TensorField(hj.Grid(SHAPE, (0.5, 0.25), (1.0, 2.0), disc()), metric())
    with np.load(out / "hks.npz") as read:
        np.testing.assert_allclose(
            read["hks"][:1], 0.4 * np.pi * hj.hks_spectrum_free(field, [0.1], boundary="mean"), rtol=1e-3
        )


def test_nifti_slice_end_to_end_keeps_the_affine(nifti, tmp_path):
    out, mask = tmp_path / "out", tmp_path / "mask.nii.gz"
    arguments = ["--slice", "z=3", "--mask", str(mask), "--metric", "inverse", "-k", "10", "--times", "1", "2"]
    assert main(["hks", str(nifti), "-o", str(out), "-q", *arguments]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["hks.json", "hks.nii.gz", *QUIET_FILES]
    assert json.loads((out / "hks.json").read_text())["Times"] == [1, 2]
    image = nib.load(out / "hks.nii.gz")
    assert image.get_data_dtype() == nib.load(nifti).get_data_dtype()
    assert image.shape == (*SHAPE, 1, 2)
    affine = nib.load(nifti).affine
    np.testing.assert_allclose(image.affine @ [1, 2, 0, 1], affine @ [1, 2, 3, 1], atol=1e-5)
    data = image.get_fdata()[:, :, 0]
    with np.load(out / "hks.npz") as read:
        np.testing.assert_array_equal(data, np.moveaxis(read["hks"], 0, -1))
    assert not np.isfinite(data[~disc()]).any()
    assert (data[np.isfinite(data)] > 0).all()


@pytest.mark.slow
def test_a_volume_is_computed_whole(nifti, tmp_path, monkeypatch):
    out, mask = tmp_path / "out", np.broadcast_to(disc()[..., None], (*SHAPE, 5)).copy()
    mask[:4, :, 0] = False
    np.save(tmp_path / "mask.npy", mask)
    arguments = ["--metric", "inverse", "--mask", str(tmp_path / "mask.npy"), "-k", "12", "--through", "8,5,3"]
    drawn, draw = [], signature.volume_panels
    monkeypatch.setattr(
        signature, "volume_panels", lambda *args, **more: drawn.append(draw(*args, **more)) or drawn[-1]
    )
    assert main(["hks", str(nifti), "-o", str(out), "-q", *arguments, "--times", "20000", "50000"]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["hks.json", "hks.nii.gz", *QUIET_FILES]

    tensors = read_tensors(nifti).tensors.astype(float)
    grid = hj.Grid((*SHAPE, 5), (2.0, 2.0, 3.0), mask=mask)
    field = hj.TensorField.from_diffusion(grid, tensors, "inverse")
    expected = hj.hks(hj.eigenpairs(field, 12, "mean"), [20000.0, 50000.0], "flat")
    with np.load(out / "hks.npz") as read:
        np.testing.assert_allclose(read["hks"], expected, rtol=1e-5)  # the file's tensors are float32
        np.testing.assert_array_equal(read["mask"], mask)
        image = nib.load(out / "hks.nii.gz")
        assert image.shape == (*SHAPE, 5, 2)
        np.testing.assert_allclose(image.affine, nib.load(nifti).affine)
        np.testing.assert_array_equal(image.get_fdata(), np.moveaxis(read["hks"], 0, -1))
    # Two times and the mean diffusivity: columns of three slices with a colour bar each. The lines cross at voxel
    # (8, 5, 3), in coordinates of space.
    place = nib.load(nifti).affine @ [8, 5, 3, 1]
    panels = drawn[0].axes
    assert len(panels) == 12
    assert [line.get_xdata()[0] for line in panels[0].lines][:1] == [place[0]]
    assert drawn[0].get_suptitle().startswith("$(4\\pi t)^{3/2}$·HKS, which is 1 for flat space, metric D⁻¹\nD = ")
    assert "\n$\\sqrt{Dt}$ = " in panels[0].get_title()


@pytest.mark.slow
def test_a_volume_without_a_mask_and_its_default_k(nifti, tmp_path):
    out = tmp_path / "out"
    arguments = ["--metric", "tensor", "--times", "auto:1", "--boundary", "neumann,neumann,periodic"]
    assert main(["hks", str(nifti), "-o", str(out), "-q", *arguments]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["settings"]["k"] == 100
    assert report["settings"]["boundary"] == ["neumann", "neumann", "periodic"]
    assert any("with a zero tensor count as outside" in note for note in report["input"]["notes"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--through", "7,6"], ["--through", "three indices from 0"]),
        (["--through", "7,6,2", "--slice", "z=1"], ["--through: this option is for a volume"]),
    ],
)
def test_bad_voxels_are_refused_before_anything_is_computed(nifti, tmp_path, capsys, arguments, words):
    code = main(["hks", str(nifti), "-o", str(tmp_path / "out"), "--metric", "inverse", *arguments])
    assert one_error(capsys, code, *words) == 2


@pytest.mark.parametrize(
    "extra",
    [
        ["--boundary", "dirichlet:neumann,neumann", "--solver", "dense"],
        pytest.param(["--boundary", "mean", "--normalisation", "flat"], marks=pytest.mark.slow),
        ["--solver", "shift-invert", "--normalisation", "heat-trace"],
        pytest.param(
            ["--metric", "adjugate", "--erode", "1", "--interpolation", "log-euclidean"], marks=pytest.mark.slow
        ),
        pytest.param(["--dtype", "float32", "--times", "auto:3"], marks=pytest.mark.slow),
    ],
)
def test_options_reach_the_computation(npz, tmp_path, extra):
    out = tmp_path / "out"
    assert main(["hks", str(npz), "-o", str(out), "-q", "-k", "10", "--times", "1", *extra]) == 0
    report = json.loads((out / "report.json").read_text())
    settings, pairs = report["settings"], report["eigenpairs"]
    with np.load(out / "hks.npz") as read:
        finite = np.isfinite(read["hks"][0])
        dtype = read["hks"].dtype
        trace = np.exp(-read["times"][:, None] * read["eigenvalues"]).sum(1)
        assert trace.shape == (len(report["times"]),)
    for option, value in zip(extra[::2], extra[1::2], strict=True):
        if (option, value) == ("--boundary", "mean"):
            assert settings["boundary"] == "mean"
            assert not any("no effect" in warning for warning in report["warnings"])
            field = hj.TensorField(hj.Grid(SHAPE, (0.5, 0.25), mask=disc()), metric())
            assert pairs["last"] == pytest.approx(float(hj.eigenpairs(field, 10, "mean").eigenvalues[-1]), rel=1e-9)
        elif option == "--boundary":
            assert settings["boundary"] == [["dirichlet", "neumann"], "neumann"]
            assert any("no effect at the low side of x" in warning for warning in report["warnings"])
        elif option == "--times":
            assert len(report["times"]) == 3
        elif option == "--erode":
            assert finite.sum() < disc().sum() - 20
        else:
            assert settings[option.lstrip("-")] == value
        if option == "--solver":
            assert pairs["solver"] == value
        if option == "--interpolation":
            with np.load(npz) as read:
                grid = hj.Grid(SHAPE, read["spacing"].tolist(), mask=hj.io.erode(read["mask"], 1))
                field = hj.TensorField.from_diffusion(grid, read["tensors"], "adjugate", interpolation=value)
            assert pairs["last"] == pytest.approx(float(hj.eigenpairs(field, 10, "mean").eigenvalues[-1]), rel=1e-9)
        if option == "--dtype":
            assert dtype == np.float32


@pytest.mark.slow
def test_a_mask_of_the_slice_alone_and_the_largest_component(nifti, tmp_path):
    mask = disc()
    mask[7:9] = False  # two halves, one larger
    np.save(tmp_path / "mask.npy", mask)
    arguments = ["hks", str(nifti), "-o", str(tmp_path / "out"), "-q", "--metric", "inverse", "--slice", "z=0"]
    arguments += ["--mask", str(tmp_path / "mask.npy"), "-k", "10", "--times", "1"]
    assert main(arguments) == 2  # two components
    assert main([*arguments, "--components", "largest"]) == 0
    with np.load(tmp_path / "out" / "hks.npz") as read:
        assert np.isfinite(read["hks"][0, :7]).any()
        assert not np.isfinite(read["hks"][0, 7:]).any()


def test_results_are_replaced_and_other_files_kept(npz, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    for t in ("1", "2"):
        assert main(["hks", str(npz), "-o", str(out), "-q", "-k", "10", "--times", t]) == 0
    assert json.loads((out / "report.json").read_text())["times"][0]["t"] == 2
    assert (out / "notes.txt").read_text() == "mine"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["field.npz", "out"]


def test_programs_are_kept_where_the_user_says_and_a_folder_that_is_set_stays(tmp_path):
    name = "jax_compilation_cache_dir"
    before = jax.config.values[name], jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    try:
        assert hj.keep_compiled(tmp_path / "other") == Path(before[0])
        assert not (tmp_path / "other").exists()
        jax.config.update(name, None)
        assert hj.keep_compiled(tmp_path / "mine") == tmp_path / "mine"
        assert jax.config.values[name] == str(tmp_path / "mine")
        (tmp_path / "file").write_text("")
        jax.config.update(name, None)
        assert hj.keep_compiled(tmp_path / "file" / "below") is None
        assert jax.config.values[name] is None
    finally:
        jax.config.update(name, before[0])
        jax.config.update("jax_persistent_cache_min_compile_time_secs", before[1])


@pytest.mark.slow
def test_the_command_line_keeps_what_it_compiled_and_the_package_nothing(npz, tmp_path):

    environment = {k: v for k, v in os.environ.items() if k not in ("JAX_COMPILATION_CACHE_DIR", "XLA_FLAGS")}
    environment |= {"XDG_CACHE_HOME": str(tmp_path / "cache"), "HOME": str(tmp_path)}

    def kept():
        return {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*-cache") if "hks-jax" in file.parts}

    def run(*options):
        command = ["hks", str(npz), "-o", str(tmp_path / "out"), "-k", "10", "--times", "1", *options]
        done = subprocess.run(
            [sys.executable, "-m", "hks_jax", *command], env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr

    run("--no-cache")
    assert not kept()
    run()
    before = kept()
    assert before
    run()
    assert {file: time for file, time in kept().items() if file in before} == before  # read, and not made again


@pytest.mark.slow
def test_module_runs_in_a_process_of_its_own(npz, tmp_path):
    out = tmp_path / os.fsdecode("λ".encode() + b"\xff")  # printed in ASCII, and invalid in UTF-8
    command = [
        sys.executable,
        "-m",
        "hks_jax",
        "hks",
        str(npz),
        "-o",
        str(out),
        "-k",
        "10",
        "--times",
        "1",
        "--dtype",
        "float32",
    ]
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=ascii_only)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "\\u03bb\\udcff/hks.npz\n" in done.stdout
    assert str(out) in json.loads((out / "report.json").read_text())["command"]
    with np.load(out / "hks.npz") as read:
        assert read["hks"].dtype == np.float32  # with 64 bits off, not merely cast
        assert read["eigenvalues"].dtype == np.float32


# ---------------------------------------------------------------------------------------------------- demo


@pytest.mark.slow
def test_demo_without_data_does_the_phantom(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "find_example_brain", lambda: None)
    monkeypatch.setattr(demo, "PHANTOM_SHAPE", (32, 32))
    monkeypatch.setattr(demo, "N_PAIRS", 60)
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    captured = capsys.readouterr()
    assert "using a phantom, because the brain needs the wheel mdt==1.2.7" in captured.err
    assert captured.out == "The picture is demo/hks.png\n"
    assert sorted(file.name for file in (tmp_path / "demo").iterdir()) == QUIET_FILES


@pytest.mark.slow
def test_demo_fits_and_draws_an_installed_brain(tmp_path, monkeypatch, capsys):
    shape = (20, 22, 2)
    directions = np.random.default_rng(0).normal(size=(13, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    b = np.array([0.0] + [1000.0] * 12)
    directions[0] = 0
    D = 1e-3 * np.diag([1.7, 0.6, 0.4])
    signal = 1000 * np.exp(-b * np.einsum("na,ab,nb->n", directions, D, directions))
    mask = np.repeat(disc(shape[:2])[..., None], 2, axis=2)
    nib.save(nib.Nifti1Image(np.broadcast_to(signal, (*shape, 13)).copy(), np.diag([2.0, 2, 2, 1])), tmp_path / "d.nii")
    nib.save(nib.Nifti1Image(mask.astype(np.uint8), np.diag([2.0, 2, 2, 1])), tmp_path / "m.nii")
    np.savetxt(tmp_path / "b", b[None])
    np.savetxt(tmp_path / "g", directions.T)
    brain = hj.io.ExampleBrain(*(tmp_path / name for name in ("d.nii", "b", "g", "m.nii")))
    monkeypatch.setattr(demo, "find_example_brain", lambda: brain)
    monkeypatch.setattr(demo, "N_PAIRS", 60)
    assert main(["demo", "-o", str(tmp_path / "out"), "-q", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert [path.rpartition("/")[2] for path in summary["files"]] == ["hks.json", "hks.nii.gz", *QUIET_FILES]
    assert (summary["settings"]["k"], len(summary["times"])) == (60, 7)
    image = nib.load(tmp_path / "out" / "hks.nii.gz")
    assert image.shape == (20, 22, 1, 7)
    inside = np.isfinite(image.get_fdata()[:, :, 0, 0])
    assert inside.sum() < mask[..., 0].sum() - 60  # the rim is gone


# ---------------------------------------------------------------------------------------------------- what goes wrong


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-k", "0"], ["k: got 0", "expected an integer from 1"]),
        (["-k", "5000"], ["k: got 5000", "number of degrees of freedom"]),
        (["--times", "0", "1"], ["--times", "'0 1'", "expected positive numbers, or auto"]),
        (["--times", "auto:no"], ["--times", "auto:N"]),
        (["-o", 300 * "a"], ["--output", "name too long", "Choose another folder"]),
        (["--slice", "14"], ["--slice", "such as z=14"]),
        (["--slice", "z=1"], ["slice", "expected a volume with three axes"]),
        (["--boundary", "robin"], ["boundary: got 'robin'", "'neumann'"]),
        (["--boundary", "neumann,neumann,neumann,neumann"], ["expected one name"]),
        (["--metric", "euclid"], ["--metric", "invalid choice", "inverse"]),
        (["--order", "fsl"], ["order", "npz holds whole matrices"]),
        (["--erode", "40"], ["removes all"]),
        (["--mask", "absent.npy"], ["absent.npy", "no such file"]),
        (["--colour", "red"], ["unrecognized arguments: --colour", "see hks-jax hks --help"]),
    ],
)
def test_bad_arguments_are_one_line_and_code_2(npz, tmp_path, capsys, arguments, words):
    before = sorted(tmp_path.iterdir())
    assert one_error(capsys, main(["hks", str(npz), "-o", str(tmp_path / "out"), *arguments]), *words) == 2
    assert sorted(tmp_path.iterdir()) == before


def test_bad_files_are_one_line_and_code_2(npz, nifti, tmp_path, capsys):
    out = ["-o", str(tmp_path / "out")]
    assert one_error(capsys, main(["hks", "absent.npz", *out]), "absent.npz: no such file") == 2
    assert one_error(capsys, main(["hks", str(nifti), *out]), "--metric: choose the metric", "D⁻¹") == 2
    image = nib.load(nifti)
    image.header["intent_code"] = 0
    nib.save(image, tmp_path / "undeclared.nii")
    code = main(["hks", str(tmp_path / "undeclared.nii"), *out, "--metric", "inverse"])
    assert one_error(capsys, code, '"nifti"', '"fsl"', '"mrtrix"') == 2
    np.savez(tmp_path / "bad.npz", tensors=-metric())
    code = main(["hks", str(tmp_path / "bad.npz"), *out])
    assert one_error(capsys, code, "168 of 168 tensors are not positive definite", "worst eigenvalue") == 2
    assert one_error(capsys, main(["hks", str(npz), "-o", str(npz)]), "expected a folder") == 2
    assert one_error(capsys, main(["hks", str(npz), "-o", str(npz / "out")]), "expected a folder") == 2
    assert not (tmp_path / "out").exists()


def test_no_command_and_help(capsys):
    assert main([]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "find the metric that has a given signature" in captured.err  # the help, not a bare error
    for arguments in (["--help"], ["hks", "--help"], ["demo", "--help"], ["--version"]):
        assert main(arguments) == 0
    captured = capsys.readouterr()
    assert f"hks-jax {hj.__version__}" in captured.out
    assert captured.out.count("examples:") == 3


def test_a_failed_computation_is_code_1(npz, tmp_path, capsys, monkeypatch):
    before = sorted(tmp_path.iterdir())

    compute = hj.eigenpairs

    def unconverged(*args, **kwargs):
        pairs = compute(*args, **kwargs)
        none = (eqx.tree_at(lambda p: p.converged, each, np.zeros(each.k, bool)) for each in pairs.problems)
        return pairs.with_problems(none)

    monkeypatch.setattr(hj, "eigenpairs", unconverged)
    code = main(["hks", str(npz), "-o", str(tmp_path / "out"), "-k", "10"])
    assert one_error(capsys, code, "10 of 10 eigenpairs did not converge") == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (OSError("disk full"), 1)])
def test_nothing_is_left_of_an_interrupted_or_failed_write(npz, tmp_path, capsys, monkeypatch, error, code):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(outputs_module, "versions", fail)  # the last step, when all but the report is written
    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr("hks_jax.cli.computation.HALF", 0.0)  # without a warning of times at which all feel the rim
    arguments = ["hks", str(npz), "-o", str(tmp_path / "out"), "-k", "10", "--times", "2"]
    assert one_error(capsys, main(arguments), "interrupted" if code == 130 else "disk full") == code
    assert sorted(tmp_path.iterdir()) == before


# A program started in the background ignores Ctrl-C. It is told otherwise in its own first line and not between
# fork and exec, since JAX, which has threads here, warns of a fork.
HEED_CTRL_C = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"


@pytest.mark.slow
def test_ctrl_c_amid_a_computation_leaves_nothing_but_one_line(tmp_path):
    n = 36
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(np.eye(3), (n, n, n, 3, 3)))
    program = HEED_CTRL_C + "import runpy; runpy.run_module('hks_jax', run_name='__main__')"
    arguments = ["hks", str(tmp_path / "t.npz"), "-o", str(tmp_path / "out"), "-k", "150"]
    command = [sys.executable, "-c", program, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        line = ""
        while "eigenpairs" not in line and process.poll() is None:
            line = process.stderr.readline()
        time.sleep(2)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert (out, err.splitlines()[-1]) == ("", "hks-jax hks: error: interrupted")
    assert "Traceback" not in err
    assert [file.name for file in tmp_path.iterdir()] == ["t.npz"]


@pytest.mark.slow
def test_ctrl_c_in_a_callback_of_the_garbage_collector_is_not_lost(tmp_path):
    # The signal comes while a callback runs that the collector calls, where Python discards every exception.
    script = """
        import gc, os, signal, time
        from hks_jax.cli import demo, run_and_exit

        def callback(phase, info):
            gc.callbacks.remove(callback)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)

        def run(args, progress):
            gc.callbacks.append(callback)
            gc.collect()
            for _ in range(400):
                time.sleep(0.1)

        demo.run = run
        run_and_exit()
    """
    command = [sys.executable, "-c", HEED_CTRL_C + textwrap.dedent(script), "demo"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=50)
    assert done.returncode == 130
    assert (done.stdout, done.stderr) == ("", "hks-jax demo: error: interrupted\n")


def test_debug_shows_the_traceback():
    with pytest.raises(FileNotFoundError):
        main(["hks", "absent.npz", "-o", "out", "--debug"])


# ---------------------------------------------------------------------------------------------------- the pieces


def test_parsing():
    assert parse_times(None) == parse_times(["auto"]) == Times((), 6)
    assert parse_times(["auto:9"]) == Times((), 9)
    assert parse_times(["3,1", "2"]) == Times((1.0, 2.0, 3.0), 0)
    assert boundary_conditions("mirror") == "mirror"
    assert boundary_conditions("mean,periodic,neumann") == ("mean", "periodic", "neumann")
    assert boundary_conditions("neumann,periodic") == ("neumann", "periodic")
    assert boundary_conditions("neumann:dirichlet,periodic") == (("neumann", "dirichlet"), "periodic")
    assert boundary_conditions("neumann:dirichlet") == (("neumann", "dirichlet"),)


def test_progress_is_silent_when_quiet_but_for_warnings(capsys, monkeypatch):
    progress = Progress(quiet=True)
    with progress.stage("work"):
        progress.update("half")
        progress.note("by the way")
        progress.warn("mind this")
        progress.warn("mind this")
    assert capsys.readouterr().err == "warning: mind this\n"
    assert progress.warnings == ["mind this"]
    assert progress.timings["work"] > 0
    monkeypatch.setattr("sys.stderr", None)  # closed, as for programs without a console
    Progress().note("by the way")


def test_a_bar_and_the_time_left_on_a_terminal(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr("hks_jax.cli.progress.TICK", 0.01)
    monkeypatch.setattr("shutil.get_terminal_size", lambda **_: os.terminal_size((60, 24)))
    progress = Progress()
    progress.stream = Terminal()
    with progress.stage("eigenpairs", "9 of 99"):
        progress.update(Status("half of them", 30.0))
        time.sleep(0.1)
        progress.update(Status("nearly all", 0.001))
        time.sleep(0.1)
    lines = progress.stream.getvalue().replace("\x1b[K", "").split("\r")
    assert "eigenpairs: 9 of 99" in lines[1]
    assert any("[....................] about 30 s left, half" in line for line in lines)
    assert len(lines) > 4  # it moves without being told
    assert "longer than estimated" in lines[-1]
    assert max(map(len, lines)) < 61
    drawn = progress.stream.getvalue()
    time.sleep(0.05)
    assert progress.stream.getvalue() == drawn  # and stops with the stage
    assert bar(0.5) == "[" + 10 * "#" + 10 * "." + "]"
    assert [duration(s) for s in (1, 42, 100, 5000)] == ["5 s", "40 s", "2 min", "1 h 20 min"]


def test_the_help_of_a_command_is_in_groups_and_says_what_is_hard_to_guess(capsys):
    for command, usage in (
        ("hks", "FILE -o OUT [options]"),
        ("info", "FILE [options]"),
        ("convert", "FILE OUT [options]"),
    ):
        assert main([command, "--help"]) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert text.startswith(f"usage: hks-jax {command} {usage} ")
        for title in ("voxels:", "meaning of the numbers:", "diffusion-weighted images:"):
            assert title in text
        assert "0.7 um2/ms, 700 um2/s (TORTOISE) or 7e-10 m2/s" in text
        assert "three rows or three columns, as dcm2niix writes them (see --bvec-frame)" in text
        assert ("t is then a time, in s for D in mm2/s and voxels in mm" in text) == (command == "hks")
        assert ("fick: the diffusion of a substance by Fick's law, div(D∇u)" in text) == (command == "hks")


def options_of(command):
    """Return the options of a command, as argparse's actions."""
    (commands,) = (action for action in build_parser()._actions if isinstance(action, argparse._SubParsersAction))
    return commands.choices[command]._actions


def test_each_command_states_its_required_arguments_and_its_input_files():
    for command in COMMANDS:
        options = options_of(command.__name__.rpartition(".")[2])
        flags = {option: option.option_strings[:1] for option in options if option.required}
        required = [" ".join((*flags[option], option.metavar)) for option in sorted(flags, key=lambda o: len(flags[o]))]
        assert " ".join(required) == command.USAGE
        files = {option.dest for option in options if option.type is Path}
        assert files - {"output"} <= set(INPUTS)


# ---------------------------------------------------------------------------------------------------- fits


def test_what_fit_offers_is_what_there_is():
    offered = {option.dest: option.choices for option in options_of("fit")}
    assert (offered["parametrisation"], offered["optimiser"]) == (tuple(PARAMETRISATIONS), tuple(OPTIMISERS))


FIT_GRID = hj.Grid((14, 13), 1 / 13)
FIT_AFFINE = np.diag([*FIT_GRID.spacing, 1.0, 1.0])
FIT_TIMES = np.array([0.02, 0.05, 0.1])
FIT_ARGUMENTS = ["--parametrisation", "conformal", "--h1", "1e-8"]  # the same ones compile once


@pytest.fixture(scope="module")
def conformal():
    """A smooth conformal metric and its signature."""
    x, y = np.moveaxis(FIT_GRID.nodes, -1, 0)
    field = hj.TensorField(FIT_GRID, np.exp(0.4 * np.sin(2 * x) * np.cos(3 * y))[..., None, None] * np.eye(2))
    return np.asarray(field.tensors), np.asarray(hj.hks(hj.eigenpairs(field, FIT_GRID.size), FIT_TIMES))


def write_target(path, values, **changes):
    arrays = {"hks": values, "times": FIT_TIMES, "spacing": FIT_GRID.spacing, "origin": FIT_GRID.origin, **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def test_a_fit_has_the_boundary_that_its_target_says(conformal, tmp_path):
    _, values = conformal
    record = json.dumps({"settings": {"boundary": [["dirichlet", "mean"], "neumann"]}})
    said = Result.read(write_target(tmp_path / "said.npz", values, provenance=record))
    assert tuples(said.settings["boundary"]) == (("dirichlet", "mean"), "neumann")
    assert not Result.read(write_target(tmp_path / "unsaid.npz", values)).settings


@pytest.mark.slow
def test_fit_end_to_end_recovers_the_metric(conformal, tmp_path, capsys):
    tensors, values = conformal
    flat, record = values * 4 * np.pi * FIT_TIMES[:, None, None], '{"settings": {"normalisation": "flat"}}'
    target, out = write_target(tmp_path / "hks.npz", flat, provenance=record), tmp_path / "out"
    arguments = ["--max-steps", "4", "-q", "--json", *FIT_ARGUMENTS]
    assert main(["fit", str(tmp_path), "-o", str(out), *arguments]) == 0  # the folder of a signature
    assert sorted(file.name for file in out.iterdir()) == ["fit.npz", "fit.png", "report.json", "tensors.npz"]
    assert (out / "fit.png").read_bytes()[:4] == b"\x89PNG"

    fitted = read_tensors(out / "tensors.npz")
    assert np.linalg.norm(fitted.tensors - tensors) < 0.02 * np.linalg.norm(tensors)
    assert fitted.spacing == FIT_GRID.spacing
    with np.load(out / "fit.npz") as read:
        np.testing.assert_allclose(read["hks"], values, rtol=0.02)
        np.testing.assert_array_equal(read["times"], FIT_TIMES)
        losses = read["losses"]
    report = json.loads((out / "report.json").read_text())
    assert (report["result"], report["steps"], len(losses)) == ("steps exhausted", 4, 5)
    assert report["explanation"] == RESULTS["steps exhausted"]
    assert report["misfit"] < report["loss"] == pytest.approx(losses.min())
    assert losses[-1] < 1e-3 * losses[0]
    assert (report["parametrisation"], report["settings"]["max_steps"]) == ("conformal", 4)
    assert 60 < report["k"] < FIT_GRID.size
    assert report["truncation_misfit"] < 1e-11
    assert report["settings"]["h1"] == 1e-8
    assert report["target"] == {
        "source": str(target),
        "shape": list(FIT_GRID.shape),
        "spacing": list(FIT_GRID.spacing),
        "nodes_inside": FIT_GRID.size,
        "times": FIT_TIMES.tolist(),
    }
    assert {"reading", "fitting"} <= set(report["seconds"])
    assert {"optimistix", "jax", "device"} <= set(report["versions"])
    captured = capsys.readouterr()
    assert report["warnings"] == [captured.err.removeprefix("warning: ").rstrip()]
    printed = json.loads(captured.out)
    assert printed.pop("files") == [str(file) for file in sorted(out.iterdir())]
    assert printed == report
    assert "steps exhausted" in report["warnings"][0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:k. the truncation:hks_jax.AccuracyWarning")
def test_a_fit_of_ficks_operator_has_the_interpolation_and_the_density_of_its_target(tmp_path, rng):
    tensors = random_spd(rng, (7, 6))
    np.savez(tmp_path / "t.npz", tensors=tensors)
    source, out, fitted = map(str, (tmp_path / "t.npz", tmp_path / "out", tmp_path / "fitted"))
    given = ["--operator", "fick", "--interpolation", "log-euclidean", "--times", "0.5", "1", "-k", "42", "-q"]
    assert main(["hks", source, "-o", out, "--boundary", "neumann", "--solver", "dense", *given]) == 0
    assert main(["fit", out, "-o", fitted, "--init", source, "--max-steps", "1", "-k", "42", "-q"]) == 0
    target, fit = Result.read(tmp_path / "out" / "hks.npz"), Result.read(tmp_path / "fitted" / "fit.npz")
    assert fit.settings["interpolation"] == "log-euclidean"
    with np.load(tmp_path / "fitted" / "fit.npz") as read:
        assert read["misfits"][0] < 1e-18
    np.testing.assert_allclose(fit.values * fit.to_flat, target.values, rtol=1e-6)


@pytest.mark.slow
def test_an_interrupted_fit_writes_the_best_so_far(conformal, tmp_path, capsys, monkeypatch):
    tensors, values = conformal
    target, out = write_target(tmp_path / "target.npz", values), tmp_path / "out"
    np.savez(tmp_path / "init.npz", tensors=1.3 * np.linalg.inv(tensors), spacing=FIT_GRID.spacing)

    def interrupt(progress, text):
        if text.startswith("step 1"):
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "update", interrupt)
    # With as many eigenpairs as the fit above chooses, nothing is compiled that it has not compiled.
    flat = hj.TensorField(FIT_GRID, np.broadcast_to(np.eye(2), (*FIT_GRID.shape, 2, 2)))
    k = pairs_for(FIT_TIMES, hj.assemble(flat), flat)
    arguments = ["--init", str(tmp_path / "init.npz"), "--metric", "inverse", "-k", str(k), "-q", *FIT_ARGUMENTS]
    assert main(["fit", str(target), "-o", str(out), *arguments]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["result"] == "interrupted"
    assert "interrupted" in capsys.readouterr().err
    with np.load(out / "fit.npz") as read:
        assert read["losses"][1] < read["losses"][0]


@pytest.mark.parametrize(
    ("arguments", "changes", "words"),
    [
        ([], {"times": None, "spacing": None}, ["the arrays hks, origin;", "Add times, spacing"]),
        ([], {"times": FIT_TIMES[:2]}, ["hks of shape (3, 14, 13)", "times of shape (2,)"]),
        (
            [],
            {"provenance": '{"settings": {"normalisation": "volume"}}'},
            ["TARGET: got", "volume; expected raw or flat"],
        ),
        ([], {"hks": np.nan}, ["target: got 1 of 546 observed values that are NaN", "(2, 3, 4)"]),
        (["--init", "init.npz"], {}, ["--init: got tensors of shape (14, 12)", "the target's shape (14, 13)"]),
        (["--init", "volume.npz"], {}, ["shape (5, 4, 3)", "hks-jax convert volume.npz slice.npz --slice"]),
        (["--init", "moved.npz"], {"affine": FIT_AFFINE}, ["--init: the affine displaces", "up to 3 from the target"]),
        (["--metric", "inverse"], {}, ["--metric", "--init"]),
        (["--init", "init.nii.gz"], {}, ["--metric: choose"]),
        (["--init", "init.nrrd"], {}, ["--metric: choose"]),
        (["--init", "scan.npz"], {}, ["--metric: choose"]),
        (["--init", "init.vti"], {}, ["--metric: choose"]),
        (["--h1", "-1"], {}, ["--h1: got '-1'; expected a positive number"]),
    ],
)
def test_fit_errors_are_one_line_and_leave_nothing(conformal, tmp_path, capsys, monkeypatch, arguments, changes, words):
    monkeypatch.chdir(tmp_path)
    values = conformal[1].copy()
    if "hks" in changes:
        values[2, 3, 4], changes = changes["hks"], {}
    write_target("target.npz", values, **changes)
    np.savez("init.npz", tensors=metric())
    np.savez("volume.npz", tensors=np.broadcast_to(np.eye(3), (5, 4, 3, 3, 3)))
    moved = FIT_AFFINE + 3.0 * np.eye(4)[:, [3, 0, 1, 2]] * [0, 0, 0, 1]
    np.savez("scan.npz", tensors=metric(), length_unit="mm")
    np.savez("moved.npz", tensors=np.tile(np.eye(2), (*FIT_GRID.shape, 1, 1)), affine=moved)
    before = sorted(tmp_path.iterdir())
    assert one_error(capsys, main(["fit", "target.npz", "-o", "out", *arguments]), *words) == 2
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_a_reader_that_has_enough_ends_the_output_silently(npz):
    for reader, read in (("head -c 1", "{"), ("true", "")):
        command = f"{sys.executable} -m hks_jax info --json {npz} | {reader}; exit ${{PIPESTATUS[0]}}"
        done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (0, read, "")


def test_a_second_scan_beside_images_is_a_file_of_tensors():
    words = ["hks", "dwi.nii.gz", "--bval", "a.bval", "--bvec", "a.bvec", "--b-max", "1200"]
    words += ["--noise", "second.nii.gz", "-o", "out"]
    second = Reading.of(build_parser().parse_args(words)).second_scan
    assert second.file == Path("second.nii.gz")
    assert (second.bval, second.bvec, second.bvec_frame, second.b_max, second.noise) == (None,) * 5


@pytest.mark.slow
@pytest.mark.parametrize("second", [False, True])
def test_error_bars_begin_where_there_is_signal(npz, tmp_path, rng, second):
    noise = "0.05"
    if second:
        noise = str(tmp_path / "second.npz")
        other = metric() * (1 + 0.04 * rng.standard_normal((*SHAPE, 1, 1)))
        np.savez(noise, tensors=other, spacing=[0.5, 0.25], origin=[1.0, 2.0], mask=disc())
    words = ["-k", "30", "--times", "auto:3", "--noise", noise, "--draws", "8", "--normalisation", "flat", "-q"]
    main(["hks", str(npz), "-o", str(tmp_path / "out"), "--metric", "inverse", *words])
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    ratio = report["noise"]["signal_to_noise_with_rim"]  # all of so small a disc is near its rim
    assert "z" in np.load(tmp_path / "out" / "hks.npz").files
    assert len(ratio) == len(report["times"]) == 3
    assert ratio[0] >= 1
    assert report["noise"]["sampling_error"] == pytest.approx(12**-0.5)
    with np.load(tmp_path / "out" / "hks.npz") as saved:
        assert saved["deviation"].shape == saved["bias"].shape == saved["hks"].shape
        known = np.isfinite(saved["hks"])
        assert (saved["deviation"][known] > 0).all()
        drawn = np.sqrt(np.mean(np.square(saved["noise_maps"]), axis=0))
        np.testing.assert_allclose(saved["deviation"][known], drawn[known], rtol=1e-4)
        labels = np.where(np.arange(SHAPE[0]) < 7, 1, 2)[:, None] * np.ones(SHAPE[1], int)
        np.save(tmp_path / "labels.npy", labels)
        mean = np.nanmean(saved["noise_maps"][:, 1, :7], axis=(1, 2))
    main(["stats", str(tmp_path / "out"), "--atlas", str(tmp_path / "labels.npy"), "-q"])
    lines = (tmp_path / "out" / "regions.tsv").read_text().splitlines()
    assert lines[0].endswith("\terror")
    assert float(lines[2].split("\t")[-1]) == pytest.approx(np.sqrt(np.mean(mean**2)), rel=1e-3)


@pytest.mark.slow
def test_the_rim_of_a_mask_is_no_signal(tmp_path, capsys):
    x, y = np.indices((28, 28)) - 13.5
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(np.eye(2), (28, 28, 2, 2)), mask=np.hypot(x, y) < 13)
    words = ["-k", "100", "--times", "3", "8", "120", "--noise", "0.05", "--draws", "8", "--normalisation", "flat"]
    assert main(["hks", str(tmp_path / "t.npz"), "-o", str(tmp_path / "out"), "--metric", "inverse", *words]) == 0
    told = capsys.readouterr().err
    assert "signal-to-noise ratio: 0" in told
    assert "no signal-to-noise ratio at t = 120: the boundary influences nearly all nodes" in told
    noise = json.loads((tmp_path / "out" / "report.json").read_text())["noise"]
    assert noise["interior"][0] > noise["interior"][1] > 0.2 > noise["interior"][2] == 0
    assert max(noise["signal_to_noise"][:2] + noise["signal_to_noise_with_rim"]) < 0.5
    with np.load(tmp_path / "out" / "hks.npz") as saved:
        known = np.isfinite(saved["z"])
        assert np.mean(abs(saved["z"][known]) > 2) < 0.06
    assert noise["signal_to_noise"][2] is noise["exceeds_2_from_t"] is None


def test_error_bars_are_refused_where_there_are_none(npz, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("hks_jax.cli.hks.compute_pairs", None)  # which may take hours, so errors come before it
    tensors, moved = np.tile(np.eye(3), (4, 4, 4, 1, 1)), np.eye(4)
    moved[0, 0], moved[0, 3] = -1.0, 3.0  # the same voxels, stored from right to left
    volume, mirrored = tmp_path / "volume.npz", str(tmp_path / "mirrored.npz")
    np.savez(volume, tensors=tensors, affine=np.eye(4))
    np.savez(mirrored, tensors=tensors + np.eye(3), affine=moved)
    cropped = str(tmp_path / "cropped.npz")
    np.savez(cropped, tensors=tensors * (np.arange(4) > 0)[:, None, None], affine=np.eye(4))
    for file, words, text in (
        (volume, ["--slice", "x=2", "-k", "4", "--noise", cropped], "without tensors at 4 of the 16 voxels"),
        (npz, ["--noise", "residuals"], "--noise: got residuals, which need a fit"),
        (npz, ["--noise", "0.1", "--method", "auto"], "--noise: got --method auto; expected spectral"),
        (npz, ["--noise", "0.1", "--draws", "4"], "--draws: got 4; expected an integer of at least 8"),
        (npz, ["--noise", str(tmp_path / "absent.npz")], "absent.npz"),
        (
            volume,
            ["--slice", "x=2", "-k", "4", "--noise", mirrored],
            "displaces this image by up to 1 from",
        ),
    ):
        assert main(["hks", str(file), "-o", str(tmp_path / "out"), "--metric", "inverse", "-q", *words]) == 2
        assert text in capsys.readouterr().err
