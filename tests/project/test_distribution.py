"""What is published: the declared dependencies, the version, the description, and what a wheel may hold."""

import ast
import re
import sys
import tomllib
import zipfile

from distribution import ROOT, files_of, wheel_differences

import hks_jax as hj

PROJECT, TOOLS = map(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8")).get, ("project", "tool"))
EXTRAS = ("dti", "nrrd", "mesh", "vtk", "pyvista")
MODULES = {"pynrrd": "nrrd"}
PART_OF = {"mpl_toolkits": "matplotlib", "vtkmodules": "vtk"}


def imported(top_level):
    """Return the packages that some file of the package imports: at its top level, or within functions only."""
    found = set()
    for path in (ROOT / "hks_jax").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body if top_level else ast.walk(tree):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"hks_jax"}


def declared(requirements):
    names = {re.match(r"[\w-]+", requirement)[0] for requirement in requirements}
    return {MODULES.get(name, name) for name in names}


def test_all_that_is_imported_is_declared():
    required = declared(PROJECT["dependencies"])
    extras = set().union(*(declared(PROJECT["optional-dependencies"][name]) for name in EXTRAS))
    always, sometimes = ({PART_OF.get(name, name) for name in imported(top)} for top in (True, False))
    assert always <= required <= sometimes
    assert sometimes <= required | extras


def test_every_requirement_has_a_floor():
    for group in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()):
        for requirement in group:
            assert ">=" in requirement or requirement.startswith("hks-jax["), requirement


def test_one_version_and_one_address():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert PROJECT["version"] == hj.__version__
    assert f"\nversion: {hj.__version__}\n" in citation
    assert f"\nrepository-code: {PROJECT['urls']['Repository']}\n" in citation
    assert all(url.startswith(PROJECT["urls"]["Repository"]) for url in PROJECT["urls"].values())
    first = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)[1]
    assert first in ("Unreleased", hj.__version__)


def test_a_released_version_has_a_date_and_no_other_has():
    changes, citation = ((ROOT / name).read_text(encoding="utf-8") for name in ("CHANGELOG.md", "CITATION.cff"))
    heading = re.search(r"^## .*", changes, re.MULTILINE)[0]
    assert bool(re.search(r"^date-released: \d{4}-\d\d-\d\d$", citation, re.MULTILINE)) == (
        "not yet released" not in heading and "Unreleased" not in heading
    )


def test_the_workflows_run_every_target_of_ci_and_exist_in_the_makefile():
    lists = re.findall(
        r"^(?:for target in (.*); do|make --jobs.*\" (.*))$", (ROOT / ".ci/run").read_text("utf-8"), re.M
    )
    everything = set(" ".join(map(" ".join, lists)).split()) - {"tools"}  # which only installs
    assert {"test", "lint", "dist"} <= everything
    defined = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    workflows = [path.read_text(encoding="utf-8") for path in (ROOT / ".github/workflows").glob("*.yml")]
    called = set(" ".join(re.findall(r"- run: make ([a-z -]+)$", "\n".join(workflows), re.MULTILINE)).split())
    listed = {t for text in workflows for found in re.findall(r"target: \[(.*)\]", text) for t in found.split(", ")}
    assert everything <= called | listed <= defined


def test_every_link_of_the_description_is_absolute_and_leads_somewhere():
    """The rules that the build applies to README.md; `make dist` looks at their result in the wheel."""
    description = (ROOT / "README.md").read_text(encoding="utf-8")
    for rule in TOOLS["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        description = re.sub(rule["pattern"], rule["replacement"], description)
    description = description.replace("$HFPR_VERSION", hj.__version__)
    links = re.findall(r"\]\(([^)]+)\)", description)
    start = re.compile(rf"{re.escape(PROJECT['urls']['Repository'])}/(raw|blob)/v{re.escape(hj.__version__)}/([^#]+)")
    assert len(links) > 20
    for link in links:
        found = start.match(link)
        assert link.startswith(("https://", "#")), link
        if found:
            assert (ROOT / found[2]).exists(), link
            assert (found[1] == "raw") == link.endswith((".png", ".svg")), link


def test_a_wheel_with_more_or_less_than_the_package_is_told(tmp_path):
    info = f"hks_jax-{hj.__version__}.dist-info"
    held = {name: "" for name in files_of(ROOT / "hks_jax") if name != "hks_jax/py.typed"}
    held |= {f"{info}/{name}": "" for name in ("WHEEL", "RECORD", "entry_points.txt")}
    held |= {f"{info}/licenses/LICENSE": "", "tests/fields.py": ""}
    held[f"{info}/METADATA"] = "Project-URL: a, b\nLicense-Expression: c\n\n# hks_jax\n[gallery](docs/gallery.md)\n"
    with zipfile.ZipFile(tmp_path / "hks_jax.whl", "w") as archive:
        for name, content in held.items():
            archive.writestr(name, content)
    told = wheel_differences(tmp_path / "hks_jax.whl")
    assert told == [
        "hks_jax.whl lacks hks_jax/py.typed",
        "hks_jax.whl holds tests/fields.py, which it should not",
        "hks_jax.whl: the description is not README.md with absolute links",
    ]
