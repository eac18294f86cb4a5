"""Valid files in unusual variants are read, or refused by a message that names the reason and a remedy."""

import base64
import gzip
import json

import numpy as np
import pytest

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import read_mask, read_tensors

nib = pytest.importorskip("nibabel")
AFFINE = np.diag([2.0, 2.0, 3.0, 1.0])
D = 1e-3 * np.array([[1.5, 0.2, 0.1], [0.2, 0.8, 0.0], [0.1, 0.0, 0.6]])


def nifti(path, shape=(5, 4, 3), affine=AFFINE):
    """Write tensors D as a symmetric-matrix image."""
    image = nib.Nifti1Image(np.broadcast_to(D[np.tril_indices(3)], (*shape, 1, 6)), affine)
    image.header.set_intent(1005, (3,))
    nib.save(image, path)
    return path


# ------------------------------------------------------------------------------------------------------ images


@pytest.mark.parametrize("kind", [nib.Nifti1Image, nib.Nifti2Image])
def test_compression_is_known_by_the_content_not_the_name(tmp_path, kind):
    path = nifti(tmp_path / "t.nii")
    nib.save(kind.from_image(nib.load(path)), path)
    plain = path.read_bytes()
    expected = read_tensors(path)
    path.write_bytes(gzip.compress(plain))
    np.testing.assert_array_equal(read_tensors(path).tensors, expected.tensors)
    (tmp_path / "t.nii.gz").write_bytes(plain)
    np.testing.assert_array_equal(read_tensors(tmp_path / "t.nii.gz").affine, expected.affine)


def test_a_voxel_size_of_zero_is_told(tmp_path):
    path = nifti(tmp_path / "t.nii")
    content = bytearray(path.read_bytes())
    content[254:256] = (0).to_bytes(2, "little")  # sform_code; the qform remains
    content[252:254] = (1).to_bytes(2, "little")
    path.write_bytes(content)
    assert read_tensors(path).spacing == (2, 2, 3)
    content[84:88] = bytes(4)  # pixdim[2]
    path.write_bytes(content)
    with pytest.warns(UserWarning, match="voxel size 0 along y and no sform; the size 1 is assumed. Correct"):
        assert read_tensors(path).spacing == (2, 1, 3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_shear_in_nrrd_is_told(tmp_path, dimension):
    nrrd = pytest.importorskip("nrrd")
    directions = np.eye(dimension)
    directions[1, :2] = np.sin(np.pi / 6), np.cos(np.pi / 6)
    count = dimension * (dimension + 1) // 2
    data = np.broadcast_to(np.eye(dimension)[np.triu_indices(dimension)], (*(4,) * dimension, count))
    header = {
        "space dimension": dimension,
        "space directions": [[np.nan] * dimension, *directions.tolist()],
        "kinds": [f"{dimension}D-symmetric-matrix", *["space"] * dimension],
        "measurement frame": np.eye(dimension),
    }
    nrrd.write(str(tmp_path / "t.nrrd"), np.moveaxis(data, -1, 0), header, index_order="F")
    notes = " ".join(read_tensors(tmp_path / "t.nrrd").notes)
    assert "the voxel axes are not orthogonal (two meet at 60°), and the shear is ignored" in notes


@pytest.mark.parametrize("high", [255, 1000, np.float32(1 / 255) * 254.99])
def test_masks_of_zero_and_another_number(tmp_path, high):
    mask = np.indices((5, 4, 3)).sum(axis=0) % 3 > 0
    values = np.where(mask, high, 0)
    nib.save(nib.Nifti1Image(values.astype(np.float32), AFFINE), tmp_path / "m.nii")
    np.save(tmp_path / "m.npy", values)
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(D, (5, 4, 3, 3, 3)), mask=values)
    for read in (read_mask, lambda path: read_tensors(path).mask):
        for name in ("m.nii", "m.npy") if read is read_mask else ("t.npz",):
            with pytest.warns(UserWarning, match=f"{name}.*the values are 0 and {high:g}; {high:g} is read as inside"):
                np.testing.assert_array_equal(read(tmp_path / name), mask)
    for wrong in (np.where(mask, 2 * high, high), -values, values / (2 * high), values + np.indices(mask.shape)[0]):
        np.save(tmp_path / "m.npy", wrong)
        with pytest.raises(ValueError, match=r"m\.npy: got dtype .* with values other than 0 and 1"):
            read_mask(tmp_path / "m.npy")


