"""Where the boundary acts pictures are hatched, and the left hemisphere is drawn on one side in all of them."""

import json
import re

import numpy as np
import pytest
from annotations import unchecked
from browser import Browser, find_browser
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from test_explore import block
from test_orientation import RAS, SHAPE, STORAGES, stored

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import Result, TensorVolume
from hks_jax.plot import Orientation, ellipses, explore, hks_curves, new_figure, scalar_image, signature_panels, surface
from hks_jax.plot.images import colours_of

TIMES = np.array([1e3, 4e3])


def result_of(order, turned, axis=None):
    """A signature that is largest in the left hemisphere, stored in some order; `axis` of space is cut to a slice."""
    values = np.full((*SHAPE, 2), 1.0)
    values[:3] = 1.5  # x < 0: left
    array, affine = stored(values, RAS, order, turned, axes=4)
    tensors = np.broadcast_to(1e-3 * np.eye(3), (*array.shape[:3], 3, 3))
    spacing = tuple(np.linalg.norm(affine[:3, :3], axis=0))
    volume = TensorVolume(tensors, spacing, (0.0,) * 3, affine=affine, length_unit="mm")
    near = np.zeros(array.shape)
    near[:2] = 1.0
    report = {"settings": {"metric": "inverse", "normalisation": "flat"}}
    if axis is not None:
        own = order.index(axis)
        volume = volume.slice("xyz"[own], 2)
        array, near = array.take(2, own), near.take(2, own)
    return Result(
        volume, np.moveaxis(array, -1, 0), TIMES, report=report, arrays={"influence": np.moveaxis(near, -1, 0)}
    )


def side_of_left(ax):
    """Return the position from 0 (left) to 1 (right) on drawn axes of the brightest columns of their image."""
    image = ax.images[0]
    bright = np.asarray(image.get_array()).mean(axis=0)
    left, right, *_ = image.get_extent()
    at = left + (right - left) * (np.argmax(bright) + 0.5) / bright.size
    return ax.transAxes.inverted().transform(ax.transData.transform((at, 0)))[0]


@pytest.mark.parametrize(
    ("order", "turned"),
    [pytest.param(*each, marks=[pytest.mark.slow] * (i % 5 != 2)) for i, each in enumerate(STORAGES[::5])],
)
@pytest.mark.parametrize("view", ["neurological", "radiological"])
def test_left_is_on_one_side_in_every_picture(order, turned, view, tmp_path):
    """Affines of both determinants and permuted axes."""
    is_left = (lambda x: x < 0.5) if view == "neurological" else (lambda x: x > 0.5)
    slices = result_of(order, turned, axis=2)
    figure = signature_panels(slices, view=view)
    figure.draw_without_rendering()
    assert is_left(side_of_left(figure.axes[0]))
    whole = signature_panels(result_of(order, turned), view=view)
    whole.draw_without_rendering()
    panels = [ax for ax in whole.axes if ax.images and ax.images[0].get_cmap().name != "gray"]
    across = [ax for ax in panels if [t for t in ax.texts if t.get_text() == "L"]]
    assert len(across) == 4
    assert all(is_left(side_of_left(ax)) for ax in across)
    # ellipses of the metric, as in pictures of fits
    by = Orientation.of(slices.volume.affine, slices.volume.thin_axis, view=view)
    big = np.where(slices.values[0] > 1.2, 4.0, 1.0)[..., None, None] * np.eye(2)
    ax = new_figure(3, 3).add_subplot()
    marks = ellipses(ax, by.field(hj.TensorField(slices.grid, big)), every=1, kind="tensor")
    by.letter(ax)
    sizes, offsets = marks.get_widths(), np.asarray(marks.get_offsets())
    at = offsets[np.argmax(sizes)]
    assert is_left(ax.transAxes.inverted().transform(ax.transData.transform(at))[0])
    # the page
    text = explore(slices, tmp_path / "page.html", view=view).read_text()
    about = json.loads(re.search(r'id="about">([^<]*)<', text)[1])
    assert about["ends"] == ["LR", "PA"]
    assert about["mirrored"] == (view == "radiological")
    shown = block(text, "values", "<f4").reshape(2, *about["shape"])[0]
    assert (shown[:3] == 1.5).all()
    assert (shown[3:] == 1.0).all()
    near = block(text, "near", "u1").reshape(2, *about["shape"])[0]
    np.testing.assert_array_equal(near, by.array(slices.near_rim[0]))
    # The page's indices are those of the volume, and lead to the same place in space.
    axes, world = about["axes"], np.array(about["world"])
    index = [f + s * 0 for f, s in zip(axes["first"], axes["step"], strict=True)]
    np.testing.assert_allclose((world @ [*index, 1])[:2], [-5, -4])


