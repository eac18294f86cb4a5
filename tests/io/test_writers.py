"""Tensors in the files of the programs that labs have, as these programs themselves wrote them."""

import base64
import gzip
import textwrap

import nibabel as nib
import numpy as np
import pytest

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io.tensor_order import ORDERS, invalid_by_order, pack

VOXEL = 1e-3 * np.array([[1.7, 0.3, 0.2], [0.3, 0.6, 0.1], [0.2, 0.1, 0.4]])
"""The tensor along the voxel axes, in mm²/s; every voxel has a multiple of it."""
SCALES = np.array([1, 0.8, 1.2, 0.9])[:, None, None] * np.ones((4, 3, 2))
EXPECTED = SCALES[..., None, None] * VOXEL
ALONG_FSL = EXPECTED * np.outer([-1, 1, 1], [-1, 1, 1])

MRTRIX = """
H4sIAAAAAAAAA4thZEACpXklmSU5qSlIQg4gooiBBQiZGZgY2BgYwRAVCDAogOkGe4gOBSB2cIDykcAGZyQxLgYcwDeopCizQqEstag4Mz/PSsFYz0DP
GJdiCgDIH/k/Re3um3620VH3tAO6+yDQfUB3P3BYfuq1/WqJvP0bDm8Ai19PdLdffpLHQZ07cD9EDQMDh5Kt/eYcc7B6dLPztA3BtILkJquGqj6rg9uv
Wl3wXGBFbf7uqGQr/UemVoszO6xK5/lQnf+y8ofl6+PHLD+Iilq9WnDfktr8PW/FrX6IfrasDjCzitnDYUVtflxaqKXPDi1LS64Gy1B+B0tq88XLKyzX
HnWztBeZapkwL57qfAA13GUQoAMAAA==
"""
"""Written by MRtrix 3.0.3, dwi2tensor and then mrconvert, from the scan below."""

MIF = {
    "-0,+1,-2,+3, Float32BE": """
H4sIAAAAAAACA62QMSwEQRSGlTKNxkV0U7u5NfPe7My+aYggkYhorhHBhjvZ5M7K3h53NEqVTiuXqDUaEhoFWo1aokMkEo3S3CUK/b7u+/P+/38zzSzP
kg5PmvF2jW0lTce1QAHCsL204zgICEIvKNaIu2k7d7wiRVmJCogysq04j/Pubs3x+UYa5wgzcyzP4p1WPc18kgwIlDSSSEfaIFrh3QFakBCGxkIEFAq/
pVQoI7+lSEupvFRR8n8ORqRVhFqiQkNR3xRZIkBlDJEFDYNosKB8JRJaP0Zw/S+mb/OVoe9X2rst9BUvIBodWSOt1wS3rDn4lPW9WtZK0h3HMfAnsHrS
8C8NOIJmc0uzbOhvXG/hyT1f3bmTgyN3Oc4L58WztjtOzl34Ouk2V26KZnrpvbtS6YseHj/op/tWNLvh21Vnlg/pu/Tjxj5vi2aaHqnSESOauF6kan2t
cF4/26DT0Smav7+gzv5Y0fwLRNBq84QDAAA=
""",
    "+1,+2,+3,+0, Float64LE": """
H4sIAAAAAAACA+2QP0scQRjG1/IG4pWpAlNEEHduM/PO7PxZ0UtizhCQYCB4YKMrnrJ458reKtqlS5EyX0Cs0yY2kqROQmwtxTJtLGwOnHkr/QjCTfMw
z77P7312BlVdFYe0GOTbPbJZDDKqmGTANDkoDzMKDJLUG4L086Nyv85oLFgMLJYs5mQzr/P6aK+X0cV+mddaLXVIXeW7w62y8iSeOBBcc+eUVVpKw2iL
J9IAhzTVBiy4lPkpIVJu/ZRwinPhrZbg9znSOiWsVFwKqZ0NIWucAym0ds6AAkSDAeFXSieNP5pRdQ8TYn5l6vcL5dMGguMNKbWyRnPjPUYNGeCjrB30
qmFR7mZUJr4C2Sr6/k8TKkGRzttXJLp7ni6stL2sd3eWgtK5Zjvoh9PRy6A/f3+ZCXp5NfksaLR8/g7vnbNFzI0uLPo/NuYx1+hOBT3+ejGNvJtvqzin
HmEu+n6C3PXmL8zT1xMceR9PAL9njfeY//v5TdDnT65nkfvp8Qv0/00gN/rzP26P+4/7j/s/3P63daE0dMQFAAA=
""",
    "+3,-2,+1,+0, Float32LE": """
H4sIAAAAAAACA8WQv0tjQRDHLWWbawxit7XZPHdn9u2+mUYLFYQgNmkOOe9xJvIg8cnzqYk2Ka3sbEWwtrFRuDQWamtjLVynhyDYWLoRLPwLMuWH74+Z
6RRlkXVl1kk3mmI967C0ChUoJ3bzLktQEMUBGNFOe/lOybKKqgaqalRVi/W0TMveVpPlYjtPS4T6giiLdHO7lRchSUcERjtNZBPrEL2SNR2hBw1x7Dwk
QLEKKmNinQSVIau1Cahm9PccTMiaBK1Gg46SoSnxRIDGOSIPFj6jwYMJlUjowzgl7beYoS1UxqHf2OD2MCQBIDqbeKd9YEp60fl8ytpus9jO8k2WGIUV
RCtrh0sjiWDFwvK8GPsaOXXBf3/+4afeOw1eJvlXq0GTe10aFe/vH/HMv5j/393Se+WN6lfTdH6zODJ+ffnAZ9khv1YqfLDimESfZieOR8bvl05556TO
z6ePtDoY58aPOfp9sjYy/gGcfpFChAMAAA==
""",
}
"""The same tensors as MRtrix's own images, by layout and datatype; compressed."""
MIF_MASK = """
H4sIAAAAAAACA1WQPW7DMAyFO+sUGrpVNvgjiaLHoh269AqFgTiFgDgOHDVIrtETl85QIBwf3vceyXlta736Oo/fk9vVefAxcCB3Wa6Dp0B9CuwO4235
aYPvILxQ6NDtxja222ka/Gttrq3j8bxfVoOhV0LIoBpLzMwSDOpZCCilLFRIUzAXYoJiLtQIgCZ1CI85XDRi4QiMnLVsUBFVYsxZVSjSPZqE0CpZWWxy
8PEhZsOsMlk/RqOFNsUE5hyLZBDTghc33//wdZnWc12Og+feVnD7erAbe89I7v3zzT39z8fv8x9Im0PROwEAAA==
"""
"""(i + 2j + k) mod 3 = 0, layout -0,+2,-1, datatype Bit."""