def test_tables_of_numbers_with_a_byte_order_mark(tmp_path):
    directions = np.concatenate([np.eye(3), (np.eye(3) + np.roll(np.eye(3), 1, axis=0)) / np.sqrt(2)])
    b = np.repeat([0.0, 1000.0], [1, 6])
    directions = np.concatenate([np.zeros((1, 3)), directions])
    signal = np.exp(-b * np.einsum("na,ab,nb->n", directions, D, directions))
    images = np.broadcast_to(1000 * signal, (4, 3, 2, 7))
    nib.save(nib.Nifti1Image(images, np.diag([-2.0, 2, 2, 1])), tmp_path / "d.nii")
    for name, table in (("bval", b[None]), ("bvec", directions.T)):
        np.savetxt(tmp_path / name, table, encoding="utf-8-sig")
        assert (tmp_path / name).read_bytes().startswith(b"\xef\xbb\xbf")
    volume = hj.io.fit_dwi(*(tmp_path / name for name in ("d.nii", "bval", "bvec")), np.ones((4, 3, 2), bool))
    np.testing.assert_allclose(volume.tensors[0, 0, 0], D, atol=1e-8)


@pytest.mark.slow
def test_voxels_without_an_element_are_counted(tmp_path, capsys):
    mask = np.zeros((7, 4, 3), bool)
    mask[:4], mask[6, 3, 2] = True, True
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(np.eye(3), (7, 4, 3, 3, 3)), mask=mask)
    assert main(["hks", str(tmp_path / "t.npz"), "-o", str(tmp_path / "out"), "-k", "4", "--times", "1"]) == 0
    note = "1 voxels of the mask are left out, because they belong to no element"
    assert note in capsys.readouterr().err
    about = json.loads((tmp_path / "out" / "report.json").read_text())["input"]
    assert about["voxels_inside"] == 48
    assert about["notes"][-1].startswith(note)
    with np.load(tmp_path / "out" / "hks.npz") as saved:
        np.testing.assert_array_equal(saved["mask"], np.isfinite(saved["hks"][0]))


# ---------------------------------------------------------------------------------------------------- surfaces


def test_two_point_sets_in_gifti_are_named(tmp_path):
    triangle = nib.gifti.GiftiDataArray(np.array([[0, 1, 2]], np.int32), "NIFTI_INTENT_TRIANGLE")
    points = [
        nib.gifti.GiftiDataArray(
            np.eye(3, dtype=np.float32), "NIFTI_INTENT_POINTSET", meta={"AnatomicalStructureSecondary": name}
        )
        for name in ("GrayWhite", "Pial")
    ]
    nib.save(nib.gifti.GiftiImage(darrays=[*points, triangle]), tmp_path / "s.surf.gii")
    with pytest.raises(ValueError, match=r"gii: got 2 sets of points \(GrayWhite, Pial\); expected one. Write each"):
        hj.io.read_mesh(tmp_path / "s.surf.gii")


def test_a_surface_that_leaves_the_volume_is_told_in_options(tmp_path, capsys):
    sphere = hj.examples.sphere_mesh(2)
    volume = nifti(tmp_path / "t.nii", affine=nib.affines.from_matvec(AFFINE[:3, :3], [5, 0, 0]))
    path = hj.io.save(tmp_path / "s.ply", np.zeros(len(sphere.vertices)), sphere)
    command = ["hks", str(path), "--tensors", str(volume), "-o", str(tmp_path / "out")]
    assert main([*command, "--metric", "inverse"]) == 2
    said = capsys.readouterr().err
    assert "Pass a larger --mask, or pass --inside with the vertices inside the mask" in said
    assert "in_space" not in said


