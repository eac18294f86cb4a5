"""What the documentation must have, checked without building it."""

import ast
import importlib
import re
import sys
from pathlib import Path

import pytest

import hks_jax as hj

ROOT = Path(__file__).parents[2]


@pytest.fixture
def tables(monkeypatch):
    """The scripts that write measurements into pages; they are no package."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    yield importlib.import_module("tables")
    for name in ("tables", "plots"):
        sys.modules.pop(name, None)


def facade(module=""):
    """Return the names that a package or a module gives to its users: imported as themselves, or its own functions."""
    path = ROOT / "hks_jax" / module
    tree = ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8"))
    imports = [alias for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    own = [node.name for node in tree.body if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")]
    return [alias.name for alias in imports if alias.asname == alias.name] + own


def documented():
    """Return the headings of the reference with what is shown under them."""
    pages = sorted((ROOT / "docs" / "reference").glob("*.md"))
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    entries = re.findall(r"^::: (\S+)(?:\n    options: \{heading: (\S+)\})?$", text, re.MULTILINE)
    return [(heading or name, name) for name, heading in entries]


def test_the_reference_has_every_public_name_once():
    names = [f"hks_jax.{name}" for name in (*facade(), *(later for later, at in hj._LATER.items() if ".fem." in at))]
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


def test_tables_and_plots_are_what_was_measured(tables):
    assert tables.differences() == []


def test_the_list_of_references_is_that_of_the_bibliography(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs" / "hooks")
    references = importlib.import_module("references")
    page = references.PAGE.read_text(encoding="utf-8")
    assert references.filled() == page
    assert page.count("\n- ") == len(references.entries()) == references.BIBLIOGRAPHY.read_text("utf-8").count("\n@")


def test_a_changed_result_and_one_shown_nowhere_are_told(tables, monkeypatch):
    stored, named = tables.load, tables.named()
    rows = [{"way": "one by one", "seconds": 0.5, "first_call_s": 0.5}]
    monkeypatch.setattr(tables, "load", lambda name: stored(name) | ({"rows": rows} if name == "batch" else {}))
    monkeypatch.setattr(tables, "named", lambda: named - {"stress"})
    told = ["benchmarks/accelerators/README.md: its tables", "benchmarks/results/stress.json is shown nowhere"]
    assert tables.differences() == told


def test_a_table_has_the_rows_that_its_request_chooses(tables, monkeypatch):
    rows = [{"solver": f"SLEPc, {way}", "seconds": 1.5} for way in ("slicing", "krylov")] + [{"solver": "LaPy"}]
    monkeypatch.setattr(tables, "load", lambda name: {"rows": rows})
    shown = tables.table("any", ["solver=SLEPc??slicing,La*", "solver", "seconds"])
    assert shown.splitlines()[2:] == ["| SLEPc, slicing | 1.5 |", "| LaPy | — |"]
    with pytest.raises(ValueError, match="no row"):
        tables.table("any", ["solver=none", "seconds"])


def test_an_overview_has_the_times_of_each_program_and_dashes_where_there_are_none(tables):
    def measured(file, column, **wanted):
        (row,) = (row for row in tables.load(file)["rows"] if all(row.get(n) == v for n, v in wanted.items()))
        return tables.text(row[column])

    lines = tables.overview(["256²/500", "32³/200"], ROOT / "README.md").splitlines()
    plane, gradient, volume = ([cell.strip() for cell in line.split("|")[2:-1]] for line in lines[2:5])
    assert plane[0] == measured("eigensolvers", "seconds", nodes=65536, k=500, solver="eigsh, SuperLU")
    assert plane[3] == measured("derivatives", "value_s", problem="256²")
    assert gradient[:2] == ["—", "—"]
    assert gradient[2] == measured("derivatives", "gradient_first_s", problem="256²")
    assert gradient[5] == measured("accelerator_h200", "seconds", nodes=65536, k=500, way="gradient of the HKS")
    assert volume[0] == measured("volumes", "seconds", nodes=32768, solver="eigsh, SuperLU")
    assert volume[1] == volume[4] == "—"


@pytest.mark.parametrize(
    ("value", "power", "expected"),
    [
        (262144, 2, "512²"),
        (262144, 3, "64³"),
        (262144, 1, "262,144"),
        (8000, 2, "8,000"),
        (0.137286, 1, "0.137"),
        (1234.5, 1, "1,234"),
        (2.78e-11, 1, "2.8e-11"),
        (None, 1, "—"),
        ([64, 48], 1, "64 × 48"),
    ],
)
def test_numbers_read_as_one_writes_them(tables, value, power, expected):
    assert tables.text(value, power) == expected