@pytest.mark.skipif(find_browser() is None, reason="no Chromium")
@pytest.mark.slow
def test_left_is_on_one_side_in_a_browser(tmp_path):
    script = """(() => { const c = document.getElementById("signature"), p = c.getContext("2d");
        const row = p.getImageData(0, Math.round(c.height / 2), c.width, 1).data;
        let [at, most] = [0, -1];
        for (let x = 0; x < c.width; x++) {
          const red = row[4 * x] - row[4 * x + 2];
          if (row[4 * x + 3] === 255 && red > most) [at, most] = [x, red];
        }
        return at / c.width; })()"""
    with Browser(tmp_path) as browser:
        for number, (order, turned) in enumerate(STORAGES[::16]):
            for view in ("neurological", "radiological"):
                page = explore(result_of(order, turned, axis=2), tmp_path / f"{number}{view}.html", view=view)
                browser.open(page)
                assert (browser.run(script) < 0.5) == (view == "neurological")
                before = browser.text("#points")
                browser.run("document.getElementById('signature').focus()")
                browser.key("ArrowRight")
                assert browser.text("#points") != before
        assert browser.problems == []


def test_hatching_covers_the_marked_nodes_and_can_be_left_out():
    grid = hj.Grid((6, 4))
    mark = np.zeros(grid.shape, bool)
    mark[:2] = True
    ax = new_figure(3, 3).add_subplot()
    scalar_image(ax, grid.nodes[..., 0], grid, hatched=mark)
    (area,) = [one for one in ax.collections if getattr(one, "hatches", None)]
    (path,) = [path for path in area.get_paths() if len(path)]
    assert path.contains_points(grid.nodes.reshape(-1, 2)).reshape(grid.shape).tolist() == mark.tolist()
    for hidden, count in ((False, 1), (True, 0)):
        figure = signature_panels(result_of((0, 1, 2), (False,) * 3, axis=2), show_rim=hidden)
        drawn = [one for one in figure.axes[0].collections if getattr(one, "hatches", None)]
        assert len(drawn) == count
        assert ("hatched: the boundary contributes over 10 %" in figure.get_suptitle()) == bool(count)
    mesh = hj.examples.sphere_mesh(2)
    with unchecked(), pytest.raises(ValueError, match=r"hatched: got shape \(3,\)"):
        surface(new_figure(3, 3).add_subplot(projection="3d"), mesh, mesh.vertices[:, 2], hatched=np.ones(3, bool))


def test_curves_are_pale_where_the_boundary_acts(tmp_path, monkeypatch):
    """From Python and on the command line, on a slice that is stored right to left, at some of the saved times."""
    grid, times = hj.Grid((4, 3)), np.array([1.0, 2.0, 3.0])
    values = np.arange(1.0, 37).reshape(3, 4, 3)
    near = np.zeros((3, 4, 3), bool)
    near[1:, 0, 0] = True
    ax = new_figure(3, 3).add_subplot()
    touched, free = hks_curves(ax, values, times, grid, [[0, 0], [3, 2]], near_rim=near)
    np.testing.assert_array_equal(touched.get_ydata(), [1, np.nan, np.nan])
    np.testing.assert_array_equal(free.get_ydata(), values[:, 3, 2])
    (pale,) = (line for line in ax.lines if (line.get_alpha() or 1) < 1)
    np.testing.assert_array_equal(pale.get_ydata(), values[:, 0, 0])
    assert pale.get_color() is touched.get_color()
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == ["(0, 0)", "(3, 2)", "pale: the boundary contributes over 10 %"]
    with unchecked(), pytest.raises(ValueError, match=r"near_rim: got shape \(4, 3\) .*; expected .* \(3, 4, 3\)"):
        hks_curves(ax, values, times, grid, [[0, 0]], near_rim=near[0])

    found = []
    monkeypatch.setattr("hks_jax.plot.hks_curves", lambda *given, **style: found.append(hks_curves(*given, **style)))
    result = result_of((0, 1, 2), (True, False, False), axis=2)  # near the boundary where x is largest
    result.save(tmp_path / "hks", "")
    x, y = result.volume.affine[:2, 3]
    command = ["plot", str(tmp_path / "hks.npz"), "-o", str(tmp_path / "p.png"), "-q", "--times", "4e3"]
    for more, share in ([], 0.5), (["--show-rim"], 0):
        assert main([*command, "--points", f"{x},{y}", f"{x - 8},{y}", *more]) == 0
        assert np.mean([np.isnan(line.get_ydata()) for line in found.pop()]) == share


@pytest.mark.skipif(find_browser() is None, reason="no Chromium")
@pytest.mark.slow
def test_curves_are_pale_in_a_browser(tmp_path):
    pale = "[...document.querySelectorAll('#chart path')].filter((one) => one.getAttribute('opacity') < 1).length"
    with Browser(tmp_path) as browser:
        browser.open(explore(result_of((0, 1, 2), (False,) * 3, axis=2), tmp_path / "page.html"))
        for across, count in (0.9, 0), (0.05, 1):
            browser.click("#signature", across, 0.5)
            assert browser.run(pale) == count
            assert ("pale: the boundary contributes over 10 %" in browser.text("#legend")) == bool(count)
        browser.click("#rim", 0.5, 0.5)
        assert browser.run(pale) == 0
        assert browser.problems == []


