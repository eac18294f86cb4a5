"""The pictures: what is drawn is where, as large and as coloured as the mathematics says."""

from dataclasses import replace

import numpy as np
import pytest
from annotations import unchecked
from matplotlib.backends.backend_agg import FigureCanvasAgg

from hks_jax import Grid, SurfaceMesh, TensorField
from hks_jax.cli import main
from hks_jax.domain.components import bounding_box
from hks_jax.domain.examples import ball_mesh, sphere_mesh
from hks_jax.io import Result, TensorVolume
from hks_jax.plot import (
    ellipses,
    evenly_spaced_lines,
    hks_curves,
    hks_panels,
    integral_lines,
    new_figure,
    save_figure,
    scalar_image,
    sensitivity,
    signature_panels,
    surface,
    time_rows,
    trace,
)
from hks_jax.plot.glyphs import FILL
from hks_jax.plot.modes import modes_panels
from hks_jax.plot.signature import away_from_rim, caption, middle_slice, quantity


def rotating_field(index, n=81, centre=(0.0, 0.0), mask=None):
    """A degenerate point of the given index: eigenvalues 2 ± |x|/3, major direction index·θ."""
    grid = Grid.from_bounds(-1, 1, (n, n), mask=mask)
    x, y = np.moveaxis(grid.nodes - np.array(centre), -1, 0)
    angle, size = 2 * index * np.arctan2(y, x), np.hypot(x, y) / 3
    c, s = size * np.cos(angle), size * np.sin(angle)
    return TensorField(grid, np.stack([np.stack([2 + c, s], -1), np.stack([s, 2 - c], -1)], -1))


def disc(n=81, radius=0.8):
    nodes = Grid.from_bounds(-1, 1, (n, n)).nodes
    return np.linalg.norm(nodes, axis=-1) < radius


# --- images -------------------------------------------------------------------------------------------------


def test_scalar_image_puts_axis_0_horizontally_and_masks_the_outside():
    mask = np.ones((7, 5), dtype=bool)
    mask[:2, 0] = False
    grid = Grid((7, 5), (2.0, 1.0), (10.0, 20.0), mask=mask)
    values = grid.nodes[..., 0] + 100 * grid.nodes[..., 1]
    values[3, 3] = np.nan
    ax = new_figure(3, 3).subplots()
    image = scalar_image(ax, values, grid, label="f")
    drawn = image.get_array()
    assert drawn.shape == (5, 7)
    expected_mask = ~mask
    expected_mask[3, 3] = True
    np.testing.assert_array_equal(np.ma.getmaskarray(drawn), expected_mask.T)
    np.testing.assert_allclose(drawn.T.compressed(), values[~expected_mask])
    assert image.get_extent() == [9.0, 23.0, 19.5, 24.5]
    assert image.origin == "lower"
    assert image.cmap.get_bad()[3] == 0  # transparent
    assert ax.get_aspect() == 1
    assert len(ax.figure.axes) == 1
    assert len(ax.child_axes) == 1
    assert ax.child_axes[0].get_ylabel() == "f"


def test_scalar_image_colours_by_quantiles():
    grid = Grid((11, 11))
    values = np.arange(121.0).reshape(11, 11)
    ax = new_figure(3, 3).subplots()
    image = scalar_image(ax, values, grid, quantiles=(0.1, 0.9))
    np.testing.assert_allclose(image.get_clim(), (12.0, 108.0))
    assert image.colorbar.extend == "both"


def test_a_range_about_a_centre_has_no_arrow_at_the_least_value():
    values = np.linspace(0.3, 1.5, 121).reshape(11, 11)
    image = scalar_image(new_figure(3, 3).subplots(), values, Grid((11, 11)), centre=1.0)
    assert values.min() < image.get_clim()[0] == pytest.approx(0.3)  # 1 − (1 − 0.3) > 0.3
    assert image.colorbar.extend == "neither"


def test_a_constant_is_one_colour():
    grid = Grid((9, 9))
    noise = 1e-12 * np.random.default_rng(0).standard_normal((9, 9))
    image = scalar_image(new_figure(3, 3).subplots(), 5 + noise, grid)
    assert np.ptp(image.norm(image.get_array())) < 1e-5


