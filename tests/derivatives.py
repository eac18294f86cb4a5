"""Trees of derivatives as QSIRecon, QSIPrep, FSL and MRtrix write them, with small synthetic tensors."""

import json
from pathlib import Path

import nibabel as nib
import numpy as np

SHAPE = (8, 7, 4)
AFFINE = np.diag([2.0, 2.0, 2.5, 1.0])
"""Of positive determinant, so that FSL reverses the first axis of its directions."""
SPACE = "space-ACPC"
_MRTRIX = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_FSL = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def tensors(scale=1.0):
    """Smooth tensors in mm²/s along the voxel axes, which are the axes of the scanner."""
    x, y, z = (a / 5 for a in np.indices(SHAPE))
    field = np.zeros((*SHAPE, 3, 3))
    for a, values in enumerate((1.5 + 0.4 * np.cos(x), 1.0 + 0.3 * np.sin(y), 0.8 + 0.1 * z)):
        field[..., a, a] = values
    field[..., 0, 1] = field[..., 1, 0] = 0.2 * np.sin(x + y)
    field[..., 1, 2] = field[..., 2, 1] = 0.1 * np.cos(z)
    return 1e-3 * scale * field


def mask():
    inside = np.ones(SHAPE, np.uint8)
    inside[0] = inside[:, -1] = 0
    return inside


def describe(root, name, kind="derivative"):
    root.mkdir(parents=True, exist_ok=True)
    about = {"Name": name, "BIDSVersion": "1.10.0", "DatasetType": kind}
    (root / "dataset_description.json").write_text(json.dumps(about | {"GeneratedBy": [{"Name": name}]}))
    return root


def image(path, values, affine=AFFINE):
    path.parent.mkdir(parents=True, exist_ok=True)
    nib.save(nib.Nifti1Image(values, affine), path)
    return path


def source_of(label, *entities):
    """The folder and the beginning of the names of a participant's files: ``ses-`` may be among the entities."""
    session = [one for one in entities if one.startswith("ses-")]
    return Path(f"sub-{label}", *session, "dwi"), "_".join([f"sub-{label}", *entities])


def qsirecon(root, label, *entities, scale=1.0):
    """Six images of components, as QSIRecon's pipelines of DSI Studio write them."""
    folder, stem = source_of(label, *entities, SPACE)
    for a, b in _FSL:
        values = tensors(scale)[..., a, b].astype(np.float32)
        image(root / folder / f"{stem}_model-tensor_param-t{'xyz'[a]}{'xyz'[b]}_dwimap.nii.gz", values)
    image(root / folder / f"{stem}_model-tensor_param-fa_dwimap.nii.gz", np.ones(SHAPE, np.float32))
    return root / folder


def bep16(root, label, *entities, scale=1.0, unit=None, desc=""):
    """One image of tensors with a sidecar, as the draft of BIDS describes it."""
    folder, stem = source_of(label, *entities, SPACE)
    values = np.stack([tensors(scale)[..., a, b] for a, b in _FSL], axis=-1).astype(np.float32)
    path = image(root / folder / f"{stem}_model-tensor{desc}_param-diffusivity_dwimap.nii.gz", values)
    encoding = {"EncodingAxis": 3, "Reference": "ijk", "TensorRank": 2, "Type": "tensor"}
    about = {"OrientationEncoding": encoding, **({"Units": unit} if unit else {})}
    path.with_name(path.name.replace(".nii.gz", ".json")).write_text(json.dumps(about))
    return path


def qsiprep(root, label, *entities, scale=1.0, desc="preproc"):
    """Preprocessed diffusion-weighted images with b-values, directions and a mask."""
    folder, stem = source_of(label, *entities, SPACE)
    rng = np.random.default_rng(7)
    directions = rng.standard_normal((20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    b = np.array([0.0, 0.0, *[1000.0] * 20])
    directions = np.vstack([np.zeros((2, 3)), directions])
    decay = np.einsum("ni,...ij,nj->...n", directions, tensors(scale), directions)
    name = root / folder / f"{stem}_desc-{desc}_dwi"
    image(name.with_name(name.name + ".nii.gz"), (1000 * np.exp(-b * decay)).astype(np.float32))
    name.with_name(name.name + ".bval").write_text(" ".join(map(str, b)))
    fsl = directions * [-1, 1, 1]
    name.with_name(name.name + ".bvec").write_text("\n".join(" ".join(map(str, row)) for row in fsl.T))
    image(root / folder / f"{stem}_desc-brain_mask.nii.gz", mask())
    return name


def dtifit(root, label, *entities, scale=1.0):
    """The images that FSL's ``dtifit --save_tensor -o dti`` writes into the folder, along FSL's axes."""
    folder, _ = source_of(label, *entities)
    signs = np.array([-1, 1, 1])
    field = tensors(scale) * np.outer(signs, signs)
    values = np.stack([field[..., a, b] for a, b in _FSL], axis=-1).astype(np.float32)
    for name in ("V1", "FA", "L1"):
        image(root / folder / f"dti_{name}.nii.gz", np.ones((*SHAPE, 3)[: 3 + (name == "V1")], np.float32))
    image(root / folder / "nodif_brain_mask.nii.gz", mask())
    return image(root / folder / "dti_tensor.nii.gz", values)


def mrtrix(root, label, *entities, scale=1.0):
    """The image that MRtrix's ``dwi2tensor dwi.mif dt.mif`` writes, and a mask."""
    folder, _ = source_of(label, *entities)
    (root / folder).mkdir(parents=True, exist_ok=True)
    values = np.stack([tensors(scale)[..., a, b] for a, b in _MRTRIX], axis=-1).astype("<f4")
    for name, array, kind in (("dt", values, "Float32LE"), ("mask", mask(), "UInt8")):
        n = array.ndim
        header = [
            "mrtrix image",
            f"dim: {','.join(map(str, array.shape))}",
            f"vox: 2,2,2.5{',nan' * (n - 3)}",
            f"layout: {','.join(f'+{i}' for i in range(n))}",
            f"datatype: {kind}",
            "transform: 1,0,0,0",
            "transform: 0,1,0,0",
            "transform: 0,0,1,0",
        ]
        text = "\n".join([*header, "file: . {:d}", "END", ""])
        offset = len(text) + 8
        content = text.format(offset).encode().ljust(offset, b"\0") + array.tobytes(order="F")
        (root / folder / f"{name}.mif").write_bytes(content)
    return root / folder / "dt.mif"


def labels(root, label, *entities, seg="Halves"):
    """A map of two regions and their names, as QSIRecon writes its atlases."""
    folder, stem = source_of(label, *entities, SPACE)
    values = np.where(np.indices(SHAPE)[0] < SHAPE[0] // 2, 1, 2).astype(np.int16)
    path = image(root / folder / f"{stem}_seg-{seg}_dseg.nii.gz", values)
    path.with_name(path.name.replace(".nii.gz", ".tsv")).write_text("index\tname\n1\tleft\n2\tright\n")
    return path
