"""Eigensolvers of two versions of this package, in turn: whether a change made a case slower.

    git worktree add /tmp/before SOME_COMMIT
    python benchmarks/first_answer/versions.py /tmp/before [--cases 256²/500 48³/200 …] [--repeats 5] [-o FILE]

Each version has a process of its own for a case. They solve by turns, so that other work on the machine meets both; a
ratio is that of the shortest times, in all and of the processors. Random and flat metrics: the flat one has
multiplets.
"""

import argparse
import json
import os
import re
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

CASES = ["64²/100", "128²/100", "256²/100", "512²/100", "256²/200", "256²/500", "32³/200", "48³/200"]
FIELDS = ("random", "flat")
TOLERANCE = 1e-8


def answer(case: str, field_name: str) -> None:
    """Solve once for each line that comes, and print the seconds that this took, and the eigenvalues."""
    import time

    import jax
    import jax.numpy as jnp
    from machine import field, timed_once

    import hks_jax as hj

    jax.config.update("jax_enable_x64", True)
    n, d, k = parsed(case)
    metric = field(n, d)
    if field_name == "flat":
        metric = hj.TensorField(metric.grid, jnp.broadcast_to(jnp.eye(d), metric.tensors.shape))
    pencil = hj.assemble(metric)
    solver = (hj.BlockLanczos if d == 2 else hj.ChebyshevFilter)(tolerance=TOLERANCE)
    for _ in sys.stdin:
        begin = time.process_time()
        seconds, result = timed_once(solver.lowest, pencil, k)
        print(json.dumps([seconds, time.process_time() - begin, np.asarray(result[0]).tolist()]), flush=True)


def parsed(case: str) -> tuple[int, int, int]:
    """Return the nodes along an axis, the dimension and the number of pairs of a case, such as 48³/200."""
    match = re.fullmatch(r"(\d+)([²³])/(\d+)", case)
    if match is None:
        raise ValueError(f"cases: got {case!r}; expected such as 256²/500 or 48³/200")
    return int(match[1]), 2 + (match[2] == "³"), int(match[3])


def compare(case: str, field_name: str, checkouts: list[Path], repeats: int) -> dict:
    """Return the times of both versions for a case, the older one first."""
    command = [sys.executable, __file__, "--answer", case, field_name]
    running = [
        subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": str(checkout)},
        )
        for checkout in checkouts
    ]
    times: list[list[list[float]]] = [[], []]
    values: list[list[float]] = [[], []]
    try:
        for turn in range(1 + repeats):
            for which in (0, 1) if turn % 2 else (1, 0):
                stdin, stdout = running[which].stdin, running[which].stdout
                assert stdin is not None
                assert stdout is not None
                print(file=stdin, flush=True)
                *seconds, values[which] = json.loads(stdout.readline())
                if turn:  # the first compiles
                    times[which].append(seconds)
    finally:
        for process in running:
            process.kill()
            process.wait()
    before, after = (np.min(each, axis=0) for each in times)
    n, d, k = parsed(case)
    difference = np.max(np.abs(np.subtract(*values)) / np.maximum(values[0], values[0][1]))
    return {
        "nodes": n**d,
        "k": k,
        "case": case,
        "field": field_name,
        "seconds_before": before[0],
        "seconds": after[0],
        "ratio": after[0] / before[0],
        "processor_ratio": after[1] / before[1],
        "eigenvalue_difference": difference,
    }


def main() -> None:
    """Compare case by case, print and write the results."""
    if sys.argv[1:2] == ["--answer"]:
        answer(*sys.argv[2:4])
        return
    from machine import RESULTS, write

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", type=Path, help="a checkout of the other version")
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="N²/K")
    parser.add_argument("--fields", nargs="+", default=FIELDS, choices=FIELDS)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "versions.json")
    arguments = parser.parse_args()
    commit = ["git", "-C", str(arguments.before), "rev-parse", "--short", "HEAD"]
    before = subprocess.run(commit, capture_output=True, text=True, check=True).stdout.strip()
    checkouts = [arguments.before.resolve(), Path(__file__).resolve().parents[2]]
    rows = []
    for case in arguments.cases:
        for field_name in arguments.fields:
            rows.append(compare(case, field_name, checkouts, arguments.repeats))
            print(
                " ".join(f"{key} {x:.3g}" if isinstance(x, float) else f"{x}" for key, x in rows[-1].items()),
                flush=True,
            )
            write(arguments.output, rows, before=before, tolerance=TOLERANCE)


if __name__ == "__main__":
    main()
