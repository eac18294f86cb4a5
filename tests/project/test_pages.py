"""The Python of the documentation's pages, run as a reader would run it: page by page, in an empty folder."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)
# Files of the reader's, and addresses of other machines, are not here.
NOT_HERE = ("heart.vtu", "lh.white", "dti.nii.gz", "dwi.nii.gz", "jax.distributed.initialize", "dask.distributed")


def blocks(page):
    """Return the blocks of a page that need nothing from elsewhere."""
    found = PYTHON.findall(page.read_text(encoding="utf-8"))
    return [block for block in found if not any(name in block for name in NOT_HERE)]


PAGES = [page for page in sorted((ROOT / "docs").glob("*.md")) if blocks(page)]


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_code_of_a_page_runs_as_printed(page, tmp_path):
    command = [sys.executable, "-W", "error", "-c", "\n".join(blocks(page))]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_strain_and_the_pages_of_old_are_among_them():
    assert {"strain", "choices", "devices", "fitting", "spectrum-free"} <= {page.stem for page in PAGES}
