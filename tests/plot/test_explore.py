"""The page to explore: its numbers against NumPy's, and its use in a browser."""

import base64
import csv
import json
import re
import time
import zlib
from dataclasses import replace
from importlib.resources import files

import matplotlib
import nibabel as nib
import numpy as np
import pytest
from annotations import unchecked
from browser import Browser, find_browser

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import Result, TensorVolume, save
from hks_jax.plot import explore
from hks_jax.plot.explore import page as page_module

SHAPE, TIMES = (24, 18), np.geomspace(0.01, 1, 7)
EXACT = 2e-5  # the page rounds numbers to 24 bits
EVIL = '</script><script>console.error("escaped")</script> <b>&amp; @@SCRIPT@@'
needs_browser = pytest.mark.skipif(
    find_browser() is None, reason="no Chromium: apt install chromium, or let the variable CHROMIUM name one"
)


def signature(shape=SHAPE):
    """Smooth and positive, different at every node, with 4πt·HKS around 1; NaN outside an ellipse."""
    x = [np.linspace(-1, 1, n) for n in shape]
    x = np.stack(np.meshgrid(*x, indexing="ij"))
    bump = np.exp(-2 * np.sum((x - 0.2) ** 2, axis=0))
    flat = np.stack([1 + t * (1 + np.sqrt(t)) * bump + 0.1 * np.sin(x[0] + 2 * x[1]) for t in TIMES])
    flat[:, np.sum(x**2, axis=0) > 1.1] = np.nan
    return flat / (4 * np.pi * TIMES.reshape(-1, *[1] * len(shape))) ** (len(shape) / 2)


def tensors(shape=SHAPE):
    rng = np.random.default_rng(5)
    a = rng.standard_normal((*shape, len(shape), len(shape)))
    return a @ a.swapaxes(-1, -2) + 0.1 * np.eye(len(shape))


def of(values, grid=None, tensors=None, **arrays):
    """Return a result on a grid, from a file without tensors unless they are given."""
    grid = hj.Grid(values.shape[1:]) if grid is None else grid
    known = (
        np.broadcast_to(np.eye(grid.dimension), (*grid.shape, *[grid.dimension] * 2)) if tensors is None else tensors
    )
    place = TensorVolume(known, grid.spacing, grid.origin, grid.mask)
    return Result(place, values, TIMES, arrays=arrays, source="a file" if tensors is None else "")


def block(text, name, dtype):
    """Return the numbers of a block; those of 24 bits as they are in single precision."""
    (found,) = re.findall(rf'id="{name}">([^<]*)<', text)
    found = zlib.decompress(base64.b64decode(found))
    if dtype != "<f4":
        return np.frombuffer(found, dtype)
    planes = np.frombuffer(found, np.uint8).reshape(3, -1).astype(np.uint32)
    return (np.cumsum(planes[0] + (planes[1] << 8) + (planes[2] << 16), dtype=np.uint32) << 8).view("<f4")


# ---------------------------------------------------------------------------------------------------- the file


def test_the_page_holds_the_numbers_and_asks_for_nothing(tmp_path):
    grid, values = hj.Grid(SHAPE, (0.5, 0.25), (1.0, 2.0)), signature()
    path = explore(of(values, grid, tensors()), tmp_path / "deep" / "page.html", title=EVIL)
    text = path.read_text(encoding="utf-8")
    inside = np.isfinite(values[0])
    low, high = [a.min() for a in np.nonzero(inside)], [a.max() + 1 for a in np.nonzero(inside)]
    about = json.loads(re.search(r'id="about">([^<]*)<', text)[1])
    assert (about["title"], about["offset"], about["times"]) == (EVIL, low, TIMES.tolist())
    box = inside[low[0] : high[0], low[1] : high[1]]
    np.testing.assert_array_equal(block(text, "inside", np.uint8).reshape(about["shape"]), box)
    shown = block(text, "values", "<f4").reshape(TIMES.size, -1)
    np.testing.assert_allclose(shown, 4 * np.pi * TIMES[:, None] * values[:, inside], rtol=EXACT)
    field = hj.TensorField(hj.Grid(SHAPE, mask=inside), tensors())
    known = hj.tensor_invariants(field)
    np.testing.assert_allclose(block(text, "layer-0", "<f4"), known["trace"][inside] / 2, rtol=EXACT)
    np.testing.assert_allclose(block(text, "layer-1", "<f4"), known["anisotropy"][inside], rtol=2 * EXACT)
    # The direction is an eigenvector, as long as the anisotropy.
    v = block(text, "layer-2", "<f4").reshape(-1, 3).astype(float)[:, :2]
    largest = np.linalg.eigvalsh(tensors()[inside])[:, 1:]
    np.testing.assert_allclose((tensors()[inside] @ v[..., None])[..., 0], largest * v, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), known["anisotropy"][inside], rtol=2 * EXACT)
    assert set(re.findall(r"https?://[^\s\"'`]+", text)) == {"http://www.w3.org/2000/svg"}  # a name, not an address
    assert not re.search(r"<(link|img|script)[^>]*(src|href)=(?!\"data:,\")", text)


