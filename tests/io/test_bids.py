"""BIDS names, and the inputs that they find in folders like those of QSIRecon, QSIPrep, FSL and MRtrix."""

import json
import re

import derivatives as tree
import numpy as np
import pytest

import hks_jax as hj
from hks_jax.io.bids import Dataset, are_entities, format_entities, kept, parse_entities, parse_name


def test_names_are_read_and_written():
    name = parse_name("sub-01/ses-a/dwi/sub-01_ses-a_acq-x_run-2_space-ACPC_model-tensor_param-txx_dwimap.nii.gz")
    assert (name.suffix, name.extension, name.source) == ("dwimap", "nii.gz", "sub-01_ses-a_acq-x_run-2_space-ACPC")
    assert (name.label("model"), name.label("res")) == ("tensor", "")
    bare = parse_name("sub-02/ses-b/dwi/dti_tensor.nii.gz")  # the folders name participant and session
    assert (format_entities(bare.entities), bare.suffix) == ("sub-02_ses-b", "dti_tensor")
    assert parse_name("dt.mif.gz").extension == "mif.gz"
    assert parse_entities("space-ACPC_desc-brain") == {"space": "ACPC", "desc": "brain"}
    assert [are_entities(text) for text in ("desc-brain", "mask.nii.gz", "sub-01/m-1", "mask")] == [True, *[False] * 3]
    with pytest.raises(ValueError, match="got 'brain'; expected entities"):
        parse_entities("brain")


def found(root, label="01", wanted=None):
    return [(source.file.path.name, source.order) for source in Dataset(root).sources(label, wanted or {})]


def test_tensors_of_every_program_are_found_and_read(tmp_path):
    for write, file, order in (
        (tree.qsirecon, "sub-01_space-ACPC_model-tensor_param-txx_dwimap.nii.gz", None),
        (tree.bep16, "sub-01_space-ACPC_model-tensor_param-diffusivity_dwimap.nii.gz", None),
        (tree.dtifit, "dti_tensor.nii.gz", "fsl"),
        (tree.mrtrix, "dt.mif", None),
    ):
        root = tmp_path / write.__name__
        write(root, "01")
        assert found(root) == [(file, order)]
        (source,) = Dataset(root).sources("01", {})
        read = hj.io.read_tensors(source.file.path, source.order)
        np.testing.assert_allclose(read.tensors, tree.tensors(), rtol=1e-6, atol=1e-12)
    (tmp_path / "dtifit" / "sub-01" / "dwi" / "dti_V1.nii.gz").unlink()
    assert found(tmp_path / "dtifit") == [("dti_tensor.nii.gz", None)]  # of an unknown program: its order is asked for


def test_images_come_with_their_tables_also_inherited_ones(tmp_path):
    name = tree.qsiprep(tmp_path, "01", "ses-1", "dir-AP")
    (source,) = Dataset(tmp_path).sources("01", {})
    assert source.bval == name.with_name(name.name + ".bval")
    volume = hj.io.fit_dwi(source.file.path, source.bval, source.bvec, np.ones(tree.SHAPE, bool))
    np.testing.assert_allclose(volume.tensors, tree.tensors(), rtol=1e-4, atol=1e-7)
    source.bval.rename(tmp_path / "dwi.bval")
    (tmp_path / "dir-PA_dwi.bval").write_text("of other images")
    source.bvec.rename(tmp_path / "sub-01" / "ses-1" / "sub-01_ses-1_dwi.bvec")
    (source,) = Dataset(tmp_path).sources("01", {})
    assert source.bval == tmp_path / "dwi.bval"
    assert source.bvec == tmp_path / "sub-01" / "ses-1" / "sub-01_ses-1_dwi.bvec"
    source.bvec.unlink()  # without directions, there are no tensors
    with pytest.raises(FileNotFoundError, match="no tensors and no diffusion-weighted images"):
        Dataset(tmp_path).sources("01", {})


def test_each_combination_of_entities_is_an_input(tmp_path):
    for entities in (("ses-1", "run-1"), ("ses-1", "run-2"), ("ses-2", "acq-fast")):
        tree.bep16(tmp_path, "01", *entities)
    tree.qsiprep(tmp_path, "01", "ses-1", "run-2")  # has tensors
    tree.qsiprep(tmp_path, "01", "ses-3", "acq-fast")
    names = [source.file.name for source in Dataset(tmp_path).sources("01", {})]
    expected = ["ses-1_run-1", "ses-1_run-2", "ses-2_acq-fast", "ses-3_acq-fast"]
    assert [name.source for name in names] == [f"sub-01_{one}_space-ACPC" for one in expected]
    assert [name.suffix for name in names] == ["dwimap"] * 3 + ["dwi"]
    assert len(found(tmp_path, wanted={"acq": "fast"})) == 2
    assert kept(names[0].entities) == {"sub": "01", "ses": "1", "run": "1", "space": "ACPC"}