@pytest.mark.parametrize("n", [1, 7, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 12))])
def test_hks_panels_has_one_panel_and_bar_per_time(n, tmp_path):
    grid = Grid((12, 8))
    values = np.random.default_rng(0).random((n, 12, 8))
    path = tmp_path / "new" / "panels.png"
    fig = hks_panels(values, np.geomspace(1e-4, 1e4, n), grid, unit="s", path=path)
    assert len(fig.axes) == n
    assert path.read_bytes()[:4] == b"\x89PNG"
    assert [p.name for p in path.parent.iterdir()] == ["panels.png"]
    for ax, v in zip(fig.axes, values, strict=True):
        assert ax.get_title().startswith("$t$ = ")
        assert ax.get_title().endswith(" s")
        np.testing.assert_allclose(ax.images[0].get_clim(), (v.min(), v.max()))
    renderer = FigureCanvasAgg(fig).get_renderer()
    boxes = [ax.get_tightbbox(renderer) for ax in fig.axes]
    for i, a in enumerate(boxes):
        assert fig.bbox.padded(1).containsx(a.x0)
        assert fig.bbox.padded(1).containsx(a.x1)
        assert not any(a.padded(-1).overlaps(b.padded(-1)) for b in boxes[i + 1 :])


def test_hks_panels_shared_range_and_titles():
    grid = Grid((6, 6))
    values = np.stack([np.full((6, 6), 1.0), np.linspace(2, 3, 36).reshape(6, 6)])
    fig = hks_panels(values, [1.0, 2.0], grid, shared_range=True, titles=["one", "two"], suptitle="both")
    assert [ax.get_title() for ax in fig.axes] == ["one", "two"]
    assert all(ax.images[0].get_clim() == (1.0, 3.0) for ax in fig.axes)


def test_image_errors():
    grid = Grid((6, 5))
    ax = new_figure(2, 2).subplots()
    with pytest.raises(ValueError, match=r"values: got shape \(5, 6\); expected the grid's shape \(6, 5\)"):
        scalar_image(ax, np.zeros((5, 6)), grid)
    with pytest.raises(ValueError, match="no finite value"):
        scalar_image(ax, np.full((6, 5), np.nan), grid)
    with unchecked(), pytest.raises(ValueError, match=r"3 dimensions.*Draw a slice"):
        scalar_image(ax, np.zeros((3, 3, 3)), Grid((3, 3, 3)))
    with unchecked(), pytest.raises(ValueError, match=r"values: got shape \(6, 5\)"):
        hks_panels(np.zeros((6, 5)), [1.0], grid)
    with pytest.raises(ValueError, match=r"titles: got 1 titles; expected 2"):
        hks_panels(np.zeros((2, 6, 5)), [1.0, 2.0], grid, titles=["one"])


def test_save_figure_is_atomic(tmp_path):
    fig = new_figure(2, 2)
    fig.subplots()
    path = save_figure(fig, tmp_path / "f.svg")
    old = path.read_bytes()
    assert b"<svg" in old
    with pytest.raises(ValueError, match=r"path: got .*f.docx.*png"):
        save_figure(fig, tmp_path / "f.docx")

    def fail(*args, **kwargs):
        raise OSError("disk full")

    fig.savefig = fail
    with pytest.raises(OSError, match="disk full"):
        save_figure(fig, path)
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["f.svg"]


# --- ellipses -----------------------------------------------------------------------------------------------


def drawn_ellipses(collection):
    return (
        np.asarray(collection.get_offsets()),
        np.asarray(collection.get_widths()),
        np.asarray(collection.get_heights()),
        np.radians(np.asarray(collection.get_angles())),
    )


@pytest.mark.parametrize("kind", ["metric", "tensor"])
@pytest.mark.parametrize("sizes", ["common", "fit"])
def test_ellipses_have_the_tensors_axes(kind, sizes):
    field = rotating_field(0.5)
    ax = new_figure(3, 3).subplots()
    centres, width, height, angle = drawn_ellipses(ellipses(ax, field, every=8, kind=kind, sizes=sizes))
    nodes = np.rint((centres + 1) / field.grid.spacing).astype(int)
    tensors = np.asarray(field.tensors)[tuple(nodes.T)]
    values, vectors = np.linalg.eigh(tensors)
    np.testing.assert_allclose(width / height, np.sqrt(values[:, 1] / values[:, 0]))
    longer = vectors[..., 0 if kind == "metric" else 1]
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    isotropic = values[:, 1] - values[:, 0] < 1e-9
    np.testing.assert_allclose(np.abs(np.sum(along * longer, axis=1))[~isotropic], 1.0)
    if sizes == "common":
        length = width * np.sqrt(values[:, 0] if kind == "metric" else 1 / values[:, 1])
        np.testing.assert_allclose(length, length[0])


