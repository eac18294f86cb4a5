"""The paper's table and figures, as benchmarks/paper makes them: the numbers, and that every picture is drawn."""

import csv
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread

from hks_jax import Grid, SurfaceMesh, TensorField, plot
from hks_jax.domain.examples import bumpy_torus_field, bumpy_torus_mesh, figure3_fields, figure4_fields

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "paper"))

import figures
import table1
import triangles
from reproduce import run
from signature import continued_signature, enough_pairs, flat_signature, signature

# What an independent implementation of the same method gives.
INDEPENDENT = {50: 0.0580, 100: 0.0223, 200: 0.0056, 400: 0.00085}


def agrees(row: table1.Row) -> bool:
    digits = 5 if row.nodes_per_axis == 400 else 4
    return round(row.nodal, digits) <= INDEPENDENT[row.nodes_per_axis]


# --- Table 1 ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_stored_reference_continues_what_coarser_surfaces_give():
    """At common vertices, the signatures of n², (2n)² and (4n)² vertices differ by 4 : 1, an error of second order."""
    coarse, middle = (
        signature(bumpy_torus_mesh(n), [table1.TIME], table1.QUICK_PAIRS)[0].reshape(n, n)[:: n // 100, :: n // 100]
        for n in (100, 200)
    )
    reference = table1.stored_reference()[::4, ::4]
    expected = middle - (coarse - middle) / 4
    even = np.ones_like(reference)
    assert table1.relative_difference(middle, reference, even) == pytest.approx(4.6e-3, rel=0.05)
    assert table1.relative_difference(expected, reference, even) < 1.2e-3


@pytest.mark.slow
def test_table_1_at_the_papers_sizes():
    reference = table1.stored_reference()
    rows = [table1.row(n, table1.REFERENCE_PAIRS, reference) for n in table1.PAPER]
    assert [row.nodes_per_axis for row in rows] == [50, 100, 200, 400]
    assert all(agrees(row) for row in rows)
    for row in rows[:2]:
        assert row.nodal == pytest.approx(INDEPENDENT[row.nodes_per_axis], rel=0.01)
        assert row.area_weighted == pytest.approx(row.nodal, rel=0.1)
        assert row.paper > row.nodal
    # The signatures converge at second order.
    assert rows[1].nodal / rows[2].nodal > 3.5


def test_stored_reference_is_symmetric_and_round_trips(tmp_path):
    reference = table1.stored_reference()
    assert reference.shape == (400, 400)
    # The triangulation keeps the symmetry (u, v) → (−u, −v).
    np.testing.assert_allclose(np.roll(reference[::-1, ::-1], 1, axis=(0, 1)), reference, rtol=3e-7)
    table1.store_reference(reference, tmp_path / "again.npy")
    np.testing.assert_array_equal(np.tile(np.load(tmp_path / "again.npy"), (10, 1)), reference)


def test_periodic_interpolation_is_bilinear():
    values = np.random.default_rng(0).random((6, 6))
    fine = table1.interpolate_periodic(values, 4)
    assert fine.shape == (24, 24)
    np.testing.assert_allclose(fine[::4, ::4], values)
    middle = 0.375 * (values[0, 0] + values[1, 0]) + 0.125 * (values[0, 1] + values[1, 1])
    np.testing.assert_allclose(fine[2, 1], middle)
    np.testing.assert_allclose(fine[-1, 0], 0.25 * values[-1, 0] + 0.75 * values[0, 0])


def test_relative_difference():
    reference = np.array([[3.0, 4.0]])
    assert table1.relative_difference(reference * 1.5, reference, np.ones((1, 2))) == pytest.approx(0.5)
    weighted = table1.relative_difference(np.array([[4.0, 4.0]]), reference, np.array([[16.0, 1.0]]))
    assert weighted == pytest.approx(4 / np.sqrt(16 * 9 + 16))


def test_table_files_state_their_conventions(tmp_path, monkeypatch):
    def small_row(n, k, reference):
        return table1.Row(n, k, table1.PAPER[n], table1.INDEPENDENT[n], 0.05 / n, 0.04 / n)

    monkeypatch.setattr(table1, "row", small_row)
    lines = []
    paths = run(tmp_path / "new", False, ["table1"], lines.append)
    assert [path.name for path in paths] == ["table1.md", "table1.csv"]
    with open(paths[1], newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["nodes_per_axis"] for row in rows] == ["50", "100", "200"]
    assert [float(row["paper"]) for row in rows] == [0.384, 0.076, 0.0092]
    assert [float(row["independent"]) for row in rows] == [0.058, 0.0223, 0.0056]
    assert float(rows[0]["nodal"]) == 0.001
    text = paths[0].read_text(encoding="utf-8")
    for phrase in ("| 100² | 200 | 0.07600 | 0.02230 |", "√(Σ (h − r)² / Σ r²)", "√|T|", "read from a file"):
        assert phrase in text
    assert [line.split(": ")[0] for line in lines] == ["[1/1] table1"] * 4


# --- triangles --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_which_triangles_violate_the_inequality():
    """None on smooth fields at the figures' sizes; some, by every rule, where a grid is coarse for its field."""
    counts = {(n, rule): triangles.count(figure3_fields(n)["T³"], rule) for n in (11, 51) for rule in triangles.LENGTHS}
    for rule in triangles.LENGTHS:
        assert counts[51, rule][:3] == (5000, 0, 2601)
        assert counts[11, rule][:3] == (200, 6, 121)
    torus = triangles.count(bumpy_torus_field(100), "integrated", periodic=True)
    assert torus[:3] == (20000, 0, 10000)
    assert torus.no_area > 0


def test_counts_of_triangles_on_known_lengths():
    """An isotropic metric with one heavy node, by hand."""
    tensors = np.broadcast_to(np.eye(2), (2, 2, 2, 2)).copy()
    grid = Grid((2, 2))
    assert triangles.count(TensorField(grid, tensors), "midpoint") == (2, 0, 4, 0)
    # Scaled by s² at the end of the diagonal, which has √2 (1 + s)/2; the sides are 1 and (1 + s)/2.
    for s, wrong in ((3.0, 0), (6.0, 2)):
        tensors[1, 1] = s**2 * np.eye(2)
        assert triangles.count(TensorField(grid, tensors), "mean of the ends").violating == wrong
    integrated = triangles.LENGTHS["integrated"](np.eye(2)[None], 4 * np.eye(2)[None], np.array([[3.0, 4.0]]))
    np.testing.assert_allclose(integrated, 5 * 14 / 9, rtol=1e-6)  # ∫√(1 + 3s) ds = 14/9


# --- figures ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were saved, by file name."""
    figures, save = {}, plot.save_figure

    def capture(fig, path, **kwargs):
        figures[path.name] = fig
        return save(fig, path, **kwargs)

    monkeypatch.setattr(plot, "save_figure", capture)
    return figures


@pytest.fixture
def cheap(monkeypatch):
    """Something smooth in place of every signature: layout does not depend on the values."""

    def cheap_signature(domain, times, k, boundary="neumann", normalisation="raw"):
        if isinstance(domain, SurfaceMesh):
            values = 2 + np.sin(np.asarray(domain.vertices)).sum(axis=1)
        else:
            values = np.where(domain.grid.inside, 2 + np.sin(domain.grid.nodes).sum(axis=-1), np.nan)
        return np.stack([values / t for t in times])

    def cheap_with_rim(field, times, k):
        values = 1 + 0.1 * cheap_signature(field, np.ones(len(times)), k)
        return values, np.where(np.isfinite(values), 0.0, np.nan)

    monkeypatch.setattr(figures, "signature", cheap_signature)
    monkeypatch.setattr(figures, "signature_and_influence", cheap_with_rim)
    monkeypatch.setattr(figures, "flat_signature", lambda f, t, b="neumann": cheap_signature(f, [t], 1)[0])
    monkeypatch.setattr(figures, "continued_signature", lambda f, t, d: cheap_signature(f, [t], 1)[0])
    monkeypatch.setattr(figures, "hks_expansion", lambda f, t: cheap_signature(f, t, 1))


def draw(name, tmp_path, drawn, monkeypatch, size=None, time=None):
    """Run one figure with small settings, and return it once its file and its layout are right."""
    monkeypatch.setattr(figures, "DRAWN", 20)
    if size is not None:
        monkeypatch.setitem(figures.SIZES, name, (size, size))
    if time is not None:
        monkeypatch.setitem(figures.TIMES, name, time)
    (path,) = run(tmp_path, False, [name], lambda text: None)
    pixels = imread(path)
    assert path == tmp_path / f"{name}.png"
    assert min(pixels.shape[:2]) > 600
    assert pixels[..., :3].std() > 0.1
    fig = drawn[path.name]
    renderer = FigureCanvasAgg(fig).get_renderer()
    boxes = [ax.get_tightbbox(renderer).padded(-1) for ax in fig.axes if ax.name != "3d"]
    for i, box in enumerate(boxes):
        assert box.x0 > -2
        assert box.x1 < fig.bbox.x1 + 2
        assert not any(box.overlaps(other) for other in boxes[i + 1 :])
    for ax in fig.axes:
        for image in ax.images:
            assert np.ptp(np.asarray(image.get_clim())) > 0
            assert image.get_array().count() > 0
    return fig


def one_colour_range(images):
    """All images of a figure have the same colours for the same values, and these span all values."""
    arrays = [image.get_array() for image in images]
    ends = min(array.min() for array in arrays), max(array.max() for array in arrays)
    assert [image.get_clim() for image in images] == [ends] * len(images)


@pytest.mark.slow
@pytest.mark.usefixtures("cheap")
def test_figure_6_draws_the_brain_beside_its_anatomy(tmp_path, drawn, monkeypatch):
    pytest.importorskip("dipy")
    if figures.find_example_brain() is None:
        pytest.skip("the brain is not installed")
    fig = draw("figure6", tmp_path, drawn, monkeypatch)
    panels = np.reshape(fig.axes, (2, 5))
    for ax in panels.flat:
        image = ax.images[0].get_array()
        assert 0.3 < image.count() / image.size < 0.95  # nothing outside the mask
        assert {text.get_text() for text in ax.texts} == set("LRAP")
    titles = [ax.get_title().split("\n")[0] for ax in panels[0]]
    assert titles == ["in-plane mean diffusivity", "5 mm", "7 mm", "10 mm", "14 mm"]
    assert [ax.get_ylabel() for ax in panels[:, 0]] == [ax.get_xlabel() for ax in panels[1, :2]] == ["mm", "mm"]
    for ax in panels[:, 1:].flat:
        assert "HKS" in ax.child_axes[0].get_ylabel()
        assert np.mean(ax.images[0].get_clim()) == pytest.approx(1)  # the middle colour is that of a flat metric


@pytest.mark.parametrize("lacking", ["brain", "dipy"])
def test_figure_6_is_skipped_where_there_is_no_brain(lacking, tmp_path, monkeypatch):
    lines = []
    if lacking == "brain":
        monkeypatch.setattr(figures, "find_example_brain", lambda: None)
    else:
        monkeypatch.setattr(figures, "find_example_brain", lambda: ())
        monkeypatch.setattr(figures.importlib.util, "find_spec", lambda name: None)
    assert run(tmp_path, False, ["figure6"], lines.append) == []
    (line,) = lines
    assert "skipped" in line
    assert "mdt==1.2.7" in line


@pytest.mark.slow
def test_signature_and_enough_pairs(monkeypatch):
    """Enough pairs are enough, and a continued metric has no boundary: the flat square is flat up to its sides."""
    metric = jnp.array([[2.0, 0.5], [0.5, 1.0]])
    field = TensorField.from_function(lambda x: metric, Grid.from_bounds(0, 1, (21, 21)))
    values = continued_signature(field, 0.02, 0.4)
    assert values.shape == (21, 21)
    np.testing.assert_allclose(values, 1.0, rtol=0.02)
    whole = flat_signature(field, 0.02)
    (pairs,) = signature(field, [0.02], enough_pairs(field, 0.02), normalisation="flat")
    np.testing.assert_allclose(pairs, whole, rtol=5e-3)
    # A large grid takes that many eigenpairs.
    monkeypatch.setattr("signature.SMALL", 400)
    np.testing.assert_allclose(flat_signature(field, 0.02), pairs, rtol=1e-12)


@pytest.mark.slow
def test_figure_1_shows_the_same_hks_on_surface_and_chart(tmp_path, drawn, monkeypatch):
    fig = draw("figure1", tmp_path, drawn, monkeypatch, size=(100, 60), time=4.0)
    assert [ax.name for ax in fig.axes[:4]] == ["3d", "3d", "rectilinear", "rectilinear"]
    surface = bumpy_torus_mesh(20)
    for ax in fig.axes[:2]:
        assert len(ax.collections[0].get_facecolor()) == len(surface.faces)
    assert len(fig.axes[2].collections[0].get_offsets()) > 400
    on_chart = fig.axes[3].images[0].get_array()
    (on_surface,) = signature(bumpy_torus_mesh(100), [4.0], 60)
    np.testing.assert_allclose(on_chart.T, on_surface.reshape(100, 100), rtol=0.05)


@pytest.mark.slow
def test_figure_2_shows_the_boundary_and_its_removal(tmp_path, drawn, monkeypatch):
    fig = draw("figure2", tmp_path, drawn, monkeypatch, size=31)
    assert [len(ax.images) for ax in fig.axes] == [1, 1, 1, 1, 0] * 2
    assert [line.get_label() for line in fig.axes[4].lines] == ["natural", "strip", "mirror", "expansion"]
    natural, before, strip, mirror = (fig.axes[i].images[0].get_array() for i in range(4))
    # The reflected strip, 9 nodes wide, is cropped to the same nodes; the dashed square shows which.
    assert before.shape == (49, 49)
    assert fig.axes[1].patches[0].get_bbox().bounds == (0, 0, 1, 1)
    assert before.max() == pytest.approx(4, rel=0.05)
    np.testing.assert_allclose(before[9:-9, 9:-9], strip)
    assert natural.max() == pytest.approx(4, rel=0.05)  # a corner
    assert natural[0, 15] == pytest.approx(2, rel=0.05)  # a side
    np.testing.assert_allclose(mirror, 1.0, rtol=0.02)
    np.testing.assert_allclose(strip, mirror, rtol=0.01)
    curved_strip, curved_mirror = (fig.axes[i].images[0].get_array() for i in (7, 8))
    np.testing.assert_allclose(curved_strip, curved_mirror, rtol=0.01)
    assert np.ptp(curved_mirror) > 0.05


@pytest.mark.slow
def test_figures_3_and_4_see_which_fields_are_flat(tmp_path, drawn, monkeypatch):
    fig = draw("figure3", tmp_path, drawn, monkeypatch)
    assert [len(ax.collections) for ax in fig.axes] == [1] * 4 + [0] * 4
    assert [len(ax.images) for ax in fig.axes] == [0] * 4 + [1] * 4
    one_colour_range([ax.images[0] for ax in fig.axes[4:]])
    spread = [float(np.ptp(ax.images[0].get_array())) for ax in fig.axes[4:]]
    assert spread[0] < 0.02
    assert min(spread[1:]) > 0.1
    fig = draw("figure4", tmp_path, drawn, monkeypatch)
    assert len(fig.axes) == 2 * len(figure4_fields(5)) == 10
    for top, bottom in zip(fig.axes[:5], fig.axes[5:], strict=True):
        assert [len(lines.get_segments()) > 5 for lines in top.collections] == [True, True]
        assert len(bottom.collections[0].get_segments()) > 5
    spread = [float(np.ptp(ax.images[0].get_array())) for ax in fig.axes[5:]]
    assert max(spread[:3]) < 0.1 * min(spread[3:])  # straight, circles and spirals; waves and cells


@pytest.mark.slow
def test_figure_5_has_the_symmetries_of_its_fields(tmp_path, drawn, monkeypatch):
    fig = draw("figure5", tmp_path, drawn, monkeypatch, size=31)
    *panels, bar = fig.axes
    titles = [ax.get_title() for ax in panels]
    assert titles == [f"index {i}" for i in ("−2", "−3/2", "−1", "−1/2", "1/2", "1", "3/2", "2", "5/2", "3")]
    assert all(len(ax.collections[0].get_segments()) > 10 for ax in panels)
    assert "HKS" in bar.get_ylabel()
    one_colour_range([ax.images[0] for ax in panels])
    images = {title: ax.images[0].get_array().T for title, ax in zip(titles, panels, strict=True)}
    # The field of index i is the same after a turn by 2π/|2i − 2|; those of a quarter turn are nodes again.
    for index in ("−1", "3"):
        image = images[f"index {index}"]
        np.testing.assert_allclose(np.rot90(image), image, rtol=1e-3)
    # u₂ → −u₂ only reverses the sign of the angle.
    for image in images.values():
        np.testing.assert_allclose(image[:, ::-1], image, rtol=1e-3)
