"""Studies: regions' statistics, six images of components, and many subjects that are computed, killed and resumed."""

import argparse
import csv
import importlib.util
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from annotations import unchecked

import hks_jax as hj
from hks_jax.cli import build_parser, main
from hks_jax.cli.computation import Settings, compute_pairs, domain_of_volume
from hks_jax.cli.noise import Noise, signature_of
from hks_jax.cli.options import defaults
from hks_jax.cli.parsing import Times
from hks_jax.cli.progress import StudyProgress
from hks_jax.cli.study.folder import Study
from hks_jax.cli.study.settings import Range, add_kept, common_times, suitable_range
from hks_jax.cli.study.subjects import read_subjects
from hks_jax.cli.study.tasks import Outcome
from hks_jax.io import TensorVolume, read_tensors, save_tensors
from hks_jax.io.masks import names_beside, read_names
from hks_jax.io.nifti import component_of
from hks_jax.io.pairs import pairs_of
from hks_jax.io.result import Result
from hks_jax.io.tables import read_table, write_table

ROOT = Path(__file__).resolve().parents[2]
BRAINS = ROOT.parent / "shared" / "data"
SHAPE = (9, 8, 3)
AFFINE = np.array([[0, -2.0, 0, 5], [2.0, 0, 0, -3], [0, 0, -3.0, 1], [0, 0, 0, 1]])


def tensors(scale=1.0):
    """Tensors in mm²/s that turn and stretch, multiplied by a number."""
    x, y, z = (a / 5 for a in np.indices(SHAPE))
    field = np.zeros((*SHAPE, 3, 3))
    for a, values in enumerate((1.5 + 0.4 * np.cos(x), 1.0 + 0.3 * np.sin(y), 0.8 + 0.1 * z)):
        field[..., a, a] = values
    field[..., 0, 1] = field[..., 1, 0] = 0.2 * np.sin(x + y)
    field[..., 1, 2] = field[..., 2, 1] = 0.1 * np.cos(z)
    return 1e-3 * scale * field


def volume(scale=1.0):
    return TensorVolume(tensors(scale), (2.0, 2.0, 3.0), (0.0,) * 3, affine=AFFINE, length_unit="mm")


def table(path):
    with open(path, encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream, delimiter="\t"))


# ---------------------------------------------------------------------------------------------------- regions


def test_region_statistics_are_those_of_the_regions_alone(rng):
    values, labels = rng.standard_normal((3, 6, 5)), rng.integers(0, 4, (6, 5)) * 10
    values[:, labels == 30] = np.nan
    values[:, 0, :] = np.nan
    found = hj.region_statistics(values, labels, 2.5)
    assert found.labels.tolist() == [10, 20, 30]
    inside = np.isfinite(values[0])
    for r, label in enumerate((10, 20)):
        part = values[:, inside & (labels == label)]
        assert (found.nodes[r], found.volume[r]) == (part.shape[1], 2.5 * part.shape[1])
        np.testing.assert_allclose(found.coverage[r], part.shape[1] / (labels == label).sum())
        np.testing.assert_allclose(found.mean[:, r], part.mean(axis=1))
        np.testing.assert_allclose(found.deviation[:, r], np.sqrt(((part - part.mean(1, keepdims=True)) ** 2).mean(1)))
        np.testing.assert_allclose(found.median[:, r], np.median(part, axis=1))
    assert (found.nodes[2], found.coverage[2]) == (0, 0)
    assert np.isnan(found.mean[:, 2]).all()


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        (np.zeros((6, 5)), "got 0 at all nodes"),
        (np.full((6, 5), 0.5), "fractional numbers"),
        (np.ones((5, 6)), r"got shape \(5, 6\)"),
    ],
)
def test_labels_that_are_none_are_refused(labels, words):
    with unchecked(), pytest.raises(ValueError, match=words):
        hj.region_statistics(np.ones((2, 6, 5)), labels)


def test_names_are_read_from_what_there_is(tmp_path):
    def names(text):
        (tmp_path / "n.tsv").write_text(text, encoding="utf-8")
        return read_names(tmp_path / "n.tsv")

    assert names("color\tname\tindex\n#ff\tleft thalamus\t10\n") == {10: "left thalamus"}
    assert names("# No. Name: R G B A\n10  Left-Thalamus  0 118 14 0\n") == {10: "Left-Thalamus"}
    assert names("10 left thalamus\n4\tbelow it\tB\n") == {10: "left thalamus", 4: "below it"}
    for text, message in (("index\tname\n", "index, name and 0 rows"), ("left\n", "no line has a number and a name")):
        with pytest.raises(ValueError, match=message):
            names(text)
    assert names_beside(tmp_path / "n.nii.gz") == str(tmp_path / "n.tsv")
    assert names_beside(tmp_path / "m.nii.gz") is None


def test_tables_come_back_as_they_were_written(tmp_path):
    rows = [("01", 1 / 3, None, "a\tb\nc"), ("02", float("nan"), 5, "")]
    path, about = write_table(tmp_path / "t.tsv", ("id", "x", "n", "text"), rows, {"x": {"Units": "s"}})
    assert path.read_text() == "id\tx\tn\ttext\n01\t0.333333333\tn/a\ta b c\n02\tn/a\t5\tn/a\n"
    assert read_table(path) == [{"id": "01", "x": "0.333333333", "text": "a b c"}, {"id": "02", "n": "5"}]
    assert json.loads(about.read_text()) == {"x": {"Units": "s"}}
    for text, words in (("id\tid\n1\t2\n", "different names"), ("id\n1\t2\n", "2 cells in row 2"), ("id\n", "0 rows")):
        path.write_text(text)
        with pytest.raises(ValueError, match=words):
            read_table(path)


# ---------------------------------------------------------------------------------------------------- six images


def write_six(folder, field, affine=AFFINE, name="sub-01_model-tensor_param-t{}_dwimap.nii.gz"):
    paths = []
    for a, b in ("xx", "xy", "xz", "yy", "yz", "zz"):
        paths.append(folder / name.format(a + b))
        nib.save(nib.Nifti1Image(field[..., "xyz".index(a), "xyz".index(b)], affine), paths[-1])
    return paths


def test_six_images_are_the_tensors_that_they_are_the_components_of(tmp_path):
    paths = write_six(tmp_path, tensors())
    for given in (paths, paths[::-1], paths[4]):
        read = read_tensors(given)
        np.testing.assert_array_equal(read.tensors, tensors())
        np.testing.assert_allclose(read.affine, AFFINE)
        assert (read.frame, read.spacing) == ("voxel", (2.0, 2.0, 3.0))
    ants = write_six(tmp_path, tensors(), name="dt{}.nii")
    np.testing.assert_array_equal(read_tensors(ants[0]).tensors, tensors())
    assert [component_of(n) for n in ("a_Dxy.nii", "t_param-tzz_x.nii", "xxl.nii", "maxx.nii")] == [
        "xy",
        "zz",
        None,
        None,
    ]


