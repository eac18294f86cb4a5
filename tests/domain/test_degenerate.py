"""Degenerate points: every one, where it is, with its index."""

import numpy as np
import pytest

import hks_jax as hj

INDICES = [m / 2 for m in range(-6, 7) if m]


def field_of(v, grid):
    """A field whose deviator is the complex number v at each node: λ = 2 ± |v|/(1 + |v|)."""
    v = v / (1 + np.abs(v))
    rows = [np.stack([2 + v.real, v.imag], -1), np.stack([v.imag, 2 - v.real], -1)]
    return hj.TensorField(grid, np.stack(rows, -1))


def plane(grid):
    return grid.nodes[..., 0] + 1j * grid.nodes[..., 1]


# The point is at a node, or in the middle of a cell.
@pytest.mark.parametrize("n", [20, *(pytest.param(n, marks=pytest.mark.slow) for n in (21, 40))])
def test_the_papers_points(n):
    for index in INDICES:
        points = hj.degenerate_points(hj.examples.degenerate_point_field(index, n))
        assert points.indices.tolist() == [index]
        np.testing.assert_allclose(points.positions, [[0, 0]], atol=1e-5)


def test_a_point_anywhere_is_found_within_its_cell():
    rng = np.random.default_rng(0)
    for index in INDICES:
        for n in (33, 64):
            grid = hj.Grid.from_bounds(-1, 1, (n, n + 5))
            z = plane(grid) - complex(*rng.uniform(-0.4, 0.4, 2))
            at = np.array([-z[0, 0].real - 1, -z[0, 0].imag - 1])
            points = hj.degenerate_points(field_of(np.abs(z) * np.exp(2j * index * np.angle(z)), grid))
            assert points.indices.tolist() == [index]
            assert np.abs(points.positions - at).max() < 1.5 * max(grid.spacing)


def several(grid):
    z = plane(grid)
    zeros, kinds = [0.5 + 0.01j, -0.41 + 0.3j, 0.2 + 0.6j, -0.1 - 0.52j], [0.5, 0.5, -0.5, -0.5]
    factors = [z - zero if kind > 0 else np.conj(z - zero) for zero, kind in zip(zeros, kinds, strict=True)]
    expected = sorted((zero.real, zero.imag, kind) for zero, kind in zip(zeros, kinds, strict=True))
    return field_of(np.prod(factors, axis=0), grid), np.array(expected)


def test_positions_converge_with_the_grid():
    errors = []
    for n in (31, 61, 121):
        field, expected = several(hj.Grid.from_bounds(-1, 1, (n, n)))
        points = hj.degenerate_points(field)
        np.testing.assert_array_equal(points.indices, expected[:, 2])
        errors.append(np.abs(points.positions - expected[:, :2]).max())
    assert errors[0] < 0.01
    assert errors[2] < errors[0] / 6


def test_masks_and_units():
    grid = hj.Grid.from_bounds(-1, 1, (61, 61))
    near = np.abs(plane(grid) - (0.2 + 0.6j)) < 0.1  # takes the trisector out
    field, expected = several(grid)
    masked = hj.TensorField(
        hj.Grid.from_bounds(-1, 1, (61, 61), mask=~near), np.where(near[..., None, None], np.nan, field.tensors)
    )
    np.testing.assert_array_equal(hj.degenerate_points(masked).indices, np.delete(expected[:, 2], 2))
    scaled = hj.TensorField(hj.Grid((61, 61), (2.0, 3.0), (10.0, 20.0)), 1e-3 * field.tensors)
    points, reference = hj.degenerate_points(scaled), hj.degenerate_points(field)
    np.testing.assert_allclose(points.positions, [10, 20] + [2, 3] * (reference.positions + 1) * 30)
    np.testing.assert_array_equal(points.indices, reference.indices)


def test_what_has_no_index_is_no_point():
    square = hj.Grid.from_bounds(-1, 1, (21, 21))
    z = plane(square)
    for v in (np.zeros_like(z), z.real + 0j, np.maximum(0.5 - np.abs(z), 0) + 0j, np.abs(z) - 0.52 + 0j):
        # equal eigenvalues everywhere, on a line to the sides, outside of a disc, on a circle
        assert hj.degenerate_points(field_of(v, square)).positions.shape == (0, 2)
    corner = hj.degenerate_points(field_of(z - z[0, 0], square))  # on the rim: one cannot go around it
    assert corner.indices.size == 0


def test_a_patch_of_equal_eigenvalues_has_an_index_and_a_middle():
    grid = hj.Grid.from_bounds(-1, 1, (41, 41))
    z = plane(grid) - 0.1
    points = hj.degenerate_points(field_of(np.maximum(np.abs(z) - 0.3, 0) * np.exp(3j * np.angle(z)), grid))
    assert points.indices.tolist() == [1.5]
    np.testing.assert_allclose(points.positions, [[0.1, 0]], atol=0.02)