# ------------------------------------------------------------------------------------------------------ meshes

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0], [2, 0, 0], [2, 1, 0]])


def ply(body, corners="vertex_indices", form="ascii", more=""):
    """A header of six vertices and three faces with one colour each, and a body."""
    return (
        f"ply\nformat {form} 1.0\ncomment a test\nelement vertex 6\nproperty float x\nproperty float y\n"
        f"property float z\nproperty float height\nelement face 3\nproperty list uchar int {corners}\n{more}"
        "property uchar region\nend_header\n"
    ).encode() + body


POINTS = "".join(f"{x} {y} {z} {10 * x}\n" for x, y, z in SQUARE).encode()
FACES = [[0, 1, 2, 3], [1, 4, 2], [4, 5, 2]]


@pytest.mark.parametrize("corners", ["vertex_indices", "vertex_index"])
@pytest.mark.parametrize("texture", [False, True])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("edges", [False, True])
def test_variants_of_ply(tmp_path, corners, texture, form, edges):
    regions, order = [7, 200, 9], ">" if "big" in form else "<"
    if form == "ascii":
        rows = [
            f"{len(face)} {' '.join(map(str, face))} {'4 0 0.5 1 0.5 ' * texture}{region}\n"
            for face, region in zip(FACES, regions, strict=True)
        ]
        body = POINTS + "".join(rows).encode() + b"0 1 5\n1 2 6\n" * edges
    else:
        body = np.column_stack([SQUARE, 10 * SQUARE[:, 0]]).astype(order + "f4").tobytes()
        for face, region in zip(FACES, regions, strict=True):
            body += bytes([len(face)]) + np.array(face, order + "i4").tobytes()
            body += (b"\4" + np.array([0, 0.5, 1, 0.5], order + "f4").tobytes()) * texture + bytes([region])
        body += (np.array([0, 1], order + "i4").tobytes() + b"\5") * edges + (b"\0" * 9) * edges
    content = ply(body, corners, form, "property list uchar float texcoord\n" * texture)
    of_edges = b"element edge 2\nproperty int vertex1\nproperty int vertex2\nproperty uchar kind\n" * edges
    path = tmp_path / "m.ply"
    path.write_bytes(content.replace(b"end_header", of_edges + b"end_header"))
    mesh = hj.io.read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [1, 4, 2], [4, 5, 2]])
    np.testing.assert_array_equal(hj.io.read_mesh_arrays(path)["height"], 10 * SQUARE[:, 0])
    np.testing.assert_array_equal(hj.io.read_mesh_arrays(path, at="faces")["region"], [7, 7, 200, 9])
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(ValueError, match=r"m\.ply: the file is damaged or not a readable PLY mesh"):
        hj.io.read_mesh(path)


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "msh"])
def test_tensors_at_cells(tmp_path, suffix, capsys):
    meshio = pytest.importorskip("meshio")
    ball = hj.examples.ball_mesh(2)
    x, cells = np.asarray(ball.vertices), ball.cells
    tensors = np.eye(3) * (2 + x[cells].mean(axis=1)[:, 0])[:, None, None]
    boundary = ("triangle", cells[:5, :3])  # as many codes write it beside the solid
    data = {"D": [np.zeros((5, 9)), tensors.reshape(-1, 9)]}
    path = tmp_path / f"m.{suffix}"
    mesh = meshio.Mesh(x, [boundary, ("tetra", cells)], cell_data=data)
    if suffix == "msh":
        meshio.gmsh.write(str(path), mesh, "2.2", binary=True)
    else:
        mesh.write(path)
    found = hj.io.read_mesh_arrays(path, at="cells")["D"].reshape(-1, 3, 3)
    np.testing.assert_array_equal(found, tensors)
    with pytest.raises(ValueError, match=r"at: got 'faces', but the places of arrays in .* are vertices, cells"):
        hj.io.read_mesh_arrays(path, at="faces")
    assert main(["info", str(path)]) == 0
    assert "D at the cells, components: 9; to use its tensors, pass --array" in capsys.readouterr().out
    command = ["hks", str(path), "-o", str(tmp_path / "out"), "-k", "5", "--times", "0.3", "--normalisation", "raw"]
    if suffix == "vtu":
        assert main(command) == 0
        assert "To use them, pass --array D" in capsys.readouterr().err
    assert main([*command, "--array", "D", "--metric", "inverse", "-q"]) == 0
    mesh = hj.TetMesh.from_tensors(x, cells, tensors, "inverse", at="cells")
    with np.load(tmp_path / "out" / "hks.npz") as result:
        np.testing.assert_allclose(result["hks"], hj.hks(hj.eigenpairs(mesh, 5), [0.3]), rtol=1e-6)


