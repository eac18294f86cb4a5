"""Meshes as programs leave them: cleaned, they must have the spectrum of the surface that was meant.

A check takes a bumpy sphere and spoils it: vertices in another order, faces turned round, doubled, without area or cut
at seams, and vertices that belong to nothing, in one of three formats. Read with ``clean=True`` its lowest eigenvalues
are those of the sphere; read without, it is refused, warned of, or has them too.
"""

import tempfile
import warnings
from functools import cache
from pathlib import Path

import numpy as np

import hks_jax as hj

from .harness import Outcome


@cache
def _sphere() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    mesh = hj.examples.sphere_mesh(5)
    places = np.asarray(mesh.vertices, np.float64)
    places = places * (1 + 0.2 * np.sin(3 * places[:, :1] + 2 * places[:, 1:2]))
    return places, mesh.faces, _values(hj.SurfaceMesh(places, mesh.faces))


def _values(mesh: hj.SurfaceMesh) -> np.ndarray:
    return np.asarray(hj.eigenpairs(mesh, 8, solver="dense", multiplet="drop").eigenvalues)


def check(seed: int) -> Outcome:
    """Spoil a mesh and read it, with and without cleaning."""
    rng = np.random.default_rng(seed)
    places, faces, exact = _sphere()
    done = []
    for spoil in (_shuffled, _turned, _doubled, _empty, _torn, _lost):
        if rng.random() < 0.4:
            places, faces = spoil(rng, places, faces)
            done.append(spoil.__name__)
    what = ", ".join(done) or "as it is"
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        path = Path(folder) / f"m.{rng.choice(['obj', 'off', 'ply'])}"
        _write(path, places, faces)
        cleaned = _values(hj.io.read_mesh(path, clean=True))
        np.testing.assert_allclose(cleaned, exact, atol=1e-6, err_msg=f"{path.suffix}, cleaned: {what}")
        said.clear()
        try:
            plain = _values(hj.io.read_mesh(path))
        except ValueError:
            if not done:
                raise
            return "refused"
        if said:
            return "told"
    np.testing.assert_allclose(plain, exact, atol=1e-6, err_msg=f"{path.suffix}: {what}")
    return "right"


Mesh = tuple[np.ndarray, np.ndarray]


def _shuffled(rng: np.random.Generator, places: np.ndarray, faces: np.ndarray) -> Mesh:
    order = rng.permutation(len(places))
    return places[order], np.argsort(order)[faces][rng.permutation(len(faces))]


def _turned(rng: np.random.Generator, places: np.ndarray, faces: np.ndarray) -> Mesh:
    return places, np.where((rng.random(len(faces)) < 0.5)[:, None], faces[:, ::-1], faces)


def _doubled(rng: np.random.Generator, places: np.ndarray, faces: np.ndarray) -> Mesh:
    return places, np.concatenate([faces, np.roll(faces[rng.choice(len(faces), 5)], 1, axis=1)])


def _empty(rng: np.random.Generator, places: np.ndarray, faces: np.ndarray) -> Mesh:
    some = faces[rng.choice(len(faces), 4)]
    return places, np.concatenate([faces, some[:, [0, 1, 0]]])


def _torn(rng: np.random.Generator, places: np.ndarray, faces: np.ndarray) -> Mesh:
    """Give some corners vertices of their own, as at the seams of a texture, or all, as in a soup."""
    some = rng.random(faces.shape) < rng.choice([0.05, 1.0])
    own = np.where(some, len(places) + np.cumsum(some).reshape(some.shape) - 1, faces)
    return np.concatenate([places, places[faces[some]]]), own


def _lost(rng: np.random.Generator, places: np.ndarray, faces: np.ndarray) -> Mesh:
    return np.concatenate([places, rng.uniform(-2, 2, (3, 3))]), faces


def _write(path: Path, places: np.ndarray, faces: np.ndarray) -> None:
    points = [" ".join(map(repr, map(float, place))) for place in places]
    corners = ["3 " + " ".join(map(str, face)) for face in faces]
    if path.suffix == ".obj":
        lines = [f"v {point}" for point in points] + ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    elif path.suffix == ".off":
        lines = ["OFF", f"{len(points)} {len(corners)} 0", *points, *corners]
    else:
        head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty double x\nproperty double y\n"
        head += f"property double z\nelement face {len(corners)}\nproperty list uchar int vertex_indices\nend_header"
        lines = [head, *points, *corners]
    path.write_text("\n".join(lines) + "\n")
