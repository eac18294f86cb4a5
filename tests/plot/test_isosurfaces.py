"""Surfaces of equal value in volumes: where they are seen, and what is refused."""

import importlib.util
import sys

import numpy as np
import pytest
from annotations import unchecked

import hks_jax as hj
from hks_jax import plot

GRID = hj.Grid((16, 30, 24), (1.0, 0.5, 1.25), (2.0, -7.0, 3.0))
X, Y, Z = np.moveaxis(GRID.nodes - GRID.nodes.mean(axis=(0, 1, 2)), -1, 0)
EGG = (X / 5) ** 2 + (Y / 5) ** 2 + (Z / 10) ** 2  # 1 on an ellipsoid, twice as high as wide

has_pyvista = pytest.mark.skipif(
    importlib.util.find_spec("pyvista") is None,
    reason='PyVista is not installed: pip install "hks-jax[pyvista]"',
)


def seen(values, **options):
    """Return where a picture along x is not white."""
    ax = plot.new_figure(4, 4).subplots()
    plot.isosurfaces(ax, values, GRID, levels=[1.0], outline=False, view=(1, 0, 0), opacity=1.0, **options)
    return np.asarray(ax.images[0].get_array()).min(axis=-1) < 250


def extent(picture):
    rows, columns = np.nonzero(picture)
    return np.ptp(columns) + 1, np.ptp(rows) + 1


@has_pyvista
def test_an_ellipsoid_is_as_high_and_as_wide_as_it_should_be():
    picture = seen(EGG)
    width, height = extent(picture)
    assert height / width == pytest.approx(2, rel=0.03)
    closer = extent(seen(EGG, zoom=1.5))
    assert closer[0] / width == pytest.approx(1.5, rel=0.03)


@has_pyvista
def test_surfaces_end_where_values_do():
    left, right = seen(np.where(Y > 0, np.nan, EGG)), seen(np.where(Y < 0, np.nan, EGG))
    for half in (left, right):  # up to the last element with all its nodes, half a node from the middle
        width, height = extent(half)
        assert height / width == pytest.approx(4 * 5 / (5 - 0.25), rel=0.05)
    # From +x, y is to the right: the flat side of each is where the other would be.
    profile_left, profile_right = left.sum(axis=0), right.sum(axis=0)
    assert np.argmax(profile_left) > np.nonzero(profile_left)[0].mean()
    assert np.argmax(profile_right) < np.nonzero(profile_right)[0].mean()


@has_pyvista
def test_colours_levels_and_frame():
    ax = plot.new_figure(3, 2).subplots()
    mappable = plot.isosurfaces(ax, EGG, GRID, levels=3, quantiles=(0.1, 0.9), resolution=100)
    assert mappable.get_clim() == pytest.approx(tuple(np.quantile(EGG, (0.1, 0.9))))
    assert not ax.axison
    height, width = ax.images[0].get_array().shape[:2]
    inches = ax.get_figure().get_size_inches() * ax.get_position().size
    assert (width, height) == tuple(np.round(100 * inches))
    shades = np.asarray(ax.images[0].get_array()).reshape(-1, 3)
    assert len(np.unique(shades, axis=0)) > 50
    blank = plot.new_figure(3, 2).subplots()
    plot.isosurfaces(blank, EGG, GRID, levels=[1e9], outline=False)
    assert np.asarray(blank.images[0].get_array()).min() == 255


def test_bad_input_is_refused():
    ax = plot.new_figure(3, 2).subplots()
    with unchecked(), pytest.raises(ValueError, match="three dimensions"):
        plot.isosurfaces(ax, np.ones((4, 4)), hj.Grid((4, 4)))
    for bad in (0, [], [np.nan]):
        with pytest.raises(ValueError, match="levels: got"):
            plot.isosurfaces(ax, EGG, GRID, levels=bad)
    with pytest.raises(ValueError, match="opacity: got 0"):
        plot.isosurfaces(ax, EGG, GRID, opacity=0)
    with pytest.raises(ValueError, match="view: got"):
        plot.isosurfaces(ax, EGG, GRID, view=(0, 0, 1))


def test_missing_pyvista_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(ImportError, match=r'pip install "hks-jax\[pyvista\]"'):
        plot.isosurfaces(plot.new_figure(3, 2).subplots(), EGG, GRID)
