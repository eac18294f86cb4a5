"""More pictures: degenerate points, line integral convolution, spectra, rows over t, the boundary's influence."""

import importlib.util
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from annotations import unchecked

import hks_jax as hj
from hks_jax import plot


def axes():
    return plot.new_figure(3, 3).subplots()


# --- degenerate points --------------------------------------------------------------------------------------


def test_marks_lie_on_the_points_and_do_not_overlap():
    rng = np.random.default_rng(0)
    frames = rng.standard_normal((40, 30, 2, 2))
    field = hj.TensorField(hj.Grid((40, 30), (1.0, 2.0)), frames @ np.swapaxes(frames, -1, -2) + np.eye(2))
    found = hj.degenerate_points(field, merge=1)
    assert found.indices.size > 20
    ax = axes()
    marks = plot.degenerate_points(ax, field, merge=1)
    outlines = [path.vertices[:-1] for path in marks.get_paths()]
    centres = np.array([(outline.max(axis=0) + outline.min(axis=0)) / 2 for outline in outlines])
    radii = np.array([np.linalg.norm(o - x, axis=1).max() for o, x in zip(outlines, found.positions, strict=True)])
    assert np.abs(centres - found.positions).max() < radii.max()
    apart = np.linalg.norm(found.positions[:, None] - found.positions, axis=-1)
    apart[np.diag_indices(len(apart))] = np.inf
    assert (radii[:, None] + radii < apart).all()
    # −½ a triangle, ½ a disc, others |2·index| + 2 corners
    corners = {-0.5: 3, 0.5: 32}
    assert [len(o) for o in outlines] == [corners.get(i, round(abs(2 * i)) + 2) for i in found.indices]
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts[0].split()[0].startswith("−")
    assert sum(int(text.split()[1].strip("()")) for text in texts) == found.indices.size
    with pytest.raises(ValueError, match="size: got 0"):
        plot.degenerate_points(ax, field, size=0)


def test_no_points_no_legend():
    ax = axes()
    assert not plot.degenerate_points(ax, hj.examples.figure4_fields(11)["waves"]).get_paths()
    assert ax.get_legend() is None


# --- line integral convolution ------------------------------------------------------------------------------


def correlation(texture, other):
    both = np.isfinite(texture) & np.isfinite(other)
    return np.corrcoef(texture[both], other[both])[0, 1]


@pytest.mark.parametrize(("which", "along"), [("major", 0), ("minor", 1)])
def test_noise_is_smeared_along_the_eigenvector(which, along):
    field = hj.TensorField(hj.Grid((20, 15), (1.0, 2.0)), np.broadcast_to(np.diag([4.0, 1.0]), (20, 15, 2, 2)))
    texture = plot.lic_texture(field, which, pixels=140)
    assert texture.shape == (95, 140)
    shifted = [correlation(np.delete(texture, -1, axis), np.delete(texture, 0, axis)) for axis in (along, 1 - along)]
    assert shifted[0] > 0.9
    assert abs(shifted[1]) < 0.15
    # uniform in (0, 1), also where lines are cut by the sides
    for part in (texture, texture[:4], texture[:, -4:]):
        assert abs(np.mean(part) - 0.5) < 0.12
        assert abs(np.std(part) - 12**-0.5) < 0.06


def test_circles_and_half_integer_points_are_followed_whatever_the_sign():
    ring = plot.lic_texture(hj.examples.degenerate_point_field(1.0, 41), "minor", pixels=200, length=40)
    i, j = np.indices(ring.shape) - 99.5
    band = (np.hypot(i, j) > 30) & (np.hypot(i, j) < 90)
    angle, radius = np.arctan2(j, i), np.hypot(i, j)

    def at(r, a):
        return ring[np.rint(r * np.cos(a) + 99.5).astype(int), np.rint(r * np.sin(a) + 99.5).astype(int)]

    radius, angle = radius[band], angle[band]
    assert correlation(ring[band], at(radius, angle + 8 / radius)) > 0.5
    assert abs(correlation(ring[band], at(radius + 8, angle))) < 0.1
    wedge = plot.lic_texture(hj.examples.degenerate_point_field(0.5, 41), pixels=160)
    # Lines come from the right, turn around the point, and cross its ray to the left.
    right, left = wedge[90:, 77:83], wedge[:70, 77:83]
    assert correlation(right[:-1], right[1:]) > 0.8
    assert correlation(left[:, :-1], left[:, 1:]) > 0.8
    assert np.isfinite(wedge).all()


def test_texture_ends_at_the_mask_and_isotropic_noise_stays():
    mask = hj.Grid((30, 30)).nodes[..., 0] < 15
    field = hj.TensorField(hj.Grid((30, 30), mask=mask), np.broadcast_to(np.eye(2), (30, 30, 2, 2)))
    texture = plot.lic_texture(field, pixels=116)
    inside = (np.arange(116) + 0.5) * 29 / 116 < 14
    np.testing.assert_array_equal(np.isfinite(texture), np.broadcast_to(inside[:, None], texture.shape))
    assert abs(correlation(texture[:, :-1], texture[:, 1:])) < 0.05
    with pytest.raises(ValueError, match="pixels, length: got 1, 25"):
        plot.lic_texture(field, pixels=1)


