"""Pages from files elsewhere in the repository, whose links work in the repository and on the site alike.

README.md becomes the home page, and the notebooks become tutorials. Every page keeps the links that it has in its place
in the repository; they are turned to the site's here.
"""

import importlib.util
import posixpath
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType

import commands
import names
import percent
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]

PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "benchmarks/README.md": "performance/index.md",
    **{
        f"benchmarks/{path.parent.name}/README.md": f"performance/{path.parent.name}.md"
        for path in sorted((ROOT / "benchmarks").glob("*/README.md"))
    },
}
"""Markdown outside docs/, and where it is on the site."""

FOLDERS = {
    "notebooks": "notebooks/quickstart.md",
    "benchmarks": "performance/index.md",
    "benchmarks/results": "performance/index.md",
}
"""Where a link to a folder leads."""

FILES = (
    "notebooks/*.py",
    "benchmarks/*/*.py",
    "benchmarks/results/*.json",
    "references.bib",
    "CITATION.cff",
    "LICENSE",
    "pyproject.toml",
)
"""Files that are on the site as they are, under the path that they have in the repository."""

LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s#]+)")


@cache
def gallery() -> ModuleType:
    """Return docs/gallery.py, which holds the code of the pictures."""
    spec = importlib.util.spec_from_file_location("gallery", ROOT / "docs" / "gallery.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


MARKERS: dict[str, Callable[[str], str]] = {
    "commands": commands.reference,
    "gallery": lambda name: gallery().code(name),
}
"""What replaces ``<!-- name: argument -->`` in a page, and needs the argument."""


def repository_paths() -> dict[str, str]:
    """Return where on the site each page and file of the repository is that is not in docs/."""
    found = dict(PAGES) | FOLDERS
    for pattern in FILES:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            found[name] = name
    # A link to a notebook leads to its page, and only there to the file.
    return found | {name: name.removesuffix(".py") + ".md" for name in found if name.startswith("notebooks/")}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the notebooks that the navigation does not name where it has ``notebooks/*``."""
    config.markdown_extensions.append(names.PublicNames())
    listed = str(config.nav)
    pages = [f"notebooks/{path.stem}.md" for path in sorted((ROOT / "notebooks").glob("*.py"))]
    others = [page for page in pages if page not in listed]
    for section in config.nav or []:
        for title, entries in section.items():
            if isinstance(entries, list) and "notebooks/*" in entries:
                place = entries.index("notebooks/*")
                section[title] = [*entries[:place], *others, *entries[place + 1 :]]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what is outside docs/."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    for path in sorted((ROOT / "notebooks").glob("*.py")):
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=percent.page(path)))
    for pattern in FILES:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in what a page leaves to the build, and turn its links."""
    if page.parent is None:
        page.meta.setdefault("hide", ["navigation"])  # there is nothing beside it
    turned_links = turned(markdown, page.file.src_uri, repository_paths())
    return re.sub(r"<!-- (\w+): (.*?) -->", lambda m: MARKERS[m[1]](m[2]) if m[1] in MARKERS else m[0], turned_links)


def turned(markdown: str, page: str, places: dict[str, str]) -> str:
    """Return a page of the site with the links that it has in the repository turned to the site's."""
    sources = {site: source for source, site in places.items() if source in PAGES or source.endswith(".py")}
    folder = posixpath.dirname(sources.get(page, f"docs/{page}"))

    def turn(link: re.Match) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[1]))
        if target.startswith("docs/"):
            place = target.removeprefix("docs/")
        elif places.get(target, page) != page:
            place = places[target]
        else:
            return link[1]  # from a notebook's page to its file; or nowhere, as mkdocs will say
        return posixpath.relpath(place, posixpath.dirname(page) or ".")

    return LINK.sub(turn, markdown)
