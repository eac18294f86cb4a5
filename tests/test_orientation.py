"""Pictures of what lies in space: left is left, however the voxels are stored."""

from itertools import permutations, product

import matplotlib.image
import numpy as np
import pytest
from annotations import unchecked

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import TensorVolume, save, save_tensors
from hks_jax.plot import Orientation, hks_panels, new_figure, orthogonal_slices, save_figure, scalar_image

SHAPE, SPACING, ORIGIN = (10, 9, 5), (2.0, 2.5, 3.0), (-5.0, -4.0, -3.0)
STORAGES = [(order, turned) for order in permutations(range(3)) for turned in product((False, True), repeat=3)]
RAS = np.array([[2.0, 0, 0, -5], [0, 2.5, 0, -4], [0, 0, 3, -3], [0, 0, 0, 1]])


def stored(array, affine, order, turned, axes=3):
    """Return the same values of the same places, stored in another order of voxels; components turn with them."""
    there = np.eye(4)
    flips = [a for a in range(3) if turned[a]]
    for a in flips:
        there[a, a], there[a, 3] = -1, array.shape[a] - 1
    moved = np.eye(4)
    moved[:3, :3] = np.eye(3)[:, order]
    array = np.flip(array, flips).transpose(*order, *range(3, array.ndim))
    if axes < array.ndim:
        signs = np.where(turned, -1, 1)
        array = (array * np.outer(signs, signs))[..., order, :][..., order]
    return array, affine @ there @ moved


def tensors():
    """Tensors without a symmetry, in a mask without one."""
    x, y, z = np.indices(SHAPE) / 4
    field = np.zeros((*SHAPE, 3, 3))
    for a, values in enumerate((1.5 + 0.4 * x, 1.0 + 0.3 * np.sin(y + x), 0.8 + 0.1 * z)):
        field[..., a, a] = values
    field[..., 0, 1] = field[..., 1, 0] = 0.2 * np.sin(x + 2 * y)
    field[:2, :2] = 0
    return 1e-3 * field


@pytest.mark.parametrize(("order", "turned"), STORAGES)
def test_all_storages_are_one_picture(order, turned):
    values = np.random.default_rng(0).random((2, *SHAPE))
    grid = hj.Grid(SHAPE, SPACING, ORIGIN, values[0] > 0.1, "all")
    array, affine = stored(np.moveaxis(values, 0, -1), RAS, order, turned, axes=4)
    shape = array.shape[:3]
    own = hj.Grid(shape, np.linalg.norm(affine[:3, :3], axis=0), 0.0, array[..., 0] > 0.1, "all")
    orientation = Orientation.of(affine)
    assert orientation.grid(own) == grid
    np.testing.assert_array_equal(orientation.array(np.moveaxis(array, -1, 0)), values)
    assert orientation.ends == ("LR", "PA", "IS")
    node = tuple(np.argwhere(array[..., 0] == values[0, 3, 1, 2])[0].tolist())
    assert orientation.node(node, shape) == (3, 1, 2)
    np.testing.assert_array_equal(orientation.tensors(stored(tensors(), RAS, order, turned)[0]), tensors())
    # and of a slice, which is a volume one voxel thick
    for axis in range(3):
        kept = [a for a in range(3) if a != order[axis]]
        index = SHAPE[order[axis]] - 1 if turned[order[axis]] else 0
        place = affine.copy()
        place[:3, 3] += index * affine[:3, axis]
        cut = Orientation.of(place, axis)
        plane = hj.Grid([n for a, n in enumerate(shape) if a != axis], [own.spacing[a] for a in range(3) if a != axis])
        flat = values.take(0, 1 + order[axis])
        np.testing.assert_array_equal(cut.array(np.moveaxis(array, -1, 0).take(index, 1 + axis)), flat)
        there = cut.grid(plane)
        assert (there.origin, there.spacing) == tuple(tuple(of[a] for a in kept) for of in (ORIGIN, SPACING))
        assert cut.ends == tuple(("LR", "PA", "IS")[a] for a in kept)


def test_oblique_voxels_have_the_nearest_letters_and_their_own_coordinates():
    angle = np.pi / 4  # as near to the one axis as to the other
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    affine = np.eye(4)
    affine[:3] = turn @ RAS[:3]
    found = set()
    for order, turned in STORAGES:
        array, placed = stored(np.arange(450.0).reshape(SHAPE), affine, order, turned)
        orientation = Orientation.of(placed)
        grid = orientation.grid(hj.Grid(array.shape, np.linalg.norm(placed[:3, :3], axis=0)))
        found.add((tuple(orientation.array(array).ravel()), grid.shape, tuple(np.round(grid.origin, 9))))
    assert len(found) == 1
    angle = np.pi / 9
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    affine[:3] = turn @ RAS[:3]
    orientation = Orientation.of(affine)
    assert (orientation.axes, orientation.turned) == ((0, 1, 2), (False,) * 3)
    np.testing.assert_allclose(orientation.origin, ORIGIN)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"affine": np.eye(3)}, r"affine: got shape \(3, 3\)"),
        ({"affine": np.diag([1.0, 0, 1, 1])}, "three independent axes"),
        ({"affine": np.eye(4), "slice_axis": 3}, "slice_axis: got 3"),
        ({"affine": np.eye(4), "view": "from above"}, "view: got 'from above'"),
    ],
)
def test_what_is_no_orientation(arguments, words):
    with unchecked(), pytest.raises(ValueError, match=words):
        Orientation.of(**arguments)
    with pytest.raises(ValueError, match="one of 3 axes, and the grid has 2"):
        Orientation.of(np.eye(4)).grid(hj.Grid((3, 3)))


