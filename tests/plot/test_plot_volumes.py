"""Pictures of volumes: the right slice in the right place, one range of colours for the three."""

import numpy as np
import pytest
from annotations import unchecked
from matplotlib.backends.backend_agg import FigureCanvasAgg

from hks_jax import Grid
from hks_jax.plot import middle_node, new_figure, orthogonal_slices, volume_panels

GRID = Grid((5, 6, 7), (1.0, 2.0, 0.5), (10.0, 20.0, 30.0))


def ramp():
    """Values that tell every node apart: 100 i + 10 j + k."""
    return np.add.reduce(
        np.meshgrid(*[s * np.arange(n) for s, n in zip((100, 10, 1), GRID.shape, strict=True)], indexing="ij")
    )


def test_slices_run_through_the_node_with_the_grids_aspect():
    axes = new_figure(3, 6).subplots(3)
    orthogonal_slices(axes, ramp(), GRID, node=(1, 2, 3))
    images = [ax.images[0] for ax in axes]
    np.testing.assert_array_equal(images[0].get_array(), ramp()[:, :, 3].T)
    np.testing.assert_array_equal(images[1].get_array(), ramp()[:, 2, :].T)
    np.testing.assert_array_equal(images[2].get_array(), ramp()[1].T)
    assert images[0].get_extent() == [9.5, 14.5, 19.0, 31.0]
    assert images[2].get_extent() == [19.0, 31.0, 29.75, 33.25]
    assert {image.get_clim() for image in images} == {(0.0, ramp().max())}
    assert all(ax.get_aspect() == 1 for ax in axes)
    # The lines: x = 11, y = 24, z = 31.5.
    places = [
        [line.get_xdata()[0] for line in ax.lines[:1]] + [line.get_ydata()[0] for line in ax.lines[1:]] for ax in axes
    ]
    assert places == [[11, 24], [11, 31.5], [24, 31.5]]


def test_colours_span_the_whole_volume_and_outside_is_left_out():
    mask = np.ones(GRID.shape, bool)
    mask[:2] = False
    values = np.where(mask, ramp(), np.nan)
    grid = Grid(GRID.shape, GRID.spacing, GRID.origin, mask)
    axes = new_figure(3, 6).subplots(3)
    image = orthogonal_slices(axes, values, grid, cross=False)
    assert image.get_clim() == (200, ramp().max())
    assert not axes[0].lines
    assert axes[0].images[0].get_array().mask[:, :2].all()
    assert middle_node(mask) == (3, 2, 3)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "shape"), [(1, (1, 1)), (7, (2, 4))])
def test_one_column_of_slices_and_one_bar_per_time(n, shape, tmp_path):
    values = ramp()[None] + 1000 * np.arange(n)[:, None, None, None]
    figure = volume_panels(
        values, np.arange(1, n + 1), GRID, unit="s", length_unit="mm", label="HKS", path=tmp_path / "v.png"
    )
    assert (tmp_path / "v.png").stat().st_size > 1000
    assert len(figure.subfigs) == shape[0]
    assert len(figure.subfigs[0].axes) == 4 * shape[1]
    assert len(figure.axes) == 4 * n
    top = [ax for ax in figure.axes if ax.get_title()]
    assert [ax.get_title() for ax in top] == [f"$t$ = {t} s" for t in range(1, n + 1)]
    assert [ax.images[0].get_clim()[0] for ax in top] == [1000 * i for i in range(n)]
    assert top[0].get_ylabel() == "z = 31.5 mm\ny (mm)"
    # Nothing is clipped, and no axes overlap.
    FigureCanvasAgg(figure).draw()
    boxes = [ax.get_tightbbox().padded(-2) for ax in figure.axes]
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y0 >= 0 for box in boxes)
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_limits_are_those_given_and_bars_show_what_lies_beyond():
    figure = volume_panels(ramp()[None], [1.0], GRID, limits=[(50, 300)], titles=["a"], suptitle="b")
    assert figure.axes[0].images[0].get_clim() == (50, 300)
    assert figure.axes[3].get_xlim() == (50, 300)


def test_noise_fades_in_the_slices_that_have_it():
    z = np.full(GRID.shape, 9.0)
    z[1, 2, 3] = 1.0  # half of what counts as signal
    figure = volume_panels(ramp()[None], [1.0], GRID, node=(1, 2, 3), z=z[None])
    for ax, (i, j) in zip(figure.axes[:3], ((1, 2), (1, 3), (2, 3)), strict=True):
        opacity = np.asarray(ax.images[1].get_array())[..., 3]
        assert (opacity[j, i], opacity.sum()) == (0.5, 0.5)


def test_slices_run_through_the_nearest_node_with_a_value():
    holed = ramp().astype(float)
    holed[:, :, 3:] = np.nan
    axes = new_figure(3, 6).subplots(3)
    orthogonal_slices(axes, holed, GRID, node=(1, 2, 9))
    assert axes[1].lines[1].get_ydata()[0] == 31  # k = 2


def test_errors():
    with unchecked(), pytest.raises(ValueError, match=r"grid: got shape .* three dimensions"):
        volume_panels(np.zeros((1, 3, 3)), [1.0], Grid((3, 3)))
    with unchecked(), pytest.raises(ValueError, match=r"values: got shape .* expected \(n_times, \*shape\)"):
        volume_panels(ramp(), [1.0], GRID)
    with pytest.raises(ValueError, match=r"limits: got shape \(2, 2\); expected \(1, 2\)"):
        volume_panels(ramp()[None], [1.0], GRID, limits=[(0, 1)] * 2)
    with pytest.raises(ValueError, match="axes: got 1 axes; expected 3"):
        orthogonal_slices(new_figure(3, 3).subplots(1, 1, squeeze=False)[0], ramp(), GRID)
    with pytest.raises(ValueError, match="inside: got no node"):
        middle_node(np.zeros((2, 2, 2), bool))