def test_six_images_say_by_their_sidecar_along_which_axes_they_are(tmp_path):
    paths = write_six(tmp_path, tensors())
    sidecar = tmp_path / "sub-01_model-tensor_param-txx_dwimap.json"
    sidecar.write_text(json.dumps({"Units": "um^2/ms"}))
    for given in (paths, paths[::-1], paths[4]):  # the sidecar of xx describes all six
        assert read_tensors(given).unit == "mm²/s"
    for reference, frame in (("xyz", "world"), ("bvec", "fsl"), ("ijk", "voxel")):
        sidecar.write_text(json.dumps({"OrientationEncoding": {"Reference": reference}}))
        expected = read_tensors(paths, frame=frame)
        assert read_tensors(paths).frame == frame
        np.testing.assert_array_equal(read_tensors(paths).tensors, expected.tensors)
    # World axes: x is −j, y is i, z is −k here.
    axes = AFFINE[:3, :3] / [2, 2, 3]
    np.testing.assert_allclose(read_tensors(paths, frame="world").tensors, axes.T @ tensors() @ axes, atol=1e-15)
    unplaced = write_six(tmp_path, tensors(), None, "dt{}.nii")
    assert "the file has neither sform nor qform, so left and right are a guess" in read_tensors(unplaced).notes


def test_what_are_not_six_images_is_refused(tmp_path):
    paths = write_six(tmp_path, tensors())
    with pytest.raises(ValueError, match="expected six NIfTI images"):
        read_tensors(paths[:5])
    with pytest.raises(ValueError, match="Leave it out"):
        read_tensors(paths, "fsl")
    nib.save(nib.Nifti1Image(tensors()[..., 0, 0], AFFINE + 0.5 * np.eye(4, k=3)), paths[5])
    with pytest.raises(ValueError, match=r"tzz.*its affine differs"):
        read_tensors(paths)
    nib.save(nib.Nifti1Image(tensors()[:-1, ..., 0, 0], AFFINE), paths[5])
    with pytest.raises(ValueError, match=r"tzz.*got shape"):
        read_tensors(paths)
    paths[5].unlink()
    with pytest.raises(FileNotFoundError, match=r"are missing: sub-01_model-tensor_param-tzz_dwimap.nii.gz"):
        read_tensors(paths[0])


