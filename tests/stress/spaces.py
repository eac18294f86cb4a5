"""Tensors in space: whatever the format, the hand, the unit, the frame and the storage, it is the same field.

A check makes tensors of voxels of any orientation in the scanner's coordinates, writes them as another program would
(NIfTI in three units of length and three frames, NRRD with a measurement frame in two spaces), and reads them. Then it
has the library write and read them once more, in any of its formats, and sample them at the voxels' centres. Components
along the axes of space, positions in mm, and the picture's sides must be what they were.
"""

import importlib.util
import tempfile
import warnings
from pathlib import Path

import nibabel
import nrrd
import numpy as np
from scipy.spatial.transform import Rotation

import hks_jax as hj
from hks_jax.plot import Orientation

from .harness import Outcome

_UNITS = {"mm": 1.0, "meter": 1e-3, "micron": 1e3}
_FORMATS = [".nii.gz", ".nii", ".nrrd", ".npz", *([".vti"] if importlib.util.find_spec("vtkmodules") else [])]
_NIFTI = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]


def check(seed: int) -> Outcome:
    """Write, read, write and read a random field."""
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(4, 8, 3).tolist())
    affine = np.eye(4)
    axes = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    if rng.random() < 0.3:
        axes = np.eye(3)[:, rng.permutation(3)] * rng.choice([-1, 1], 3)
    affine[:3, :3] = axes * np.where(rng.random() < 0.5, rng.choice([-1.0, 1.0]), 1.0) * rng.uniform(0.5, 3, 3)
    affine[:3, 3] = rng.uniform(-90, 90, 3)
    factors = rng.standard_normal((*shape, 3, 3))
    world = 5e-4 * (np.eye(3) + 0.3 * factors @ np.swapaxes(factors, -1, -2))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        name, frame = (_nifti, _nrrd)[rng.integers(2)](rng, Path(folder), world, affine)
        read = hj.io.read_tensors(name, frame=frame)
        _same(read, world, affine, f"{name.name}, frame {frame}")
        again = Path(folder) / f"again{rng.choice(_FORMATS)}"
        hj.io.save_tensors(again, read)
        back = hj.io.read_tensors(again)
        _same(back, world, affine, f"{name.name}, then {again.name}")
    places = np.argwhere(np.ones(shape, bool)) @ affine[:3, :3].T + affine[:3, 3]
    np.testing.assert_allclose(hj.io.sample_tensors(back, places).reshape(world.shape), world, atol=1e-7)
    return "right"


def _same(volume: hj.io.TensorVolume, world: np.ndarray, affine: np.ndarray, what: str) -> None:
    assert volume.affine is not None, f"{what}: no affine"
    # Some formats store the voxels in another order: each tensor is looked up by its place.
    np.testing.assert_allclose(np.linalg.norm(volume.affine[:3, :3], axis=0), volume.spacing, rtol=1e-5, err_msg=what)
    places = np.argwhere(np.ones(volume.shape, bool)) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    voxels = np.linalg.solve(affine[:3, :3], (places - affine[:3, 3]).T).T
    np.testing.assert_allclose(voxels, voxels.round(), atol=1e-3, err_msg=what)
    axes = volume.affine[:3, :3] / np.asarray(volume.spacing)
    along = axes @ volume.tensors.reshape(-1, 3, 3) @ axes.T
    expected = world[tuple(voxels.round().astype(int).T)]
    np.testing.assert_allclose(along, expected, atol=1e-8, err_msg=what)
    # The side that a picture calls left is where x is least.
    letters = Orientation.of(volume.affine)
    x = places.reshape(*volume.shape, 3)
    for axis, ends in enumerate(letters.ends):
        number = ("LR", "PA", "IS").index(ends)
        turned = letters.array(x[None, ..., number])[0]
        assert np.all(np.diff(turned.mean(axis=tuple(a for a in range(3) if a != axis))) > 0), f"{what}: {letters.ends}"


def _nifti(rng: np.random.Generator, folder: Path, world: np.ndarray, affine: np.ndarray) -> tuple[Path, str]:
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    frame, unit = str(rng.choice(["voxel", "fsl", "world"])), str(rng.choice(list(_UNITS)))
    along = world if frame == "world" else axes.T @ world @ axes
    if frame == "fsl" and np.linalg.det(affine[:3, :3]) > 0:
        along = along * np.outer([-1, 1, 1], [-1, 1, 1])
    scaled = np.diag([_UNITS[unit]] * 3 + [1]) @ affine
    components = np.stack([along[..., i, j] for i, j in _NIFTI], -1)[..., None, :]
    image = nibabel.Nifti1Image(components, scaled)
    image.header.set_intent("symmetric matrix", (3,))
    image.header.set_xyzt_units(unit)
    path = folder / f"{unit}.nii{'.gz' if rng.random() < 0.5 else ''}"
    nibabel.save(image, path)
    return path, frame


def _nrrd(rng: np.random.Generator, folder: Path, world: np.ndarray, affine: np.ndarray) -> tuple[Path, str]:
    space = str(rng.choice(["left-posterior-superior", "right-anterior-superior"]))
    to_space = np.diag([-1.0, -1, 1]) if space.startswith("left") else np.eye(3)
    frame = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    components = frame.T @ to_space @ world @ to_space @ frame
    header = {
        "kinds": ["3D-matrix", "space", "space", "space"],
        "space": space,
        "space directions": np.vstack([np.full(3, np.nan), (to_space @ affine[:3, :3]).T]),
        "space origin": to_space @ affine[:3, 3],
        "measurement frame": frame.T,  # pynrrd writes rows as vectors, and they are columns of the frame
    }
    path = folder / f"{space[:4]}.nrrd"
    nrrd.write(str(path), np.moveaxis(components.reshape(*world.shape[:3], 9), -1, 0), header)
    return path, "measurement"