def letters(ax):
    """Return the letters of axes by where they are: left, right, bottom, top."""
    found = {text.xy: text.get_text() for text in ax.texts}
    return "".join(found[place] for place in ((0.0, 0.5), (1.0, 0.5), (0.5, 0.0), (0.5, 1.0)))


@pytest.mark.parametrize(
    ("view", "expected"),
    [("neurological", ["LRPA", "LRIS", "PAIS"]), ("radiological", ["RLPA", "RLIS", "PAIS"])],
)
def test_the_letters_are_where_the_sides_are(view, expected):
    """A bright voxel on the right, in front, on top, in voxels that run left, back and up."""
    values = np.zeros(SHAPE)
    values[9, 8, 4] = 1
    array, affine = stored(values, RAS, (1, 0, 2), (True, True, False))
    figure = new_figure(6, 3)
    axes, grid = figure.subplots(1, 3), hj.Grid(array.shape, (2.5, 2.0, 3.0))
    node = np.argwhere(array == 1)[0].tolist()
    orthogonal_slices(axes, array, grid, node=node, orientation=Orientation.of(affine, view=view))
    assert [letters(ax) for ax in axes] == expected
    figure.draw_without_rendering()
    for ax, (x, y) in zip(axes, ((13.0, 16.0), (13.0, 9.0), (16.0, 9.0)), strict=True):  # its coordinates in space
        (image,) = ax.images
        where = np.argwhere(np.asarray(image.get_array()) == 1)
        np.testing.assert_array_equal(where, [[n - 1 for n in image.get_array().shape]])
        across, up = ax.transAxes.inverted().transform(ax.transData.transform((x, y)))
        mirrored = view == "radiological" and ax is not axes[2]
        assert (across < 0.5) == mirrored
        assert up > 0.5
    ax = new_figure(3, 3).subplots()
    scalar_image(ax, array[:, :, 4], hj.Grid(array.shape[:2]), orientation=Orientation.of(affine, 2, view=view))
    assert letters(ax) == expected[0]


def pixels(path):
    return matplotlib.image.imread(path)[..., :3]


@pytest.fixture(scope="module")
def brains(tmp_path_factory):
    """The same tensors stored right to left, left to right, and in another order of axes."""
    folder, found = tmp_path_factory.mktemp("brains"), {}
    for name, order, turned in (
        ("RAS", (0, 1, 2), (False,) * 3),
        ("LAS", (0, 1, 2), (True, False, False)),
        ("PIR", (1, 2, 0), (False, True, True)),
    ):
        array, affine = stored(tensors(), RAS, order, turned)
        volume = TensorVolume(array, tuple(np.linalg.norm(affine[:3, :3], axis=0)), (0.0,) * 3, affine=affine)
        found[name] = save_tensors(folder / f"{name}.nii.gz", volume), order
    return found


def test_a_brain_stored_in_another_order_is_the_same_picture(brains, tmp_path):
    pictures = {}
    for name, (path, order) in brains.items():
        options = ["--metric", "inverse", "-k", "20", "--times", "3000", "20000", "--frame", "voxel", "-q"]
        assert main(["hks", str(path), "-o", str(tmp_path / name), *options]) == 0
        pictures[name] = [pixels(tmp_path / name / "hks.png")]
        axis = order.index(2)  # the axis that runs from foot to head, and the slice of one height
        index = 2
        flat = ["--slice", f"{'xyz'[axis]}={index}"]
        assert main(["hks", str(path), "-o", str(tmp_path / f"{name}-slice"), *flat, *options]) == 0
        pictures[name].append(pixels(tmp_path / f"{name}-slice" / "hks.png"))
        assert main(["curvature", str(path), "-o", str(tmp_path / f"{name}-K"), *flat, *options[:2], *options[7:]]) == 0
        pictures[name].append(pixels(tmp_path / f"{name}-K" / "curvature.png"))
        for more in ([], ["--view", "radiological"], ["--points", "1,1,3", "5,8.5,0"]):
            picture, saved = tmp_path / "plot.png", tmp_path / name / "hks.npz"
            cut = flat if "--points" not in more else []
            assert main(["plot", str(saved), "-o", str(picture), *cut, *more, "-q"]) == 0
            pictures[name].append(pixels(picture))
        assert main(["plot", str(tmp_path / f"{name}-slice" / "hks.npz"), "-o", str(picture), "-q"]) == 0
        pictures[name].append(pixels(picture))
    for name in ("LAS", "PIR"):
        for ours, theirs in zip(pictures["RAS"], pictures[name], strict=True):
            assert ours.shape == theirs.shape
            assert np.abs(ours - theirs).mean() < 1e-3
    # and the radiological view is another one
    assert np.abs(pictures["RAS"][3] - pictures["RAS"][4]).mean() > 1e-2


def test_without_a_place_in_space_nothing_is_turned(tmp_path):
    values = np.random.default_rng(0).random((1, 6, 5))
    flat = TensorVolume(np.broadcast_to(np.eye(2), (6, 5, 2, 2)), (0.5, 1.0), (1.0, 2.0))
    path = save(tmp_path / "hks.npz", values, flat, name="hks", extra={"times": [1.0]})
    for view in ("neurological", "radiological"):
        assert main(["plot", str(path), "-o", str(tmp_path / f"{view}.png"), "--view", view, "-q"]) == 0
    save_figure(
        hks_panels(values, [1.0], hj.Grid((6, 5), (0.5, 1.0), (1.0, 2.0)), cmap="viridis"), tmp_path / "own.png"
    )
    own = pixels(tmp_path / "own.png")
    for view in ("neurological", "radiological"):
        np.testing.assert_array_equal(pixels(tmp_path / f"{view}.png"), own)