def gmsh_file(version, text, nodes, elements, sections):
    """Return a Gmsh file of nodes {tag: place}, elements [(type, tag, tags of nodes)] and arrays {tag: values}."""

    def put(kind, *numbers):  # "i": a tag or an integer, "u": a size, "d": a real number
        if text:
            return " ".join(map(str, numbers)).encode() + b"\n"
        return np.array(numbers, {"i": "<i4", "u": "<u8", "d": "<f8"}[kind]).tobytes()

    def line(*words):
        return (" ".join(map(str, words)) + "\n").encode()

    out = line("$MeshFormat") + line(version, int(not text), 8)
    out += b"" if text else np.array(1, "<i4").tobytes() + b"\n"
    out += line("$EndMeshFormat") + line("$Nodes")
    if version == "2.2":
        out += line(len(nodes))
        out += b"".join(put("i", tag).replace(b"\n", b" " * text) + put("d", *place) for tag, place in nodes.items())
        out += line("$EndNodes") + line("$Elements") + line(len(elements))
        for kind, tag, corners in elements:
            out += put("i", tag, kind, 2, 7, 7, *corners) if text else put("i", kind, 1, 2, tag, 7, 7, *corners)
    else:
        half = len(nodes) // 2  # two blocks
        blocks = [dict(list(nodes.items())[:half]), dict(list(nodes.items())[half:])]
        out += put("u", 2, len(nodes), min(nodes), max(nodes))
        for block in blocks:
            out += put("i", 2, 1, 0, len(block)) if text else put("i", 2, 1, 0) + put("u", len(block))
            out += b"".join(put("u", tag) for tag in block) + b"".join(put("d", *place) for place in block.values())
        tags = [tag for _, tag, _ in elements]
        out += line("$EndNodes") + line("$Elements") + put("u", len(elements), len(elements), min(tags), max(tags))
        for kind, tag, corners in elements:
            out += (put("i", 2, 1, kind, 1) if text else put("i", 2, 1, kind) + put("u", 1)) + put("u", tag, *corners)
    out += line("$EndElements")
    for kind, name, step, values in sections:
        size = len(next(iter(values.values())))
        out += line(f"${kind}") + line(1) + line(f'"{name}"') + line(1) + line(0.5) + line(3)
        out += line(step) + line(size) + line(len(values))
        out += b"".join(put("i", tag).replace(b"\n", b" " * text) + put("d", *row) for tag, row in values.items())
        out += line(f"$End{kind}")
    return out


