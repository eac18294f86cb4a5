"""Meshes: files that meshio and VTK wrote, against what meshio reads; values at vertices, read by meshio."""

import json
import re

import numpy as np
import pytest

import hks_jax as hj
from hks_jax.io import read_mesh, read_mesh_arrays, save

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
        np.testing.assert_allclose(read_mesh_arrays(tmp_path / name)["Normals"], 2 * mesh.vertices, atol=1e-6)


def test_seams_are_closed_if_asked(tmp_path):
    vertices, faces = octahedron()
    corners = vertices[faces].reshape(-1, 3)
    split = np.arange(24).reshape(8, 3)
    split = np.concatenate([split, [[0, 0, 1]]])  # a triangle without area, and a vertex without a triangle
    meshio.Mesh(np.concatenate([corners, [[9.0, 9, 9]]]), [("triangle", split)]).write(tmp_path / "m.obj")
    with pytest.raises(
        ValueError, match=r"belong to no face \(the first is vertex 24\); remove them.* clean=True repairs"
    ):
        read_mesh(tmp_path / "m.obj")
    with pytest.warns(UserWarning, match="18 vertices merged with a coincident vertex; 1 triangles without area"):
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


SOLID = hj.examples.ball_mesh(2)


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "msh"])
def test_tetrahedra_and_arrays_there_and_back(tmp_path, suffix, rng):
    values = rng.random((2, len(SOLID.vertices)))
    path = save(tmp_path / f"b.{suffix}", values, SOLID, name="hks", extra={"times": [1.0, 2.5]})
    theirs = meshio.read(path)
    np.testing.assert_array_equal(theirs.points, SOLID.vertices)
    np.testing.assert_array_equal(theirs.get_cells_type("tetra"), SOLID.cells)
    mesh, arrays = read_mesh(path), read_mesh_arrays(path)
    assert isinstance(mesh, hj.TetMesh)
    np.testing.assert_array_equal(mesh.vertices, SOLID.vertices)
    np.testing.assert_array_equal(mesh.cells, SOLID.cells)
    assert list(arrays) == ["hks_0_t1", "hks_1_t2.5"]
    np.testing.assert_array_equal(list(arrays.values()), values)
    with np.load(save(tmp_path / "b.npz", values[0], SOLID)) as read:
        np.testing.assert_array_equal(read["cells"], SOLID.cells)
    with pytest.raises(ValueError, match=r"tetrahedra can be written as \.vtu, \.vtk, \.msh or \.npz"):
        save(tmp_path / "b.ply", values[0], SOLID)


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "msh", "ply", "npz"])
def test_names_that_no_format_can_hold_are_refused_by_all(tmp_path, suffix):
    mesh, values = hj.SurfaceMesh(*octahedron()), np.arange(6.0)
    for name in ("", "a b", "t<1", 'a"b', "a\nb", "λ"):
        with pytest.raises(ValueError, match=r"name: got the name .*; expected letters a–z, digits"):
            save(tmp_path / f"m.{suffix}", values, mesh, name=name)
        with pytest.raises(ValueError, match=r"extra: got the name"):
            save(tmp_path / f"m.{suffix}", values, mesh, extra={name: np.zeros(2)})
    assert not list(tmp_path.iterdir())
    path = save(tmp_path / f"m.{suffix}", values, mesh, name="FA_1.5-x")
    arrays = np.load(path) if suffix == "npz" else read_mesh_arrays(path)
    np.testing.assert_array_equal(arrays["FA_1.5-x"], values)


@pytest.mark.filterwarnings("ignore:.*")
@pytest.mark.parametrize("suffix", ["vtu", "vtk", "msh", "ply"])
@pytest.mark.parametrize("name", ["x", "POINTS", "CELL_TYPES", "METADATA", "NodeData", "end_header"])
def test_names_with_a_meaning_in_a_format_are_read_back_or_refused(tmp_path, suffix, name):
    mesh, values = hj.SurfaceMesh(*octahedron()), np.arange(6.0)
    if (suffix, name) in [("ply", "x"), ("ply", "end_header"), ("vtk", "METADATA")]:
        with pytest.raises(ValueError, match=rf"name: got '{name}', which has another meaning in \.{suffix}"):
            save(tmp_path / f"m.{suffix}", values, mesh, name=name)
    else:
        arrays = read_mesh_arrays(save(tmp_path / f"m.{suffix}", values, mesh, name=name))
        np.testing.assert_array_equal(arrays[name], values)