def oblique():
    """An affine that turns about two axes and keeps orientation: FSL's first axis is reversed."""
    (c, s), (a, b) = (np.cos(0.4), np.sin(0.4)), (np.cos(0.3), np.sin(0.3))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, a, -b], [0, b, a]])
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = turn @ np.diag([2, 2.5, 3]), [-10, 4, 7]
    return affine


@pytest.fixture
def scan(tmp_path):
    """The folder of a scan without noise, with FSL's b-vectors."""
    directions = np.random.default_rng(0).normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    b, directions = np.r_[0, np.full(12, 1000.0)], np.r_[np.zeros((1, 3)), directions]
    signal = 1000 * np.exp(-b * np.einsum("na,xyzab,nb->xyzn", directions, EXPECTED, directions))
    nib.save(nib.Nifti1Image(signal.astype(np.float32), oblique()), tmp_path / "dwi.nii.gz")
    np.savetxt(tmp_path / "dwi.bvec", (directions * [-1, 1, 1]).T)
    np.savetxt(tmp_path / "dwi.bval", b[None])
    nib.save(nib.Nifti1Image(np.ones((4, 3, 2), np.uint8), oblique()), tmp_path / "mask.nii.gz")
    return tmp_path


@pytest.mark.parametrize("declared", [False, True])
def test_dipys_own_command_writes_fsls_order_unless_told_otherwise(scan, declared):
    """``dipy_fit_dti`` without and with ``--nifti_tensor``: the flow that the command runs, with its flag's values."""
    reconst = pytest.importorskip("dipy.workflows.reconst")
    files = [str(scan / name) for name in ("dwi.nii.gz", "dwi.bval", "dwi.bvec", "mask.nii.gz")]
    reconst.ReconstDtiFlow().run(*files, nifti_tensor=declared, save_metrics=["tensor"], out_dir=str(scan))
    path = scan / "tensors.nii.gz"
    image = nib.load(path)
    if declared:
        assert (image.shape, image.header.get_intent()[0]) == ((4, 3, 2, 1, 6), "symmetric matrix")
        read = hj.io.read_tensors(path, frame="fsl")
    else:
        assert (image.shape, image.header.get_intent()[0]) == ((4, 3, 2, 6), "none")
        with pytest.raises(ValueError, match="does not declare their order"):
            hj.io.read_tensors(path)
        read = hj.io.read_tensors(path, order="fsl")
        wrong = hj.io.read_tensors(path, order="nifti").invalid_by_order
        assert wrong.counts["nifti"] == wrong.of == 24
        assert wrong.fewer[0] == "fsl"
    np.testing.assert_allclose(read.tensors, EXPECTED, rtol=1e-5, atol=1e-9)
    assert read.invalid_by_order is None


def test_what_mrtrix_wrote(tmp_path):
    path = tmp_path / "dt.nii.gz"
    path.write_bytes(base64.b64decode(textwrap.dedent(MRTRIX)))
    read = hj.io.read_tensors(path, order="mrtrix")
    np.testing.assert_allclose(read.affine, oblique(), atol=1e-6)
    np.testing.assert_allclose(read.tensors, EXPECTED, rtol=1e-5, atol=1e-9)
    for order in ("nifti", "fsl"):
        assert hj.io.read_tensors(path, order=order).invalid_by_order.counts["mrtrix"] == 0


