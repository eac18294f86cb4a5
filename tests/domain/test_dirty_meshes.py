"""Meshes as programs leave them: dialects of OBJ and OFF, doubled and thin triangles, cracks, and cleaning."""

import json
import warnings

import numpy as np
import pytest

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import read_mesh, read_mesh_arrays
from hks_jax.io.mesh_formats import fans

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
SIDES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
V = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in TETRAHEDRON)
F = "".join("f {} {} {}\n".format(*(1 + face)) for face in SIDES)
POINTS = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
FACES = "3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"


def written(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    return tmp_path / name


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("plain.obj", V + F),
        ("normals.obj", V + "vn 0 0 1\n" + F.replace("\n", "//1\n").replace(" 1 ", " 1//1 ")),
        ("textures.obj", "mtllib a.mtl\n" + V + "vt 0 0\nvt 1 1\nvn 0 0 1\ng one\nusemtl b\ns off\n" + F),
        ("negative.obj", V + "f -4 -2 -3\nf -4 -3 -1\nf -3 -2 -1\nf -4 -1 -2\n"),
        ("mixed.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -1 -2\nv 0 0 1\nf 1 2 4\nf 2 3 4\nf 1 4 3 # the last\n"),
        ("coloured.obj", V.replace("\n", " 0.5 0.5 1\n") + F),
        ("weighted.obj", V.replace("\n", " 1.0\n") + F),
        ("continued.obj", V + F.replace("f 1 3 2", "f 1 3 \\\n 2")),
        ("plain.off", f"OFF\n4 4 6\n{POINTS}{FACES}"),
        ("one-line.off", f"OFF 4 4 6\n{POINTS}{FACES}"),
        ("glued.off", f"OFF4 4 0\n{POINTS}{FACES}"),
        ("two-numbers.off", f"OFF\n# a remark\n\n4 4\n{POINTS}\n{FACES}"),
        ("coff.off", "COFF\n4 4 6\n" + POINTS.replace("\n", " 255 0 0 255\n") + FACES),
        ("noff.off", "NOFF\n4 4 6\n" + POINTS.replace("\n", " 0 0 1\n") + FACES),
        ("stoff.off", "STOFF\n4 4 6\n" + POINTS.replace("\n", " 0.5 0.5\n") + FACES),
        ("face-colours.off", f"OFF\n4 4 6\n{POINTS}" + FACES.replace("\n", " 0.5 0.5 0 1\n")),
        ("some-colours.off", f"OFF\n4 4 6\n{POINTS}" + FACES.replace("3 0 1 3", "3 0 1 3 255 0 0")),
    ],
)
def test_what_other_programs_write(tmp_path, name, text):
    mesh = read_mesh(written(tmp_path, name, text))
    np.testing.assert_array_equal(mesh.vertices, TETRAHEDRON)
    np.testing.assert_array_equal(mesh.faces, SIDES)
    assert read_mesh_arrays(tmp_path / name) == {}


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("m.obj", V + F + "f 1 2 5\n", "vertex 4; expected 0 … 3"),
        ("m.obj", V + F + "f 0 1 2\n", "line 9: got the face 0 1 2"),
        ("m.obj", "f -1 -2 -3\n" + V + F, "vertex -3; expected 0 … 3"),
        ("m.obj", V + "v 1 2\n" + F, "line 5: got 2 coordinates for a vertex"),
        ("m.obj", V, "has no triangles"),
        ("m.off", f"OFF\n4 4 6\n{POINTS}{FACES[:-8]}", "declares 4 vertices and 4 faces, but has 7 lines"),
        ("m.off", f"OFF\n4 4 6\n{POINTS}{FACES}".replace("3 0 3 2", "3 0 3"), "got the face 3 0 3"),
        (
            "m.off",
            f"OFF\n4 4 6\n{POINTS}{FACES}".replace("0 0 1\n", "0 0\n"),
            r"\[2, 3\] columns; expected equal numbers",
        ),
        ("m.off", f"4OFF\n4 4 6\n{POINTS}{FACES}", "does not begin with OFF"),
        ("m.off", "", "does not begin with OFF"),
    ],
)
def test_damaged_texts(tmp_path, name, text, words):
    with pytest.raises(ValueError, match=words):
        read_mesh(written(tmp_path, name, text))


