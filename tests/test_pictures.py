"""More pictures: degenerate points, line integral convolution, spectra, rows over t, the boundary's influence."""

import numpy as np
import pytest

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
    with pytest.raises(ValueError, match="which: got 'medium'"):
        plot.line_integral_convolution(ax, field, "medium")