@pytest.mark.parametrize("every", [None, 3, (5, 9)])
@pytest.mark.parametrize("sizes", ["common", "fit"])
def test_ellipses_never_overlap_and_are_centred_in_the_frame(every, sizes):
    rng = np.random.default_rng(1)
    a = rng.standard_normal((50, 37, 2, 2)) * rng.lognormal(size=(50, 37, 1, 1))
    grid = Grid((50, 37), (1.0, 2.0))
    field = TensorField(grid, a @ np.swapaxes(a, -1, -2) + 0.02 * np.eye(2))
    ax = new_figure(3, 3).subplots()
    centres, width, height, angle = drawn_ellipses(ellipses(ax, field, every, sizes=sizes))
    assert len(centres) > 20
    # Dense outlines: no point of one ellipse lies inside another.
    s = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    outline = (
        centres[:, None]
        + 0.5 * width[:, None, None] * np.cos(s)[:, None] * along[:, None]
        + 0.5 * height[:, None, None] * np.sin(s)[:, None] * across[:, None]
    )
    for i in range(len(centres)):
        rest = np.delete(outline, i, axis=0) - centres[i]
        u, v = rest @ along[i] / width[i], rest @ across[i] / height[i]
        assert (u**2 + v**2 > 0.25).all()
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    np.testing.assert_allclose(centres.min(axis=0) - [x0, y0], [x1, y1] - centres.max(axis=0), atol=2.0)


def test_ellipses_respect_the_mask_and_colour():
    field = rotating_field(1, mask=disc())
    ax = new_figure(3, 3).subplots()
    collection = ellipses(ax, field, color="orientation", kind="tensor")
    centres, _, _, angle = drawn_ellipses(collection)
    assert np.linalg.norm(centres, axis=1).max() < 0.8
    np.testing.assert_allclose(collection.get_array(), np.degrees(angle), atol=1e-9)
    plain = ellipses(new_figure(3, 3).subplots(), field, color="tab:red")
    assert plain.get_array() is None
    anisotropy = ellipses(new_figure(3, 3).subplots(), field).get_array()
    assert anisotropy.min() >= 0
    assert anisotropy.max() <= 0.8 / 6 + 1e-12


def test_ellipse_errors():
    field = rotating_field(1, n=9)
    ax = new_figure(2, 2).subplots()
    with unchecked(), pytest.raises(ValueError, match=r'kind: got "?\'?glyph'):
        ellipses(ax, field, kind="glyph")
    with unchecked(), pytest.raises(ValueError, match="sizes: got 'big'"):
        ellipses(ax, field, sizes="big")
    with pytest.raises(ValueError, match=r"every: got 0; expected one positive integer"):
        ellipses(ax, field, every=0)


# --- integral lines -----------------------------------------------------------------------------------------


def test_lines_of_a_circular_field_are_circles():
    field = rotating_field(1, n=101)  # major: radial, minor: circular
    seeds = np.array([[0.3, 0.0], [0.0, 0.6], [-0.5, 0.5]])
    for seed, line in zip(seeds, trace(field, seeds, "minor", max_length=8.0), strict=True):
        radius = np.linalg.norm(line, axis=1)
        assert len(line) > 200
        assert np.abs(radius - np.linalg.norm(seed)).max() < 1e-3
        turned = np.abs(np.diff(np.unwrap(np.arctan2(line[:, 1], line[:, 0])))).sum()
        assert turned > 2 * np.pi


def test_tracing_converges_with_the_grid():
    seed = np.array([[0.45, 0.2]])
    drift = []
    for n in (21, 41, 81):
        (line,) = trace(rotating_field(1, n=n, centre=(0.013, 0.007)), seed, "minor", max_length=4.0, step=0.02)
        radius = np.linalg.norm(line - [0.013, 0.007], axis=1)
        drift.append(np.ptp(radius))
    assert drift[0] / drift[1] > 3
    assert drift[1] / drift[2] > 3


def test_radial_lines_end_at_the_side_and_near_the_degenerate_point():
    field = rotating_field(1, n=101)
    (line,) = trace(field, np.array([[0.4, 0.2]]), "major")
    np.testing.assert_allclose(line[:, 1] / line[:, 0], 0.5, atol=5e-3)
    inner, outer = np.sort(np.abs(line[[0, -1], 0]))
    assert inner < 0.03
    assert outer > 0.98


def test_half_integer_points_have_no_consistent_sign_but_lines_pass():
    """A wedge (index ½) turns lines around it: they come from the right and go back there."""
    (line,) = trace(rotating_field(0.5, n=101), np.array([[-0.3, 0.0]]), "major")
    assert line[0, 0] > 0.5
    assert line[-1, 0] > 0.5
    assert line[0, 1] * line[-1, 1] < 0
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.01, rtol=0.02)