def test_three_dimensions_have_fractional_anisotropy_and_powers_of_three_halves(tmp_path):
    shape = (6, 5, 4)
    values = signature(shape)
    text = explore(of(values, tensors=tensors(shape)), tmp_path / "page.html").read_text()
    inside = np.isfinite(values[0])
    shown = block(text, "values", "<f4").reshape(TIMES.size, -1)
    np.testing.assert_allclose(shown, (4 * np.pi * TIMES[:, None]) ** 1.5 * values[:, inside], rtol=EXACT)
    known = hj.tensor_invariants(hj.TensorField(hj.Grid(shape), tensors(shape)))["anisotropy"]
    np.testing.assert_allclose(block(text, "layer-1", "<f4"), known[inside], rtol=2 * EXACT)


@pytest.mark.parametrize(
    ("changed", "more", "words"),
    [
        ({"times": TIMES[::-1]}, {}, "times: got"),
        ({"values": signature()[1:]}, {}, r"values: got shape \(6, 24, 18\)"),
        ({"values": np.full((7, *SHAPE), np.nan)}, {}, "finite values at all times"),
        ({"arrays": {"deviation": np.ones(2)}}, {}, r"deviation: got shape \(2,\)"),
        (
            {"place": of(signature(), tensors=np.full((*SHAPE, 2, 2), np.nan)).place, "source": ""},
            {},
            "tensors: got NaN",
        ),
        ({}, {"maps": {"age": np.ones(3)}}, r"maps\['age'\]: got shape \(3,\)"),
        ({}, {"labels": np.ones(SHAPE) / 2}, "labels: got fractional numbers"),
        ({}, {"labels": np.zeros(SHAPE)}, "labels: got 0 at all nodes"),
        ({}, {"labels": np.zeros((3, 3))}, "labels: got shape"),
    ],
)
def test_what_cannot_be_shown_is_refused(changed, more, words, tmp_path):
    with unchecked(), pytest.raises(ValueError, match=words):
        explore(replace(of(signature()), **changed), tmp_path / "page.html", **more)
    assert not list(tmp_path.iterdir())


def test_too_many_numbers_are_refused_before_they_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(page_module, "LIMIT", 1000)
    with pytest.raises(ValueError, match=r"7 times at \d+ nodes take .* MiB; expected at most"):
        explore(of(signature()), tmp_path / "page.html")


