"""The BIDS app on trees as QSIRecon, QSIPrep, FSL and MRtrix write them: its results, its levels, and bad input."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import derivatives as tree
import nibabel as nib
import numpy as np
import pytest

from hks_jax.cli import build_parser, main
from hks_jax.cli.study.bids import find_subjects
from hks_jax.io import read_tensors
from hks_jax.io.bids import Dataset

GIVEN = ("--metric", "inverse", "--slice", "z=1", "-k", "6", "--boundary", "neumann", "--times", "1e4", "3e4", "-q")
HKS = "_model-tensor_param-hks"


def table(path):
    with open(path, encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream, delimiter="\t"))


def contents(folder):
    files = [path for path in folder.rglob("*") if path.is_file() and path.parent.name != "logs"]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.fixture
def app(tmp_path, monkeypatch):
    """Call the app on the folder ``in``; pictures are not drawn."""
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )

    def call(*words, out="out"):
        return main(["bids", str(tmp_path / "in"), str(tmp_path / out), *words])

    return call


def test_participants_are_jobs_and_the_group_collects(tmp_path, app, monkeypatch, capsys):
    for entities, scale in ((("ses-1", "run-1"), 1.0), (("ses-1", "run-2"), 1.2), (("ses-2", "acq-fast"), 0.9)):
        tree.bep16(tmp_path / "in", "01", *entities, scale=scale)
        tree.labels(tmp_path / "in", "01", *entities)
    tree.qsirecon(tmp_path / "in", "02", "ses-1")
    tree.labels(tmp_path / "in", "02", "ses-1")
    (tmp_path / "in" / "participants.tsv").write_text("participant_id\tage\nsub-02\t41\nsub-01\t30\n")
    (tmp_path / "in" / "sub-03" / "dwi").mkdir(parents=True)
    more = ("--skip-bids-validation", "--atlas", "seg-Halves")
    assert app("participant", "--participant-label", "01", *GIVEN, *more) == 0
    stems = [f"sub-01_{one}_space-ACPC{HKS}" for one in ("ses-1_run-1", "ses-1_run-2", "ses-2_acq-fast")]
    out = tmp_path / "out"
    for stem in stems:
        folder = out / "sub-01" / re.search("ses-.", stem)[0]
        assert nib.load(folder / "dwi" / f"{stem}_dwimap.nii.gz").shape == (8, 7, 1, 2)
        assert (out / "sub-01" / "figures" / f"{stem}_dwimap.png").is_file()
        assert (out / "logs" / f"{stem.removesuffix(HKS)}.log").read_text().endswith("\ndone\n")
    assert app("participant", "--participant_label", "02", "-q") == 0  # options, also the labels, are those of OUT

    # A repeated job computes nothing; one with other settings is refused.
    before = contents(out)
    with monkeypatch.context() as patch:
        patch.setattr("hks_jax.cli.study.tasks._compute", None)
        assert app("participant", "--participant-label", "sub-01", "02", "-q") == 0
        assert app("participant", "--participant-label", "01", "-q", "-k", "7") == 2
        assert "has -k 6, not 7. Leave" in capsys.readouterr().err
        assert contents(out) == before
        assert app("group", "-q") == 0
    assert "sub-03: failed: sub-03: no tensors" in capsys.readouterr().err
    rows = table(out / "group_summary.tsv")
    assert [(row["participant_id"], row["session_id"], row["run"], row["acq"], row["status"]) for row in rows] == [
        ("sub-01", "ses-1", "1", "n/a", "done"),
        ("sub-01", "ses-1", "2", "n/a", "done"),
        ("sub-01", "ses-2", "n/a", "fast", "done"),
        ("sub-02", "ses-1", "n/a", "n/a", "done"),
        ("sub-03", "n/a", "n/a", "n/a", "failed"),
    ]
    regions = table(out / "group_regions.tsv")
    assert len(regions) == 4 * 2 * 2
    assert {row["region"] for row in regions} == {"left", "right"}
    people = table(out / "participants.tsv")
    assert people == [{"participant_id": f"sub-0{i}", "age": age} for i, age in ((1, "30"), (2, "41"), (3, "n/a"))]

    # A damaged result is no result of the group, until its job is repeated.
    npz = out / "sub-02" / "ses-1" / "dwi" / f"sub-02_ses-1_space-ACPC{HKS}_dwimap.npz"
    npz.write_bytes(b"half of it")
    collected = contents(out)
    assert app("group", "-q") == 0
    row = table(out / "group_summary.tsv")[3]
    assert (row["status"], row["problem"]) == ("pending", f"{npz} is damaged: its SHA-256 is not that of the sidecar")
    assert {row["participant_id"] for row in table(out / "group_regions.tsv")} == {"sub-01"}
    assert app("participant", "--participant-label", "02", "-q") == 0
    assert app("group", "-q") == 0
    assert {name for name, content in contents(out).items() if collected[name] != content} == {
        npz.relative_to(out).as_posix()
    }
    assert npz.read_bytes() == before[npz.relative_to(out).as_posix()]


def test_options_that_no_input_has_a_use_for_are_refused(tmp_path, app, capsys):
    tree.bep16(tmp_path / "in", "01")
    assert app("participant", *GIVEN, "--b-max", "700") == 2
    assert "--b-max: this option is for diffusion-weighted images, but all participants" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_metadata_that_images_inherit_describe_them(tmp_path):
    """Six images with one JSON file at the root are read as those with a sidecar each."""
    frames = {}
    for name, places in (("own", None), ("root", "model-tensor_dwimap.json")):
        folder = tree.qsirecon(tmp_path / name, "01")
        text = json.dumps({"OrientationEncoding": {"Reference": "bvec"}, "Units": "um^2/ms"})
        files = (
            [tmp_path / name / places] if places else [p.with_suffix("").with_suffix(".json") for p in folder.iterdir()]
        )
        for file in files:
            file.write_text(text)
        dataset = Dataset(tmp_path / name)
        args = build_parser().parse_args(["bids", str(tmp_path / name), "out", "participant"])
        (subject,) = find_subjects(dataset, ["01"], args)
        reading = subject.args
        volume = read_tensors(reading.file, reading.order, frame=reading.frame, unit=reading.unit)
        frames[name] = volume.tensors, volume.frame, volume.unit
    np.testing.assert_array_equal(frames["own"][0], frames["root"][0])
    assert frames["own"][1:] == frames["root"][1:] == ("fsl", "mm²/s")


def test_inputs_without_a_mask_are_told(tmp_path, capsys):
    for label in ("01", "02"):
        path = tree.bep16(tmp_path / "in", label)
    tree.image(path.with_name("sub-02_space-ACPC_label-lesion_mask.nii.gz"), tree.mask())
    args = build_parser().parse_args(["bids", str(tmp_path / "in"), "out", "participant"])
    with pytest.warns(UserWarning, match=r"2 of 2 inputs have no mask desc-brain .*label-lesion_mask\.nii\.gz is not"):
        subjects = find_subjects(Dataset(tmp_path / "in"), ["01", "02"], args)
    assert [subject.args.mask for subject in subjects] == [None, None]
    tree.image(path.with_name("sub-02_space-ACPC_desc-brain_mask.nii.gz"), tree.mask())
    with pytest.warns(UserWarning, match="1 of 2 inputs have no mask desc-brain with .* .the first is sub-01"):
        find_subjects(Dataset(tmp_path / "in"), ["01", "02"], args)


@pytest.mark.slow
def test_all_programs_give_the_same_signature(tmp_path, app):
    """Tensors in three conventions, and images to which they are fitted, within the same mask."""
    tree.dtifit(tmp_path / "in", "fsl")
    tree.mrtrix(tmp_path / "in", "mrtrix")
    tree.qsiprep(tmp_path / "in", "qsiprep")
    folder = tree.qsirecon(tmp_path / "in", "qsirecon")
    tree.image(folder / "sub-qsirecon_space-ACPC_desc-brain_mask.nii.gz", tree.mask())
    assert app("participant", *GIVEN, "--save-pairs") == 0
    values = {}
    for label in ("fsl", "mrtrix", "qsiprep", "qsirecon"):
        (file,) = (tmp_path / "out" / f"sub-{label}" / "dwi").glob("*_dwimap.npz")
        values[label] = np.load(file)["hks"]
    assert np.isfinite(values["fsl"][0]).sum() == 7 * 6
    for label in ("mrtrix", "qsirecon"):
        np.testing.assert_allclose(values[label], values["fsl"], rtol=1e-5)
    np.testing.assert_allclose(values["qsiprep"], values["fsl"], rtol=1e-3)


def test_automatic_times_suit_all_participants_and_are_chosen_once(tmp_path, app, monkeypatch, capsys):
    for label, scale in (("01", 1.0), ("02", 1.1)):
        tree.bep16(tmp_path / "in", label, scale=scale)
    auto = [word for word in GIVEN if word not in ("1e4", "3e4", "--times")]
    assert app("prepare", *auto, "--times", "auto:2", "--select", "space-ACPC", "--json") == 0
    times = json.loads(capsys.readouterr().out)["times"]
    assert app("participant", "--participant-label", "01", *auto, "--times", "auto:2", out="alone") == 0
    assert json.loads((tmp_path / "alone" / "study.json").read_text())["times"] == times  # also of the other
    monkeypatch.setattr("hks_jax.cli.study.settings.suitable_range", None)
    assert app("participant", "--participant-label", "01", "-q") == 0
    npz = next((tmp_path / "out" / "sub-01" / "dwi").glob("*_dwimap.npz"))
    assert np.load(npz)["times"].tolist() == times
    assert json.loads((tmp_path / "out" / "study.json").read_text())["files"] == {"select": "space-ACPC"}


def test_bad_input_is_refused(tmp_path, app, capsys):
    def refused(*words):
        assert app(*words) == 2
        return capsys.readouterr().err

    assert "no such folder" in refused("participant", *GIVEN)
    tree.qsirecon(tmp_path / "in", "01")
    (tmp_path / "in" / "sub-02" / "dwi").mkdir(parents=True)
    assert "invalid choice: 'run'" in refused("run", *GIVEN)
    assert "got 07; the participants in" in refused("participant", "--participant-label", "07", *GIVEN)
    assert "sub-02: no tensors" in refused("participant", "--participant-label", "02", *GIVEN)
    assert "leave the option out" in refused("group", "--participant-label", "01", *GIVEN)
    assert "there are no results in" in refused("group", *GIVEN)
    assert "--metric: choose the metric" in refused("prepare", "-q")
    assert "--select: got 'ACPC'" in refused("participant", "--select", "ACPC", *GIVEN)
    assert "--mask: got desc-x, but no file" in refused("participant", "--mask", "desc-x", *GIVEN)
    assert not (tmp_path / "out").exists()
    assert app("prepare", *GIVEN) == 0
    assert "has none of the 2 results. sub-01_space-ACPC: not computed" in refused("group")
    assert app("participant", "--components", "all", out="other") == 2  # without a metric
    assert "--metric" in capsys.readouterr().err


def recipe(language):
    """Return a block of the documentation."""
    page = (Path(__file__).parents[2] / "docs" / "bids.md").read_text(encoding="utf-8")
    return re.search(rf"```{language}\n(.*?)```", page, re.DOTALL)[1]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("snakemake") is None, reason="snakemake is not installed")
def test_snakemake_runs_three_participants_and_resumes_after_a_killed_job(tmp_path, monkeypatch):
    """The recipe of the documentation, with a program that dies once, in the middle of a participant."""
    data = tmp_path / "derivatives" / "qsirecon-DSIStudio"
    for label in ("01", "02", "03"):
        tree.qsirecon(data, label, "ses-1")
    (tmp_path / "Snakefile").write_text(recipe("snakemake"))
    program = tmp_path / "bin" / "hks-jax"
    program.parent.mkdir()
    program.write_text(
        f"#!/bin/bash\n[[ $* == *' 02' && ! -e killed ]] || exec {sys.executable} -m hks_jax \"$@\"\n"
        f'touch killed\n{sys.executable} -m hks_jax "$@" &\n'
        "until grep -q eigenpairs out/logs/sub-02_*.log; do sleep 0.05; done\nkill -9 $!\nwait $!\n"
    )
    program.chmod(0o755)
    path = f"{program.parent}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "JAX_PLATFORMS": "cpu", "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = ["snakemake", "--cores", "1", "--keep-going"]
    options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True, "timeout": 400}
    first = subprocess.run(command, **options)
    out = tmp_path / "out"
    assert first.returncode != 0, first.stderr
    assert sorted(file.name for file in (out / "logs").glob("*.finished")) == ["sub-01.finished", "sub-03.finished"]
    assert not list(out.glob("sub-02/**/*.json"))
    assert not (out / "group_summary.tsv").exists()
    before = contents(out)
    second = subprocess.run([*command, "--rerun-incomplete"], **options)
    assert second.returncode == 0, second.stderr
    assert [row["status"] for row in table(out / "group_summary.tsv")] == ["done"] * 3
    after = contents(out)
    assert {name: after[name] for name in before} == before
    shutil.rmtree(out / "sub-02")
    monkeypatch.chdir(tmp_path)  # as in the recipe, because results contain the paths of their inputs
    again = ["bids", str(data.relative_to(tmp_path)), "out", "participant", "--participant-label", "02", "-q"]
    assert main(again) == 0
    assert contents(out) == after


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bids-validator-deno") is None, reason="bids-validator-deno is not installed")
def test_the_validator_accepts_the_results(tmp_path, app):
    tree.qsirecon(tmp_path / "in", "01", "ses-1", "run-1")
    tree.labels(tmp_path / "in", "01", "ses-1", "run-1")
    assert app("participant", *GIVEN, "--atlas", "seg-Halves", "--save-pairs") == 0
    assert app("group", "-q") == 0
    command = ["bids-validator-deno", str(tmp_path / "out"), "--format", "json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    issues = json.loads(done.stdout)["issues"]["issues"]
    assert [issue for issue in issues if issue["severity"] == "error"] == []


@pytest.mark.skipif(shutil.which("hadolint") is None, reason="hadolint is not installed")
def test_the_recipe_of_the_container_is_linted():
    assert subprocess.run(["hadolint", Path(__file__).parents[2] / "containers" / "Dockerfile"]).returncode == 0