def test_lines_stay_inside_the_mask():
    field = rotating_field(0.5, mask=disc())
    lines = evenly_spaced_lines(field, separation=0.1)
    assert max(np.linalg.norm(line, axis=1).max() for line in lines) < 0.8
    (outside,) = trace(field, np.array([[0.95, 0.95]]))
    assert outside.shape == (0, 2)


@pytest.mark.parametrize("index", [-1.5, *(pytest.param(i, marks=pytest.mark.slow) for i in (0.5, 1, 2))])
@pytest.mark.parametrize("which", ["major", pytest.param("minor", marks=pytest.mark.slow)])
def test_evenly_spaced_lines_cover_and_keep_their_distance(index, which):
    field, separation = rotating_field(index), 0.12
    lines = evenly_spaced_lines(field, which, separation=separation)
    points = np.concatenate(lines)
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    apart = np.linalg.norm(points[:, None, :] - points[None, ::3, :], axis=-1)
    apart[owner[:, None] == owner[None, ::3]] = np.inf
    assert apart.min() >= separation / 2 * 0.999
    probes = np.random.default_rng(0).uniform(-0.95, 0.95, (500, 2))
    nearest = np.linalg.norm(probes[:, None] - points[None], axis=-1).min(axis=1)
    assert np.quantile(nearest, 0.95) < separation


def test_circles_close():
    lines = evenly_spaced_lines(rotating_field(1, n=41), "minor", separation=0.15)
    full = [line for line in lines if np.linalg.norm(line, axis=1).max() < 0.97]
    closed = [line for line in full if np.array_equal(line[0], line[-1])]
    assert len(closed) >= 4
    assert len(closed) >= 0.8 * len(full)


@pytest.mark.slow
def test_integral_lines_draws_on_the_axes_it_is_given():
    field = rotating_field(0.5, n=41)
    ax = new_figure(3, 3).subplots()
    sparse = integral_lines(ax, field, density=0.5, colors="white")
    dense = integral_lines(ax, field, "minor", density=1.5, linewidths=0.3)
    seeded = integral_lines(ax, field, seeds=np.array([[0.5, 0.5], [5.0, 5.0]]))
    assert list(ax.collections) == [sparse, dense, seeded]
    assert len(dense.get_segments()) > 1.5 * len(sparse.get_segments()) > 0
    assert len(seeded.get_segments()) == 1
    with unchecked(), pytest.raises(ValueError, match='which: got \'medium\'; expected "major" or "minor"'):
        integral_lines(ax, field, "medium")
    with pytest.raises(ValueError, match=r"density: got 0"):
        integral_lines(ax, field, density=0)
    with unchecked(), pytest.raises(ValueError, match=r"seeds: got shape \(3,\)"):
        trace(field, np.zeros(3))
    with pytest.raises(ValueError, match=r"separation: got -1"):
        evenly_spaced_lines(field, separation=-1)


# --- curves and surfaces ------------------------------------------------------------------------------------


def test_hks_curves_are_the_values_at_the_nodes():
    grid = Grid((5, 4), 0.5)
    times = np.array([0.1, 1.0, 10.0])
    values = np.random.default_rng(0).random((3, 5, 4)) + 1
    ax = new_figure(3, 3).subplots()
    lines = hks_curves(ax, values, times, grid, [[0.5, 0.6], [2.0, 1.5]], expansion=2 * values)
    np.testing.assert_allclose(lines[0].get_ydata(), values[:, 1, 1])
    np.testing.assert_allclose(lines[1].get_ydata(), values[:, 4, 3])
    assert len(ax.lines) == 4
    np.testing.assert_allclose(ax.lines[2].get_ydata(), 2 * values[:, 1, 1])
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["(0.5, 0.5)", "(2, 1.5)", "expansion"]
    assert ax.get_xscale() == ax.get_yscale() == "log"
    few = new_figure(3, 3).subplots()
    scaled = hks_curves(few, values, times, grid, [[0, 0]], scaled=True, labels=["a"])
    assert len([label for label in few.get_xticklabels("both") if label.get_text()]) <= 3  # more labels would overlap
    np.testing.assert_allclose(scaled[0].get_ydata(), 4 * np.pi * times * values[:, 0, 0])


