"""Draw docs/images/explore.png: the page of the demo's brain, in a headless Chromium (docs/explore.md).

python notebooks/brains/explore_page.py [-o docs/images/explore.png]
"""

import argparse
import sys
import tempfile
from pathlib import Path

import hks_jax as hj
from hks_jax.cli import main as hks_jax
from hks_jax.cli.demo import B_MAX, RIM

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from browser import Browser


def write_page(folder: Path) -> Path:
    """Write the page of a slice of the brain that the demo shows, and return its path."""
    brain = hj.io.find_example_brain()
    assert brain is not None, "pip install --no-deps mdt==1.2.7"
    words = [brain.images, "--bval", brain.bval, "--bvec", brain.bvec, "--mask", brain.mask, "--b-max", B_MAX]
    words += ["--slice", "z=0", "--erode", RIM, "--components", "largest", "--metric", "inverse", "-k", 600]
    assert hks_jax(["hks", *map(str, words), "-o", str(folder), "--times", "auto:24"]) == 0
    assert hks_jax(["explore", str(folder), "--title", "A brain slice"]) == 0
    return folder / "explore.html"


def main() -> None:
    """Write the page, use it, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images/explore.png"))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Browser(folder / "browser", 1240, 1330) as browser:
            browser.open(write_page(folder / "out"))
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