def test_all_arrays_at_nodes_are_turned_with_the_volume(tmp_path):
    """A volume stored left to right shows the numbers of the same volume stored right to left."""
    shape, rng = (5, 4, 3), np.random.default_rng(2)
    values, deviation, z, influence = rng.random((4, TIMES.size, *shape))
    density, pages = rng.random(shape) + 0.5, []
    for step, affine in ((1, np.eye(4)), (-1, np.diag([-1.0, 1, 1, 1]))):
        affine[0, 3] = 0 if step == 1 else shape[0] - 1
        turned = {
            name: array[..., ::step, :, :]
            for name, array in {"deviation": deviation, "z": z, "influence": influence, "density": density}.items()
        }
        place = TensorVolume(tensors(shape)[::step], (1.0,) * 3, (0.0,) * 3, affine=affine)
        settings = {"operator": "fick", "metric": "inverse", "normalisation": "raw"}
        result = Result(place, values[:, ::step], TIMES, arrays=turned, report={"settings": settings})
        pages.append(explore(result, tmp_path / "page.html").read_text(encoding="utf-8"))
    for name, dtype in {"values": "<f4", "deviation": "<f4", "z": "<f4", "density": "<f4", "near": np.uint8}.items():
        ours, theirs = (block(page, name, dtype) for page in pages)
        assert len(set(ours)) > 1
        np.testing.assert_array_equal(ours, theirs)
    # The means and distances of the page are those of the HKS, which the page multiplies by √|D| for one quantity.
    plain = block(pages[0], "values", "<f4").reshape(TIMES.size, -1) / values.reshape(TIMES.size, -1)
    np.testing.assert_allclose(plain, (4 * np.pi * TIMES[:, None]) ** 1.5 + 0 * plain, rtol=2 * EXACT)
    np.testing.assert_allclose(block(pages[0], "density", "<f4"), density.ravel(), rtol=2 * EXACT)


def test_every_script_beside_the_code_is_used():
    own = files("hks_jax.plot.explore")
    assert {f"{name}.js" for name in page_module.SCRIPTS} == {p.name for p in own.iterdir() if p.name.endswith(".js")}


# ---------------------------------------------------------------------------------------------------- the command


@pytest.fixture
def result(tmp_path):
    """A slice z = 2 of a volume whose affine turns and flips, as `hks-jax hks` leaves it."""
    affine = np.array([[0, -2.0, 0, 5], [2.0, 0, 0, -3], [0, 0, -3.0, 1], [0, 0, 0, 1]])
    whole = TensorVolume(
        np.broadcast_to(np.eye(3), (*SHAPE, 5, 3, 3)).copy(), (2.0, 2.0, 3.0), (0.0,) * 3, affine=affine
    )
    extra = {"times": TIMES, "eigenvalues": np.arange(9.0), "input_tensors": tensors().astype(np.float32)}
    settings = {"settings": {"normalisation": "raw", "metric": "inverse", "boundary": "neumann"}}
    cut = whole.slice("z", 2)
    (tmp_path / "out").mkdir()
    save(tmp_path / "out" / "hks.npz", signature(), cut, name="hks", extra=extra, provenance=settings)
    labels = np.zeros((*SHAPE, 5), np.int16)
    labels[:12, :, 2], labels[..., 1] = 17, 4
    nib.save(nib.Nifti1Image(labels, affine), tmp_path / "labels.nii.gz")
    (tmp_path / "names.tsv").write_text("# number name\n17\tleft half\n4 below\n")
    return tmp_path / "out"


