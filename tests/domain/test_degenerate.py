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
@pytest.mark.parametrize("n", [20, 21, pytest.param(40, marks=pytest.mark.slow)])
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
    assert hj.degenerate_points(pair, merge=6).indices.size == 0


def test_errors():
    with pytest.raises(ValueError, match=r"field: got a grid of shape \(3, 3, 3\); expected 2 dimensions"):
        hj.degenerate_points(hj.TensorField(hj.Grid((3, 3, 3)), np.broadcast_to(np.eye(3), (3, 3, 3, 3, 3))))
    with pytest.raises(ValueError, match="merge: got 0; expected an integer of at least 1"):
        hj.degenerate_points(hj.examples.degenerate_point_field(0.5, 9), merge=0)