@pytest.mark.parametrize("version", ["2.2", "4.1"])
@pytest.mark.parametrize("text", [True, False])
def test_arrays_of_gmsh_are_placed_by_tags(tmp_path, version, text):
    """Of lines, triangles and quadrilaterals; at all nodes and elements or at some, in another order, in steps."""
    pytest.importorskip("meshio")
    tags = [11, 3, 7, 1, 5, 2] if text or version == "4.1" else [1, 2, 3, 4, 5, 6]  # meshio reads no others there
    nodes = dict(zip(tags, SQUARE.tolist(), strict=True))
    elements = [(1, 30, tags[:2]), (3, 4, tags[:4]), (2, 9, [tags[i] for i in (1, 4, 2)])]
    elements += [(2, 8, [tags[i] for i in (4, 5, 2)])]
    tensors = {tag: (tag * np.eye(3)).ravel() for tag in (4, 8, 9, 30)}
    x = {tag: [nodes[tag][0]] for tag in sorted(nodes)}
    sections = [
        ("NodeData", "x", 0, x),
        ("NodeData", "x", 1, {tag: [10 + value[0]] for tag, value in x.items()}),
        ("ElementData", "D", 0, tensors),
        ("ElementData", "some", 0, {9: [0.9]}),
        ("ElementData", "some", 0, {4: [0.4]}),  # as of another partition
        ("ElementData", "of lines", 0, {30: [1.0]}),
    ]
    path = tmp_path / "m.msh"
    path.write_bytes(gmsh_file(version, text, nodes, elements, sections))
    mesh, at_nodes = hj.io.read_mesh(path), hj.io.read_mesh_arrays(path)
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [1, 4, 2], [4, 5, 2]])
    assert set(at_nodes) == {"x", "x, step 1"}
    np.testing.assert_array_equal(at_nodes["x"], SQUARE[:, 0])
    np.testing.assert_array_equal(at_nodes["x, step 1"], 10 + SQUARE[:, 0])
    at_faces = hj.io.read_mesh_arrays(path, at="faces")
    assert set(at_faces) == {"D", "some"}
    np.testing.assert_array_equal(at_faces["D"].reshape(-1, 3, 3), np.array([4, 4, 9, 8])[:, None, None] * np.eye(3))
    np.testing.assert_array_equal(at_faces["some"], [0.4, 0.4, 0.9, np.nan])
    whole = path.read_bytes()
    for end in (whole.rfind(b"$End"), whole.rfind(b"$ElementData") + 40):
        path.write_bytes(whole[:end])
        with pytest.raises(ValueError, match=r"the file has no complete section \$ElementData"):
            hj.io.read_mesh(path)
    others = [(5, 40, [*tags[:4], *tags[:4]])]
    path.write_bytes(gmsh_file(version, text, nodes, [*elements, *others], sections))
    with pytest.raises(ValueError, match=r"m\.msh: got hexahedron cells; expected triangles"):
        hj.io.read_mesh(path)
    stray = [("ElementData", "D", 0, {**tensors, 77: np.zeros(9)})]
    path.write_bytes(gmsh_file(version, text, nodes, elements, stray))
    with pytest.raises(ValueError, match=r"\$ElementData has a value at 77, which is not in the file"):
        hj.io.read_mesh(path)


def test_tensors_at_faces_follow_quadrilaterals_and_cleaning(tmp_path):
    meshio = pytest.importorskip("meshio")
    cells = [("quad", np.array([[0, 1, 2, 3]])), ("triangle", np.array([[1, 4, 2], [4, 4, 2], [4, 5, 2]]))]
    meshio.Mesh(SQUARE, cells, cell_data={"a": [[1.0], [2.0, 3.0, 4.0]]}).write(tmp_path / "m.vtu")
    arrays = hj.io.read_mesh_arrays(tmp_path / "m.vtu", at="faces", clean=True)
    np.testing.assert_array_equal(arrays["a"], [1, 1, 2, 4])