def test_the_command_line_takes_six_files(tmp_path, capsys):
    paths = [str(path) for path in write_six(tmp_path, tensors())]
    assert main(["convert", *paths, str(tmp_path / "t.nii.gz"), "-q"]) == 0
    np.testing.assert_allclose(read_tensors(tmp_path / "t.nii.gz").tensors, tensors(), rtol=1e-6)
    assert main(["info", paths[2], "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["shape"] == list(SHAPE)
    assert main(["info", *paths[:2]]) == 2
    assert "expected six NIfTI images" in capsys.readouterr().err


# ---------------------------------------------------------------------------------------------------- studies


@pytest.fixture
def study(tmp_path):
    """Three subjects alike but for the size of their tensors, of which one is in six images; and their labels."""
    rows = ["participant_id\tfile\tgroup"]
    for i, scale in enumerate((1.0, 1.5, 0.7), 1):
        if i == 2:
            write_six(tmp_path, tensors(scale), name="sub-2_param-t{}.nii.gz")
        else:
            save_tensors(tmp_path / f"t{i}.nii.gz", volume(scale))
        rows.append(f"0{i}\t{'sub-2_param-txx' if i == 2 else f't{i}'}.nii.gz\t{'patient' if i == 3 else 'control'}")
    (tmp_path / "subjects.tsv").write_text("\n".join(rows) + "\n")
    labels = np.where(np.indices(SHAPE)[0] < 4, 17, 4)
    nib.save(nib.Nifti1Image(labels.astype(np.int16), AFFINE), tmp_path / "atlas_dseg.nii.gz")
    (tmp_path / "atlas_dseg.tsv").write_text("index\tname\n17\tleft half\n4\tright half\n")
    return tmp_path


def command(study, out, *more):
    given = ["batch", study / "subjects.tsv", "-o", study / out, "--atlas", study / "atlas_dseg.nii.gz", "-k", "8"]
    return [*map(str, given), "--metric", "inverse", "--slice", "z=1", "--components", "largest", *more]


def contents(folder):
    """The bytes of all files but the logs, which have durations."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.parent.name != "logs"]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


LAMBDA1 = ("--times", "2", "5", "--time-unit", "lambda1", "--normalisation", "volume")


@pytest.mark.slow
def test_a_study_that_was_stopped_and_one_that_was_not_have_the_same_bytes(study, monkeypatch, capsys):
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )
    assert main(command(study, "whole", *LAMBDA1, "-q")) == 0
    write, count = Study.write_signature, []

    def stop(self, subject, *rest):
        count.append(subject.name)
        if len(count) == 2:
            (self.path(subject, "x").parent).mkdir(parents=True)
            (self.path(subject, "x").parent / f".{'0' * 12}.left").write_text("half of it")
            raise KeyboardInterrupt
        write(self, subject, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(Study, "write_signature", stop)
        assert main(command(study, "stopped", *LAMBDA1, "-q")) == 130
    assert not (study / "stopped" / "group_regions.tsv").exists()
    capsys.readouterr()
    assert main(command(study, "stopped", *LAMBDA1)) == 0  # the subject without an end is the last
    printed = capsys.readouterr().err
    assert "1 of 3 subjects are already done" in printed
    assert printed.index("0 of 2: sub-03") < printed.index("1 of 2, ") < printed.index(": sub-02")
    assert contents(study / "stopped") == contents(study / "whole")

    # λ₁t and the domain's volume take the size of the metric out: the subjects are alike then.
    rows = table(study / "whole" / "group_regions.tsv")
    assert [row["participant_id"] for row in rows] == [f"sub-0{i}" for i in (1, 2, 3) for _ in range(4)]
    assert {row["region"] for row in rows} == {"left half", "right half"}
    for name in ("mean", "std", "median", "lambda1_t", "volume"):
        numbers = np.array([float(row[name]) for row in rows]).reshape(3, -1)
        np.testing.assert_allclose(numbers, np.broadcast_to(numbers[0], numbers.shape), rtol=1e-6)
    times = np.array([float(row["t"]) for row in rows]).reshape(3, -1)
    np.testing.assert_allclose(times[1:] / times[0], [[1 / 1.5] * 4, [1 / 0.7] * 4], rtol=1e-6)

    # They are the library's numbers.
    field = hj.TensorField.from_diffusion(volume().slice("z", 1).grid(), volume().slice("z", 1).tensors, "inverse")
    values = hj.hks(hj.eigenpairs(field, 8, "mean"), times[0][:2], "volume")
    np.testing.assert_allclose([float(r["mean"]) for r in rows[2:4]], np.asarray(values)[:, :4].mean((1, 2)), rtol=1e-7)

    # Again, nothing is computed; with other labels, only the tables.
    monkeypatch.setattr("hks_jax.cli.study.tasks._compute", None)
    assert main(command(study, "whole", *LAMBDA1)) == 0
    assert "3 of 3 subjects are already done" in capsys.readouterr().err
    nib.save(nib.Nifti1Image(np.full(SHAPE, 3, np.int16), AFFINE), study / "atlas_dseg.nii.gz")
    assert main(command(study, "whole", *LAMBDA1)) == 0
    assert {row["index"] for row in table(study / "whole" / "group_regions.tsv")} == {"3"}


def test_a_study_is_a_bids_derivative(study, monkeypatch, capsys):
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )
    assert main([*command(study, "out", "--times", "3e3", "--only", "sub-01"), "-q"]) == 0
    out = study / "out"
    about = json.loads((out / "dataset_description.json").read_text())
    assert (about["DatasetType"], about["GeneratedBy"][0]["Name"]) == ("derivative", "hks-jax")
    assert (out / "logs" / "sub-01.log").read_text().splitlines()[-1] == "done"
    assert not list(out.glob("*.tsv"))  # the command without --only collects
    head, first, *_ = (study / "subjects.tsv").read_text().splitlines()
    again = first.replace("control", "patient")
    sessions = [f"{head}\tsession_id\tage", f"{first}\t\tn/a", f"{again}\tses-2\t31"]
    (study / "subjects.tsv").write_text("\n".join(sessions))
    with monkeypatch.context() as patch:
        patch.setattr("hks_jax.cli.study.tasks._compute", None)
        main([*command(study, "out", "--times", "3e3"), "-q"])
    assert table(out / "participants.tsv") == [{"participant_id": "sub-01", "group": "control", "age": "31"}]
    assert "group differs between sessions of sub-01, and participants.tsv has the first" in capsys.readouterr().err
    (study / "subjects.tsv").write_text("\n".join([head, first]))
    (out / "participants.tsv").write_text("participant_id\tgroup\nsub-01\told\nsub-07\tgone\n")
    with monkeypatch.context() as patch:
        patch.setattr("hks_jax.cli.study.tasks._compute", None)
        assert main([*command(study, "out", "--times", "3e3"), "-q"]) == 0
    assert table(out / "participants.tsv") == [{"participant_id": "sub-01", "group": "control"}]
    assert [row["status"] for row in table(out / "group_summary.tsv")] == ["done"]
    stem = out / "sub-01" / "dwi" / "sub-01_model-tensor_param-hks_dwimap"
    sidecar = json.loads(stem.with_suffix(".json").read_text())
    assert (sidecar["Times"], sidecar["Sources"]) == ([3000.0], ["t1.nii.gz"])
    assert (sidecar["OrientationEncoding"], sidecar["Units"]) == ({"Type": "scalar"}, "1")
    assert set(sidecar["SHA256"]) == {f"{stem.name}.nii.gz", f"{stem.name}.npz"}
    image = nib.load(stem.with_suffix(".nii.gz"))
    assert image.shape == (9, 8, 1, 1)
    assert (out / "sub-01" / "figures" / f"{stem.name}.png").is_file()

    # One result's table by itself is that of the study; on other voxels, labels are refused.
    atlas = study / "atlas_dseg.nii.gz"
    np.testing.assert_array_equal(Result.read(out / "sub-01").values, Result.read(f"{stem}.npz").values)
    assert main(["stats", f"{stem}.npz", "--atlas", str(atlas), "-o", str(study / "r.tsv"), "-q"]) == 0
    assert (study / "r.tsv").read_text() == stem.with_name("sub-01_model-tensor_param-hks_regions.tsv").read_text()
    (row,) = (row for row in table(study / "r.tsv") if row["index"] == "17")
    assert (row["region"], row["voxels"], row["coverage"]) == ("left half", "32", "1")
    assert float(row["volume"]) == 32 * 12  # mm³

    # The regions of a signature that is computed again without labels are gone.
    assert (out / "group_regions.tsv").is_file()
    words = command(study, "out", "--times", "3e3", "--replace", "--normalisation", "raw", "-q")
    assert main([word for word in words if word not in ("--atlas", str(atlas))]) == 0
    assert not list(out.rglob("*regions*"))
    assert json.loads(stem.with_suffix(".json").read_text())["Units"] == "s^-1"


def test_one_bad_subject_does_not_stop_the_others(study, monkeypatch, capsys):
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )
    lines = (study / "subjects.tsv").read_text().splitlines()
    bad = ["04\tabsent.nii.gz\tx", "05\tt1.nii.gz\tx\tz=99", "06\tt1.nii.gz\tx\tz=1\tmoved.nii.gz"]
    (study / "subjects.tsv").write_text("\n".join([lines[0] + "\tslice\tatlas", *bad, lines[3]]) + "\n")
    nib.save(nib.Nifti1Image(np.ones(SHAPE, np.int16), AFFINE + 0.9 * np.eye(4, k=3)), study / "moved.nii.gz")
    assert main(command(study, "out", "--times", "3e3")) == 1
    printed = capsys.readouterr().err
    assert "3 of 4 subjects failed (sub-04, sub-05, sub-06)" in printed
    rows = table(study / "out" / "group_summary.tsv")
    assert [row["status"] for row in rows] == ["failed", "failed", "failed", "done"]
    for row, words in zip(rows, ("no such file", "0 … 2", "labels and the image on different voxels"), strict=False):
        assert words in row["problem"]
    assert {row["participant_id"] for row in table(study / "out" / "group_regions.tsv")} == {"sub-03"}


@pytest.mark.slow
def test_subjects_in_other_units_are_refused_and_open_frames_are_said(study, monkeypatch, capsys):
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )
    image = nib.load(study / "t1.nii.gz")
    for number, matrix, scale in ((4, AFFINE, 1e6), (5, AFFINE, 1e6), (6, AFFINE @ np.diag([-1.0, 1, 1, 1]), 1.0)):
        other = nib.Nifti1Image(image.get_fdata() * scale, matrix)  # without the record that our files have
        other.header.set_intent("symmetric matrix", (3,))
        nib.save(other, study / f"t{number}.nii.gz")
    (study / "subjects.tsv").write_text(
        "participant_id\tfile\tunit\tatlas\n01\tt1.nii.gz\t\tn/a\n04\tt4.nii.gz\t\tn/a\n05\tt5.nii.gz\tum2/s\tn/a\n"
        "06\tt6.nii.gz\t\tn/a\n"
    )
    arguments = [word for word in command(study, "out", "--times", "3e3") if "atlas" not in word]
    assert main(arguments) == 1
    printed = capsys.readouterr().err
    assert "1 of 4 subjects failed (sub-04)" in printed
    assert "sub-04 failed: " in printed
    mean = np.median(np.trace(tensors(), axis1=-2, axis2=-1)) / 3
    assert (
        f"If the numbers are in um2/s, the median is {mean:.3g}: try --unit um2/s. The tensors of all subjects"
        in printed
    )
    # The determinant of the last is positive, and so few voxels do not tell.
    assert [line for line in printed.splitlines() if line.startswith("warning: sub-06: The NIfTI file does not")]
    assert "sub-01: The NIfTI file does not declare" not in printed
    values = [np.load(next((study / "out" / f"sub-0{i}" / "dwi").glob("*.npz")))["hks"] for i in (1, 5)]
    np.testing.assert_allclose(values[1], values[0], rtol=1e-6)


@pytest.mark.slow
def test_numbers_without_a_unit_are_compared_within_the_study(study, monkeypatch, capsys):
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )
    for i, scale in enumerate((1e3, 0.8e3, 1e6)):  # two in um2/ms, one in um2/s
        np.savez(study / f"n{i}.npz", tensors=tensors(scale), spacing=(2.0, 2.0, 3.0))
    rows = "".join(f"0{i}\tn{i}.npz\n" for i in range(3))
    (study / "subjects.tsv").write_text("participant_id\tfile\n" + rows)
    arguments = ["batch", str(study / "subjects.tsv"), "-o", str(study / "out"), "-k", "8", "--metric", "inverse"]
    arguments += ["--slice", "z=1", "--times", "10"]
    assert main(arguments) == 1
    assert "1 of 3 subjects failed (sub-02)" in capsys.readouterr().err
    summary = table(study / "out" / "group_summary.tsv")
    assert [row["status"] for row in summary] == ["done", "done", "failed"]
    assert "expected the same unit for all subjects" in summary[2]["problem"]
    told = rows.replace("npz", "npz\tum2/ms").replace("n2.npz\tum2/ms", "n2.npz\tum2/s")
    (study / "subjects.tsv").write_text("participant_id\tfile\tunit\n" + told)
    assert main([*arguments[:-1], "1e4", "-q", "--replace"]) == 0


def test_a_subject_is_done_again_when_its_sidecar_changes(study):
    args = build_parser().parse_args(command(study, "out"))
    vars(args).update({name: value for name, value in defaults(add_kept).items() if getattr(args, name) is None})
    rows = read_subjects(study / "subjects.tsv", args)
    whole = Study(study / "out", Settings.of(metric="inverse"), "scanner", {})
    before = [whole.fingerprint(row) for row in rows]
    for name in ("t1", "sub-2_param-txx"):
        (study / f"{name}.json").write_text(json.dumps({"OrientationEncoding": {"Reference": "xyz"}}))
    after = [whole.fingerprint(row) for row in rows]
    assert [a == b for a, b in zip(before, after, strict=True)] == [False, False, True]


@pytest.mark.slow
def test_a_damaged_or_foreign_result_is_computed_again_and_said(study, monkeypatch, capsys):
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )
    words = command(study, "out", "--times", "3e3", "--only", "sub-01", "sub-03")
    assert main(words) == 0
    before = contents(study / "out")
    stem = "sub-{0}/dwi/sub-{0}_model-tensor_param-hks"
    first, third = (study / "out" / f"{stem.format(one)}_dwimap.npz" for one in ("01", "03"))
    first.write_bytes(first.read_bytes()[:-1])  # damaged
    third.write_bytes(before[f"{stem.format('01')}_dwimap.npz"])  # of another subject
    table_of_3 = study / "out" / f"{stem.format('03')}_regions.tsv"
    table_of_3.write_text(table_of_3.read_text().replace("left", "LEFT"))
    capsys.readouterr()
    assert main(words) == 0
    printed = capsys.readouterr().err
    assert f"sub-01 is computed again: {first} is damaged: its SHA-256 is not that of the sidecar" in printed
    assert f"sub-03 is computed again: {third} is damaged" in printed
    assert contents(study / "out") == before


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("id\tfile\n1\tt.nii\n", "got the columns id, file; expected a column named participant_id"),
        ("participant_id\tfile\nsub-1\ta\n1\tb\n", "two rows for sub-1"),
        ("participant_id\tfile\nsub-a_b\ta\n", "only letters and digits"),
        ("participant_id,file\n", "separated by tabs"),
        ("participant_id file\nsub-1 a\n", "expected columns separated by tabs"),
    ],
)
def test_a_table_that_is_wrong_for_all_is_refused(tmp_path, capsys, text, words):
    (tmp_path / "subjects.tsv").write_text(text)
    assert main(["batch", str(tmp_path / "subjects.tsv"), "-o", str(tmp_path / "out"), "--metric", "inverse"]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_rows_join_the_options_of_the_command(tmp_path):
    (tmp_path / "subjects.csv").write_text(
        "participant_id,session_id,file,spacing,b_max,mask,age\n"
        "01,pre,a.npz,1 2,900,,41\nsub-01,ses-post,/b.npz,,n/a,m.npy,42\n02,pre,c.npz,x,,,\n03,pre,,,,,\n"
    )
    words = ["batch", str(tmp_path / "subjects.csv"), "-o", "out", "--erode", "2", "--b-max", "1000"]
    first, second, bad, empty = read_subjects(tmp_path / "subjects.csv", build_parser().parse_args(words))
    assert (first.name, first.folder.as_posix(), first.covariates) == (
        "sub-01_ses-pre",
        "sub-01/ses-pre",
        {"age": "41"},
    )
    assert (first.arguments.file, first.arguments.spacing) == (tmp_path / "a.npz", [1.0, 2.0])
    assert (first.arguments.b_max, second.arguments.b_max, second.arguments.erode) == (900, 1000, 2)
    assert (second.arguments.file, second.arguments.mask) == (Path("/b.npz"), tmp_path / "m.npy")
    assert (first.arguments.mask, bad.arguments, empty.problem) == (
        None,
        None,
        "got no file; expected a file in every row",
    )
    assert "--spacing: invalid float value: 'x'" in bad.problem


def test_common_times_suit_all_subjects():
    ranges = {"sub-01": Range(2.0, 25.0, 50.0), "sub-02": Range(3.0, 48.0, 80.0)}
    assert common_times(ranges, 3, "scanner") == (3.0, 8.66, 25.0)
    scaled = common_times(ranges, 2, "lambda1")
    np.testing.assert_allclose(scaled, np.pi**2 / 4 * np.array([2 / 50, 1 / 2]), rtol=5e-3)
    # If half of the voxels are free of the boundary only at unresolved times, the times are the first resolved ones.
    assert common_times({"sub-01": Range(4.0, 1.0, 50.0)}, 2, "scanner") == (4.0, 8.0)
    assert common_times({"sub-01": Range(4.0, 1.0, 5.0)}, 2, "scanner") == (4.0, 5.0)
    with pytest.raises(ValueError, match="sub-02 resolves only t ≥ 4, and the size of sub-01 allows only t ≤ 3"):
        common_times({"sub-01": Range(2.0, 1.0, 3.0), "sub-02": Range(4.0, 5.0, 9.0)}, 3, "scanner")


@pytest.mark.slow
def test_automatic_times_follow_the_metric_and_remain_those_of_the_study(study, monkeypatch, capsys):
    def suitable(scale, k, boundary, metric="inverse", operator="laplace-beltrami"):
        args = argparse.Namespace(file=Path("t.nii"), metric=metric, operator=operator, k=k, boundary=boundary)
        # So many voxels that k, and not their size, limits t; in an image much larger.
        many = np.zeros((60, 60, 20, 3, 3))
        many[3:30, 4:28, 5:14] = np.tile(tensors(scale), (3, 3, 3, 1, 1))
        return np.array(suitable_range(TensorVolume(many, (2.0, 2.0, 3.0), (0.0,) * 3, many[..., 0, 0] > 0), args))

    np.testing.assert_allclose(suitable(2.0, 8, "neumann"), suitable(1.0, 8, "neumann") / 2, rtol=1e-12)
    np.testing.assert_allclose(suitable(1.0, 8, "mean"), suitable(1.0, 4, "neumann"), rtol=1e-12)
    np.testing.assert_array_equal(suitable(1.0, 8, "mean", None, "fick"), suitable(1.0, 8, "mean"))
    side = 54.0  # mm, of the largest axis, along which D is about 1.5e-3 mm²/s
    assert abs(suitable(1.0, 8, "neumann")[2] / ((side / 2) ** 2 / 1.5e-3) - 1) < 0.3
    assert suitable(1.0, 1, "neumann")[0] > suitable(1.0, 8, "neumann")[0]

    def times(*more):
        assert main([*command(study, "out", "--times", "auto:2", *more), "-q"]) == 0
        return json.loads((study / "out" / "study.json").read_text())["times"]

    monkeypatch.setattr("hks_jax.cli.study.tasks.run_all", lambda *_: Outcome({}, []))
    monkeypatch.setattr("hks_jax.cli.study.tasks.write_group", lambda *_: [])
    monkeypatch.setattr("hks_jax.cli.study.tasks.other_units", lambda *_: {})
    save_tensors(study / "t3.nii.gz", volume(0.9))
    first = times()
    with open(study / "subjects.tsv", "a") as stream:
        stream.write("04\tt1.nii.gz\tcontrol\n05\tt4.nii.gz\tcontrol\n")
    save_tensors(study / "t4.nii.gz", volume(0.8))
    assert times() == first
    fick = [each for each in command(study, "out") if each not in ("--metric", "inverse")]
    assert main([*fick, "--metric", "inverse", "--operator", "fick"]) == 2
    assert "--metric: got inverse with --operator fick" in capsys.readouterr().err
    assert main([*fick, "--times", "auto:2", "--operator", "fick"]) == 2
    said = capsys.readouterr().err
    assert "--metric inverse, not unset" in said
    assert "--operator laplace-beltrami, not fick" in said
    other = ("--interpolation", "log-euclidean")
    assert main(command(study, "out", "--times", "auto:2", *other)) == 2
    assert "has --interpolation linear, not log-euclidean. Leave" in capsys.readouterr().err
    assert times("--replace", *other)[0] > first[0]  # chosen anew, of all subjects


def test_progress_says_how_long_the_others_take(tmp_path, capsys, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    progress = StudyProgress(4)
    for seconds in (60, 120):
        with progress.subject("sub-01", tmp_path / "log"):
            clock[0] += seconds
    assert progress.line() == "[##########..........] 2 of 4, about 3 min left"
    assert "1 of 4, about 3 min left: sub-01" in capsys.readouterr().err


def test_on_a_terminal_the_bar_stays_in_its_line(tmp_path):
    stream = io.StringIO()
    stream.isatty = lambda: True
    progress = StudyProgress(2)
    progress.stream = stream
    with progress.subject("sub-01", tmp_path / "log"), progress.stage("eigenpairs"):
        progress.update("3 of 8 pairs")
        progress.warn("it is too coarse")
    progress.end("done")
    text = stream.getvalue()
    assert re.findall(r"\n", text) == ["\n"] * 2
    assert "\r\x1b[Kwarning: sub-01: it is too coarse\n" in text
    assert "\r[....................] 0 of 2: sub-01: eigenpairs, 3 of 8 pairs\x1b[K" in text
    logged = [line.partition("] ")[2] for line in (tmp_path / "log").read_text().splitlines()]
    assert logged == ["eigenpairs", "warning: it is too coarse"]


def test_a_study_that_another_process_begins_anew_is_left_to_it(study, monkeypatch, capsys):
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )
    write = Study.write_signature

    def write_and_lose(self, *rest):
        write(self, *rest)
        record = json.loads((self.folder / "study.json").read_text())
        (self.folder / "study.json").write_text(json.dumps({**record, "times": [7.0]}))

    monkeypatch.setattr(Study, "write_signature", write_and_lose)
    assert main(command(study, "out", *LAMBDA1)) == 2
    printed = capsys.readouterr().err
    assert "another process has meanwhile changed" in printed
    assert "sub-02" not in printed


@pytest.mark.slow
def test_a_killed_study_is_resumed_with_the_same_result(study):
    """Three volumes in processes of their own, killed once a subject is there."""

    def start(out):
        words = command(study, out, "--boundary", "mean", "--times", "1e5", "3e5")
        arguments = [word for word in words if word not in ("--slice", "z=1")]
        return [sys.executable, "-m", "hks_jax", *arguments]

    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    subprocess.run(start("whole"), check=True, env=environment, capture_output=True, timeout=600)
    with subprocess.Popen(start("killed"), env=environment, stderr=subprocess.DEVNULL) as process:
        first = study / "killed" / "sub-01" / "dwi" / "sub-01_model-tensor_param-hks_dwimap.json"
        end = time.monotonic() + 300
        while not first.exists() and process.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not (study / "killed" / "group_regions.tsv").exists()
    done = subprocess.run(start("killed"), env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert contents(study / "killed") == contents(study / "whole")


@pytest.mark.slow
@pytest.mark.skipif(not (BRAINS / "brain_tensor.nii.gz").exists(), reason=f"no brain data in {BRAINS}")
def test_tissues_of_a_real_brain_differ_as_the_documentation_says(tmp_path):
    spec = importlib.util.spec_from_file_location("brain_study", ROOT / "notebooks" / "brains" / "brain_study.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    subjects, means = script.write_study(BRAINS, tmp_path), {}
    stem = "sub-01/dwi/sub-01_model-tensor_param-hks"
    for boundary, k in (("neumann", "100"), ("mean", "200")):
        out = tmp_path / boundary
        options = ["--metric", "inverse", "--components", "largest", "--normalisation", "flat", "--times", "1.2e5"]
        given = ["batch", str(subjects), "-o", str(out), "--only", "01", "--boundary", boundary, "-k", k, *options]
        assert main([*given, "--names", str(tmp_path / "names.tsv"), "-q"]) == 0
        means[boundary] = {row["region"]: float(row["mean"]) for row in table(out / f"{stem}_regions.tsv")}
    rim, deep, white, fluid = script.REGIONS.values()
    assert means["neumann"][rim] > 1.9  # the rim doubles the signature
    assert max(means["mean"][name] for name in (rim, deep, white)) < 1.1
    assert means["mean"][fluid] < 0.9 < 1 < means["mean"][deep]


# ---------------------------------------------------------------------------------------------------- saved pairs


def test_a_study_keeps_the_boundary_that_it_began_with(study, monkeypatch, capsys):
    def boundary(out, *more):
        assert main(command(study, out, "--times", "3e3", *more)) == 0
        return json.loads((study / out / "study.json").read_text())["settings"]["boundary"]

    monkeypatch.setattr("hks_jax.cli.study.tasks.run_all", lambda *_: Outcome({}, []))
    monkeypatch.setattr("hks_jax.cli.study.tasks.write_group", lambda *_: [])
    monkeypatch.setattr("hks_jax.cli.study.tasks.other_units", lambda *_: {})
    assert boundary("new") == "mean"
    assert "options for all subjects: --boundary mean\n" in capsys.readouterr().err
    assert boundary("old", "--boundary", "neumann:dirichlet,neumann") == [["neumann", "dirichlet"], "neumann"]
    assert boundary("old") == [["neumann", "dirichlet"], "neumann"]
    assert main(command(study, "old", "--times", "3e3", "--boundary", "mean")) == 2
    assert "has --boundary neumann:dirichlet,neumann, not mean. Leave" in capsys.readouterr().err
    assert boundary("old", "--replace") == "mean"


def test_omitted_options_are_those_of_the_study(study, monkeypatch, capsys):
    monkeypatch.setattr("hks_jax.cli.study.tasks.run_all", lambda *_: Outcome({}, []))
    monkeypatch.setattr("hks_jax.cli.study.tasks.write_group", lambda *_: [])
    monkeypatch.setattr("hks_jax.cli.study.tasks.other_units", lambda *_: {})
    kept = ["--normalisation", "raw", "--repair", "clip:1e-4", "--times", "3e3", "6e3", "--time-unit", "lambda1"]
    assert main(command(study, "out", "--erode", "0", *kept)) == 0
    record = (study / "out" / "study.json").read_text()
    capsys.readouterr()
    short = ["batch", str(study / "subjects.tsv"), "-o", str(study / "out")]
    assert main(short) == 0
    assert (study / "out" / "study.json").read_text() == record
    printed = capsys.readouterr().err
    for option in ("-k 8", "--slice z=1", "--repair clip:0.0001", "--times 3000.0,6000.0", "--normalisation raw"):
        assert option in printed
    assert main([*short, "-k", "9", "--normalisation", "flat", "--times", "auto:4", "--noise", "0.1"]) == 2
    printed = capsys.readouterr().err
    for text in ("-k 8, not 9;", "--normalisation raw, not flat;", "--times 3000.0,6000.0, not auto:4;"):
        assert text in printed
    assert "--noise unset, not 0.1" in printed
    assert "Leave these options out to continue the study" in printed
    assert main([*short, "-k", "9", "--metric", "inverse", "--slice", "z=1", "--times", "9", "--replace"]) == 0
    assert json.loads((study / "out" / "study.json").read_text())["settings"]["normalisation"] == "flat"


def test_what_a_study_keeps_serves_all_its_subjects(study, monkeypatch, capsys):
    monkeypatch.setattr("hks_jax.cli.study.tasks.run_all", lambda *_: Outcome({}, []))
    monkeypatch.setattr("hks_jax.cli.study.tasks.write_group", lambda *_: [])
    monkeypatch.setattr("hks_jax.cli.study.tasks.other_units", lambda *_: {})
    head, first, *_ = (study / "subjects.tsv").read_text().splitlines()
    (study / "subjects.tsv").write_text(f"{head}\tnoise\n{first}\t0.1\n")
    masks = [study / f"mask{i}.npy" for i in range(3)]
    for i, mask in enumerate(masks):
        np.save(mask, np.indices(SHAPE)[0] >= max(i - 1, 0))  # the first two are equal
    short = ["batch", str(study / "subjects.tsv"), "-o", str(study / "out")]
    own = ["--draws", "16", "--view", "radiological", "--save-pairs", "--mask", str(masks[0]), "--times", "3e3"]
    assert main(command(study, "out", *own)) == 0
    record = (study / "out" / "study.json").read_text()
    picture = study / "out" / "sub-01" / "figures" / "sub-01_model-tensor_param-hks_dwimap.png"
    picture.parent.mkdir(parents=True)
    picture.touch()
    capsys.readouterr()
    assert main(short) == 0
    assert (study / "out" / "study.json").read_text() == record
    assert picture.exists()
    printed = capsys.readouterr().err
    for option in ("--draws 16", "--view radiological", "--save-pairs", f"--mask {masks[0]}"):
        assert option in printed
    assert main([*short, "--mask", str(masks[1])]) == 0
    assert main([*short, "--mask", str(masks[2])]) == 2
    assert f"has --mask {masks[1]}, not {masks[2]}. Leave" in capsys.readouterr().err
    assert main([*short, "--show-rim"]) == 0
    assert "the pictures are drawn again for --show-rim" in capsys.readouterr().err
    assert not picture.exists()


@pytest.mark.slow
def test_a_study_that_keeps_its_pairs_has_other_times_for_nothing_and_to_the_bit(study, monkeypatch):
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )
    other = ("--times", "2", "5", "--time-unit", "lambda1", "--normalisation", "volume", "--only", "02", "-q")
    assert main(command(study, "kept", "--times", "3e3", "--only", "02", "--save-pairs", "-q")) == 0
    assert main(command(study, "direct", *other)) == 0
    monkeypatch.setattr("hks_jax.cli.study.tasks.compute_pairs", None)
    assert main(command(study, "kept", "--replace", *other)) == 0
    kept, direct = contents(study / "kept"), contents(study / "direct")
    assert len(kept.pop("sub-02/dwi/sub-02_model-tensor_param-hks_pairs.npz")) > 8 * 8 * 72
    assert kept == direct
    # Pairs that a study is to keep, and lacks, are computed; pairs of other settings are none.
    assert main(command(study, "direct", "--save-pairs", *other)) == 1
    assert main(command(study, "kept", "--replace", "--interpolation", "log-euclidean", *other)) == 1


@pytest.mark.slow
def test_a_study_has_errors_of_regions_and_computes_again_what_had_other_noise(study, monkeypatch, capsys, rng):
    monkeypatch.setattr(
        "hks_jax.cli.study.tasks.signature_panels", lambda result, path, **_: path.write_text("picture")
    )
    head, first, _, third = (study / "subjects.tsv").read_text().splitlines()
    labels = "atlas_dseg.nii.gz"
    subjects = f"{head}\tnoise\tatlas\n{first}\tsecond.nii.gz\t{{}}\n{third}\t\t{labels}\n"
    (study / "subjects.tsv").write_text(subjects.format(labels))

    def scan_again():
        other = tensors() * (1 + 0.04 * rng.standard_normal((*SHAPE, 1, 1)))
        save_tensors(
            study / "second.nii.gz", TensorVolume(other, (2.0, 2.0, 3.0), (0.0,) * 3, affine=AFFINE, length_unit="mm")
        )

    scan_again()
    words = command(study, "out", "--times", "3e3", "6e3", "--noise", "0.01", "--draws", "8", "--save-pairs")
    del words[(at := words.index("--atlas")) : at + 2]  # the table has the atlases
    assert main(words) == 0
    rows = table(study / "out" / "group_regions.tsv")
    stem = study / "out" / "sub-01" / "dwi" / "sub-01_model-tensor_param-hks"
    with np.load(f"{stem}_dwimap.npz") as saved:
        maps = saved["noise_maps"][:, :, :4]  # the left half, 17, after 4 in the table
    errors = np.sqrt(np.mean(maps.mean(axis=(2, 3)) ** 2, axis=0))
    np.testing.assert_allclose([float(row["error"]) for row in rows[2:4]], errors, rtol=1e-5)
    noises = [
        json.loads(Path(f"{stem}_dwimap.json".replace("sub-01", f"sub-{one}")).read_text())["Noise"]
        for one in ("01", "03")
    ]
    assert [noise["source"] for noise in noises] == ["second.nii.gz", "0.01"]
    before = contents(study / "out")
    assert main([*words, "--draws", "12"]) == 2
    assert "has --draws 8, not 12. Leave" in capsys.readouterr().err
    scan_again()  # nothing is solved again but the noisy maps, of the one subject
    monkeypatch.setattr("hks_jax.cli.study.tasks.compute_pairs", None)
    assert main(words) == 0
    assert "1 of 2 subjects are already done" in capsys.readouterr().err
    changed = {name for name, content in contents(study / "out").items() if before[name] != content}
    assert {name.split("/")[0] for name in changed} == {"sub-01", "group_regions.tsv"}
    (study / "subjects.tsv").write_text(subjects.format("n/a"))
    assert main(words) == 0  # one subject has no atlas any more
    assert "2 of 2 subjects are already done" in capsys.readouterr().err
    assert {row["participant_id"] for row in table(study / "out" / "group_regions.tsv")} == {"sub-03"}
    assert not list((study / "out" / "sub-01").rglob("*regions*"))
    for more, text in (
        (["--noise", "second.nii.gz"], "a column named noise"),
        (["--method", "auto"], "expected spectral"),
    ):
        assert main([*words, *more]) == 2
        assert text in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(("scaled", "sees"), [(None, True), (np.array([2.0, 5.0]), False)])
def test_noise_of_the_first_eigenvalue_changes_times_that_follow_it(scaled, sees):
    settings = Settings.of(metric="inverse", k=8, boundary="neumann", times=Times((2e4, 5e4), 0))
    progress = StudyProgress(1, quiet=True, stream=io.StringIO())
    solved = compute_pairs(domain_of_volume(volume().slice("z", 1), settings), settings, progress)
    plane = solved.domain.place
    gain = 0.01 * plane.tensors[..., *np.tril_indices(2)][..., None, :]  # one factor for all tensors
    noise = Noise(hj.TensorNoise.from_modes(gain, plane.grid()), "gain", 8)
    if scaled is not None:
        own = Times(tuple((scaled / float(solved.pairs.eigenvalues[1])).tolist()), 0)
        solved = solved._replace(settings=replace(settings, times=own))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)  # one mode has hardly any degrees of freedom
        result = signature_of(solved, noise, progress, scaled=scaled)
    # Without dimension, HKS depends on λ₁t only, which a factor of all tensors does not change.
    assert (np.max(result.arrays["deviation"] / result.values) > 1e-3) == sees
    assert sees or np.max(result.arrays["deviation"]) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["neumann", "mean"])
def test_saved_pairs_give_the_signature_of_other_times_without_another_computation(
    tmp_path, monkeypatch, capsys, boundary
):
    monkeypatch.setattr("hks_jax.plot.signature_panels", lambda result, path, **_: path.write_text("picture"))
    save_tensors(tmp_path / "t.nii.gz", volume())
    arguments = ["--metric", "inverse", "--slice", "z=1", "-k", "8", "--boundary", boundary, "-q"]

    def run(source, out, times, *more):
        return main(["hks", str(source), "-o", str(tmp_path / out), "--times", *times, *more])

    assert run(tmp_path / "t.nii.gz", "first", ["1e4"], *arguments, "--save-pairs") == 0
    assert run(tmp_path / "t.nii.gz", "other", ["2e4", "5e4"], *arguments, "--normalisation", "flat") == 0
    with monkeypatch.context() as patch:
        patch.setattr("hks_jax.eigenpairs", None)
        kept = tmp_path / "first" / "pairs.npz"
        assert run(kept, "again", ["2e4", "5e4"], "--normalisation", "flat", "-q") == 0
        other, again = (dict(np.load(tmp_path / out / "hks.npz")) for out in ("other", "again"))
        np.testing.assert_array_equal(again["hks"], other["hks"])
        np.testing.assert_array_equal(again["affine"], other["affine"])
        assert nib.load(tmp_path / "again" / "hks.nii.gz").shape == (9, 8, 1, 2)
        reports = [json.loads((tmp_path / out / "report.json").read_text()) for out in ("other", "again")]
        assert reports[0]["input"] == reports[1]["input"]
        assert reports[0]["settings"] == reports[1]["settings"]
        assert reports[0]["times"] == reports[1]["times"]
        capsys.readouterr()
        assert run(kept, "again", ["2e4"], "-k", "5") == 2
        assert "-k: " in capsys.readouterr().err
        assert main(["info", str(kept), "--json"]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert (facts["eigenpairs"], facts["shape"], facts["boundary"]) == (8, [9, 8], boundary)


def test_pairs_of_another_pencil_are_refused(tmp_path):
    def pencil(field):
        return hj.assemble(hj.TensorField(hj.Grid((7, 6)), field))

    plane = 1e3 * tensors()[:7, :6, 0, :2, :2]
    pairs = hj.eigenpairs(pencil(plane), 6)
    path = hj.io.save_pairs(tmp_path / "p.npz", pairs)
    read = hj.io.load_pairs(path, pencil(plane))
    np.testing.assert_array_equal(hj.hks(read, [5.0, 9.0]), hj.hks(pairs, [5.0, 9.0]))
    assert read.summary() == pairs.summary()
    with pytest.raises(ValueError, match="do not solve"):
        hj.io.load_pairs(path, pencil(1.1 * plane))
    fewer = {**np.load(path), "vectors": np.ones((6, 41))}
    with pytest.raises(ValueError, match=r"got .* \(6, 41\); expected \(6, 42\) for this pencil"):
        pairs_of("p.npz", fewer, pencil(plane))
    with pytest.raises(ValueError, match="lacks kept"):
        pairs_of("p.npz", {name: a for name, a in fewer.items() if name != "kept"}, pencil(plane))
    with pytest.raises(ValueError, match=r"ends in \.npz"):
        hj.io.save_pairs(tmp_path / "p.npy", pairs)


@pytest.mark.slow
def test_a_folder_that_is_used_again_holds_one_result(tmp_path, monkeypatch, capsys):
    """What was made of an earlier signature goes with it; eigenpairs stay where they are those of the new one."""
    monkeypatch.setattr("hks_jax.plot.signature_panels", lambda result, path, **_: path.write_text("picture"))
    save_tensors(tmp_path / "one.nii.gz", volume())
    save_tensors(tmp_path / "two.nii.gz", volume(1.5))
    np.savez(tmp_path / "three.npz", tensors=1e3 * tensors()[:, :, 1, :2, :2])
    out, options = tmp_path / "out", ["--times", "1e4", "-k", "8", "--boundary", "neumann"]
    of_slice = ["--metric", "inverse", "--slice", "z=1"]

    def run(source, *more):
        assert main(["hks", str(tmp_path / source), "-o", str(out), *options, *more]) == 0
        return sorted(path.name for path in out.iterdir())

    own = ["hks.json", "hks.nii.gz", "hks.npz", "hks.png", "report.json"]
    assert run("one.nii.gz", *of_slice, "--save-pairs") == sorted([*own, "pairs.npz"])
    np.save(tmp_path / "labels.npy", np.ones(SHAPE[:2], int))
    for name in ("explore.html", "regions.json", "mine.txt"):
        (out / name).write_text("of the first")
    assert main(["stats", str(out), "--atlas", str(tmp_path / "labels.npy"), "-q"]) == 0
    first = np.load(out / "pairs.npz")["eigenvalues"]
    capsys.readouterr()
    # The same eigenpairs, at another time: they stay.
    assert main(["hks", str(out / "pairs.npz"), "-o", str(out), "--times", "3e4"]) == 0
    assert "removed explore.html, regions.json, regions.tsv of an earlier signature" in capsys.readouterr().err
    assert run("one.nii.gz", *of_slice) == sorted([*own, "mine.txt", "pairs.npz"])
    # Other tensors: they go, or are replaced.
    assert run("two.nii.gz", *of_slice) == sorted([*own, "mine.txt"])
    assert "removed pairs.npz of an earlier signature" in capsys.readouterr().err
    run("one.nii.gz", *of_slice, "--save-pairs")
    run("two.nii.gz", *of_slice, "--save-pairs")
    np.testing.assert_allclose(np.load(out / "pairs.npz")["eigenvalues"], first * 1.5, rtol=1e-5, atol=1e-12)
    # Of a file without a place for images: no image of the one before.
    assert run("three.npz", "--metric", "tensor") == ["hks.npz", "hks.png", "mine.txt", "report.json"]


def test_pairs_that_were_kept_do_not_stand_beside_an_older_signature(tmp_path, monkeypatch):
    """What comes after the eigenpairs fails: the folder has them alone, and what is not ours."""
    save_tensors(tmp_path / "one.nii.gz", volume())
    save_tensors(tmp_path / "two.nii.gz", volume(1.5))
    options = ["--times", "1e4", "-k", "8", "--boundary", "neumann", "--metric", "inverse", "--slice", "z=1", "-q"]
    out = tmp_path / "out"
    out.mkdir()
    (out / "regions.tsv").write_text("not made of a signature")
    monkeypatch.setattr("hks_jax.plot.signature_panels", lambda result, path, **_: path.write_text("picture"))
    assert main(["hks", str(tmp_path / "one.nii.gz"), "-o", str(out), *options]) == 0
    monkeypatch.setattr("hks_jax.cli.hks.signature_of", None)
    assert main(["hks", str(tmp_path / "two.nii.gz"), "-o", str(out), *options, "--save-pairs"]) == 1
    assert sorted(path.name for path in out.iterdir()) == ["pairs.npz", "regions.tsv"]