def test_hks_curves_errors():
    grid = Grid((5, 4))
    ax = new_figure(3, 3).subplots()
    with pytest.raises(ValueError, match=r"values: got shape \(2, 5, 4\) .*; expected .* \(1, 5, 4\)"):
        hks_curves(ax, np.zeros((2, 5, 4)), [1.0], grid, [[0, 0]])
    with pytest.raises(ValueError, match=r"points: got \(9.0, 0.0\) outside"):
        hks_curves(ax, np.ones((1, 5, 4)), [1.0], grid, [[9, 0]])
    with (
        unchecked(),
        pytest.raises(ValueError, match=r"expansion: got shape \(2, 5, 4\) .*; expected .* \(1, 5, 4\)"),
    ):
        hks_curves(ax, np.ones((1, 5, 4)), [1.0], grid, [[0, 0]], expansion=np.ones((2, 5, 4)))
    with unchecked(), pytest.raises(ValueError, match=r"points: got shape \(2,\)"):
        hks_curves(ax, np.ones((1, 5, 4)), [1.0], grid, [0, 0])


def test_surface_colours_triangles_by_their_vertices():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    values = np.array([0.0, 1.0, 2.0, 3.0])
    ax = new_figure(3, 3).add_subplot(projection="3d")
    mappable = surface(ax, SurfaceMesh(vertices, faces), values, relief=0.0)
    (collection,) = ax.collections
    expected = mappable.to_rgba(values[faces].mean(axis=1))
    # The collection keeps its triangles sorted by depth.
    np.testing.assert_allclose(np.sort(collection.get_facecolor(), axis=0), np.sort(expected, axis=0))
    assert mappable.get_clim() == (0.0, 3.0)
    with pytest.raises(ValueError, match=r"values: got shape \(3,\); expected \(4,\)"):
        surface(ax, SurfaceMesh(vertices, faces), values[:3])
    # Vertices outside a mask have neither values nor, perhaps, coordinates.
    part = SurfaceMesh(
        np.append(vertices, [[np.nan] * 3], axis=0), np.append(faces, [[0, 1, 4]], axis=0), mask=[True] * 4 + [False]
    )
    ax = new_figure(3, 3).add_subplot(projection="3d")
    assert surface(ax, part, np.append(values, np.nan)).get_clim() == (0.0, 3.0)
    assert np.isfinite(ax.get_xlim()).all()


def test_a_solid_is_drawn_by_its_boundary():
    ball = ball_mesh(2)
    values = np.asarray(ball.vertices)[:, 0] + 5.0 * (np.linalg.norm(ball.vertices, axis=1) < 0.9)
    boundary, numbers = ball.boundary()
    axes = [new_figure(3, 3).add_subplot(projection="3d") for _ in range(2)]
    of_solid, of_surface = surface(axes[0], ball, values), surface(axes[1], boundary, values[numbers])
    assert of_solid.get_clim() == of_surface.get_clim() == (-1.0, 1.0)
    assert len(axes[0].collections[0].get_facecolor()) == 80
    np.testing.assert_array_equal(*(np.sort(ax.collections[0].get_facecolor(), axis=0) for ax in axes))
    with pytest.raises(ValueError, match=r"values: got shape \(42,\); expected \(55,\)"):
        surface(axes[0], ball, values[numbers])


# --- sensitivity --------------------------------------------------------------------------------------------


def test_sensitivity_draws_the_eigenvectors_of_either_sign():
    grid = Grid((6, 6), 0.5)
    gradient = np.zeros((6, 6, 2, 2))
    gradient[2, 3] = [[4.0, 0.0], [0.0, -1.0]]
    gradient[4, 4] = [[0.0, 1.0], [1.0, 0.0]]  # ±1 along the diagonals
    ax = new_figure(3, 3).subplots()
    bars = sensitivity(ax, grid, gradient, every=1)
    segments, colours = np.array(bars.get_segments()), bars.get_colors()
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    longest = np.argmax(lengths)
    half = 0.25 * FILL  # of a cell
    assert lengths[longest] == pytest.approx(2 * half)
    np.testing.assert_allclose(np.sort(segments[longest], axis=0), [[1 - half, 1.5], [1 + half, 1.5]])
    crossing = np.flatnonzero(np.isclose(lengths, half) & np.isclose(segments.mean(axis=1), [1.0, 1.5]).all(axis=1))
    assert len(crossing) == 1
    assert not np.allclose(colours[longest], colours[crossing[0]])
    diagonal = np.flatnonzero(np.isclose(segments.mean(axis=1), [2.0, 2.0]).all(axis=1))
    np.testing.assert_allclose(lengths[diagonal], half)
    rising = np.prod(segments[diagonal, 1] - segments[diagonal, 0], axis=1) > 0
    np.testing.assert_array_equal(colours[diagonal][rising][0], colours[longest])  # both positive
    np.testing.assert_array_equal(colours[diagonal][~rising][0], colours[crossing[0]])  # both negative


