"""The description for the package's page: README.md, with absolute links where its own lead within the repository.

Everything else is in pyproject.toml.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).resolve().parent
PICTURES = (".png", ".svg")


def description() -> str:
    """Return README.md with absolute links, to the release's own state of the repository."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    repository, tag = project["urls"]["Repository"], f"v{project['version']}"

    def absolute(target: re.Match) -> str:
        path, _, _ = target[0].partition("#")
        return f"{repository}/{'raw' if path.endswith(PICTURES) else 'blob'}/{tag}/{target[0]}"

    return re.sub(r"(?<=\]\()(?![a-z]+:|#)[^)\s]+", absolute, (ROOT / "README.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    setup(long_description=description(), long_description_content_type="text/markdown")
