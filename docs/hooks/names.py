"""A Markdown extension: code that is a public name, as `eigenpairs` or `hj.eigenpairs`, links to its reference."""

import re
from functools import cache
from pathlib import Path
from xml.etree.ElementTree import Element

from markdown import Markdown
from markdown.extensions import Extension
from markdown.treeprocessors import Treeprocessor

REFERENCE = Path(__file__).parents[1] / "reference"


def documented() -> dict[str, str]:
    """Return the names that the reference documents, ``hks_jax.Grid``, with what mkdocstrings calls them there.

    The two differ where a module has the name of its function, which mkdocstrings would take for the module.
    """
    entry = re.compile(r"^::: (\S+)(?:\n    options: \{heading: (\S+)\})?$", re.MULTILINE)
    texts = [page.read_text(encoding="utf-8") for page in sorted(REFERENCE.glob("*.md"))]
    return {heading or identifier: identifier for text in texts for identifier, heading in entry.findall(text)}


@cache
def links() -> dict[str, str]:
    """Return the places in the reference of what one may write in the text."""
    found = {}
    for name, identifier in documented().items():
        module, _, short = name.removeprefix("hks_jax.").rpartition(".")
        written = {name, f"hj.{name.removeprefix('hks_jax.')}"}
        if module in ("", "inverse"):
            written |= {short, f"hj.{short}"}
        elif module == "plot" and "_" in short:  # others are everyday words
            written |= {short}
        # The package's own names first: `degenerate_points` is a picture as well.
        found |= {text: identifier for text in written if module == "" or text not in found}
    return found


class _Links(Treeprocessor):
    """Wraps such code in a reference that mkdocs-autorefs resolves."""

    def run(self, root: Element) -> None:
        self._within(root)

    def _within(self, parent: Element) -> None:
        for place, child in enumerate(list(parent)):
            if child.tag in ("a", "pre", "autoref", "h1", "h2", "h3", "h4"):
                continue
            name = re.sub(r"\(.*\)$", "", child.text or "") if child.tag == "code" else ""
            if name in links() and not len(child):
                reference = Element("autoref", {"identifier": links()[name], "optional": ""})
                reference.tail, child.tail = child.tail, None
                parent[place] = reference
                reference.append(child)
            else:
                self._within(child)


class PublicNames(Extension):
    """The extension; a blank `Markdown` that gets it must also have mkdocs-autorefs."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register after inline code is code."""
        md.treeprocessors.register(_Links(md), "public-names", 15)
