"""The README's Python, run as a newcomer would: in an empty folder, warnings as errors."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


DIFFERENCE = """
width = jnp.exp(-20 * jnp.sum(jnp.asarray(grid.nodes) ** 2, axis=-1))[..., None, None]
change = 1e-4 * width * jnp.array([[1.0, 0.3], [0.3, -0.5]])
ends = [float(signature(tensors + sign * change)[0, 18, 18]) for sign in (1, -1)]
print(float(jnp.sum(gradient * change)), (ends[0] - ends[1]) / 2)
print(*(float(x) for x in (values.max(axis=(1, 2)) - values[:, 18, 18]) / jnp.ptp(values, axis=(1, 2))))
"""
"""Code after the README's: the derivative beside a difference quotient, and how far the top is below the maximum."""


@pytest.mark.slow
def test_readme_code_runs_in_an_empty_folder_and_prints_what_it_says(tmp_path):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    command = [sys.executable, "-W", "error", "-c", block + DIFFERENCE]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    at_bump, value, differences, below = done.stdout.splitlines()
    assert f"print(values[:, 18, 18])  # {at_bump}" in block
    assert f'print(f"{{value:.4f}}", gradient.shape)  # {value}' in block
    derivative, difference = map(float, differences.split())
    assert abs(derivative / difference - 1) < 1e-5
    assert all(float(share) < 0.01 for share in below.split())  # the bump is the maximum, as the comment says
    assert (tmp_path / "hks.png").stat().st_size > 10_000


def test_readme_shows_code_at_once_and_is_short():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert lines.index("```python") < 30
    assert len(lines) <= 130


def test_links_of_the_documents_lead_somewhere():
    for page in [*ROOT.glob("*.md"), *(ROOT / "benchmarks").rglob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"