def test_sensitivity_refuses_what_it_cannot_draw():
    ax = new_figure(3, 3).subplots()
    with pytest.raises(ValueError, match=r"gradient: got shape \(6, 6\); expected \(6, 6, 2, 2\)"):
        sensitivity(ax, Grid((6, 6)), np.zeros((6, 6)))
    with pytest.raises(ValueError, match="gradient: got NaN or infinite tensors"):
        sensitivity(ax, Grid((6, 6)), np.full((6, 6, 2, 2), np.nan), every=1)


def test_colours_reach_as_far_above_their_centre_as_below():
    grid = Grid((2, 3))
    values = np.array([[0.9, 1.0, 1.1], [1.0, 1.4, np.nan]])
    ax = new_figure(3, 3).subplots()
    image = scalar_image(ax, values, grid, centre=1.0)
    assert image.get_clim() == pytest.approx((0.6, 1.4))
    assert image.get_cmap().name == "RdBu_r"
    image = scalar_image(ax, values, grid, centre=1.0, vmax=1.2, cmap="viridis")
    assert image.get_clim() == pytest.approx((0.6, 1.2))
    assert image.get_cmap().name == "viridis"
    figure = hks_panels(np.stack([values, 1 + 2 * (values - 1)]), [1.0, 2.0], grid, centre=1.0, shared_range=True)
    assert figure.axes[0].images[0].get_clim() == pytest.approx((0.2, 1.8))


def test_what_noise_could_make_fades_into_grey():
    grid = Grid((3, 2))
    values, z = np.arange(6.0).reshape(3, 2), np.array([[0.0, -1.0], [2.0, 5.0], [np.nan, -3.0]])
    figure = hks_panels(values[None], [1.0], grid, z=z[None])
    grey = np.asarray(figure.axes[0].images[1].get_array())
    assert grey.shape == (2, 3, 4)
    np.testing.assert_allclose(grey[..., 3].T, [[1, 0.5], [0, 0], [0, 0]])
    place = TensorVolume(np.broadcast_to(np.eye(2), (3, 2, 2, 2)), grid.spacing, grid.origin)
    figure = signature_panels(Result(place, values[None], np.array([1.0]), arrays={"z": z[None]}))
    assert "noise alone leaves 5 % of the nodes without grey" in figure.get_suptitle()
    assert "40 % without grey" in figure.axes[0].get_title()


def test_pictures_are_cropped_and_coloured_away_from_the_rim():
    inside = np.zeros((40, 40), bool)
    inside[5:35, 1:38] = True
    assert bounding_box(inside) == (slice(3, 37), slice(0, 40))
    assert not away_from_rim(inside)[5:10].any()
    assert away_from_rim(inside)[10:30, 6:33].all()
    flat = away_from_rim(inside[4:12])  # seven nodes wide: what leaves a third of them
    assert inside.sum() > 3 * 7 > flat.sum() / 37 > 7 / 3
    assert not flat[[1, 7]].any()
    np.testing.assert_array_equal(away_from_rim(inside[4:7]), inside[4:7])  # too thin: all of it
    solid = np.zeros((30, 30, 9), bool)
    solid[4:26, 4:26, 1:8] = True
    assert bounding_box(solid, 1) == (slice(3, 27), slice(3, 27), slice(0, 9))
    deep = away_from_rim(solid)
    assert deep.sum() > solid.sum() / 3
    assert not deep[..., 1].any()


def test_labels_of_ficks_signature_have_its_factor_and_its_unit():
    place = TensorVolume(np.broadcast_to(np.eye(2), (6, 5, 2, 2)), (1.0, 1.0), (0.0, 0.0), length_unit="mm")

    def labels(normalisation):
        report = {"settings": {"operator": "fick", "normalisation": normalisation}}
        result = Result(place, np.ones((1, 6, 5)), np.array([2.0]), report=report)
        return quantity(result), caption(result)

    assert labels("raw") == ("HKS in 1/mm$^2$", r"HKS in units of $\mathrm{length}^{-2}$, Fick's operator")
    assert labels("flat")[0] == r"$4\pi t\sqrt{|D|}\,$·HKS"


def test_the_middle_slice_of_a_domain_with_a_gap_is_one_of_its_slices():
    inside = np.zeros((4, 4, 8), bool)
    inside[..., [0, 1, 6, 7]] = True
    volume = TensorVolume(np.broadcast_to(np.eye(3), (4, 4, 8, 3, 3)), (1.0,) * 3, (0.0,) * 3, mask=inside)
    plane, cut = middle_slice(volume, inside)
    assert plane.mask is not None
    assert plane.mask.all()
    assert cut(inside).all()


