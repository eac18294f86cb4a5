"""What the documentation must have, checked without building it."""

import ast
import re
from pathlib import Path

import pytest

import hks_jax as hj

ROOT = Path(__file__).parents[1]


def facade(module=""):
    """Return the names that a package imports as themselves: what it gives to its users."""
    tree = ast.parse((ROOT / "hks_jax" / module / "__init__.py").read_text(encoding="utf-8"))
    imports = [alias for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    return [alias.name for alias in imports if alias.asname == alias.name]


def documented():
    """Return the headings of the reference with what is shown under them."""
    pages = sorted((ROOT / "docs" / "reference").glob("*.md"))
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    entries = re.findall(r"^::: (\S+)(?:\n    options: \{heading: (\S+)\})?$", text, re.MULTILINE)
    return [(heading or name, name) for name, heading in entries]


def test_the_reference_has_every_public_name_once():
    names = [f"hks_jax.{name}" for name in facade()]
    for module in ("plot", "io", "inverse", "devices"):
        assert getattr(hj, module)  # imported when asked for, so not in the façade
        names += [f"hks_jax.{module}.{name}" for name in facade(module)]
    assert len(names) > 80
    assert sorted(name for name, _ in documented()) == sorted([*names, "hks_jax.examples"])


def test_the_reference_shows_functions_and_not_the_modules_of_the_same_name():
    for heading, shown in documented():
        if heading != "hks_jax.examples":
            assert not (ROOT / shown.replace(".", "/")).with_suffix(".py").exists(), f"{heading}: {shown} is a module"


@pytest.mark.parametrize("name", ["fit_metric", "identifiability"])
def test_what_is_imported_when_asked_for_is_in_the_reference(name):
    assert getattr(hj, name) is getattr(hj.inverse, name)
    assert f"hks_jax.inverse.{name}" in dict(documented())


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2].partition("\ntheme:")[0]
    named = set(re.findall(r"[\w/*-]+\.md|notebooks/\*", navigation))
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert pages <= named
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.py")}
    assert "notebooks/*" in named or notebooks <= named