def test_polygons_are_cut_where_they_are_not_convex(tmp_path):
    """An arrowhead has one diagonal inside; a star with five points has no corner that sees all others."""
    points = np.array([[0.0, 0, 0], [2, 1, 0], [0, 2, 0], [1, 1, 0]])
    arrow = np.array([[0, 1, 2, 3], [1, 2, 3, 0]])
    for cut in fans(points, arrow):
        a, b, c = np.moveaxis(points[cut], 1, 0)
        areas = np.cross(b - a, c - a)[:, 2] / 2
        assert (areas > 0).all()
        assert areas.sum() == 1.0
    angle = np.arange(10) * np.pi / 5
    star = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * np.where(np.arange(10) % 2, 0.3, 1)[:, None]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in star) + "f " + " ".join(map(str, range(1, 11))) + "\n"
    with pytest.raises(ValueError, match="face 0 with 10 corners is not star-shaped"):
        read_mesh(written(tmp_path, "star.obj", text))
    pentagon = "".join(f"{x} {y} {z}\n" for x, y, z in star[::2])
    mesh = read_mesh(written(tmp_path, "p.off", f"OFF\n5 1 0\n{pentagon}5 0 1 2 3 4\n"))
    assert float(hj.assemble(mesh).volume) == pytest.approx(2.5 * np.sin(2 * np.pi / 5))


# ---------------------------------------------------------------------------------------------- what is refused


def square(n=4):
    """The unit square of 2n² triangles."""
    x = np.linspace(0, 1, n + 1)
    vertices = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((n + 1, n + 1))], axis=-1).reshape(-1, 3)
    node = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (part.ravel() for part in (node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]))
    return vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def save_off(path, vertices, faces):
    rows = [" ".join(map(repr, row.tolist())) for row in vertices]
    rows += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    path.write_text("\n".join([f"OFF\n{len(vertices)} {len(faces)} 0", *rows]) + "\n")
    return path


def eigenvalues(mesh, k=6):
    return np.asarray(hj.eigenpairs(mesh, k).eigenvalues)


def test_triangles_that_are_there_twice(tmp_path):
    vertices, faces = square()
    for again in (faces[5], faces[5][[1, 2, 0]], faces[5][::-1]):
        with pytest.raises(ValueError, match=r"1 of 33 triangles occur twice \(the first are faces 5 and 32"):
            hj.SurfaceMesh(vertices, np.concatenate([faces, [again]]))
    path = save_off(tmp_path / "m.off", vertices, np.concatenate([faces, faces[:7]]))
    with pytest.raises(ValueError, match=r"7 of 39 triangles occur twice .* clean=True repairs"):
        read_mesh(path)
    with pytest.warns(UserWarning, match=r"m\.off: 7 duplicate triangles removed$"):
        mesh = read_mesh(path, clean=True)
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_allclose(eigenvalues(mesh), eigenvalues(hj.SurfaceMesh(vertices, faces)), atol=1e-12)


def test_three_triangles_at_an_edge_are_a_branch():
    vertices, faces = square()
    fin = np.concatenate([vertices, [[0.5, 0.5, 1.0]]])
    with pytest.warns(hj.AccuracyWarning, match=r"1 edges belong to three triangles or more .* vertices \[12, 13\]"):
        hj.SurfaceMesh(fin, np.concatenate([faces, [[12, 13, 25]]]))


