"""Notebooks in the percent format as pages: text as text, code as code, nothing executed."""

import re
from pathlib import Path

IMAGES = Path(__file__).parents[1] / "images"


def page(path: Path) -> str:
    """Return the page of a notebook, with a link to its file after the title."""
    first, *others = cells(path.read_text(encoding="utf-8"))
    link = (
        f"*A notebook as plain Python: download [{path.name}]({path.name}), run it, or open it in Jupyter (jupytext).*"
    )
    title, _, rest = first.partition("\n")
    return "\n\n".join([title, link, rest.strip("\n"), *others]) + "\n"


def cells(text: str) -> list[str]:
    """Return the cells of a notebook as Markdown. The first is text, and its first line the title.

    Raises:
        ValueError: another first cell.
    """
    found = []
    for cell in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        kind, _, body = cell.partition("\n")
        if "[markdown]" in kind:
            found.append("\n".join(re.sub("^# ?", "", line) for line in body.strip("\n").split("\n")))
        else:
            found.append(f"```python\n{body.strip()}\n```" + pictures(body))
    if not found or not found[0].startswith("# "):
        raise ValueError("notebook: expected a text cell with a title, '# …', first")
    return found


def pictures(code: str) -> str:
    """Return images of what the code saves, those that docs/images has."""
    saved = re.findall(r'save_figure\(\w+, "([\w-]+\.png)"\)', code)
    return "".join(f"\n\n![What the code above draws](../images/{name})" for name in saved if (IMAGES / name).exists())
