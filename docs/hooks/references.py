"""The list of references in docs/references.md, from references.bib.

python docs/hooks/references.py    writes the list between the page's comments, as `make tables` does
"""

import re
from pathlib import Path

BIBLIOGRAPHY = Path(__file__).parents[2] / "references.bib"
PAGE = Path(__file__).parents[1] / "references.md"
LISTED = re.compile(r"(?<=<!-- references -->\n\n).*?(?=\n\n<!-- end -->)", re.DOTALL)


def entries() -> list[dict[str, str]]:
    """Return the fields of every entry, with its kind and key."""
    found = []
    for kind, key, body in re.findall(
        r"^@(\w+)\{([\w-]+),\n(.*?)^\}", BIBLIOGRAPHY.read_text(encoding="utf-8"), re.M | re.S
    ):
        fields = re.findall(r"^ *(\w+) *= *\{(.*?)\},?$", body, re.M)
        found.append({"kind": kind, "key": key, **{name: re.sub("[{}]", "", value) for name, value in fields}})
    return found


def people(author: str) -> str:
    """Return authors as they are read: last names first in the file, last in the text."""
    names = [" ".join(reversed(name.split(", "))) for name in author.split(" and ")]
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def line(entry: dict[str, str]) -> str:
    """Return an entry as an item of a list."""
    place = entry.get("journal") or entry.get("booktitle") or entry.get("publisher", "")
    volume = f" {entry['volume']}" + (f"({entry['number']})" if "number" in entry else "") if "volume" in entry else ""
    pages = f", {entry['pages'].replace('--', '–')}" if "pages" in entry else ""
    doi = f" [doi:{entry['doi']}](https://doi.org/{entry['doi']})" if "doi" in entry else ""
    return f"- {people(entry['author'])} ({entry['year']}). {entry['title']}. *{place}*{volume}{pages}.{doi}"


def filled() -> str:
    """Return the page with all entries between its comments, by author and year."""
    listing = "\n".join(line(entry) for entry in sorted(entries(), key=lambda entry: (entry["author"], entry["year"])))
    return LISTED.sub(lambda _: listing, PAGE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    PAGE.write_text(filled(), encoding="utf-8")
