"""The README's Python, run as a newcomer would: in an empty folder, warnings as errors."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_readme_code_runs_in_an_empty_folder(tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert "jax.grad" in "".join(blocks)
    command = [sys.executable, "-W", "error", "-c", "\n".join(blocks)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "120 of 120 converged" in done.stdout
    # K = −∇² log f / 2f of the metric f·I, here −(−40/11)/22
    curvature, signature = map(float, done.stdout.splitlines()[-1].split())
    assert abs(curvature - 40 / 11 / 22) < 1e-12
    assert 1 < signature < 1.1  # 1 + Kt/3 at t = 0.56
    assert (tmp_path / "hks.png").stat().st_size > 10_000


def test_links_of_the_documents_lead_somewhere():
    for page in [*ROOT.glob("*.md"), *(ROOT / "benchmarks").rglob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"