@pytest.mark.parametrize(
    ("normalisation", "title"),
    [("raw", "HKS in units of $t^{-1}$"), ("flat", r"$4\pi t$·HKS, which is 1 for flat space")],
)
def test_pictures_of_a_signature_name_it_and_the_distance_of_diffusion(normalisation, title):
    place = TensorVolume(np.broadcast_to(2 * np.eye(2), (6, 5, 2, 2)), (1.0, 1.0), (0.0, 0.0))
    place = replace(place, length_unit="mm", unit="mm²/s")
    report = {"settings": {"metric": "inverse", "normalisation": normalisation}}
    values = np.stack([np.linspace(0.9, 1.1, 30).reshape(6, 5)] * 2)
    figure = signature_panels(Result(place, values, np.array([2.0, 8.0]), report=report))
    assert figure.get_suptitle().startswith(f"{title}, metric D⁻¹\nD = 2 mm²/s, the median in-plane mean diffusivity")
    titles = [ax.get_title() for ax in figure.axes]
    known = "in-plane mean diffusivity\nin $10^{-3}$ mm²/s"
    assert titles == ["$t$ = 2 s\n$\\sqrt{Dt}$ = 2 mm", "$t$ = 8 s\n$\\sqrt{Dt}$ = 4 mm", known]
    # The anatomy is grey and has the mean eigenvalues; axes have their unit, colour bars their quantity.
    anatomy = figure.axes[2].images[0]
    assert anatomy.get_cmap().name == "gray"
    np.testing.assert_allclose(anatomy.get_array(), 2000.0)
    assert [ax.get_xlabel() for ax in figure.axes] == ["mm"] * 3
    assert [ax.get_ylabel() for ax in figure.axes] == ["mm", "", ""]
    bars = [ax.child_axes[0].get_ylabel() for ax in figure.axes]
    assert bars == [*[{"raw": "HKS in 1/s", "flat": r"$4\pi t$·HKS"}[normalisation]] * 2, ""]
    # The title has the share of the values that the arrows stand for.
    low, high = figure.axes[0].images[0].get_clim()
    beyond = 100 * np.mean((values[0] < low) | (values[0] > high))
    assert beyond > 10
    assert f"arrows: up to {beyond:.2g} % of the values are beyond the colours" in figure.get_suptitle()


@pytest.mark.parametrize("shape", [(16, 14), (10, 9, 6)])
@pytest.mark.parametrize("normalisation", ["flat", "raw"])
def test_slices_and_volumes_have_the_colours_of_one_rule(shape, normalisation, tmp_path, monkeypatch):
    d, times = len(shape), np.array([2.0, 3.0])
    rng, scale = np.random.default_rng(0), (4 * np.pi * times) ** (len(shape) / 2)
    near = np.zeros((2, *shape))
    near[:, 6:] = 1.0  # the boundary raises the values on more than a third of the nodes
    flat = rng.uniform(0.9, 1.2, (2, *shape)) * np.where(near > 0, 4.0, 1.0)
    values = flat / scale.reshape(2, *[1] * d) if normalisation == "raw" else flat
    place = TensorVolume(np.broadcast_to(np.eye(d), (*shape, d, d)), (1.0,) * d, (0.0,) * d)
    report = {"settings": {"normalisation": normalisation, "metric": "tensor"}}
    Result(place, values, times, report=report, arrays={"influence": near}).save(tmp_path / "hks", ".npz")
    drawn = []
    monkeypatch.setattr("hks_jax.plot.save_figure", lambda figure, *_, **__: drawn.append(figure))
    assert main(["plot", str(tmp_path / "hks.npz"), "-o", str(tmp_path / "x.png"), "--scaled", "-q"]) == 0
    report, arrays = {"settings": {"normalisation": "flat"}}, {"influence": near}
    own = signature_panels(Result(place, flat, times, report=report, arrays=arrays))
    for figure in (drawn[0], own):
        image = figure.axes[0].images[0]
        assert image.get_cmap().name == "RdBu_r"
        low, high = image.get_clim()
        assert low + high == pytest.approx(2.0)
        assert 1.19 < high < 1.201


def test_a_surface_is_seen_from_two_sides_in_the_colours_of_all_pictures():
    mesh = sphere_mesh(2)
    values = 1 + 0.2 * np.asarray(mesh.vertices)[:, 2]
    report = {"settings": {"normalisation": "flat"}}
    figure = signature_panels(Result(mesh, values[None], np.array([0.25]), report=report))
    front, back = (ax for ax in figure.axes if hasattr(ax, "elev"))
    assert (front.elev, front.azim % 360) == (-back.elev, (back.azim + 180) % 360)
    assert front.get_title() == "$t$ = 0.25\n$\\sqrt{t}$ = 0.5"
    (bar,) = (ax for ax in figure.axes if not hasattr(ax, "elev"))
    assert bar.get_ylabel() == r"$4\pi t$·HKS"
    assert sum(bar.get_ylim()) == pytest.approx(2.0)  # about 1, for a flat metric


