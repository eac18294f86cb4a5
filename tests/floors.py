"""The lowest versions that pyproject.toml allows, for pip: ``python tests/floors.py > constraints.txt``."""

import re
import tomllib
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def floors() -> list[str]:
    """Return one constraint for each library that the package or one of its extras requires."""
    groups = (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
    found = (re.match(r"([\w-]+)(?:\[\w+\])?>=([\d.]+)", requirement) for group in groups for requirement in group)
    return sorted({f"{match[1]}=={match[2]}" for match in found if match})


if __name__ == "__main__":
    print("\n".join(floors()))
