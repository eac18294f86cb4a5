import jax
import numpy as np
import pytest
from annotations import unchecked

import hks_jax as hj
from hks_jax.domain.components import label_nodes


def two_blocks() -> np.ndarray:
    mask = np.zeros((9, 9), dtype=bool)
    mask[:3, :3] = True
    mask[5:, 5:] = True
    return mask


def test_coordinates_follow_array_axes():
    grid = hj.Grid((3, 4), (0.5, 2.0), (1.0, -1.0))
    assert grid.nodes.shape == (3, 4, 2)
    np.testing.assert_array_equal(grid.nodes[2, 3], [2.0, 5.0])
    assert grid.extent == (1.0, 2.0, -1.0, 5.0)
    assert hj.Grid.from_bounds((1, -1), (2, 5), (3, 4)) == grid


def test_equal_grids_hash_alike_and_share_a_compilation():
    a, b = hj.Grid((9, 9), mask=two_blocks(), components="all"), hj.Grid((9, 9), mask=two_blocks(), components="all")
    assert a == b
    assert hash(a) == hash(b)
    assert a != hj.Grid((9, 9), mask=two_blocks(), components="largest")
    traces = []

    @jax.jit
    def size(grid):
        traces.append(1)
        return np.float64(grid.size)

    assert size(a) == size(b) == 81
    assert len(traces) == 1


def test_mask_components_are_reported_kept_or_refused():
    with pytest.raises(ValueError, match=r"2 connected components \(16, 9 nodes\).*largest"):
        hj.Grid((9, 9), mask=two_blocks())
    largest = hj.Grid((9, 9), mask=two_blocks(), components="largest")
    assert largest.mask.sum() == 16
    assert largest.mask[8, 8]
    assert hj.Grid((9, 9), mask=two_blocks(), components="all").mask.sum() == 25


def test_labels_join_across_periodic_sides_and_through_corners():
    mask = np.zeros((8, 8), dtype=bool)
    mask[:2, 2:6] = True
    mask[6:, 2:6] = True
    assert label_nodes(mask, (False, False))[1] == 2
    labels, count = label_nodes(mask, (True, False))
    assert count == 1
    np.testing.assert_array_equal(labels > 0, mask)
    corner = np.zeros((7, 7), dtype=bool)
    corner[:4, :4] = corner[3:, 3:] = True
    assert label_nodes(corner, (False, False))[1] == 1


def test_neighbouring_nodes_without_a_common_element_are_not_connected():
    mask = np.ones((6, 6), dtype=bool)
    mask[0:3, 3] = False  # a slit, one node wide, does not cut the lower half
    assert label_nodes(mask, (False, False))[1] == 1
    mask[3:5, 3] = False  # only the last row of nodes joins the halves: nodes, but no element
    assert label_nodes(mask, (False, False))[1] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"shape": (4,)}, "shape: got .* expected 2 or 3 axes"),
        ({"shape": (3.7, 4)}, r"shape: got \(3.7, 4\); expected a tuple of 2 or 3 integers"),
        ({"shape": 5}, "shape: got 5; expected a tuple"),
        ({"shape": (4, 4), "spacing": "wide"}, "spacing: got 'wide'; expected an array of numbers"),
        ({"shape": (4, 1)}, "at least 2 nodes"),
        ({"shape": (4, 4), "spacing": (1, 2, 3)}, "spacing: got .*; expected 2 finite numbers"),
        ({"shape": (4, 4), "spacing": (1, -2)}, "spacing: .* expected positive"),
        ({"shape": (4, 4), "spacing": np.nan}, "spacing: .* finite"),
        ({"shape": (4, 4), "mask": np.ones((4, 5))}, r"mask: got shape \(4, 5\); expected the grid's shape \(4, 4\)"),
        ({"shape": (4, 4), "mask": np.zeros((4, 4))}, "mask is empty"),
        ({"shape": (4, 4), "mask": np.full((4, 4), 2)}, "expected booleans"),
        ({"shape": (4, 4), "mask": np.eye(4)}, "no element has all its 4 nodes inside"),
        ({"shape": (4, 4), "components": "some"}, "components: got 'some'"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        hj.Grid(**arguments)
