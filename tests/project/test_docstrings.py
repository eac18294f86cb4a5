"""Every public function, and every class that users make, has an example in its docstring that prints what it says."""

import doctest
import re

import numpy as np
import pytest
from test_documentation import ROOT, documented

import hks_jax as hj

MADE_BY_THE_LIBRARY = """
Adjoint Alignment AutomaticHKS Colouring DegeneratePoints DenseEigenpairs Eigenpairs Eigensolver ExampleBrain
FactorisedMatrix Identifiability MetricFit MirrorPencil ModeEnergies Parametrisation Pencil Posterior Regulariser
RegionStatistics Signature Step SymmetricPencil Truncation Uncertainty hks_jax.LogDeterminant
"""  # results, and what is there to be subclassed
NO_CALL = "AccuracyWarning RESULTS REPAIRS ORDERS UNITS examples"  # codes, choices, and a module
SLOW = """
ChebyshevFilter Data FactorisedAdjoint FilteredAdjoint Free H1 HostAdjoint Multifrontal Search TensorField TensorNoise
TotalVariation ball_mesh boundary_influence count_eigenvalues degenerate_point_field eigsh factorise fit_metric
fit_panels gaussian_curvature heat_flow hks_auto hks_expansion hks_spectrum_free identifiability log_determinant phantom
scalar_curvature smooth_tensors uncertainty varadhan_distance
"""  # long for the compiler, above all fits
NEEDS = {"isosurfaces": "pyvista", "fit_dwi": "dipy", "read_mesh": "meshio", "read_mesh_arrays": "meshio"}

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def among(name, listed):
    """Return whether a name is in a list, whole or its last part."""
    return bool({name, name.split(".")[-1]} & set(listed.split()))


def public():
    """Return the names in the reference that have an example, and those of the functions of `hks_jax.examples`."""
    code = (ROOT / "hks_jax" / "domain" / "examples.py").read_text(encoding="utf-8")
    names = [name for name, _ in documented() if not among(name, MADE_BY_THE_LIBRARY + NO_CALL)]
    return names + [f"hks_jax.examples.{name}" for name in re.findall(r"^def ([a-z]\w*)", code, re.MULTILINE)]


def run(thing, name, names, **options):
    """Run the examples of a docstring, and of a class's methods; return how many there are, and the names after."""
    told, count = [], 0
    for found in doctest.DocTestFinder(**options).find(thing, name, module=False, globs=names):
        count += len(found.examples)
        if doctest.DocTestRunner(optionflags=FLAGS).run(found, out=told.append, clear_globs=False).failed:
            pytest.fail("".join(told), pytrace=False)
    return count, found.globs


@pytest.fixture(scope="module")
def given():
    """The names that all examples take for granted, as the package's docstring makes them."""
    names = run(hj, "hks_jax", {}, recurse=False)[1]
    yield names
    names["folder"].rmdir()


def write_scan(folder):
    """Write a scan of the diffusivity 10⁻³ mm²/s in all directions."""
    nibabel = pytest.importorskip("nibabel")
    directions = np.vstack([np.zeros(3), np.eye(3), (1 - np.eye(3)) / np.sqrt(2)])
    b = 1000 * (directions**2).sum(axis=1)
    signal = np.tile(1000 * np.exp(-1e-3 * b), (2, 2, 2, 1))
    nibabel.save(nibabel.Nifti1Image(signal, np.eye(4)), folder / "dwi.nii")
    np.savetxt(folder / "dwi.bval", b[None])
    np.savetxt(folder / "dwi.bvec", directions)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if among(name, SLOW) else []) for name in public()],
)
def test_the_example_in_the_docstring_prints_what_it_says(name, given, tmp_path):
    *modules, last = name.split(".")
    pytest.importorskip(NEEDS.get(last, "numpy"))
    if last == "fit_dwi":
        write_scan(tmp_path)
    thing = hj
    for part in (*modules[1:], last):
        thing = getattr(thing, part)
    assert run(thing, name, {**given, "folder": tmp_path})[0], f"{name}: no example in its docstring"
