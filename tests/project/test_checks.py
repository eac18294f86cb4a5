"""Settings out of range and complex numbers are refused by name, wherever they enter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from annotations import unchecked

import hks_jax as hj
from hks_jax.checks import require_count, require_number
from hks_jax.inverse import H1, Data, Prior, Search, TotalVariation
from hks_jax.inverse.gauss_newton import GaussNewton
from hks_jax.io import find_invalid, repair_tensors
from hks_jax.io.volume import TensorVolume

GRID = hj.Grid((4, 5))
FIELD = hj.TensorField(GRID, np.broadcast_to(np.eye(2), (4, 5, 2, 2)))
SOLVERS = (hj.Dense, hj.ShiftInvert, hj.BlockLanczos, hj.ChebyshevFilter)
VOLUME = TensorVolume(np.broadcast_to(np.eye(2), (4, 5, 2, 2)), (1.0, 1.0), (0.0, 0.0))
NAN, INF = float("nan"), float("inf")


@pytest.fixture(autouse=True)
def as_users_call():
    """Almost every value here contradicts an annotation."""
    with unchecked():
        yield


def pairs():
    return hj.eigenpairs(FIELD, 5)


@pytest.mark.parametrize("value", [NAN, INF, -1e-8, 0, 1, 1e-3 + 1j, "1e-8", None, True, [1e-8]])
def test_tolerances_of_solvers(value):
    for solver in SOLVERS:
        with pytest.raises(ValueError, match=r"^tolerance: got .*; expected a finite number above 0 and below 1"):
            solver(tolerance=value)


@pytest.mark.parametrize("value", [NAN, INF, -1e-8, 0, 1, "1e-8"])
@pytest.mark.parametrize("adjoint", [hj.FactorisedAdjoint, hj.FilteredAdjoint, hj.HostAdjoint])
def test_tolerances_of_adjoints(adjoint, value):
    with pytest.raises(ValueError, match=r"^tolerance: got .*; expected a finite number above 0 and below 1"):
        adjoint(tolerance=value)


@pytest.mark.parametrize("value", [0, -3, 0.5, 2.0, NAN, "8", 1j])
@pytest.mark.parametrize(
    ("solver", "name"),
    [
        (hj.BlockLanczos, "block"),
        (hj.BlockLanczos, "slice_size"),
        (hj.ChebyshevFilter, "block"),
        (hj.ChebyshevFilter, "max_rounds"),
        (hj.ShiftInvert, "max_restarts"),
        (hj.ShiftInvert, "basis"),
    ],
)
def test_counts_of_solvers(solver, name, value):
    with pytest.raises(ValueError, match=f"^{name}: got .*; expected an integer of at least [12]$"):
        solver(**{name: value})


OTHERS = {
    "tolerance of hks_auto": ("tolerance", lambda v: hj.hks_auto(pairs(), [1.0], tolerance=v)),
    "tolerance of hks_spectrum_free": (
        "tolerance",
        lambda v: hj.hks_spectrum_free(FIELD, [1.0], method="selected-inversion", tolerance=v),
    ),
    "tolerance of colouring": ("tolerance", lambda v: hj.colouring(FIELD, [0.1], tolerance=v)),
    "memory": ("memory", lambda v: hj.colouring(FIELD, [0.1], memory=v)),
    "slack": ("slack", lambda v: hj.colouring(FIELD, [0.1], slack=v)),
    "tolerance of Search": ("tolerance", lambda v: Search(tolerance=v)),
    "noise": ("noise", lambda v: Data(noise=v)),
    "spread": ("spread", lambda v: Search(spread=v)),
    "smoothness": ("smoothness", lambda v: Search(smoothness=v)),
    "tolerance of GaussNewton": ("tolerance", lambda v: GaussNewton(tolerance=v)),
    "damping": ("damping", lambda v: GaussNewton(damping=v)),
    "growth": ("growth", lambda v: GaussNewton(growth=v)),
    "inner_tolerance": ("inner_tolerance", lambda v: GaussNewton(inner_tolerance=v)),
    "weight of H1": ("weight", H1),
    "weight of Prior": ("weight", lambda v: Prior(v, FIELD)),
    "weight of TotalVariation": ("weight", lambda v: TotalVariation(v)),
    "epsilon": ("epsilon", lambda v: TotalVariation(1.0, v)),
    "floor of repair": ("floor", lambda v: repair_tensors(VOLUME, "clip", v)),
    "sigma of wks": ("sigma", lambda v: hj.wks(pairs(), [1.0], v)),
}


@pytest.mark.parametrize("case", OTHERS)
@pytest.mark.parametrize("value", [NAN, INF, -1.0])
def test_other_settings(case, value):
    name, call = OTHERS[case]
    with pytest.raises(ValueError, match=f"^{name}: got {value}; expected a finite number"):
        call(value)


def test_limits_that_may_be_any_finite_number():
    for call in (lambda v: find_invalid(VOLUME, v), lambda v: hj.count_eigenvalues(FIELD, v)):
        with pytest.raises(ValueError, match="got nan; expected a finite number"):
            call(NAN)
    with pytest.raises(ValueError, match="values: got nan; expected finite, nonnegative numbers"):
        hj.weyl_count(pairs(), [1.0, NAN])


def test_what_is_right_passes():
    for value in (1e-8, np.float32(1e-3), jnp.asarray(1e-3), np.array(0.5)):
        require_number("x", value, 1)
    require_number("x", 0, inclusive=True)
    require_number("x", -3, above=-INF)
    jax.jit(lambda x: require_number("x", x))(-1.0)  # traced: not known
    require_count("x", np.int64(3))


VERTICES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
TENSORS = np.broadcast_to(np.eye(2), (4, 5, 2, 2)) * (1 + 0.5j)
NODAL = np.ones((4, 5)) + 1j

COMPLEX = {
    "tensors": lambda: hj.TensorField(GRID, TENSORS),
    "tensors of lists": lambda: hj.TensorField(hj.Grid((2, 2)), [[[[1, 0], [0, 1 + 1j]]] * 2] * 2),
    "tensors under jit": lambda: jax.jit(lambda T: hj.TensorField(GRID, T).tensors)(TENSORS),
    "D": lambda: hj.TensorField.from_diffusion(GRID, TENSORS, "inverse"),
    "fn": lambda: hj.TensorField.from_function(lambda x: jax.lax.complex(jnp.eye(2), x[0] * jnp.eye(2)), GRID),
    "tensors of a volume": lambda: TensorVolume(TENSORS, (1.0, 1.0), (0.0, 0.0)),
    "vertices": lambda: hj.SurfaceMesh(VERTICES * (1 + 1j), FACES),
    "metric": lambda: hj.SurfaceMesh(VERTICES, FACES, TENSORS[0, :4]),
    "tensors in space": lambda: hj.SurfaceMesh.from_tensors(VERTICES, FACES, np.ones((4, 3, 3)) * 1j, "tensor"),
    "spacing": lambda: hj.Grid((4, 5), spacing=np.array([1, 1 + 1j])),
    "origin": lambda: hj.Grid((4, 5), origin=1j),
    "times": lambda: hj.hks(pairs(), [1 + 1j]),
    "times of a fit": lambda: hj.fit_metric(FIELD, np.ones((1, 4, 5)), [1 + 1j]),
    "target": lambda: hj.fit_metric(FIELD, NODAL[None], [1.0]),
    "weights": lambda: hj.fit_metric(FIELD, np.ones((1, 4, 5)), [1.0], data=Data(weights=NODAL)),
    "functions": lambda: hj.heat_flow(pairs(), [1.0], NODAL),
    "functions of a scale space": lambda: hj.gaussian_scale_space(FIELD, [1.0], NODAL),
    "c": lambda: hj.reconstruct(pairs(), np.ones(5) + 1j),
    "f in modes": lambda: hj.decompose(pairs(), NODAL),
    "f": lambda: hj.laplace_beltrami(FIELD, NODAL),
    "f as a function": lambda: hj.laplace_beltrami(
        hj.TensorField.from_function(lambda x: jnp.eye(2), GRID), lambda x: 1j
    ),
    "energies": lambda: hj.wks(pairs(), [1 + 1j], 0.5),
    "parameters": lambda: hj.spectral_signature(pairs(), lambda t, x: jnp.exp(-t * x), [1j]),
    "values": lambda: hj.weyl_count(pairs(), [1j]),
}


@pytest.mark.parametrize("case", COMPLEX)
def test_complex_numbers_are_refused(case):
    with pytest.raises(ValueError, match=f"^{case.split()[0]}: got complex numbers; expected real numbers"):
        COMPLEX[case]()


def test_other_objects_than_arrays_fields_and_eigenpairs_are_named_with_a_remedy():
    path, ax, mesh = "tensors.nii", hj.plot.new_figure(1, 1).add_subplot(), hj.examples.sphere_mesh(1)
    matrix = scipy.sparse.csr_array(np.eye(3))
    calls = [
        (lambda: hj.TensorField(GRID, path), "tensors: got 'tensors.nii'; expected an array of numbers. Read the file"),
        (lambda: hj.TensorField(GRID, VOLUME), "tensors: got .*; expected an array of numbers. Pass its .tensors"),
        (lambda: hj.TensorField(GRID, None), "tensors: got None; expected an array of numbers"),
        (lambda: hj.TensorField.from_function(GRID, np.eye), "grid: got function; expected hks_jax.Grid"),
        (lambda: hj.TensorField.from_function(GRID, GRID), "fn: got Grid; expected a function from coordinates"),
        (lambda: hj.Grid((4, 5), mask=np.ma.array(np.ones((4, 5)), mask=np.eye(4, 5))), "mask: got a masked array"),
        (
            lambda: hj.SurfaceMesh(mesh, mesh.faces),
            "vertices: got .*; expected .*. Pass its .vertices",
        ),
        (lambda: hj.eigh(matrix), r"A: got .*; expected an array of numbers. Pass its .todense\(\)"),
        (lambda: hj.eigenpairs(FIELD.tensors, 3), r"K: got shape .* For tensors, pass TensorField\(grid, tensors\)"),
        (lambda: hj.eigenpairs(FIELD, 3, solver=["dense"]), r"solver: got \['dense'\]; expected \"auto\""),
        (lambda: hj.assemble_forms(FIELD, fields=path), "fields: got 'tensors.nii'; expected a dictionary"),
        (lambda: hj.matrix_function(np.eye(2), np.exp), "f: got .*; expected a function of a JAX scalar"),
        (lambda: hj.crop(np.ones(4), GRID), r"values: got shape \(4,\); expected at least 2 axes"),
        (lambda: hj.boundary_influence(VOLUME, [1.0], 3), "domain: got TensorVolume; expected a TensorField"),
        (lambda: hj.weyl_count(FIELD, [1.0]), "problem: got TensorField; expected the result of `eigenpairs`"),
        (lambda: hj.weyl_count(pairs(), [1.0], GRID), "domain: got Grid; expected a TensorField or a mesh"),
        (lambda: hj.plot.trace(GRID, [[0, 0]]), "field: got Grid; expected hks_jax.TensorField"),
        (lambda: hj.plot.scalar_image(ax, np.ones((4, 5)), FIELD), "grid: got TensorField; expected hks_jax.Grid"),
        (lambda: hj.plot.volume_panels(np.ones((1, 4, 5)), [1.0], VOLUME), "grid: got TensorVolume.*volume.grid"),
        (lambda: hj.plot.time_rows(np.ones((1, 4, 5)), [1.0], GRID), "rows: got float64 .*; expected a dictionary"),
        (lambda: hj.plot.surface(ax, mesh, np.ones(12)), "ax: got axes in two dimensions; expected .*3d"),
        (lambda: hj.plot.signature_panels(path), "result: got str; expected hks_jax.io.Result"),
        (lambda: hj.io.save(path, np.ones((4, 5)), GRID), "volume: got Grid; expected a TensorVolume or a mesh"),
        (lambda: hj.io.save_tensors(path, FIELD), "volume: got TensorField; expected a TensorVolume"),
        (lambda: hj.io.Result(GRID, np.ones((1, 4, 5)), [1.0]), "place: got Grid; expected a TensorVolume or a mesh"),
    ]
    field_functions = (hj.scalar_curvature, hj.gaussian_curvature, hj.degenerate_points, hj.tensor_invariants)
    calls += [(lambda f=f: f(VOLUME), "field: got TensorVolume; expected hks_jax.TensorField") for f in field_functions]
    pair_functions = (hj.shape_dna, hj.default_energies, lambda p: hj.biharmonic_distance(p, [(0, 0)]))
    calls += [(lambda f=f: f(FIELD), "pairs: got TensorField; expected the result of") for f in pair_functions]
    for call, message in calls:
        with pytest.raises((TypeError, ValueError), match=f"^{message}"):
            call()


def test_settings_without_meaning_are_refused():
    known = pairs()
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), known)
    calls = [
        (batch.summary, r"pairs: got a batch with eigenvalues of shape \(2, 5\)"),
        (lambda: hj.weyl_count(batch, [1.0]), r"pairs: got a batch with eigenvalues of shape \(2, 5\)"),
        (lambda: hj.heat_coefficients(known, 1, condition="Neumann"), "condition: got 'Neumann'; expected \"neumann\""),
        (lambda: hj.heat_coefficients(known, NAN), "euler_characteristic: got nan"),
        (lambda: hj.heat_coefficients(known, 1, -1.0), "boundary_length: got -1.0"),
        (lambda: hj.scale_invariant_hks(known, 2.5), "n_frequencies: got 2.5"),
        (lambda: hj.reflect(FIELD, 1.5), "width: got 1.5"),
        (lambda: hj.TensorNoise(np.ones((4, 5, 3, 3)), freedom=-1.0), "freedom: got -1.0"),
        (lambda: hj.region_statistics(np.ones((1, 4)), np.full(4, INF)), "labels: got fractional numbers or infinity"),
        (lambda: hj.plot.evenly_spaced_lines(FIELD, separation=INF), "separation: got inf"),
        (lambda: hj.io.erode(np.full((4, 4), 0.5)), "mask: got dtype float64 with values other than 0 and 1"),
    ]
    for call, message in calls:
        with pytest.raises(ValueError, match=f"^{message}"):
            call()
    with pytest.raises(AttributeError, match=r"spacing: a grid cannot be changed"):
        GRID.spacing = (2.0, 2.0)
