"""Draw docs/images/explore.png: the page of the demo's brain, in a headless Chromium (docs/explore.md).

python notebooks/brains/explore_page.py [-o docs/images/explore.png]
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

import hks_jax as hj
from hks_jax.cli.demo import B_MAX, RIM

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from browser import Browser

BOUNDARY, PAIRS, TIMES = "mean", 600, 24


def write_page(path: Path) -> None:
    """Write the page of a slice of the brain that the demo shows."""
    brain = hj.io.find_example_brain()
    assert brain is not None, "pip install --no-deps mdt==1.2.7"
    plane = hj.io.fit_dwi(brain.images, brain.bval, brain.bvec, brain.mask, b_max=B_MAX).slice("z", 0)
    plane = replace(plane, mask=hj.io.erode(plane.inside, RIM))
    grid = plane.grid("largest")
    field = hj.TensorField.from_diffusion(grid, plane.tensors.astype(float), metric="inverse")
    pairs = hj.eigenpairs(field, PAIRS, boundary=BOUNDARY)
    times = np.asarray(hj.default_times(pairs, TIMES))
    values, eigenvalues = (np.asarray(array) for array in (hj.hks(pairs, times), pairs.eigenvalues))
    report = {"settings": {"metric": "inverse", "boundary": BOUNDARY}}
    arrays = {"influence": np.asarray(hj.boundary_influence(pairs, times))}
    result = hj.io.Result(plane.with_mask(grid.mask), values, times, eigenvalues, report, arrays)
    hj.plot.explore(result, path, title="A brain slice")


def main() -> None:
    """Write the page, use it, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images/explore.png"))
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_page(folder / "page.html")
        with Browser(folder / "browser", 1240, 1330) as browser:
            browser.open(folder / "page.html")
            browser.choose("#time", "8")
            browser.click("#signature", 0.362, 0.495)
            browser.click("#signature", 0.641, 0.495, shift=True)
            browser.choose("#region", "2")
            browser.choose("#alike", "40")
            browser.run("scrollTo(0, 0)")
            browser.picture(args.output, whole=False)
            assert browser.problems == [], browser.problems


if __name__ == "__main__":
    main()