def test_near_points_merge_as_asked():
    grid = hj.Grid.from_bounds(-1, 1, (41, 41))
    z = plane(grid)
    field = field_of((z - 0.12 - 0.03j) * (z + 0.13 - 0.03j), grid)  # two wedges, 5 cells apart
    assert hj.degenerate_points(field).indices.tolist() == [0.5, 0.5]
    assert hj.degenerate_points(field, merge=6).indices.tolist() == [1.0]
    pair = field_of((z - 0.12 - 0.03j) * np.conj(z + 0.13 - 0.03j), grid)
    assert sorted(hj.degenerate_points(pair, merge=6).indices) == [-0.5, 0.5]  # their sum is no point, but they are two


@pytest.mark.slow
@pytest.mark.parametrize(("same", "distances"), [(False, (1.0, 1.5, 2.5, 3.5)), (True, (2.5, 3.5))])
def test_near_pairs_are_found_at_random_places_and_angles(same, distances):
    grid, rng, trials = hj.Grid((20, 20)), np.random.default_rng(1), 40
    for distance in distances:
        count = 0
        for _ in range(trials):
            z = (plane(grid) - complex(*rng.uniform(7, 12, 2))) / 10
            half = np.exp(1j * rng.uniform(0, 2 * np.pi)) * distance / 20
            turned = np.exp(1j * rng.uniform(0, 2 * np.pi)) * (z - half)
            points = hj.degenerate_points(field_of(turned * ((z + half) if same else np.conj(z + half)), grid))
            count += sorted(points.indices) == ([0.5, 0.5] if same else [-0.5, 0.5])
        assert count >= (trials if distance > 1 else 10)  # at a distance of one cell, both may be in the same cell


def test_noise_is_not_one_point_and_indices_on_a_torus_add_up_to_zero():
    grid, rng = hj.Grid((60, 60)), np.random.default_rng(0)
    noise = field_of(rng.normal(size=grid.shape) + 1j * rng.normal(size=grid.shape), grid)
    points = hj.degenerate_points(noise, periodic=True)
    assert points.indices.size > 600
    assert points.indices.sum() == 0
    assert (points.positions >= 0).all()
    assert (points.positions < 60).all()
    assert hj.degenerate_points(noise, merge=0.01, periodic=True).indices.sum() == 0


def test_periodic_fields_turn_with_the_grid():
    n = 40
    x, y = np.moveaxis(hj.Grid((n, n)).nodes * 2 * np.pi / n, -1, 0)
    v = np.sin(x + 0.013) + 0.3 * np.cos(y) + 1j * np.sin(y + 0.2)
    reference = hj.degenerate_points(field_of(v, hj.Grid((n, n))), periodic=True)
    assert sorted(reference.indices) == [-0.5, -0.5, 0.5, 0.5]
    for shift in ((7, 0), (0, 3), (20, 31), *((0, k) for k in range(34, 40)), *((k, 0) for k in range(16, 24))):
        moved = hj.degenerate_points(field_of(np.roll(v, shift, axis=(0, 1)), hj.Grid((n, n))), periodic=True)
        expected = np.mod(reference.positions + shift, n)
        order = np.lexsort((expected[:, 1], expected[:, 0]))
        np.testing.assert_allclose(moved.positions, expected[order], atol=1e-9)
        np.testing.assert_array_equal(moved.indices, reference.indices[order])
    with pytest.raises(ValueError, match="periodic: got"):
        hj.degenerate_points(field_of(v, hj.Grid((n, n))), periodic=(True,) * 3)


def test_a_point_of_high_index_across_periodic_sides():
    grid = hj.Grid.from_bounds(-1, 1, (30, 30))
    z = plane(grid)
    for index in (-1.5, -1, 1, 1.5):
        # Far from the point, v is constant, so that the rest of the index is in the points around.
        near = np.abs(z) ** 2 * np.exp(2j * index * np.angle(z))
        field = field_of(near * np.exp(-((np.abs(z) / 0.5) ** 6)) + 1e-3 * (np.exp(1j * z.real) + z.imag**2), grid)
        reference = hj.degenerate_points(field, periodic=True)
        rolled = hj.TensorField(grid, np.roll(field.tensors, (15, 15), axis=(0, 1)))
        moved = hj.degenerate_points(rolled, periodic=True)
        assert reference.indices.sum() == moved.indices.sum() == 0
        assert sorted(reference.indices) == sorted(moved.indices)
        assert index in moved.indices


def test_errors():
    with pytest.raises(ValueError, match=r"field: got a grid of shape \(3, 3, 3\); expected 2 dimensions"):
        hj.degenerate_points(hj.TensorField(hj.Grid((3, 3, 3)), np.broadcast_to(np.eye(3), (3, 3, 3, 3, 3))))
    with pytest.raises(ValueError, match="merge: got 0; expected a finite number above 0"):
        hj.degenerate_points(hj.examples.degenerate_point_field(0.5, 9), merge=0)