@pytest.mark.slow
def test_shading_keeps_the_mean_colour_and_the_grain_its_size_on_paper():
    field = hj.examples.figure4_fields(21)["cells"]
    ax = axes()
    texture = plot.line_integral_convolution(ax, field, values=field.grid.nodes[..., 0], label="x")
    scalar, shade = ax.images
    assert shade is texture
    assert scalar.get_clim() == (0.0, 1.0)
    rgba = shade.get_array()
    signed = np.where(rgba[..., 0] > 0, 1, -1) * rgba[..., 3]
    assert abs(signed.mean()) < 0.02
    assert 0.7 < rgba[..., 3].max() <= 0.75
    large = plot.line_integral_convolution(plot.new_figure(6, 6).subplots(), field)
    assert large.get_array().shape[0] == pytest.approx(2 * rgba.shape[0], rel=0.02)
    assert (large.get_array()[..., 3] == 1).all()  # nothing below: opaque
    with pytest.raises(ValueError, match="contrast: got 2"):
        plot.line_integral_convolution(ax, field, contrast=2)
    with unchecked(), pytest.raises(ValueError, match="which: got 'medium'"):
        plot.line_integral_convolution(ax, field, "medium")


# --- spectra, curves, rows, influence -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def square():
    grid = hj.Grid.from_bounds(0, 1, (12, 12))
    field = hj.TensorField(grid, np.broadcast_to(np.eye(2), (12, 12, 2, 2)))
    return field, hj.eigenpairs(field, 30, solver="dense", multiplet="drop")


def test_spectrum_is_the_counting_function(square):
    field, pairs = square
    values = np.asarray(pairs.eigenvalues)[np.asarray(pairs.kept)]
    ax = axes()
    count, law, area = plot.spectrum(ax, pairs, field, unit="1/s")
    x, y = count.get_data()
    np.testing.assert_array_equal(x[1::2], values)
    np.testing.assert_array_equal(y[1::2], np.arange(1, values.size + 1))
    np.testing.assert_array_equal(y[::2], np.arange(values.size))
    t = np.asarray(law.get_xdata())
    np.testing.assert_allclose(law.get_ydata(), (t + 4 * np.sqrt(t)) / (4 * np.pi), rtol=1e-9)
    np.testing.assert_allclose(area.get_ydata(), t / (4 * np.pi), rtol=1e-9)
    assert ax.get_xlabel().endswith(" in 1/s")
    assert len(plot.spectrum(axes(), pairs)) == 2
    count, law, area = plot.spectrum(axes(), pairs, field, remainder=True)
    assert np.abs(count.get_ydata()).max() < 5
    assert np.abs(law.get_ydata()).max() == 0
    assert np.max(area.get_ydata()) <= 0


def test_unresolved_times_are_shaded():
    grid, times = hj.Grid((3, 3)), np.geomspace(0.01, 1, 9)
    values = (1 / times)[:, None, None] * np.ones((9, 3, 3))
    ax = axes()
    plot.hks_curves(ax, values, times, grid, [[1, 1]], limit=0.1, unit="s")
    (span,) = ax.patches
    assert span.get_x() < 0.01
    assert span.get_x() + span.get_width() == pytest.approx(0.1)
    assert ax.get_xlabel() == "$t$ in s"
    assert ax.get_legend().get_texts()[-1].get_text() == "unresolved $t$"
    resolved = axes()
    plot.hks_curves(resolved, values, times, grid, [[1, 1]], limit=0.001)
    assert not resolved.patches


def test_rows_over_time():
    grid = hj.Grid((6, 4), mask=np.indices((6, 4))[0] < 5)
    rng = np.random.default_rng(0)
    rows = {"HKS": rng.random((3, 6, 4)), "trace": 5 + rng.random((3, 6, 4))}
    fig = plot.time_rows(
        rows, [0.1, 1, 10], grid, unit="s", shared_range=True, cmap={"HKS": "viridis", "trace": "cividis"}
    )
    assert len(fig.axes) == 6
    assert [ax.get_title() for ax in fig.axes[:3]] == ["$t$ = 0.1 s", "$t$ = 1 s", "$t$ = 10 s"]
    assert [fig.axes[i].get_ylabel() for i in (0, 3)] == list(rows)
    for i, values in enumerate(rows.values()):
        inside = values[:, :5]
        assert all(ax.images[0].get_clim() == (inside.min(), inside.max()) for ax in fig.axes[3 * i : 3 * i + 3])
        assert fig.axes[3 * i].images[0].get_cmap().name == ("viridis", "cividis")[i]
    own = plot.time_rows(rows, [0.1, 1, 10], grid)
    assert own.axes[1].images[0].get_clim() == (rows["HKS"][1, :5].min(), rows["HKS"][1, :5].max())
    with pytest.raises(ValueError, match=r"rows: HKS: got shape \(3, 6, 4\).*; expected .* \(2, 6, 4\)"):
        plot.time_rows(rows, [0.1, 1], grid)
    with pytest.raises(ValueError, match=r"rows: got \{\}; expected a dictionary"):
        plot.time_rows({}, [0.1], grid)