def test_tensors_at_the_cells_of_polygonal_data(tmp_path, capsys):
    """Beside points, lines and a strip, whose cells are numbered before and after the polygons."""
    pytest.importorskip("vtkmodules", reason='VTK is not installed: pip install "hks-jax[vtk]"')
    points = np.vstack([SQUARE, [[3, 0, 0], [3, 1, 0]]])
    lists = {"VERTICES": [[0], [1]], "LINES": [[0, 1]], "POLYGONS": [[0, 1, 2, 3], [1, 4, 5], [1, 5, 2]]}
    lists["TRIANGLE_STRIPS"] = [[4, 6, 5, 7]]
    text = "# vtk DataFile Version 3.0\ntest\nASCII\nDATASET POLYDATA\nPOINTS 8 double\n"
    text += "\n".join(" ".join(map(str, point)) for point in points) + "\n"
    for name, cells in lists.items():
        text += f"{name} {len(cells)} {sum(len(cell) + 1 for cell in cells)}\n"
        text += "".join(f"{len(cell)} {' '.join(map(str, cell))}\n" for cell in cells)
    text += "CELL_DATA 7\nFIELD a 1\nD 9 7 double\n"
    text += "\n".join(" ".join(map(str, (i + 1) * np.eye(3).ravel())) for i in range(7)) + "\n"
    (tmp_path / "m.vtk").write_text(text)
    found = hj.io.read_mesh_arrays(tmp_path / "m.vtk", at="faces")["D"].reshape(-1, 3, 3)
    np.testing.assert_array_equal(found, np.array([4, 4, 5, 6, 7, 7])[:, None, None] * np.eye(3))
    assert main(["info", str(tmp_path / "m.vtk")]) == 0
    assert "D at the faces, components: 9" in capsys.readouterr().out


def test_six_components_in_legacy_vtk(tmp_path):
    pytest.importorskip("meshio")
    six = np.arange(24.0).reshape(4, 6)
    heads = {
        "UNSTRUCTURED_GRID": "POINTS 4 double\n0 0 0 1 0 0 0 1 0 1 1 0\nCELLS 1 5\n4 0 1 3 2\nCELL_TYPES 1\n9\n",
        "STRUCTURED_GRID": "DIMENSIONS 2 2 1\nPOINTS 4 double\n0 0 0 1 0 0 0 1 0 1 1 0\n",
        "RECTILINEAR_GRID": "DIMENSIONS 2 2 1\nX_COORDINATES 2 double\n0 1\nY_COORDINATES 2 double\n0 1\n"
        "Z_COORDINATES 1 double\n0\n",
    }
    for kind, head in heads.items():
        path = tmp_path / f"{kind}.vtk"
        text = f"# vtk DataFile Version 3.0\ntest\nASCII\nDATASET {kind}\n{head}CELL_DATA 1\nTENSORS6 E float\n"
        text += "1 2 3 0 0 0.5\nPOINT_DATA 4\nSCALARS s float 1\nLOOKUP_TABLE default\n1 2 3 4\nNORMALS n float\n"
        text += "0 0 1 " * 4 + "\nTENSORS6 D double\n" + " ".join(map(str, six.ravel())) + "\n"
        path.write_text(text)
        assert len(hj.io.read_mesh(path).faces) == 2
        arrays = hj.io.read_mesh_arrays(path)
        np.testing.assert_array_equal(arrays["D"], six)
        np.testing.assert_array_equal(arrays["n"], [[0, 0, 1]] * 4)
        np.testing.assert_array_equal(hj.io.read_mesh_arrays(path, at="faces")["E"], [[1, 2, 3, 0, 0, 0.5]] * 2)
    path.write_text(text.replace("DIMENSIONS 2 2 1", "DIMENSIONS 2 3 1"))
    with pytest.raises(ValueError, match="the file is damaged"):
        hj.io.read_mesh(path)


