"""Series of maps in modes: the processor time of `decompose` and `reconstruct` beside NumPy's product of the same size.

    python benchmarks/spectrum_free/maps.py [-o FILE]

200 maps on 37³ nodes (50 653) in 100 modes. NumPy's product has the maps and the modes as factors, or the coefficients
and the modes, and no mass. Seconds are of all processors, the least of three calls after the first.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from machine import RESULTS, field, write

import hks_jax as hj

N, MODES, MAPS = 37, 100, 200


def processor(function: Callable[[], Any]) -> float:
    """Return the least processor time of three calls after the first, in seconds."""
    jax.block_until_ready(function())
    spent = []
    for _ in range(3):
        begin = time.process_time()
        jax.block_until_ready(function())
        spent.append(time.process_time() - begin)
    return min(spent)


def measured(dtype: type) -> list[dict]:
    """Measure both functions in one precision."""
    whole = field(N, 3)
    pairs = hj.eigenpairs(hj.TensorField(whole.grid, whole.tensors.astype(dtype)), MODES)
    f = jnp.asarray(np.random.default_rng(0).standard_normal((MAPS, N, N, N)), dtype)
    c = hj.decompose(pairs, f)
    maps, modes, coefficients = np.asarray(f).reshape(MAPS, -1), np.asarray(pairs.vectors), np.asarray(c)
    rows = []
    for name, ours, numpy in (
        ("decompose", lambda: hj.decompose(pairs, f), lambda: maps @ modes.T),
        ("reconstruct", lambda: hj.reconstruct(pairs, c), lambda: coefficients @ modes),
    ):
        row = {"call": name, "dtype": np.dtype(dtype).name, "maps_MB": maps.nbytes / 1e6}
        row |= {"processor_s": processor(ours), "numpy_s": processor(numpy)}
        rows.append(row | {"ratio": row["processor_s"] / row["numpy_s"]})
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Measure in single and double precision."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "maps.json")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    write(args.output, measured(np.float32) + measured(np.float64))


if __name__ == "__main__":
    main()
