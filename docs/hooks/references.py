"""The list of references, from references.bib."""

import re
from pathlib import Path

BIBLIOGRAPHY = Path(__file__).parents[2] / "references.bib"


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


def listing(_: str) -> str:
    """Return all entries, by author and year."""
    return "\n".join(line(entry) for entry in sorted(entries(), key=lambda entry: (entry["author"], entry["year"])))