def test_cleaned_tetrahedra_and_their_arrays(tmp_path, rng):
    """Split into corners, some in the other order, with a flat one and a vertex without any: as at first."""
    corners, cells = np.asarray(SOLID.vertices)[SOLID.cells].reshape(-1, 3), np.arange(640).reshape(-1, 4)
    cells[::3] = cells[::3][:, [1, 0, 2, 3]]
    points = np.concatenate([[[9.0, 9, 9]], corners])
    cells = np.concatenate([1 + cells, [[1, 1, 2, 3]]])
    tensors = rng.random((641, 9))
    tensors[1:] = corners @ rng.random((3, 9))
    meshio.Mesh(points, [("tetra", cells)], point_data={"D": tensors}).write(tmp_path / "m.vtu")
    with pytest.raises(ValueError, match=r"belong to no cell \(the first is vertex 0\).* clean=True repairs"):
        read_mesh(tmp_path / "m.vtu")
    with pytest.warns(
        UserWarning,
        match="54 tetrahedra of negative orientation reversed; 1 tetrahedra without volume removed; 1 vertices",
    ):
        mesh = read_mesh(tmp_path / "m.vtu", clean=True)
    assert mesh.vertices.shape == (55, 3)
    assert float(hj.assemble(mesh).volume) == pytest.approx(float(hj.assemble(SOLID).volume))
    D = read_mesh_arrays(tmp_path / "m.vtu", clean=True)["D"]
    first = [int(np.flatnonzero((points == v).all(axis=1))[0]) for v in np.asarray(mesh.vertices)]
    np.testing.assert_array_equal(D, tensors[first])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("version", ["2.2", "4.1"])
@pytest.mark.parametrize("binary", [True, False])
def test_gmsh(tmp_path, version, binary):
    vertices, faces = octahedron()
    for kind, cells, name in (("triangle", faces, "faces"), ("tetra", SOLID.cells, "cells")):
        points = vertices if kind == "triangle" else np.asarray(SOLID.vertices)
        path = tmp_path / f"{kind}.msh"
        meshio.gmsh.write(path, meshio.Mesh(points, [(kind, cells)]), version, binary)
        mesh = read_mesh(path)
        np.testing.assert_array_equal(mesh.vertices, points)
        np.testing.assert_array_equal(getattr(mesh, name), cells)
    content = path.read_bytes()
    damages = [(b"$EndNodes", b"$EndNode"), (b"$MeshFormat\n" + version.encode(), b"$MeshFormat\n3.0")]
    if not binary:
        declared = b"$Nodes\n55" if version == "2.2" else b"$Nodes\n1 55"
        damages += [(declared, declared[:-2] + b"54"), (declared, declared[:-2] + b"99999999999")]
        elements = b"$Elements\n160" if version == "2.2" else b"$Elements\n1 160"
        damages += [(elements, elements[:-3] + b"159")]
        tag = b"\n55 " if version == "2.2" else b"\n55\n"
        damages += [(tag, tag.replace(b"55", b"99999999999"))]
    for old, new in damages:
        assert old in content
        path.write_bytes(content.replace(old, new, 1))
        with pytest.raises(ValueError, match=r"tetra\.msh: the file is damaged or not a mesh that meshio can read"):
            read_mesh(path)


def test_tetrahedra_with_the_cells_of_their_boundary(tmp_path):
    """As Gmsh writes them: the boundary's triangles, lines and points come before the tetrahedra."""
    points, cells = np.asarray(SOLID.vertices), SOLID.cells
    blocks = [("vertex", cells[:1, :1]), ("line", cells[:2, :2]), ("triangle", cells[:5, :3]), ("tetra", cells)]
    meshio.Mesh(points, blocks).write(tmp_path / "m.vtu")
    np.testing.assert_array_equal(read_mesh(tmp_path / "m.vtu").cells, cells)


