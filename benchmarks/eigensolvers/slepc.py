"""SLEPc on the matrices of `eigensolvers.py`, in an interpreter that has slepc4py; NumPy besides.

python slepc.py slicing|krylov petsc|mumps N K END TOLERANCE
"""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
from petsc4py import PETSc
from slepc4py import SLEPc


def matrix(name: str) -> PETSc.Mat:
    """Return a matrix as PETSc's."""
    arrays = np.load(Path(os.environ["EIGENSOLVERS_MATRICES"]) / name)
    n = arrays["indptr"].size - 1
    made = PETSc.Mat().createAIJ((n, n), csr=(arrays["indptr"], arrays["indices"], arrays["data"]))
    made.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return made


def main() -> None:
    """Solve, and print the cost as JSON."""
    method, package, n, k, end, tolerance = sys.argv[1:]
    K, M = matrix(f"K{n}_csr.npz"), matrix(f"M{n}_csr.npz")
    start = time.perf_counter()
    solver = SLEPc.EPS().create()
    solver.setOperators(K, M)
    solver.setProblemType(SLEPc.EPS.ProblemType.GHEP)
    solver.setType(SLEPc.EPS.Type.KRYLOVSCHUR)
    solver.setTolerances(float(tolerance), 1000)
    transform = solver.getST()
    transform.setType(SLEPc.ST.Type.SINVERT)
    linear = transform.getKSP()
    linear.setType(PETSc.KSP.Type.PREONLY)
    linear.getPC().setType(PETSc.PC.Type.CHOLESKY)
    linear.getPC().setFactorSolverType(package)
    if package == "mumps":  # inertia
        PETSc.Options()["mat_mumps_icntl_13"] = 1
    if method == "slicing":
        solver.setInterval(-0.05, float(end))
        solver.setWhichEigenpairs(SLEPc.EPS.Which.ALL)
        solver.setKrylovSchurDimensions(40, 80)
    else:
        solver.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
        solver.setTarget(-0.05)
        solver.setDimensions(int(k), PETSc.DECIDE, 200)
    solver.setFromOptions()
    solver.solve()
    seconds = time.perf_counter() - start
    vector, image, mass = K.createVecRight(), K.createVecRight(), K.createVecRight()
    values, residuals = [], []
    for i in range(solver.getConverged()):
        value = solver.getEigenpair(i, vector).real
        K.mult(vector, image)
        M.mult(vector, mass)
        image.axpy(-value, mass)
        values.append(value)
        residuals.append(image.norm() / mass.norm())
    order = np.argsort(values)
    values, residuals = np.asarray(values)[order], np.asarray(residuals)[order]
    peak = int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 1e6
    worst = float(np.max(residuals / np.maximum(values, values[1])))
    print(json.dumps({"seconds": seconds, "peak_GB": peak, "worst_residual": worst, "eigenvalues": values.tolist()}))


main()