def test_stripes_cover_the_marked_part_of_a_surface(monkeypatch):
    given = {}
    monkeypatch.setattr(
        "hks_jax.plot.surfaces.Poly3DCollection",
        lambda corners, **more: given.update(more) or Poly3DCollection(corners),
    )
    mesh = hj.examples.sphere_mesh(8)
    ax = new_figure(3, 3).add_subplot(projection="3d")
    marked = np.asarray(mesh.vertices)[:, 2] > 0
    surface(ax, mesh, np.ones(len(mesh.vertices)), relief=0.0, hatched=marked)
    light = given["facecolors"][:, :3].sum(axis=1)
    up = np.asarray(mesh.vertices)[mesh.faces][..., 2].mean(axis=1)
    dark = light < 0.9 * light.max()
    assert not dark[up < -0.2].any()
    assert 0.2 < dark[up > 0.2].mean() < 0.6


@pytest.mark.parametrize("values", [[0.1, 0.9, 4.0], [1.6, 1.7, 3.5], [0.2, 1.8, 1.9]])
def test_no_range_of_colours_of_a_signature_reaches_below_zero(values):
    others = np.array([0.9, 1.0, 1.1])
    for colours in colours_of([others, others, np.array(values)], (0, 1), centre=1.0):
        assert colours.low >= 0


@pytest.mark.parametrize(("metric", "unit"), [("inverse", "s"), ("tensor", "mm⁴/s"), ("adjugate", "mm⁴/s")])
@pytest.mark.parametrize("known", [1e-3, 1.0])
def test_times_have_the_unit_of_a_squared_length_of_the_metric(metric, unit, known):
    """Tensors in mm²/s, as their size shows; tensors of no plausible size have times without a unit."""
    place = TensorVolume(np.broadcast_to(known * np.eye(2), (4, 3, 2, 2)), (1.0, 1.0), (0.0, 0.0), length_unit="mm")
    result = Result(place, np.ones((1, 4, 3)), np.array([4.0]), report={"settings": {"metric": metric}})
    assert result.unit == (unit if known == 1e-3 else "")
    assert (result.units["D"] is None) == (metric != "inverse")


@pytest.mark.slow
def test_the_command_line_tells_of_the_rim(tmp_path, capsys):
    x, y = np.meshgrid(*[np.linspace(-1, 1, 33)] * 2, indexing="ij")
    np.savez(
        tmp_path / "t.npz",
        tensors=np.broadcast_to(np.eye(2), (33, 33, 2, 2)),
        spacing=1 / 16,
        mask=np.hypot(x, y) < 0.95,
    )
    out = tmp_path / "out"
    assert main(["hks", str(tmp_path / "t.npz"), "-o", str(out), "-k", "150", "--times", "auto:4"]) == 0
    said = capsys.readouterr().err
    assert re.search(r"less than 10 % influence of the boundary: \d+, \d+, \d+, (4[7-9]|5[0-3]) %", said)
    report = json.loads((out / "report.json").read_text())
    shares = [row["free_of_rim"] for row in report["times"]]
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] == pytest.approx(0.5, abs=0.03)
    assert report["settings"]["normalisation"] == "flat"
    assert report["rim"] == {"limit": 0.1, "influence": "from the eigenpairs of both boundary problems"}
    assert report["warnings"] == []
    influence = Result.read(out).arrays["influence"]
    inside = np.isfinite(influence[0])
    np.testing.assert_allclose([np.mean(one[inside] < 0.1) for one in influence], shares)
    np.save(tmp_path / "labels.npy", np.where(x < 0, 1, 2))
    assert main(["stats", str(out), "--atlas", str(tmp_path / "labels.npy"), "-q"]) == 0
    lines = [line.split("\t") for line in (out / "regions.tsv").read_text().splitlines()]
    column, voxels = lines[0].index("free_of_rim"), lines[0].index("voxels")
    last = lines[4::4]
    assert sum(float(r[column]) * int(r[voxels]) for r in last) == pytest.approx(shares[-1] * inside.sum(), rel=1e-6)
    # One problem: an estimate, and a time at which all feel the boundary.
    late = ["--boundary", "neumann", "-k", "60", "--times", "0.02", "1"]
    assert main(["hks", str(tmp_path / "t.npz"), "-o", str(out), *late, "-q"]) == 0
    assert (
        "at 1 of 2 times, most nodes feel the boundary: at t = 1, it contributes over 10 %" in capsys.readouterr().err
    )
    report = json.loads((out / "report.json").read_text())
    assert report["rim"]["influence"].startswith("estimated")
    assert report["times"][1]["free_of_rim"] == 0