def test_surfaces_of_neuroimaging(tmp_path):
    """Written by nibabel: GIFTI, also compressed, and FreeSurfer's."""
    nibabel = pytest.importorskip("nibabel")
    vertices, faces = octahedron()
    intents = ("NIFTI_INTENT_POINTSET", "NIFTI_INTENT_TRIANGLE")
    arrays = [
        nibabel.gifti.GiftiDataArray(values, intent)
        for values, intent in zip((vertices.astype(np.float32), faces.astype(np.int32)), intents, strict=True)
    ]
    for name in ("lh.surf.gii", "lh.surf.gii.gz"):
        nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), tmp_path / name)
    nibabel.freesurfer.write_geometry(tmp_path / "lh.white", vertices, faces)
    for name in ("lh.surf.gii", "lh.surf.gii.gz", "lh.white"):
        mesh = read_mesh(tmp_path / name)
        np.testing.assert_array_equal(mesh.vertices, vertices)
        np.testing.assert_array_equal(mesh.faces, faces)
        assert read_mesh_arrays(tmp_path / name) == {}
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[:-13])
        with pytest.raises(ValueError, match=f"{name}: the file is damaged or not a readable"):
            read_mesh(tmp_path / name)
    nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays[:1]), tmp_path / "p.gii")
    with pytest.raises(ValueError, match="got 1 and 0 arrays of points and of triangles; expected one of each"):
        read_mesh(tmp_path / "p.gii")
    (tmp_path / "lh.inflated").write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"kind of mesh is unknown; expected .*, or a FreeSurfer surface"):
        read_mesh(tmp_path / "lh.inflated")


def test_bad_meshes(tmp_path, capsys):
    vertices, faces = octahedron()
    meshio.Mesh(vertices, [("wedge", np.array([[0, 2, 4, 5, 1, 3]]))]).write(tmp_path / "w.vtu")
    with pytest.raises(ValueError, match="got wedge cells; expected triangles"):
        read_mesh(tmp_path / "w.vtu")
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
    with pytest.raises(ValueError, match="kind of mesh is unknown"):
        read_mesh(tmp_path / "m.gts")
    mesh = hj.SurfaceMesh(vertices, faces)
    with pytest.raises(ValueError, match=r"can be written as \.vtu, \.vtk, \.msh, \.ply, \.gii or \.npz"):
        save(tmp_path / "v.stl", np.zeros(6), mesh)
    with pytest.raises(ValueError, match=r"expected \(6,\), or \(n_times, \*shape\)"):
        save(tmp_path / "v.ply", np.zeros(7), mesh)
    assert capsys.readouterr().out == ""  # meshio's own reader prints, and ends the process


def test_a_series_has_a_file_for_each_time(tmp_path):
    sphere = hj.examples.sphere_mesh(2)
    values = np.arange(84.0).reshape(2, 42)
    path = save(tmp_path / "u.pvd", values, sphere, name="u", extra={"times": [0.25, 3]})
    text = path.read_text(encoding="utf-8")
    assert re.findall(r'timestep="([^"]*)".*?file="([^"]*)"', text) == [("0.25", "u.0.vtu"), ("3.0", "u.1.vtu")]
    for i in range(2):
        np.testing.assert_array_equal(read_mesh_arrays(tmp_path / f"u.{i}.vtu")["u"], values[i])
    assert (tmp_path / "u.pvd.json").is_file()
    for given in ({}, {"times": [1.0]}):
        with pytest.raises(ValueError, match=r"extra: got [01] times for values of shape \(2, 42\)"):
            save(tmp_path / "v.pvd", values, sphere, extra=given)


@pytest.mark.parametrize("suffix", ["ply", "vtk", "vtu", "msh"])
def test_a_mesh_with_a_mask_is_read_again_with_the_mask(tmp_path, suffix):
    sphere = hj.examples.sphere_mesh(3)
    vertices = np.array(sphere.vertices, np.float64)
    inside = vertices[:, 2] > -0.4
    vertices[np.argmin(vertices[:, 2])] = np.nan
    cap = hj.SurfaceMesh(vertices, sphere.faces, mask=inside)
    path = save(tmp_path / f"cap.{suffix}", np.arange(92.0), cap)
    read = read_mesh(path, mask=inside)
    np.testing.assert_allclose(read.vertices, vertices, rtol=1e-6)
    np.testing.assert_array_equal(read.faces, cap.faces)
    with pytest.raises(ValueError, match=r"^mask: got shape \(7,\)"):
        read_mesh(path, mask=inside[:7])