def test_an_edge_that_passes_through_a_vertex_is_a_crack():
    """On one side of the diagonal of a square there is a vertex in the middle, on the other none."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]])
    halves = np.array([[0, 1, 2], [0, 4, 3], [4, 2, 3]])
    with pytest.warns(
        hj.AccuracyWarning, match=r"1 vertices lie on edges .* vertex 4, on the edge of the vertices \[2, 0\]"
    ):
        hj.SurfaceMesh(vertices, halves)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hj.SurfaceMesh(vertices, np.array([[0, 1, 4], [1, 2, 4], [0, 4, 3], [4, 2, 3]]))
        hj.SurfaceMesh(*square(12))


def with_cap(height):
    """A square one of whose triangles is split at a vertex so near its longest edge that a triangle is all but flat."""
    vertices, faces = square()
    a, b, c = faces[6]
    middle = (vertices[a] + vertices[c]) / 2
    vertices = np.concatenate([vertices, [middle + height * np.sqrt(2) * (vertices[b] - middle)]])
    return vertices, np.concatenate([np.delete(faces, 6, axis=0), [[a, 25, c], [a, b, 25], [b, c, 25]]])


@pytest.mark.parametrize("height", [3e-10, 0.0])
def test_a_thin_triangle_is_named_and_its_edge_flipped_if_asked(height, tmp_path):
    vertices, faces = with_cap(height)
    what = "so thin that their metric is lost to rounding in float64" if height else "have no area"
    with pytest.raises(ValueError, match=rf"1 of 34 triangles (are )?{what} \(the first is face 31"):
        hj.SurfaceMesh(vertices, faces)
    with pytest.warns(UserWarning, match="1 edges through a vertex flipped$"):
        mesh = read_mesh(save_off(tmp_path / "m.off", vertices, faces), clean=True)
    assert len(mesh.faces) == 34  # there is no crack
    assert len(mesh.triangulation.boundary_facets) == 16
    assert float(hj.assemble(mesh).volume) == pytest.approx(1)
    exact = eigenvalues(hj.SurfaceMesh(*square()))
    np.testing.assert_allclose(eigenvalues(mesh)[1:], exact[1:], rtol=0.05)
    assert (eigenvalues(mesh) < exact + 1e-9).all()  # a vertex more: never larger


def test_what_float32_does_not_resolve_is_fine_in_float64():
    vertices, faces = with_cap(1e-5)
    assert np.isfinite(eigenvalues(hj.SurfaceMesh(vertices, faces))).all()
    with pytest.raises(ValueError, match=r"so thin that their metric is lost to .* float32 .*, or use float64"):
        hj.SurfaceMesh(vertices.astype(np.float32), faces)


@pytest.mark.parametrize(
    ("mesh", "least", "largest"),
    [(hj.examples.ball_mesh(2), 1e-4, 1e6), (hj.examples.sphere_mesh(3), 1e-7, 1e8)],
)
def test_a_unit_of_length_beyond_float32_is_refused_and_every_other_one_is_as_good(mesh, least, largest):
    def scaled(unit):
        vertices = (unit * np.asarray(mesh.vertices)).astype(np.float32)
        return type(mesh)(vertices, mesh.triangulation.cells)

    expected = eigenvalues(mesh, 4)
    for unit in (least, largest):
        np.testing.assert_allclose(eigenvalues(scaled(unit), 4) * unit**2, expected, atol=1e-5 * expected.max())
    for unit in (least**2, largest**2):
        with pytest.raises(ValueError, match=r"beyond the accurate range of float32 .* near 1, or use float64"):
            scaled(unit)


# ---------------------------------------------------------------------------------------------- what is torn


@pytest.mark.parametrize("apart", [0.0, 1e-9])
def test_a_soup_of_triangles_is_refused_or_joined(apart, tmp_path, rng):
    vertices, faces = square(10)
    soup = vertices[faces].reshape(-1, 3)
    soup = soup + apart * rng.uniform(-0.5, 0.5, soup.shape)
    path = save_off(tmp_path / "soup.off", soup, np.arange(600).reshape(-1, 3))
    with pytest.raises(ValueError, match=r"479 of 600 .* has 200 pieces that touch; expected 1, .* clean=True"):
        read_mesh(path)
    with pytest.warns(UserWarning, match="479 vertices merged with a coincident vertex"):
        mesh = read_mesh(path, clean=True)
    assert len(mesh.vertices) == 121
    np.testing.assert_allclose(eigenvalues(mesh), eigenvalues(hj.SurfaceMesh(vertices, faces)), atol=1e-6)


def test_a_seam_is_said(tmp_path):
    """A tube whose two sides are not joined: one piece, and yet torn."""
    n = 12
    angle = np.linspace(0, 2 * np.pi, n + 1)
    rings = [np.stack([np.cos(angle), np.sin(angle), np.full(n + 1, z)], axis=1) for z in (0.0, 0.5, 1.0)]
    vertices = np.round(np.concatenate(rings), 12)
    node = np.arange(3 * (n + 1)).reshape(3, n + 1)
    a, b, c, d = (part.ravel() for part in (node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    path = save_off(tmp_path / "tube.off", vertices, faces)
    with pytest.warns(hj.AccuracyWarning, match=r"3 of 39 vertices coincide with another vertex\. The mesh is torn"):
        torn = read_mesh(path)
    with pytest.warns(UserWarning, match="3 vertices merged"):
        tube = read_mesh(path, clean=True)
    assert (len(torn.vertices), len(tube.vertices)) == (39, 36)
    assert eigenvalues(torn, 3)[1] < 0.5 * eigenvalues(tube, 3)[1]  # half a circle's, and a circle's


def test_cleaning_says_all_that_it_did_on_the_command_line(tmp_path, capsys):
    vertices, faces = square(6)
    dirty = np.concatenate([vertices, [[np.nan, 0, 0], [9.0, 9, 9], vertices[3]]])
    more = [[0, 1, 49], faces[4], [7, 7, 8], [3, 51, 10]]
    path = save_off(tmp_path / "m.off", dirty, np.concatenate([faces, more]))
    assert main(["info", str(path)]) == 2
    said = capsys.readouterr().err
    assert "vertices: 1 of 52 belong to no face (the first is vertex 50); remove them" in said
    assert "--clean repairs some defects" in said
    assert main(["info", str(path), "--clean", "--json"]) == 0
    captured = capsys.readouterr()
    assert captured.err.strip() == (
        f"warning: {path}: 1 vertices with NaN or infinite coordinates removed; 1 triangles at such vertices removed; "
        "1 vertices merged with a coincident vertex; 2 triangles without area removed; 1 duplicate triangles removed; "
        "1 vertices without a face removed"
    )
    assert json.loads(captured.out)["vertices"] == 49
    options = ["-k", "6", "--times", "0.1", "-q"]
    assert main(["hks", str(path), "-o", str(tmp_path / "out"), "--clean", *options]) == 0
    assert "1 vertices merged" in json.loads((tmp_path / "out" / "report.json").read_text())["warnings"][0]
    with np.load(tmp_path / "out" / "hks.npz") as read:
        mesh = hj.SurfaceMesh(vertices, faces)
        np.testing.assert_allclose(read["hks"], hj.hks(hj.eigenpairs(mesh, 6), [0.1], "flat"), rtol=1e-9)
    capsys.readouterr()
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(np.eye(2), (5, 5, 2, 2)))
    assert main(["hks", str(tmp_path / "t.npz"), "-o", str(tmp_path / "o"), "--clean"]) == 2
    assert "--clean: this option is for meshes" in capsys.readouterr().err


# ---------------------------------------------------------------------------------------------- what only touches


def two_spheres(n):
    """Two unit spheres that share the vertex of the largest z of the first; also the number of this vertex."""
    sphere = hj.examples.sphere_mesh(n)
    vertices = np.asarray(sphere.vertices, np.float64)
    top = int(np.argmax(vertices[:, 2]))
    turned = 2 * vertices[top] - vertices  # reflected in the vertex
    numbers = len(vertices) + np.arange(len(vertices)) - (np.arange(len(vertices)) > top)
    numbers[top] = top
    return (
        np.concatenate([vertices, np.delete(turned, top, axis=0)]),
        np.concatenate([sphere.faces, numbers[sphere.faces]]),
        top,
    )


def test_parts_that_touch_only_at_a_vertex_are_named():
    vertices, faces, top = two_spheres(3)
    with pytest.warns(
        hj.AccuracyWarning, match=rf"faces: at 1 vertices, parts .* sharing an edge .* vertex {top}, with"
    ):
        hj.SurfaceMesh(vertices, faces)
    pair = np.concatenate([TETRAHEDRON, -TETRAHEDRON[1:]])  # two tetrahedra share a vertex, and then an edge
    with pytest.warns(hj.AccuracyWarning, match="cells: at 1 vertices, parts .* sharing a triangle .* vertex 0, with"):
        hj.TetMesh(pair, [[0, 1, 2, 3], [0, 5, 4, 6]])
    pair = np.concatenate([TETRAHEDRON, [[0.0, -1, 0], [0, 0, -1]]])
    with pytest.warns(hj.AccuracyWarning, match="cells: at 2 vertices"):
        hj.TetMesh(pair, [[0, 1, 2, 3], [0, 1, 4, 5]])


def test_sound_meshes_with_and_without_boundary_have_no_such_vertices():
    vertices, faces = square(8)
    i, j = np.divmod(np.tile(np.arange(64), 2), 8)
    keep = (np.abs(i - 3.5) > 2) | (np.abs(j - 3.5) > 2)  # a square with a square hole
    numbers, holed = np.unique(faces[keep], return_inverse=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for mesh in (
            hj.SurfaceMesh(vertices[numbers], holed.reshape(-1, 3)),
            hj.examples.sphere_mesh(4),
            hj.examples.bumpy_torus_mesh(12),
            hj.examples.ball_mesh(3),
            hj.SurfaceMesh(vertices, faces, mask=keep),
        ):
            assert not mesh.triangulation.pinched_vertices.size


def test_cleaning_is_no_remedy_for_parts_that_touch_at_a_point(tmp_path):
    vertices, faces, top = two_spheres(3)
    half = len(faces) // 2
    apart = np.concatenate([vertices, vertices[top : top + 1]])
    separate = np.concatenate([faces[:half], np.where(faces[half:] == top, len(vertices), faces[half:])])
    path = save_off(tmp_path / "m.off", apart, separate)
    with pytest.raises(ValueError, match=r"2 pieces that touch; expected 1, .* would leave 1 at which") as told:
        read_mesh(path)
    assert "clean=True" not in str(told.value)
    with (
        pytest.warns(UserWarning, match="1 vertices merged"),
        pytest.warns(hj.AccuracyWarning, match="parts of the mesh touch"),
    ):
        read_mesh(path, clean=True)