@pytest.mark.parametrize("form", ["ascii", "base64", "raw"])
def test_vtu_of_several_pieces(tmp_path, form):
    pytest.importorskip("meshio")
    solids = [hj.examples.ball_mesh(n) for n in (1, 2)]
    parts, appended = [], b""

    def array(name, values, components=1):
        nonlocal appended
        kind = {"f": "Float64", "i": "Int64", "u": "UInt8"}[values.dtype.kind]
        head = f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{components}" '
        content = np.uint32(values.nbytes).tobytes() + values.tobytes()
        if form == "raw":
            head += f'format="appended" offset="{len(appended)}"/>'
            appended += content
            return head
        text = " ".join(map(repr, values.ravel().tolist()))
        text = text if form == "ascii" else base64.b64encode(content).decode()
        return f'{head} format="{"ascii" if form == "ascii" else "binary"}">\n{text}\n</DataArray>'

    for i, solid in enumerate(solids):
        x, cells = np.asarray(solid.vertices, np.float64) + 3.0 * i, np.asarray(solid.cells, np.int64)
        n = len(cells)
        parts.append(
            f'<Piece NumberOfPoints="{len(x)}" NumberOfCells="{n}"><PointData>{array("x", x[:, 0])}</PointData>'
            f"<CellData>{array('x', x[cells].mean(axis=1)[:, 0])}</CellData><Points>{array('p', x, 3)}</Points><Cells>"
            f"{array('connectivity', cells.ravel())}{array('offsets', 4 * np.arange(1, n + 1))}"
            f"{array('types', np.full(n, 10, np.uint8))}</Cells></Piece>"
        )
    content = (
        '<VTKFile type="UnstructuredGrid" version="2.2" byte_order="LittleEndian" header_type="UInt32">'
        f"<UnstructuredGrid>{''.join(parts)}</UnstructuredGrid>"
    ).encode()
    content += b'<AppendedData encoding="raw">_' + appended + b"\n</AppendedData>" if form == "raw" else b""
    path = tmp_path / "m.vtu"
    path.write_bytes(content + b"</VTKFile>")
    mesh = hj.io.read_mesh(path)
    x = np.asarray(mesh.vertices)
    np.testing.assert_array_equal(x, np.concatenate([np.asarray(s.vertices) + 3.0 * i for i, s in enumerate(solids)]))
    n = len(solids[0].vertices)
    np.testing.assert_array_equal(mesh.cells, np.concatenate([solids[0].cells, solids[1].cells + n]))
    np.testing.assert_allclose(hj.io.read_mesh_arrays(path)["x"].ravel(), x[:, 0])
    np.testing.assert_allclose(hj.io.read_mesh_arrays(path, at="cells")["x"].ravel(), x[mesh.cells].mean(axis=1)[:, 0])
    if form == "raw":
        path.write_bytes(content.replace(b"header_type", b'compressor="vtkLZ4DataCompressor" header_type'))
        with pytest.raises(ValueError, match=r"m\.vtu: the data are compressed by vtkLZ4.* with zlib compression"):
            hj.io.read_mesh(path)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("x y z|list uchar int tristrips", "vertex: x, y, z; face: list tristrips; expected"),
        ("x y|list uchar int vertex_indices", "vertex: x, y; face: list vertex_indices; expected"),
        ("x y z|int vertex_indices", "vertex: x, y, z; face: vertex_indices; expected"),
        ("x y z", "vertex: x, y, z; face: none; expected"),
    ],
)
def test_an_intact_ply_that_is_no_mesh_of_polygons_is_not_called_damaged(tmp_path, header, words):
    points, _, faces = header.partition("|")
    lines = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {name}" for name in points.split())]
    lines += ["element face 1", f"property {faces}"] if faces else []
    rows = ["0 " * len(points.split())] * 3
    path = tmp_path / "m.ply"
    path.write_text("\n".join([*lines, "end_header", *rows, *(["3 0 1 2"] if faces else [])]) + "\n")
    with pytest.raises(ValueError, match=words) as told:
        hj.io.read_mesh(path)
    assert "damaged" not in str(told.value)