def test_masked_values_stay_hidden_and_rules_without_meaning_are_refused():
    grid, times = Grid((3, 2)), [0.5, 2.0]
    values = np.ma.array(np.arange(12.0).reshape(2, 3, 2), mask=np.arange(12).reshape(2, 3, 2) % 6 == 5)
    values.data[values.mask] = 1e6
    with unchecked():
        figures = hks_panels(values, times, grid, unit=None), time_rows({"HKS": values}, times, grid)
    for figure in figures:
        assert [ax.images[0].get_clim() for ax in figure.axes[:2]] == [(0, 4), (6, 10)]
        assert [ax.get_title() for ax in figure.axes[:2]] == ["$t$ = 0.5", "$t$ = 2"]
    for rules, message in (
        ({"quantiles": (0.9, 0.1)}, "quantiles: got"),
        ({"vmin": np.nan}, "vmin: got nan"),
        ({"centre": "1"}, "centre: got"),
        ({"z": np.zeros((3, 3, 2))}, r"z: got shape \(3, 3, 2\)"),
        ({"limits": (0, 1)}, r"limits: got shape \(2,\); expected \(2, 2\)"),
    ):
        with unchecked(), pytest.raises(ValueError, match=f"^{message}"):
            hks_panels(values.filled(1.0), times, grid, **rules)
    with unchecked(), pytest.raises(ValueError, match="values: got complex numbers"):
        hks_panels(values.filled(1.0) + 1j, times, grid)


def test_a_curve_of_one_time_is_a_mark():
    grid = Grid((3, 3))
    ax = new_figure(3, 3).subplots()
    (line,) = hks_curves(ax, np.ones((1, 3, 3)), [0.5], grid, [(1, 1)])
    assert line.get_marker() == "o"
    with pytest.raises(ValueError, match="labels: got 2 labels; expected 1"):
        hks_curves(ax, np.ones((1, 3, 3)), [0.5], grid, [(1, 1)], labels=["A", "B"])


@pytest.mark.parametrize("mesh", [False, True])
def test_the_figure_of_modes(mesh):
    """The energies are drawn at their wavelengths, without that of the mean, and a map has the colours of the whole."""
    if mesh:
        place = sphere_mesh(2)
        modes = np.random.default_rng(0).normal(size=(9, len(place.vertices)))
    else:
        inside = np.hypot(*(np.indices((14, 12)) - 6.0)) < 5.5
        place = TensorVolume(np.tile(np.eye(2), (14, 12, 1, 1)), (2.0, 2.0), (0.0, 0.0), mask=inside)
        modes = np.where(inside, np.random.default_rng(0).normal(size=(9, 14, 12)), np.nan)
    wavelength = np.array([np.inf, 40, 40, 30, 25, 20, 18, 16, 15.0])
    energy, explained = 10.0 ** (-0.9 * np.arange(9)), np.linspace(0, 0.8, 9)
    style = {"energy": energy, "explained": explained, "counts": [2, 9], "unit": "mm"}
    figure = modes_panels(place, modes, wavelength, maps={"2 modes": modes[0], "map": modes[1]}, **style)
    energies, shares, *panels = [ax for ax in figure.axes if ax.get_title() or ax.get_xlabel()]
    (dots,) = energies.get_lines()
    np.testing.assert_allclose(dots.get_xdata(), wavelength[1:8])  # without the mean, and energies below 1e-6
    np.testing.assert_allclose(dots.get_ydata(), energy[1:8])
    assert energies.get_xlabel() == "wavelength in mm"
    np.testing.assert_allclose(shares.get_lines()[1].get_xydata(), [[2, 0.1], [9, 0.8]])
    titles = ["mode 2: 40 mm", "mode 3: 40 mm", "mode 5: 25 mm", "mode 9: 15 mm", "2 modes", "map"]
    assert [ax.get_title() for ax in panels] == titles
    if not mesh:
        first, second = (ax.get_images()[0].get_clim() for ax in panels[-2:])
        assert first == second == pytest.approx(np.nanquantile(modes[1], [0.01, 0.99]))
    assert len(modes_panels(place, modes, np.full(9, np.inf)).axes) == 0
