"""Finished work and inputs are kept: results before pictures, and no output in the place of an input."""

import csv
import json
import shutil
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from matplotlib.figure import Figure

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io.result import Result

SHAPE, SPACING = (12, 10), 0.1


@pytest.fixture
def field(tmp_path):
    tensors = np.broadcast_to(np.diag([1.0, 2.0]), (*SHAPE, 2, 2))
    np.savez(tmp_path / "field.npz", tensors=tensors, spacing=[SPACING] * 2)
    return tmp_path / "field.npz"


@pytest.fixture
def without_latex(monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("Failed to process string with tex because latex could not be found")

    monkeypatch.setattr(Figure, "savefig", fail)


def bytes_in(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_one_eigenpair_is_a_constant_signature(field, tmp_path):
    """The mode of λ = 0 alone: 1/area, where no time is resolved."""
    out = tmp_path / "out"
    assert main(["hks", str(field), "-o", str(out), "-q", "-k", "1", "--times", "0.1", "1"]) == 0
    result = Result.read(out)
    area = 11 * 9 * SPACING**2 * np.sqrt(2)
    np.testing.assert_allclose(result.values / result.flat_scale, 1 / area, rtol=1e-10)
    assert result.smallest_time == np.inf
    assert main(["plot", str(out), "-o", str(tmp_path / "p.png"), "--points", "0.5,0.5", "-q"]) == 0


@pytest.mark.parametrize("name", ["hks", "spectrum", "curvature", pytest.param("fit", marks=pytest.mark.slow)])
def test_a_picture_that_cannot_be_drawn_leaves_the_results(field, tmp_path, capsys, name, without_latex):
    out, source = tmp_path / "out", str(field)
    out.mkdir()
    (out / f"{name}.png").write_text("of an earlier result")
    more = {"hks": ["-k", "6", "--times", "0.1"], "spectrum": ["-k", "6"], "curvature": [], "fit": ["--max-steps", "1"]}
    if name == "fit":
        grid = hj.Grid(SHAPE, SPACING)
        tensors = np.broadcast_to(np.diag([1.2, 1.2]), (*SHAPE, 2, 2))
        values = np.asarray(hj.hks(hj.eigenpairs(hj.TensorField(grid, tensors), 40), [0.1]))
        source = str(tmp_path / "target.npz")
        np.savez(source, hks=values, times=[0.1], spacing=grid.spacing, origin=grid.origin)
        more[name] += ["--parametrisation", "conformal", "-k", "40"]
    assert main([name, source, "-o", str(out), "-q", *more[name]]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert (
        f"the picture {out / f'{name}.png'} cannot be drawn (RuntimeError: Failed to process string with tex" in error
    )
    files = {file.name for file in out.iterdir()}
    assert f"{name}.png" not in files
    assert {f"{name}.npz", "report.json"} <= files
    assert f"The results are complete: {', '.join(str(out / file) for file in sorted(files))}" in error
    with np.load(out / f"{name}.npz") as arrays:
        assert arrays[{"spectrum": "eigenvalues", "fit": "hks"}.get(name, name)].size > 5


def test_no_command_replaces_its_input(field, tmp_path, capsys):
    out, mask = tmp_path / "out", np.ones(SHAPE, bool)
    assert main(["hks", str(field), "-o", str(out), "-q", "-k", "6", "--times", "0.1", "--save-pairs"]) == 0
    labels = np.ones(SHAPE, int)
    for name in ("hks", "curvature"):
        np.savez(out / f"{name}.mine.npz", mask=mask)
    np.save(tmp_path / "regions.npy", labels)
    (tmp_path / "regions.tsv").write_text("index\tname\n1\tone half\n")
    shutil.copy(field, out / "spectrum.npz")
    shutil.copy(field, out / "tensors.npz")
    link = tmp_path / "link"
    link.symlink_to(out)
    before = bytes_in(tmp_path)
    commands = {
        "hks.npz": ["hks", out / "hks.npz", "--array", "input_tensors", "-o", out],
        "link/hks.npz": ["hks", link / "hks.npz", "--array", "input_tensors", "-o", out],
        "hks.mine.npz": ["hks", field, "--mask", out / "hks.mine.npz", "-o", tmp_path / "link" / ".." / "out"],
        "spectrum.npz": ["spectrum", out / "spectrum.npz", "-o", out],
        "curvature.mine.npz": ["curvature", field, "--mask", out / "curvature.mine.npz", "-o", out],
        "tensors.npz": ["fit", out, "-o", out, "--init", out / "tensors.npz"],
        "out/hks.npz": ["fit", out, "-o", tmp_path / "fitted", "--checkpoint", out / "hks.npz"],
        "field.npz": ["convert", field, link / ".." / "field.npz"],
        "regions.tsv": ["stats", out, "--atlas", tmp_path / "regions.npy", "-o", tmp_path / "regions.tsv"],
        "pairs.npz": ["hks", field, "--noise", out / "pairs.npz", "-o", out, "--save-pairs"],
    }
    for name, words in commands.items():
        assert main([*map(str, words), "-q"]) == 2, name
        error = capsys.readouterr().err
        assert f"{name}: this input file would be replaced by the output" in error, error
    assert bytes_in(tmp_path) == before
    # Saved eigenpairs serve for other times in the same folder, and a fit may go on from its checkpoint.
    assert main(["hks", str(out / "pairs.npz"), "-o", str(out), "-q", "--times", "0.2"]) == 0
    assert (out / "pairs.npz").read_bytes() == before[Path("out") / "pairs.npz"]


@pytest.fixture
def subjects(tmp_path):
    x, y, _ = (a / 5 for a in np.indices((9, 8, 3)))
    tensors = 1e-3 * (1 + 0.2 * np.sin(x + y))[..., None, None] * np.diag([1.5, 1.0, 0.8])
    hj.io.save_tensors(
        tmp_path / "t.nii.gz", hj.io.TensorVolume(tensors, (2.0,) * 3, (0.0,) * 3, affine=np.diag([2, 2, 2, 1.0]))
    )
    nib.save(
        nib.Nifti1Image(np.where(x < 0.8, 1, 2).astype(np.int16), np.diag([2, 2, 2, 1.0])), tmp_path / "atlas.nii.gz"
    )
    (tmp_path / "names.txt").write_text("1 one half\n2 other half\n")
    (tmp_path / "subjects.tsv").write_text("participant_id\tfile\n01\tt.nii.gz\n")
    return tmp_path


def test_a_repeated_study_keeps_its_names_and_draws_what_it_lacks(subjects, capsys, monkeypatch):
    study = subjects / "study"
    given = ["batch", str(subjects / "subjects.tsv"), "-o", str(study)]
    more = ["--metric", "inverse", "--slice", "z=1", "-k", "8", "--times", "2e4"]
    files = ["--atlas", str(subjects / "atlas.nii.gz"), "--names", str(subjects / "names.txt")]
    with monkeypatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda *_, **__: 1 / 0)
        assert main([*given, *more, *files]) == 1
    error = capsys.readouterr().err
    assert "sub-01: the picture" in error
    assert "the results are complete, but 1 of 1 pictures cannot be drawn (sub-01). Repeat the command" in error

    def regions():
        with open(study / "group_regions.tsv", encoding="utf-8", newline="") as stream:
            return [row["region"] for row in csv.DictReader(stream, delimiter="\t")]

    assert regions() == ["one half", "other half"]
    picture = study / "sub-01" / "figures" / "sub-01_model-tensor_param-hks_dwimap.png"
    assert not picture.exists()
    before = bytes_in(study)
    assert main(given) == 0
    printed = capsys.readouterr().err
    assert f"--names {subjects / 'names.txt'}" in printed
    assert regions() == ["one half", "other half"]
    assert picture.read_bytes()[:4] == b"\x89PNG"
    after = bytes_in(study)
    after.pop(picture.relative_to(study))
    for files in (before, after):  # the log is that of the last run
        files.pop(Path("logs/sub-01.log"))
    assert after == before
    assert main([*given, "-q"]) == 0
    assert json.loads((study / "study.json").read_text())["files"]["names"] == str(subjects / "names.txt")


def test_a_study_does_not_replace_another_dataset_or_its_table(subjects, capsys):
    more = ["--metric", "inverse", "--slice", "z=1", "-k", "8", "--times", "2e4", "-q"]
    raw = subjects / "raw"
    raw.mkdir()
    (raw / "dataset_description.json").write_text('{"Name": "Raw", "BIDSVersion": "1.10.0"}')
    before = bytes_in(subjects)
    assert main(["batch", str(subjects / "subjects.tsv"), "-o", str(raw), *more]) == 2
    error = capsys.readouterr().err
    assert f"--output: got {raw}, where another program wrote dataset_description.json" in error
    assert f"Choose a folder such as {raw / 'derivatives' / 'hks-jax'}" in error
    assert bytes_in(subjects) == before
    shutil.copy(subjects / "subjects.tsv", subjects / "participants.tsv")
    assert main(["batch", str(subjects / "participants.tsv"), "-o", str(subjects), *more]) == 2
    assert "participants.tsv: this input file would be replaced by the output" in capsys.readouterr().err
    image = subjects / "s" / "sub-01" / "dwi" / "sub-01_model-tensor_param-hks_dwimap.nii.gz"
    image.parent.mkdir(parents=True)
    shutil.copy(subjects / "t.nii.gz", image)
    (subjects / "subjects.tsv").write_text(f"participant_id\tfile\n01\t{image.relative_to(subjects)}\n")
    assert main(["batch", str(subjects / "subjects.tsv"), "-o", str(subjects / "s"), *more]) == 2
    assert "hks_dwimap.nii.gz: this input file would be replaced by the output" in capsys.readouterr().err