def test_influence_lines_are_where_the_influence_is():
    grid = hj.Grid.from_bounds(0, 1, (21, 21))
    x = grid.nodes[..., 0]
    ax = axes()
    image = plot.influence_map(ax, x, grid, levels=(0.1, 0.5))
    assert image.get_clim() == (0, 1)
    (lines,) = [c for c in ax.collections if hasattr(c, "levels")]
    for level, path in zip(lines.levels, lines.get_paths(), strict=True):
        np.testing.assert_allclose(path.vertices[:, 0], level, atol=1e-9)
    plot.influence_map(ax, 0 * x, grid)  # no line, no warning


def test_what_is_drawn_over_an_oriented_image_is_oriented_too():
    upwards = plot.Orientation.of(np.array([[0, -1, 0, 20], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), 2)
    grid = hj.Grid((21, 11))
    x, y = np.moveaxis(grid.nodes, -1, 0)
    ax = axes()
    plot.influence_map(ax, x / 20, grid, levels=(0.5,), orientation=upwards)  # x of the array points upwards
    (lines,) = [c for c in ax.collections if hasattr(c, "levels")]
    np.testing.assert_allclose(lines.get_paths()[0].vertices[:, 1], 10)
    direction = np.stack([1 + 0.1 * x, y - 4], axis=-1)
    field = hj.TensorField(grid, np.eye(2) + direction[..., None] * direction[..., None, :])
    turned = hj.TensorField(upwards.grid(grid), upwards.tensors(field.tensors))
    images = [
        plot.line_integral_convolution(axes(), shown, values=shown.tensors[..., 0, 0], **more)
        for shown, more in ((field, {"orientation": upwards}), (turned, {}))
    ]
    assert images[0].get_extent() == images[1].get_extent()
    np.testing.assert_array_equal(*(image.get_array() for image in images))


# --- at any size --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [20, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("inches", "most"), [(1.0, 10), (3.0, 26), (14.0, 26)])
def test_glyphs_are_as_many_as_fit_whatever_the_grid(n, inches, most):
    """Sizes are in coordinates, so that nothing overlaps in any figure; in a small one there are fewer."""
    x = np.linspace(-1, 1, n)
    a, b = np.meshgrid(x, x, indexing="ij")
    tensors = 2 * np.eye(2) + np.stack([np.stack([a, b], -1), np.stack([b, -a], -1)], -1)
    field = hj.TensorField(hj.Grid.from_bounds(-1, 1, (n, n)), tensors)
    ax = plot.new_figure(inches, inches).subplots()
    drawn = plot.ellipses(ax, field)
    assert (0.6 * most) ** 2 <= len(drawn.get_offsets()) <= most**2
    bars = plot.sensitivity(ax, field.grid, tensors)
    assert 2 * (0.6 * most) ** 2 <= len(bars.get_segments()) <= 2 * most**2
    (mark,) = plot.degenerate_points(ax, field).get_paths()
    width = np.ptp(mark.vertices[:, 0])
    assert 0.06 < width < 0.1
    if inches < 14:  # a quarter of a million steps more would show nothing new
        texture = plot.line_integral_convolution(ax, field)
        assert texture.get_array().shape[0] == pytest.approx(max(100, 85 * inches), rel=0.05)
        lines = plot.integral_lines(ax, field, which="minor").get_segments()
        assert 0.2 * most < len(lines) < 4 * most


# --- the gallery --------------------------------------------------------------------------------------------

COMPUTATIONS = {"evenly_spaced_lines", "lic_texture", "middle_node", "number_text", "save_figure", "trace"}


@pytest.fixture(scope="module")
def gallery():
    path = Path(__file__).parents[2] / "docs" / "gallery.py"
    spec = importlib.util.spec_from_file_location("gallery", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_picture_is_in_the_gallery(gallery):
    text = (gallery.HERE / "gallery.md").read_text(encoding="utf-8")
    assert text == gallery.page(), "run: python docs/gallery.py"
    public = {name for name, value in vars(plot).items() if inspect.isfunction(value)}
    assert public > COMPUTATIONS
    # Drawn by volume_panels; a page; hks_panels or slices of a saved result.
    shown = public - COMPUTATIONS - {"orthogonal_slices", "explore", "signature_panels"}
    code = "".join(gallery.code(name) for name in re.findall("<!-- gallery: (.*?) -->", text))
    missing = [name for name in sorted(shown) if f"plot.{name}(" not in code]
    assert missing == []


def test_the_gallerys_pictures_are_there_and_small(gallery):
    pictures = sorted(gallery.PICTURES.iterdir())
    assert [p.stem for p in pictures] == sorted(draw.__name__ for draw in gallery.ENTRIES.values())
    assert sum(p.stat().st_size for p in pictures) < 1.5e6