def test_the_command_reads_a_result_with_labels_in_space(result, capsys):
    labels, names = result.parent / "labels.nii.gz", result.parent / "names.tsv"
    assert main(["explore", str(result), "-q", "--json", "--labels", str(labels), "--names", str(names)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["files"] == [str(result / "explore.html")]
    text = (result / "explore.html").read_text(encoding="utf-8")
    about = json.loads(re.search(r'id="about">([^<]*)<', text)[1])
    assert about["labels"] == [[17, "left half"]]
    assert about["ends"] == ["LR", "PA"]  # the volume's second axis runs to the left, its first to the front
    assert about["axes"] == {"shown": [1, 0], "first": [0, 17], "step": [1, -1]}
    medians = np.median(np.trace(tensors()[np.isfinite(signature()[0])], axis1=-2, axis2=-1)) / 2
    np.testing.assert_allclose(about["lengths"], np.sqrt(medians * TIMES), rtol=2 * EXACT)
    assert about["world"] == [[0, -2, 5], [2, 0, -3], [0, 0, -5]]
    assert dict(about["facts"]) == {
        "grid": "24 × 18", "slice": "z = 2", "metric": "D⁻¹", "boundary": "neumann", "eigenpairs": "9",
        "D in √(Dt)": f"{medians:.3g}, the median of the mean eigenvalues of the tensors in the domain",
    }  # fmt: skip
    inside = np.isfinite(signature()[0])
    expected = np.broadcast_to(17 * (np.arange(24) < 12)[:, None], SHAPE)
    np.testing.assert_array_equal(block(text, "labels", "<i4"), expected.T[::-1][inside.T[::-1]])


def test_the_command_refuses_what_does_not_fit(result, tmp_path, capsys):
    def error(*arguments):
        assert main(["explore", *map(str, arguments), "-q"]) == 2
        return capsys.readouterr().err

    moved = nib.load(tmp_path / "labels.nii.gz")
    nib.save(nib.Nifti1Image(np.asarray(moved.dataobj), moved.affine + 0.9 * np.eye(4, k=3)), tmp_path / "moved.nii.gz")
    assert "labels and the image on different voxels" in error(result, "--labels", tmp_path / "moved.nii.gz")
    np.save(tmp_path / "labels.npy", np.zeros((3, 3)))
    assert "got labels of shape (3, 3)" in error(result, "--labels", tmp_path / "labels.npy")
    np.save(tmp_path / "labels.npy", np.full(SHAPE, 0.5))
    assert "got fractional numbers" in error(result, "--labels", tmp_path / "labels.npy")
    assert "pass --labels too" in error(result, "--names", tmp_path / "names.tsv")
    assert "ends in .html" in error(result, "-o", tmp_path / "page.png")
    assert "no such file" in error(tmp_path / "nowhere")
    np.savez(
        tmp_path / "mesh.npz", hks=np.ones((1, 4)), times=[1.0], vertices=np.eye(4, 3), cells=np.array([[1, 0, 2, 3]])
    )
    assert "got a result on tetrahedra" in error(tmp_path / "mesh.npz")
    assert not (result / "explore.html").exists()


# ---------------------------------------------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture
def plane(browser, tmp_path):
    """The page of the plane, whose cells are 20 pixels wide, and what the browser says of it."""
    browser.problems.clear()
    browser.requests.clear()
    browser.resize(1200, 900)
    labels = np.where(np.arange(SHAPE[0])[:, None] < 8, 3, 0) + np.zeros(SHAPE)
    path = explore(of(signature(), tensors=tensors()), tmp_path / "page.html", labels=labels, title=EVIL)
    browser.open(path)
    yield browser
    assert browser.problems == []
    assert browser.requests == [path.as_uri()]


def at(node, shape=SHAPE):
    """Return where a node of the plane is in its image, as fractions of the image's width and height."""
    inside = np.isfinite(signature(shape)[0])
    low, high = ([f(along) for along in np.nonzero(inside)] for f in (np.min, np.max))
    size = np.array(high) - low + 1
    assert size[1] <= 1.35 * size[0]  # it fills the image's width
    return (node[0] - low[0] + 0.5) / size[0], 1 - (node[1] - low[1] + 0.5) / size[1]


def pixel_of(browser, node):
    """Return red, green and blue of a node in the image of the signature."""
    across, down = at(node)
    return browser.run(
        f"(() => {{ const c = document.querySelector('#signature'); return [...c.getContext('2d').getImageData("
        f"{across} * c.width, {down} * c.height, 1, 1).data].slice(0, 3); }})()"
    )


def saved_columns(browser):
    """Save the curves, and return them by name."""
    for old in browser.folder.glob("hks-curves*"):
        old.unlink()
    browser.click("#save")
    end = time.monotonic() + 20
    while not (found := list(browser.folder.glob("hks-curves*.csv"))):
        assert time.monotonic() < end, "nothing was downloaded"
        time.sleep(0.02)
    with open(found[0], newline="", encoding="utf-8") as stream:
        head, *rows = csv.reader(stream)
    return dict(zip(head, np.array(rows, float).T, strict=True))


@needs_browser
def test_a_click_chooses_a_point_and_its_curve_is_that_of_numpy(plane):
    a, b = (7, 9), (15, 6)
    plane.click("#signature", *at(a))
    plane.click("#distance", *at(b), shift=True)
    rows = plane.text("#points")
    assert "7, 9" in rows
    assert "15, 6" in rows
    flat = signature() * (4 * np.pi * TIMES[:, None, None])
    mean = np.nanmean(flat, axis=(1, 2))
    columns = saved_columns(plane)
    assert list(columns) == ["t", "4πt·HKS mean: all points", "4πt·HKS A: node 7, 9", "4πt·HKS B: node 15, 6"]
    np.testing.assert_allclose(list(columns.values()), [TIMES, mean, flat[:, *a], flat[:, *b]], rtol=EXACT)
    # Times are evenly spaced in log t: the trapezoidal rule has half the weight at the ends.
    weight = np.r_[0.5, np.ones(5), 0.5] / 6
    apart = np.sqrt(np.sum(weight * ((flat[:, *a] - flat[:, *b]) / mean) ** 2))
    assert float(plane.text("#apart").split(":")[1]) == pytest.approx(apart, abs=6e-4)
    plane.click("#clear")
    assert "15, 6" not in plane.text("#points")


@needs_browser
def test_colours_are_those_of_the_values(plane):
    flat = signature() * (4 * np.pi * TIMES[:, None, None])
    plane.choose("#time", "4")
    assert plane.text("#time-text") == "t = 0.215"
    inside = np.isfinite(flat[0])
    half = min(np.quantile(np.abs(flat[4][inside] - 1), 0.9, method="nearest"), 1)
    node = (6, 4)
    pixel = pixel_of(plane, node)
    colour = np.array(matplotlib.colormaps["RdBu_r"]((flat[4][node] - 1 + half) / (2 * half))) * 255
    np.testing.assert_allclose(pixel, colour[:3], atol=5)
    assert plane.text("#signature-bar").endswith(f"{1 + half:.2f}".rstrip("0"))


def in_space():
    """A result with a voxel that runs from right to left, and an image of other voxels that is linear in space."""
    affine = np.diag([-2.0, 3.0, 2.5, 1.0])
    affine[:3, 3] = 7, -4, 2
    values = signature((12, 10, 3))
    place = TensorVolume(np.tile(np.eye(3), (12, 10, 3, 1, 1)), (2.0, 3.0, 2.5), (0.0,) * 3, affine=affine)
    place = place.with_mask(np.isfinite(values[0]))
    of_image = np.array([[0, 0, 1.5, -20.0], [1.25, 0, 0, -8], [0, 2, 0, 0], [0, 0, 0, 1]])
    slope = np.array([1.0, 0.5, -2.0])
    image = np.tensordot(of_image[:3, :3].T @ slope, np.indices((32, 8, 14)), 1) + of_image[:3, 3] @ slope
    expected = np.tensordot(affine[:3, :3].T @ slope, np.indices((12, 10, 3)), 1) + affine[:3, 3] @ slope
    return Result(place, values, TIMES, source="a file"), nib.Nifti1Image(image, of_image), expected


def test_an_anatomical_image_lies_under_the_maps_at_its_place_in_space(tmp_path, capsys):
    result, image, expected = in_space()
    nib.save(image, tmp_path / "T1.nii.gz")
    sampled = hj.io.sample_image(tmp_path / "T1.nii.gz", result.volume)
    known = np.isfinite(sampled)
    assert 0.3 < known.mean() < 1  # the image does not cover all voxels
    np.testing.assert_allclose(sampled[known], expected[known], atol=1e-4)
    one = result.volume.slice("z", 1)
    np.testing.assert_array_equal(hj.io.sample_image(tmp_path / "T1.nii.gz", one), sampled[..., 1])
    save(tmp_path / "hks.npz", result.values, result.volume, name="hks", extra={"times": TIMES})
    command = ["explore", str(tmp_path / "hks.npz"), "--anatomy"]
    assert main([*command, str(tmp_path / "T1.nii.gz"), "-q"]) == 0
    text = (tmp_path / "explore.html").read_text(encoding="utf-8")
    about = json.loads(re.search(r'id="about">([^<]*)<', text)[1])
    grey = block(text, "anatomy", np.uint8).reshape(about["shape"]).astype(float)
    low, high = np.quantile(sampled[known], [0.01, 0.99])
    levels = np.where(known, 1 + 254 * np.clip((sampled - low) / (high - low), 0, 1), 0)
    np.testing.assert_allclose(grey, levels[::-1], atol=0.51)  # left is on the left, and the margin reaches the sides
    nib.save(
        nib.Nifti1Image(image.get_fdata(), np.diag([1, 1, 1, 1.0]) + 900 * np.eye(4, k=3)), tmp_path / "far.nii.gz"
    )
    assert main([*command, str(tmp_path / "far.nii.gz"), "-q"]) == 2
    assert "the image contains no voxel of" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"anatomy: got shape \(3, 3\); expected the grid's shape \(12, 10, 3\)"):
        explore(result, tmp_path / "no.html", anatomy=np.ones((3, 3)))


@needs_browser
def test_maps_are_mixed_with_the_anatomy(browser, tmp_path):
    anatomy = np.linspace(0, 1, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    browser.open(explore(of(signature()), tmp_path / "anatomy.html", anatomy=anatomy))
    node, outside = (6, 4), (0, 17)
    browser.choose("#opacity", "100")
    own = np.array(pixel_of(browser, node))
    browser.choose("#opacity", "0")
    grey = np.array(pixel_of(browser, node))
    level = 1 + 254 * np.clip((anatomy[node] - 0.01) / 0.98, 0, 1)
    np.testing.assert_allclose(grey, level, atol=2)
    browser.choose("#opacity", "40")
    np.testing.assert_allclose(pixel_of(browser, node), 0.4 * own + 0.6 * grey, atol=2)
    np.testing.assert_allclose(pixel_of(browser, outside), 1 + 254 * (anatomy[outside] - 0.01) / 0.98, atol=2)


@needs_browser
def test_what_noise_could_make_fades_and_points_have_bands(browser, tmp_path):
    browser.problems.clear()
    flat = signature() * (4 * np.pi * TIMES[:, None, None])
    node, other = (6, 4), (15, 6)
    noise, z = 0.1 * flat, np.full_like(flat, 9.0)
    z[:, *node] = -1
    scale = 4 * np.pi * TIMES[:, None, None]
    path = explore(of(signature(), deviation=noise / scale, z=z), tmp_path / "noise.html")
    browser.open(path)
    browser.choose("#time", "4")

    half_faded, untouched = np.array(pixel_of(browser, node)), pixel_of(browser, other)
    browser.choose("#fade", "0")
    np.testing.assert_allclose(half_faded, (np.array(pixel_of(browser, node)) + 204) / 2, atol=1)
    assert pixel_of(browser, other) == untouched
    browser.choose("#fade", "1")
    assert pixel_of(browser, node) != half_faded.tolist()
    browser.click("#signature", *at(node))
    assert f"± {noise[4][node]:.3f}"[:6] in browser.text("#points")
    columns = saved_columns(browser)
    np.testing.assert_allclose(columns["4πt·HKS A standard deviation by noise"], noise[:, *node], rtol=EXACT)
    assert browser.run("document.querySelectorAll('#chart polygon').length") == 1
    assert all("willReadFrequently" in problem for problem in browser.problems)


@needs_browser
def test_regions_have_the_mean_and_spread_of_their_points(plane):
    flat = signature() * (4 * np.pi * TIMES[:, None, None])
    plane.choose("#region", "1")
    x, y, width, height = plane.box("#signature")
    # Around the nodes 9 … 13, 5 … 8: their corners are half a cell away.
    corners = [at((8.5, 4.5)), at((13.5, 4.5)), at((13.5, 8.5)), at((8.5, 8.5)), at((8.5, 4.6))]
    plane.drag([(x + u * width, y + v * height) for u, v in corners])
    assert plane.text("#region-text").startswith("20 of ")
    inside = flat[:, 9:14, 5:9].reshape(TIMES.size, -1)
    columns = saved_columns(plane)
    named = {name.removeprefix("4πt·HKS region "): column for name, column in columns.items()}
    np.testing.assert_allclose(named["mean"], inside.mean(axis=1), rtol=EXACT)
    np.testing.assert_allclose(named["standard deviation"], inside.std(axis=1), rtol=1e-4)
    np.testing.assert_array_equal(columns["points in region: lasso"], 20)
    quartiles = np.quantile(inside, [0.25, 0.5, 0.75], axis=1, method="nearest")
    np.testing.assert_allclose(named["lower quartile"], quartiles[0], rtol=EXACT)
    np.testing.assert_allclose(named["upper quartile"], quartiles[2], rtol=EXACT)

    plane.choose("#region", "3")  # label 3
    inside = flat[:, :8].reshape(TIMES.size, -1)
    inside = inside[:, np.isfinite(inside[0])]
    np.testing.assert_allclose(saved_columns(plane)["4πt·HKS region mean"], inside.mean(axis=1), rtol=EXACT)

    plane.choose("#region", "2")  # what is alike: more of it, the farther it may be
    plane.choose("#alike", "0")
    assert plane.text("#region-text").startswith("1 of ")
    plane.choose("#alike", "60")
    assert int(plane.text("#region-text").split()[0]) > 20


@needs_browser
def test_the_page_is_used_by_keys_alone(plane):
    plane.click("#signature", *at((9, 9)))
    plane.run("document.querySelector('#distance').focus()")
    plane.key("ArrowRight", 2)
    plane.key("ArrowUp")
    plane.key("ArrowLeft", shift=True)
    assert plane.text("#status").startswith("Point A at node 6, 10:")
    plane.key("ArrowLeft", 30)  # it stops at the rim
    assert plane.text("#status").startswith(
        f"Point A at node {np.nonzero(np.isfinite(signature()[0, :, 10]))[0][0]}, 10:"
    )
    plane.run("document.querySelector('#time').focus()")
    plane.key("ArrowRight")
    assert plane.text("#time-text") == "t = 0.100"
    unnamed = "e => !e.labels?.length && !e.textContent.trim() && !e.ariaLabel"
    assert plane.run(f"[...document.querySelectorAll('input, select, button, canvas')].filter({unnamed}).length") == 0


@needs_browser
def test_a_title_is_only_a_title(plane):
    assert plane.text("h1") == EVIL
    assert plane.run("document.title") == EVIL
    assert plane.run("document.querySelectorAll('b').length") == plane.run(
        "document.querySelectorAll('details b').length"
    )


@needs_browser
@pytest.mark.parametrize("width", [400, 1200])
def test_nothing_leaves_the_window(plane, width):
    plane.resize(width, 800)
    plane.settle()
    outside = f"e => e.getBoundingClientRect().right > {width} && e.offsetParent"
    assert plane.run("document.documentElement.scrollWidth") <= width
    assert plane.run(f"[...document.querySelectorAll('body *')].filter({outside}).map(e => e.id || e.tagName)") == []
    assert plane.run("document.querySelector('#signature').clientWidth") > 0.28 * width


@needs_browser
def test_slices_of_a_volume(browser, tmp_path):
    browser.problems.clear()
    shape = (10, 9, 8)
    path = explore(of(signature(shape), hj.Grid(shape, (1, 1, 2)), tensors(shape)), tmp_path / "page.html")
    browser.open(path)
    z = int(browser.text("#points").split("node")[1].split(",")[2].split("position")[0])
    assert browser.text("#slice-text") == f"z = {z}"
    browser.choose("#slice", str(z - 2))
    shown = "document.querySelector('#signature').toDataURL()"
    assert browser.text("#slice-text") == f"z = {z - 2}"
    before = browser.run(shown)
    browser.run("document.querySelector('#signature').focus()")
    browser.key("PageUp")
    assert browser.text("#slice-text") == f"z = {z + 1}"  # the point's own slice, and one up
    assert browser.run(shown) != before
    browser.choose("#plane", "0")
    assert browser.text("#slice-text").startswith("x = ")
    browser.click("#signature")
    for layer in range(3):
        browser.choose("#layer-name", str(layer))
    for quantity in range(3):
        browser.choose("#quantity", str(quantity))
    flat = signature(shape) * (4 * np.pi * TIMES[:, None, None, None]) ** 1.5
    node = tuple(int(i) for i in re.search(r"node (\d+, \d+, \d+)", browser.text("#legend"))[1].split(", "))
    columns = saved_columns(browser)
    expected = flat[:, *node] / (4 * np.pi * TIMES) ** 1.5
    np.testing.assert_allclose(columns[f"HKS A: node {', '.join(map(str, node))}"], expected, rtol=EXACT)
    assert browser.problems == []


@pytest.mark.slow
@needs_browser
def test_a_surface_is_turned_and_its_vertices_are_chosen(browser, tmp_path):
    browser.problems.clear()
    sphere = hj.examples.sphere_mesh(6)
    vertices = np.concatenate([np.zeros((3, 3)), sphere.vertices])  # three vertices are outside the domain
    flat = 1 + 0.3 * np.sin(np.outer(TIMES, vertices[:, 0]) + vertices[:, 2])
    flat[:, :3] = np.nan
    np.savez(
        tmp_path / "hks.npz",
        hks=flat / (4 * np.pi * TIMES[:, None]),
        times=TIMES,
        vertices=vertices,
        faces=np.asarray(sphere.faces) + 3,
    )
    assert main(["explore", str(tmp_path), "-q"]) == 0
    browser.open(tmp_path / "explore.html")

    def chosen():
        return int(re.search(r"A \(vertex (\d+)\)", browser.text("#legend"))[1])

    # The middle of the image is the point that looks at the reader.
    for turn, tilt in ((90, 0), (-160, 30), (0, 90)):
        browser.choose("#turn", str(turn))
        browser.choose("#tilt", str(tilt))
        browser.click("#distance")
        a, e = np.radians([turn, tilt])
        towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        assert chosen() == np.argmax(vertices @ towards)
    before = vertices[chosen()]
    browser.key("ArrowRight", 2)  # seen from above, with x down
    assert vertices[chosen()][1] > before[1] + 0.2
    x, y, width, height = browser.box("#signature")
    browser.drag([(x + width / 2, y + height / 2), (x + width / 2 - 40, y + height / 2), (x + width / 2 - 40, y + 10)])
    assert browser.run("document.querySelector('#turn').value") == "20"
    columns = saved_columns(browser)
    np.testing.assert_allclose(columns[f"4πt·HKS A: vertex {chosen()}"], flat[:, chosen()], rtol=EXACT)

    browser.choose("#region", "1")  # around the middle of the image: one side of the sphere alone
    browser.choose("#tilt", "90")
    x, y, width, height = browser.box("#signature")
    reach = 0.4 * 0.49 * min(width, height)
    corners = [(x + width / 2 + reach * np.cos(a), y + height / 2 + reach * np.sin(a)) for a in np.linspace(0, 6.2, 24)]
    browser.drag(corners)
    inside = (np.hypot(vertices[:, 0], vertices[:, 1]) < 0.4) & (vertices[:, 2] > 0)
    assert abs(int(browser.text("#region-text").split()[0]) - inside.sum()) <= 2
    assert browser.problems == []


def test_maps_and_labels_that_the_page_cannot_hold_are_refused(tmp_path):
    known, hidden = of(signature()), np.ma.array(np.ones(SHAPE), mask=np.eye(*SHAPE))
    for result, given, words in (
        (known, {"maps": {"a": np.ones(SHAPE) + 1j}}, "maps['a']: got complex numbers"),
        (known, {"maps": {"a": hidden}}, "maps['a']: got a masked array"),
        (known, {"labels": np.full(SHAPE, 2**40)}, "labels: got 1099511627776"),
        (known.values, {}, "result: got ndarray; expected hks_jax.io.Result"),
    ):
        with unchecked(), pytest.raises((TypeError, ValueError), match=f"^{re.escape(words)}"):
            explore(result, tmp_path / "page.html", **given)
