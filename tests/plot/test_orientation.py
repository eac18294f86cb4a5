"""Pictures of what lies in space: left is left, however the voxels are stored."""

import json
from itertools import permutations, product
from types import SimpleNamespace

import matplotlib.image
import nibabel as nib
import numpy as np
import pytest
from annotations import unchecked

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import TensorVolume, read_tensors, save, save_tensors
from hks_jax.io.repair import find_background
from hks_jax.plot import Orientation, fit_panels, hks_panels, new_figure, orthogonal_slices, save_figure, scalar_image
from hks_jax.plot.images import colours_of
from hks_jax.plot.signature import SPAN

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
        ({"affine": np.diag([1.0, 0, 1, 1])}, "with independent axes"),
        ({"affine": np.eye(4), "slice_axis": 3}, "slice_axis: got 3"),
        ({"affine": np.eye(4), "view": "from above"}, "view: got 'from above'"),
    ],
)
def test_what_is_no_orientation(arguments, words):
    with unchecked(), pytest.raises(ValueError, match=words):
        Orientation.of(**arguments)
    with pytest.raises(ValueError, match="orientation: got 3 axes; expected 2"):
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


@pytest.mark.slow
def test_a_brain_stored_in_another_order_is_the_same_picture(brains, tmp_path):
    pictures = {}
    for name, (path, order) in brains.items():
        options = ["--metric", "inverse", "-k", "20", "--times", "3000", "20000", "--frame", "voxel", "-q"]
        shown = [*options, "--show-rim"]  # the lines of hatching differ by fractions of a pixel
        assert main(["hks", str(path), "-o", str(tmp_path / name), *shown]) == 0
        pictures[name] = [pixels(tmp_path / name / "hks.png")]
        axis = order.index(2)  # the axis that runs from foot to head, and the slice of one height
        index = 2
        flat = ["--slice", f"{'xyz'[axis]}={index}"]
        assert main(["hks", str(path), "-o", str(tmp_path / f"{name}-slice"), *flat, *shown]) == 0
        pictures[name].append(pixels(tmp_path / f"{name}-slice" / "hks.png"))
        assert main(["curvature", str(path), "-o", str(tmp_path / f"{name}-K"), *flat, *options[:2], *options[7:]]) == 0
        pictures[name].append(pixels(tmp_path / f"{name}-K" / "curvature.png"))
        for more in ([], ["--view", "radiological"], ["--points", "-1,1,3", "5,8.5,0"]):
            picture, saved = tmp_path / "plot.png", tmp_path / name / "hks.npz"
            cut = flat if "--points" not in more else []
            assert main(["plot", str(saved), "-o", str(picture), "--title", "T", *cut, *more, "-q", "--show-rim"]) == 0
            pictures[name].append(pixels(picture))
        assert main(["plot", str(tmp_path / f"{name}-slice" / "hks.npz"), "-o", str(picture), "-q", "--show-rim"]) == 0
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
        assert main(["plot", str(path), "-o", str(tmp_path / f"{view}.png"), "--view", view, "--title", "T", "-q"]) == 0
    grid, limits = hj.Grid((6, 5), (0.5, 1.0), (1.0, 2.0)), [tuple(np.quantile(values, SPAN).tolist())]
    save_figure(hks_panels(values, [1.0], grid, limits=limits, label="HKS", suptitle="T"), tmp_path / "own.png")
    own = pixels(tmp_path / "own.png")
    for view in ("neurological", "radiological"):
        np.testing.assert_array_equal(pixels(tmp_path / f"{view}.png"), own)


# ---------------------------------------------------------------------------------------------- where the file lies


def nifti_of(path, sform=None, qform=None):
    tensors_and_place = save_tensors(
        path, TensorVolume(tensors() + np.eye(3) * 1e-4, SPACING, (0.0,) * 3, affine=np.diag([*SPACING, 1.0]))
    )
    image = nib.load(tensors_and_place)
    image = nib.Nifti1Image(np.asarray(image.dataobj), None, image.header)
    image.set_sform(sform, code=0 if sform is None else 2)
    image.set_qform(qform, code=0 if qform is None else 1)
    nib.save(image, path)
    return read_tensors(path)


