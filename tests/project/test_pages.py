"""The Python of the documentation's pages, run as a reader would run it: page by page, in an empty folder."""

import json
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


PAGES = {page.stem: page for page in sorted((ROOT / "docs").glob("*.md")) if blocks(page)}
# The number of devices is set before JAX starts. The other pages share imports and compilations, in two processes.
ALONE = ["devices"]
TOGETHER = [name for name in PAGES if name not in ALONE]
GROUPS = [ALONE, TOGETHER[::2], TOGETHER[1::2]]

# Each page has names, a folder and settings of its own; those that cannot run are named together.
RUN = """
import json, os, sys, traceback
import jax
failed = []
for page, code in json.load(sys.stdin).items():
    os.mkdir(page)
    os.chdir(page)
    before = dict(jax.config.values)
    try:
        exec(compile(code, page + ".md", "exec"), {"__name__": "__main__"})
    except Exception:
        traceback.print_exc()
        failed.append(page)
    for name, value in before.items():
        if jax.config.values[name] != value:
            jax.config.update(name, value)
    os.chdir("..")
sys.exit(f"pages that fail: {failed}" if failed else 0)
"""


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group[0])
def test_the_code_of_pages_runs_as_printed(group, tmp_path):
    code = json.dumps({name: "\n".join(blocks(PAGES[name])) for name in group})
    command = [sys.executable, "-W", "error", "-c", RUN]
    done = subprocess.run(command, cwd=tmp_path, input=code, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_strain_and_the_pages_of_old_are_among_them():
    assert {"strain", "choices", "devices", "fitting", "spectrum-free"} <= {name for group in GROUPS for name in group}