def test_derivatives_of_a_dataset_are_searched_and_raw_images_are_not(tmp_path):
    tree.describe(tmp_path, "raw", "raw")
    (tmp_path / "dataset_description.json").write_text(json.dumps({"Name": "raw", "BIDSVersion": "1.10.0"}))
    raw = tree.qsiprep(tmp_path, "01")
    with pytest.raises(ValueError, match="a raw dataset, whose images need preprocessing"):
        Dataset(tmp_path).sources("01", {})
    prep = tree.describe(tmp_path / "derivatives" / "qsiprep", "QSIPrep")
    recon = tree.describe(tmp_path / "derivatives" / "qsirecon", "QSIRecon")
    studio = tree.describe(recon / "derivatives" / "qsirecon-DSIStudio", "QSIRecon")
    tree.qsiprep(prep, "01", "ses-1")
    tree.qsirecon(studio, "01", "ses-1")
    tree.qsiprep(prep, "02")
    dataset = Dataset(tmp_path)
    assert dataset.participants == ["01", "02"]
    (source,) = dataset.sources("01", {})
    assert source.file.root == studio
    assert dataset.companion(source.file, "mask", {}, {}, "--mask").is_relative_to(prep)
    assert dataset.sources("02", {})[0].file.path.is_relative_to(prep)
    assert raw.parent.is_dir()


def test_masks_and_labels_are_on_the_voxels_of_the_input(tmp_path):
    tree.qsirecon(tmp_path, "01", "run-1")
    tree.qsirecon(tmp_path, "01", "run-2")
    dwi = tmp_path / "sub-01" / "dwi"
    for name in ("run-1_space-ACPC_desc-brain", "run-2_space-ACPC_desc-brain", "space-ACPC", "run-1_space-MNI"):
        tree.image(dwi / f"sub-01_{name}_mask.nii.gz", tree.mask())
    tree.image(dwi.with_name("anat") / "sub-01_run-2_space-ACPC_desc-brain_mask.nii.gz", tree.mask())
    first, second = Dataset(tmp_path).sources("01", {})
    usual = {"desc": "brain"}

    def mask(source, wanted=()):
        return Dataset(tmp_path).companion(source.file, "mask", dict(wanted), usual, "--mask")

    assert mask(first).name == "sub-01_run-1_space-ACPC_desc-brain_mask.nii.gz"
    assert mask(second) == dwi / "sub-01_run-2_space-ACPC_desc-brain_mask.nii.gz"
    tree.image(dwi / "sub-01_run-1_space-ACPC_mask.nii.gz", tree.mask())
    with pytest.raises(ValueError, match=r"two files \*_mask.*Choose one by --mask desc-brain$"):
        mask(first)
    assert mask(first, {"desc": "brain"}.items()).name == "sub-01_run-1_space-ACPC_desc-brain_mask.nii.gz"
    tree.labels(tmp_path, "01", seg="Halves")
    tree.labels(tmp_path, "01", seg="Thirds")
    atlas = {"seg": "Thirds"}
    assert "Thirds" in Dataset(tmp_path).companion(first.file, "dseg", atlas, {}, "--atlas").name
    with pytest.raises(FileNotFoundError, match="--atlas: got seg-Fifths, but no file"):
        Dataset(tmp_path).companion(first.file, "dseg", {"seg": "Fifths"}, {}, "--atlas")
    assert Dataset(tmp_path).companion(first.file, "probseg", {}, {}, "--atlas") is None


def test_what_entities_do_not_tell_apart_is_named_with_the_option_that_decides(tmp_path):
    one, two = tmp_path / "desc", tmp_path / "two"
    tree.qsiprep(one, "01", desc="preproc")
    tree.qsiprep(one, "01", desc="denoised")
    words = r"two inputs .*desc-denoised_dwi.nii.gz and .*desc-preproc_dwi.nii.gz. Choose one by --select desc-"
    with pytest.raises(ValueError, match=words + "denoised or --select desc-preproc"):
        found(one)
    assert len(found(one, wanted={"desc": "preproc"})) == 1
    for name in ("a", "b"):
        tree.bep16(tree.describe(two / "derivatives" / name, name), "01")
    folders = [re.escape(str(two / "derivatives" / name)) for name in "ab"]
    with pytest.raises(ValueError, match=f"in place of BIDS_DIR: {folders[0]} or {folders[1]}"):
        found(two)
    tree.mrtrix(tmp_path / "three", "01")
    tree.dtifit(tmp_path / "three", "01")
    with pytest.raises(ValueError, match=r"dt.mif and .*dti_tensor.nii.gz. Move one of them"):
        found(tmp_path / "three")


def test_nothing_found_says_what_was_looked_for_and_where(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such folder; expected a BIDS dataset"):
        Dataset(tmp_path / "absent").participants  # noqa: B018
    with pytest.raises(ValueError, match=r"got no folders sub-\*"):
        Dataset(tmp_path).participants  # noqa: B018
    tree.image(tmp_path / "sub-01" / "dwi" / "sub-01_model-noddi_param-odi_dwimap.nii.gz", np.ones((2, 2, 2)))
    with pytest.raises(FileNotFoundError) as caught:
        found(tmp_path, wanted={"space": "T1w"})
    text = str(caught.value)
    for words in ("space-T1w", str(tmp_path / "sub-01"), "param-txx", "dtifit", "dwi2tensor", "_dwi.nii[.gz]"):
        assert words in text
    (tmp_path / "sub-02").mkdir()
    with pytest.raises(ValueError, match=r"--participant-label: got 3; the participants in .* are 01, 02"):
        Dataset(tmp_path).chosen(["sub-01", "3"])
    assert Dataset(tmp_path).chosen(["sub-02", "02"]) == ["02"]