def test_of_two_places_the_sform_wins_and_both_are_named(tmp_path):
    mirrored = RAS @ np.array([[-1.0, 0, 0, 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    volume = nifti_of(tmp_path / "t.nii.gz", RAS, mirrored)
    np.testing.assert_array_equal(volume.affine, RAS)
    (note,) = (note for note in volume.notes if "qform" in note)
    assert "sform (code 2) and qform (code 1) differ by up to 18, and one mirrors the other; the sform is used" in note
    shifted = RAS.copy()
    shifted[2, 3] += 7
    (note,) = (note for note in nifti_of(tmp_path / "t.nii.gz", RAS, shifted).notes if "qform" in note)
    assert "up to 7; the sform" in note
    for sform, qform in ((RAS, RAS), (RAS, None), (None, RAS)):
        volume = nifti_of(tmp_path / "t.nii.gz", sform, qform)
        np.testing.assert_allclose(volume.affine, RAS, atol=1e-6)
        assert not any("qform" in note for note in volume.notes)
    assert any("left and right are a guess" in note for note in nifti_of(tmp_path / "t.nii.gz").notes)


# ---------------------------------------------------------------------------------------------- what is background


def filled(value):
    """A quarter of the voxels hold tensors that differ; the others hold what a program filled in."""
    x = np.indices((12, 10, 4))
    inside = (np.abs(x[0] - 5.5) < 3) & (np.abs(x[1] - 4.5) < 3)
    field = np.broadcast_to(value * np.eye(3), (12, 10, 4, 3, 3)).copy()
    rng = np.random.default_rng(0)
    field[inside] = 1e-3 * (np.eye(3) + 0.2 * np.cos(rng.standard_normal((int(inside.sum()), 1, 1))) * np.ones((3, 3)))
    return field, inside


@pytest.mark.parametrize(
    ("value", "words"),
    [(7e-4, "have the same isotropic tensor, 0.0007·I"), (1e-12, "have the same isotropic tensor, 1e-12·I")],
)
def test_a_background_that_is_filled_in_is_named_and_left_out_if_asked(value, words, tmp_path, capsys):
    field, inside = filled(value)
    path = save_tensors(
        tmp_path / "ants.nii.gz", TensorVolume(field, (2.0,) * 3, (0.0,) * 3, affine=np.diag([2.0, 2, 2, 1]))
    )
    assert main(["info", str(path), "--json"]) == 0
    captured = capsys.readouterr()
    assert f"no mask given: {int((~inside).sum())} of 480 voxels {words}" in captured.err
    assert "Pass --mask or --background outside, or --background inside" in captured.err
    assert json.loads(captured.out)["inside"] == 480
    for said, count in (("outside", int(inside.sum())), ("inside", 480)):
        assert main(["info", str(path), "--json", "--background", said]) == 0
        captured = capsys.readouterr()
        assert captured.err == ""
        assert json.loads(captured.out)["inside"] == count


def test_what_is_no_background():
    field, inside = filled(7e-4)
    volume = TensorVolume(field, (2.0,) * 3, (0.0,) * 3)
    np.testing.assert_array_equal(find_background(volume)[0], ~inside)
    noise = field * np.where(inside, 1, 1e-9 * (1 + np.random.default_rng(1).random(inside.shape)))[..., None, None]
    noise[~inside, 0, 0] *= 1.5
    found, text = find_background(TensorVolume(noise, (2.0,) * 3, (0.0,) * 3))
    np.testing.assert_array_equal(found, ~inside)
    assert "have tensors near zero" in text
    assert find_background(volume.with_mask(inside)) is None  # there is a mask
    flat = np.broadcast_to(np.eye(2), (9, 9, 2, 2))
    assert find_background(TensorVolume(flat, (1.0,) * 2, (0.0,) * 2)) is None  # alike everywhere
    smooth = TensorVolume(tensors()[2:] + 1e-4 * np.eye(3), SPACING, (0.0,) * 3)
    assert find_background(smooth) is None


# ---------------------------------------------------------------------------------------------- what colours mean


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.7, 0.9, 1.2], (0.7, 1.3, "RdBu_r")),  # as far above 1 as below
        ([0.7, 0.9, 1.5, 3.0], (0.0, 2.0, "RdBu_r")),  # not −1 to 3 of what is never negative
        ([30.0, 38.0, 41.0], (30.0, 41.0, "viridis")),  # nothing near 1: not −39 to 41, all dark red
        ([-1.0, 3.0], (-1.0, 3.0, "RdBu_r")),
    ],
)
def test_colours_of_what_is_positive_are_not_negative(values, expected):
    assert colours_of([np.array(values)], (0, 1), centre=1.0) == [pytest.approx(expected)]


