"""A step under `jax.jit`: seconds and memory of its compilation, and seconds of later calls.

    python benchmarks/first_answer/jit.py [--cases 64²/100 …] [-o FILE]

The step is the value of a loss on the signature at three times, and its gradient with respect to the tensors or the
vertices. Each row is a process of its own. The ways differ in the compiler's options (`hks_jax.compiler_options`) and
in the solver.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

CASES = {
    "64²/100": (2, 64, 100, "neumann"),
    "128²/100 mean": (2, 128, 100, "mean"),
    "mesh4000/100": (0, 4_000, 100, "neumann"),
    "24³/60": (3, 24, 60, "neumann"),
}
"""Dimension (0 for a surface), nodes along an axis or in all, k, and the boundary."""
WAYS = {
    "default": (False, "auto"),
    "options": (True, "auto"),
    "options, in JAX": (True, "in JAX"),
}
"""Whether the step is compiled with the options, and the solver; "in JAX" is block Lanczos or the Chebyshev filter."""
TIMES = (0.02, 0.05, 0.1)


def child(case: str, way: str) -> None:
    """Compile and run one step, and print its measurements."""
    import jax
    import jax.numpy as jnp
    from first_answer import surface, tensors

    import hks_jax as hj

    jax.config.update("jax_enable_x64", True)
    d, n, k, boundary = CASES[case]
    with_options, solver = WAYS[way]
    solver = solver if solver == "auto" else "chebyshev-filter" if d == 3 else "block-lanczos"
    grid = hj.Grid((n,) * d, 1 / (n - 1)) if d else None
    points, triangles = (tensors(d, n)[0], None) if d else surface(n)
    x = jnp.asarray(points)

    def domain(x: Any) -> Any:
        return hj.TensorField(grid, x) if d else hj.SurfaceMesh(x, triangles)

    def loss(x: Any) -> Any:
        return jnp.sum(hj.hks(hj.eigenpairs(domain(x), k, boundary, solver=solver), TIMES) ** 2)

    step = jax.jit(jax.value_and_grad(loss), compiler_options=hj.compiler_options() if with_options else None)
    begin, of_processors = time.perf_counter(), time.process_time()
    compiled = step.lower(x).compile()
    found = {"compilation_s": time.perf_counter() - begin, "processor_s": time.process_time() - of_processors}
    found["peak_GB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    later = []
    for _ in range(6):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(x))
        later.append(time.perf_counter() - begin)
    print(json.dumps(found | {"later_s": min(later[1:])}))


def main() -> None:
    """Measure all cases in all ways, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", type=Path)
    args = parser.parse_args()
    if args.child:
        child(*args.child)
        return
    from machine import RESULTS, write

    rows = []
    for case in args.cases:
        for way in args.ways:
            command = [sys.executable, __file__, "--child", case, way]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            rows.append({"case": case, "way": way} | json.loads(done.stdout.splitlines()[-1]))
            print(rows[-1])
    write(args.output or RESULTS / "jit.json", rows)


if __name__ == "__main__":
    main()