@pytest.mark.parametrize("layout", list(MIF))
def test_mrtrixs_own_images(tmp_path, layout):
    compressed = base64.b64decode(MIF[layout])
    (tmp_path / "dt.mif.gz").write_bytes(compressed)
    (tmp_path / "dt.mif").write_bytes(gzip.decompress(compressed))
    (tmp_path / "mask.mif").write_bytes(gzip.decompress(base64.b64decode(MIF_MASK)))
    i, j, k = np.indices((4, 3, 2))
    for name in ("dt.mif", "dt.mif.gz"):
        read = hj.io.read_tensors(tmp_path / name, mask=tmp_path / "mask.mif")
        np.testing.assert_allclose(read.affine, oblique(), atol=1e-12)
        np.testing.assert_allclose(read.tensors, EXPECTED, rtol=1e-6, atol=1e-10)
        np.testing.assert_array_equal(read.mask, (i + 2 * j + k) % 3 == 0)
    assert (read.order, read.frame, read.tensors.dtype) == ("mrtrix", "world", "f8" if "64" in layout else "f4")


def test_damaged_images_of_mrtrix(tmp_path):
    whole = gzip.decompress(base64.b64decode(next(iter(MIF.values()))))
    for content, words in (
        (whole[:-1], "got 899 bytes; expected 900"),
        (whole.replace(b"Float32BE", b"CFloat32BE"), "expected real numbers"),
        (whole.replace(b"-0,+1,-2,+3", b"-0,+1,-2,+2"), "layout: got"),
        (whole.replace(b"dim: 4,3,2,6", b"dim: 4,3,9,6"), "bytes; expected"),
        (whole.replace(b"file: . 324", b"file: x 324"), "for voxels in the same file"),
        (whole[7:], "does not begin with"),
    ):
        (tmp_path / "t.mif").write_bytes(content)
        with pytest.raises(ValueError, match=rf"t\.mif: the file is damaged or not a readable MRtrix image.*{words}"):
            hj.io.read_tensors(tmp_path / "t.mif")
    (tmp_path / "t.mih").write_bytes(whole)
    with pytest.raises(ValueError, match=r"MRtrix converts it into one file: mrconvert .*t\.mih .*t\.mif"):
        hj.io.read_tensors(tmp_path / "t.mih")
    with pytest.raises(ValueError, match=r"Camino's raw files .* dt2nii -inputfile .*dt\.Bdouble -header"):
        hj.io.read_tensors(tmp_path / "dt.Bdouble")


def test_what_fsl_writes(scan, tmp_path):
    """dtifit --save_tensor: a 4D float32 image xx xy xz yy yz zz without intent, along the axes of its b-vectors."""
    nib.save(nib.Nifti1Image(pack(ALONG_FSL, "fsl").astype(np.float32), oblique()), tmp_path / "dti_tensor.nii.gz")
    read = hj.io.read_tensors(tmp_path / "dti_tensor.nii.gz", order="fsl")
    np.testing.assert_allclose(read.tensors, EXPECTED, rtol=1e-6)
    fit = hj.io.fit_dwi(scan / "dwi.nii.gz", scan / "dwi.bval", scan / "dwi.bvec", np.ones((4, 3, 2), bool))
    np.testing.assert_allclose(fit.tensors, read.tensors, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("order", list(ORDERS))
def test_validity_tells_orders_apart_but_for_the_two_with_the_diagonal_first(order, rng):
    roots = rng.normal(size=(200, 3, 3))
    tensors = roots @ np.swapaxes(roots, 1, 2) + 0.3 * np.eye(3)
    components = pack(np.concatenate([tensors, np.zeros((50, 3, 3))]), order)
    assert invalid_by_order(components, order) is None
    diagonal_first = {"mrtrix", "vtk"}
    for wrong in set(ORDERS) - {order}:
        found = invalid_by_order(components, wrong)
        if {order, wrong} == diagonal_first:
            continue
        assert found.of == 200
        assert found.counts[order] == 0
        assert order in found.fewer[:2]
        assert f'try order="{found.fewer[0]}"' in found.question
    noise = tensors.copy()
    noise[:5] *= -1
    assert invalid_by_order(pack(noise, order), order) is None  # a few are no sign of a wrong order


def test_the_command_line_asks_whether_the_order_is_wrong(tmp_path, capsys):
    nib.save(nib.Nifti1Image(pack(ALONG_FSL, "fsl"), oblique()), tmp_path / "t.nii.gz")
    arguments = [str(tmp_path / "t.nii.gz"), "--order", "nifti"]
    assert main(["hks", *arguments, "-o", str(tmp_path / "out"), "--metric", "inverse", "-q"]) == 2
    error = capsys.readouterr().err
    assert "Wrong order? Of 24 nonzero tensors, 24 are not positive definite in order" in error
    assert "try --order fsl" in error
    assert main(["info", *arguments]) == 0
    assert "try --order fsl" in capsys.readouterr().out