def test_a_centre_of_zero_is_one_of_either_sign():
    assert colours_of([np.array([0.0, 2.0])], (0, 1), centre=0.0) == [(-2.0, 2.0, "RdBu_r")]


@pytest.mark.parametrize("rounding", [-1e-12, 0.0, 1e-12])
def test_all_panels_of_a_figure_have_one_colour_map(rounding):
    near, flat, late = np.linspace(0.8, 1.3, 9), np.full(9, 2.0) + rounding, np.linspace(1.9, 2.4, 9)
    assert [each.cmap for each in colours_of([near, near, flat], (0, 1), centre=1.0)] == ["RdBu_r"] * 3
    assert [each.cmap for each in colours_of([near, late, late], (0, 1), centre=1.0)] == ["RdBu_r"] * 3
    assert [each.cmap for each in colours_of([near[:1], late, late], (0, 1), centre=1.0)] == ["viridis"] * 3


@pytest.mark.slow
def test_automatic_times_end_where_something_is_left_to_see(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "hks_jax.plot.panels.scalar_image", lambda ax, values, grid, **more: drawn.append((values, more))
    )
    field = hj.examples.torus_field((16, 16))
    np.savez(tmp_path / "t.npz", tensors=field.tensors, spacing=field.grid.spacing)
    options = ["-k", "30", "--boundary", "periodic", "-q"]
    assert main(["hks", str(tmp_path / "t.npz"), "-o", str(tmp_path / "out"), *options, "--times", "auto:5"]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    last = report["times"][-1]["t"]
    assert last * report["eigenpairs"]["first_positive"] == pytest.approx(np.pi**2 / 9)
    values, more = drawn[-1]
    assert np.ptp(values) > 0.01 * values.max()
    assert more["vmin"] > 0  # far from 1, and positive
    # Where nothing is left, nothing is shown.
    assert main(["hks", str(tmp_path / "t.npz"), "-o", str(tmp_path / "out"), *options, "--times", str(14 * last)]) == 0
    values, more = drawn[-1]
    assert np.ptp(values) < 1e-3 * values.max()
    assert more["vmax"] - more["vmin"] == pytest.approx(0.01 * values.max(), rel=1e-2)


@pytest.mark.slow
def test_a_fit_is_the_same_picture_too(monkeypatch, tmp_path):
    """The ellipses of the metric turn with the images."""
    monkeypatch.setattr("hks_jax.plot.fit._draw_loss", lambda ax, fit: None)
    values = 1 + np.random.default_rng(0).random((1, *SHAPE[:2]))
    for name, turned in (("RAS", (False,) * 3), ("LAS", (True, False, False))):
        array, affine = stored(tensors()[:, :, 2:3] + 1e-4 * np.eye(3), RAS, (0, 1, 2), turned)
        images = values[:, ::-1] if turned[0] else values
        field = hj.TensorField(hj.Grid(SHAPE[:2], SPACING[:2]), array[:, :, 0, :2, :2])
        observation = SimpleNamespace(times=None, signature=SimpleNamespace(symbol="t"))
        fit = SimpleNamespace(field=field, hks=images + 0.1, problem=SimpleNamespace(observation=observation))
        with unchecked():
            figure = fit_panels(fit, images, [1.0], orientation=Orientation.of(affine, 2))
        assert [letters(ax) for ax in figure.axes if ax.texts] == ["LRPA"] * 4
        save_figure(figure, tmp_path / f"{name}.png")
    assert np.abs(pixels(tmp_path / "RAS.png") - pixels(tmp_path / "LAS.png")).mean() < 1e-5
