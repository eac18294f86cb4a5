"""Meshes: files that meshio and VTK wrote, against what meshio reads; values at vertices, read by meshio."""

import builtins
import json

import numpy as np
import pytest

import hks_jax as hj
from hks_jax.io import read_mesh, save

meshio = pytest.importorskip("meshio")


def octahedron():
    vertices = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 3], [0, 0, -3]])
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    return vertices, faces


def sorted_corners(vertices, faces):
    """Return the triangles as points, in an order that does not depend on numbering."""
    corners = np.asarray(vertices)[np.asarray(faces)].reshape(len(faces), 9)
    return corners[np.lexsort(corners.T)]


@pytest.mark.parametrize("suffix", ["vtk", "vtu", "ply", "stl", "obj", "off"])
def test_what_meshio_writes(tmp_path, suffix):
    vertices, faces = octahedron()
    path = tmp_path / f"m.{suffix}"
    meshio.Mesh(vertices, [("triangle", faces)]).write(path)
    with np.errstate(over="ignore"):  # meshio's STL takes letters for a number first
        mesh, theirs = read_mesh(path), meshio.read(path)
    np.testing.assert_array_equal(mesh.vertices, theirs.points)
    np.testing.assert_array_equal(mesh.faces, theirs.get_cells_type("triangle"))
    np.testing.assert_array_equal(sorted_corners(mesh.vertices, mesh.faces), sorted_corners(vertices, faces))
    assert len(mesh.vertices) == 6  # STL's 24 corners are these
    if suffix != "stl":
        np.testing.assert_array_equal(mesh.faces, faces)


def test_quadrilaterals_and_flat_meshes(tmp_path):
    points = np.array([[0.0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]])
    cells = [("quad", np.array([[0, 1, 4, 3]])), ("triangle", np.array([[1, 2, 5], [1, 5, 4]]))]
    meshio.Mesh(points, cells).write(tmp_path / "m.vtu")
    mesh = read_mesh(tmp_path / "m.vtu")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    np.testing.assert_array_equal(mesh.vertices, np.column_stack([points, np.zeros(6)]))


def test_polygonal_data_through_vtk(tmp_path):
    pytest.importorskip("vtkmodules", reason='VTK is not installed: pip install "hks-jax[vtk]"')
    from vtkmodules.vtkFiltersSources import vtkSphereSource
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    source = vtkSphereSource()
    source.SetThetaResolution(24)
    source.SetPhiResolution(20)
    source.Update()
    for name, writer in (("s.vtk", vtkPolyDataWriter()), ("s.vtp", vtkXMLPolyDataWriter())):
        writer.SetFileName(str(tmp_path / name))
        writer.SetInputData(source.GetOutput())
        writer.Write()
        mesh = read_mesh(tmp_path / name)
        assert (len(mesh.vertices), len(mesh.faces)) == (source.GetOutput().GetNumberOfPoints(), 24 * 18 * 2)
        np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.5, rtol=1e-5)
        assert not mesh.triangulation.boundary_vertices.any()


def test_seams_are_closed_if_asked(tmp_path):
    vertices, faces = octahedron()
    corners = vertices[faces].reshape(-1, 3)
    split = np.arange(24).reshape(8, 3)
    split = np.concatenate([split, [[0, 0, 1]]])  # a triangle without area, and a vertex without a triangle
    meshio.Mesh(np.concatenate([corners, [[9.0, 9, 9]]]), [("triangle", split)]).write(tmp_path / "m.obj")
    with pytest.raises(ValueError, match=r"belong to no face; remove them\. clean=True merges"):
        read_mesh(tmp_path / "m.obj")
    mesh = read_mesh(tmp_path / "m.obj", clean=True)
    assert mesh.vertices.shape == (6, 3)
    np.testing.assert_array_equal(sorted_corners(mesh.vertices, mesh.faces), sorted_corners(vertices, faces))
    np.testing.assert_array_equal(mesh.vertices[0], corners[0])  # in the order of the file


@pytest.mark.parametrize("suffix", ["vtk", "vtu", "ply"])
def test_signatures_at_the_vertices(tmp_path, suffix):
    mesh = hj.SurfaceMesh(*octahedron())
    values = np.random.default_rng(0).random((2, 6))
    extra, provenance = {"times": [1.0, 2.5]}, {"settings": {"k": 4}, "note": "λ"}
    path = save(tmp_path / f"m.{suffix}", values, mesh, name="hks", extra=extra, provenance=provenance)
    theirs = meshio.read(path)
    np.testing.assert_array_equal(theirs.points, mesh.vertices)
    np.testing.assert_array_equal(theirs.get_cells_type("triangle"), mesh.faces)
    np.testing.assert_array_equal(theirs.point_data["hks_0_t1"], values[0])
    np.testing.assert_array_equal(theirs.point_data["hks_1_t2.5"], values[1])
    record = json.loads((tmp_path / f"m.{suffix}.json").read_text(encoding="utf-8"))
    assert record == {"software": f"hks-jax {hj.__version__}", **provenance}
    assert len(list(tmp_path.iterdir())) == 2
    np.testing.assert_array_equal(read_mesh(path).vertices, mesh.vertices)


def test_signatures_in_npz(tmp_path):
    mesh = hj.SurfaceMesh(*octahedron())
    with np.load(save(tmp_path / "m.npz", np.arange(6.0), mesh)) as read:
        np.testing.assert_array_equal(read["values"], np.arange(6))
        np.testing.assert_array_equal(read["vertices"], mesh.vertices)
        np.testing.assert_array_equal(read["faces"], mesh.faces)


def test_bad_meshes(tmp_path, capsys):
    vertices, faces = octahedron()
    tetrahedra = meshio.Mesh(vertices, [("tetra", np.array([[0, 2, 4, 5]]))])
    tetrahedra.write(tmp_path / "t.vtu")
    with pytest.raises(ValueError, match="has tetra cells; expected triangles"):
        read_mesh(tmp_path / "t.vtu")
    meshio.Mesh(vertices, [("line", faces[:, :2])]).write(tmp_path / "l.vtu")
    with pytest.raises(ValueError, match="has no triangles"):
        read_mesh(tmp_path / "l.vtu")
    for suffix in ("vtk", "vtu", "ply", "stl", "obj", "off"):
        (tmp_path / f"n.{suffix}").write_bytes(b"not what the name says")
        with pytest.raises(ValueError, match="n." + suffix):
            read_mesh(tmp_path / f"n.{suffix}")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_mesh(tmp_path / "absent.ply")
    (tmp_path / "m.gts").write_text("")
    with pytest.raises(ValueError, match="unknown kind of mesh"):
        read_mesh(tmp_path / "m.gts")
    mesh = hj.SurfaceMesh(vertices, faces)
    with pytest.raises(ValueError, match=r"written as \.vtu, \.vtk, \.ply or \.npz"):
        save(tmp_path / "v.stl", np.zeros(6), mesh)
    with pytest.raises(ValueError, match=r"expected \(6,\), or n_times before it"):
        save(tmp_path / "v.ply", np.zeros(7), mesh)
    assert capsys.readouterr().out == ""  # meshio's own reader prints, and ends the process


def test_without_meshio_the_extra_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "meshio":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    (tmp_path / "m.ply").write_text("")
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r'pip install "hks-jax\[mesh\]"'):
        read_mesh(tmp_path / "m.ply")
