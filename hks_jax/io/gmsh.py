"""The numbers, tags and arrays of Gmsh's files, formats 2.2 and 4.1.

Arrays refer to nodes and elements by tags, which need not be ascending or complete. meshio 5.3 ignores the tags, so
that it misplaces values or fails; it reads the mesh without arrays, and this module places them.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

_HEAD = re.compile(rb"\s*(?:\$Comments.*?\$EndComments\s*)?\$MeshFormat\s+(\S+)\s+([01])\s+([48])\b", re.DOTALL)
_ARRAYS = re.compile(rb"^\$(NodeData|ElementData)\b[^\n]*\n(.*?)\$End\1\b", re.DOTALL | re.MULTILINE)


class Head(NamedTuple):
    """The first digit of the format, whether the file is text, and the bytes of a size in binary files."""

    version: int
    text: bool
    width: int


def declared(content: bytes) -> tuple[int, int, int]:
    """Return the declared numbers of nodes and elements, and the largest node tag, the length of an array in meshio."""
    head = _head(content)
    nodes, elements = (_section(content, name) for name in (b"Nodes", b"Elements"))
    if head.version == 4:
        (_, n_nodes, _, largest), (_, n_elements, _, _) = (
            map(int, each.split(maxsplit=4)[:4] if head.text else _numbers(each, 4, f"<u{head.width}"))
            for each in (nodes, elements)
        )
        return n_nodes, n_elements, largest
    n_nodes, n_elements = (int(each.partition(b"\n")[0]) for each in (nodes, elements))
    for each, n in ((nodes, n_nodes), (elements, n_elements)) if head.text else ():
        there = len(_lines(each)) - 1
        if there != n:  # meshio ignores further lines
            raise ValueError(f"the file declares {n} nodes or elements, but has {there} lines for them")
    return n_nodes, n_elements, int(_node_tags(content, head).max(initial=0))


def split(content: bytes) -> tuple[bytes, list[tuple[str, bytes]]]:
    """Return the content without the sections of arrays, and the name and the content of these sections."""
    bare = _ARRAYS.sub(b"", content)
    if cut := re.search(rb"^\$(NodeData|ElementData)\b", bare, re.MULTILINE):
        raise ValueError(f"the file has no complete section ${cut[1].decode()}")
    return bare, [(name.decode(), body) for name, body in _ARRAYS.findall(content)]


def arrays(
    content: bytes, sections: Sequence[tuple[str, bytes]], corners: Int[np.ndarray, " n"]
) -> tuple[dict[str, Float[np.ndarray, "V ..."]], dict[str, Float[np.ndarray, "n ..."]]]:
    """Return the arrays at the nodes and at the elements, in the order of the file, with NaN where a value is missing.

    Steps of an array after the first one have their number in the name. The elements have `corners` nodes each.
    """
    if not sections:
        return {}, {}
    head = _head(content, with_arrays=True)
    found: dict[str, dict[tuple[bytes, int], np.ndarray]] = {"NodeData": {}, "ElementData": {}}
    for kind in {kind for kind, _ in sections}:
        tags = _node_tags(content, head) if kind == "NodeData" else _element_tags(content, head, corners)
        order = np.argsort(tags, kind="stable")
        for name, step, given, values in (_data(body, head.text) for other, body in sections if other == kind):
            place = order[np.searchsorted(tags, given, sorter=order).clip(max=len(tags) - 1)]
            if (tags[place] != given).any():
                raise ValueError(f"${kind} has a value at {given[tags[place] != given][0]}, which is not in the file")
            # Partitions of a mesh have sections of their own.
            array = found[kind].setdefault((name, step), np.full((len(tags), *values.shape[1:]), np.nan))
            array[place] = values
    at_nodes, at_elements = map(_named, found.values())
    return at_nodes, at_elements


def _named(steps: dict[tuple[bytes, int], np.ndarray]) -> dict[str, np.ndarray]:
    named: dict[str, np.ndarray] = {}
    for (name, step), array in steps.items():
        text = name.decode(errors="replace")
        named[text if text not in named else f"{text}, step {step}"] = array
    return named


def _data(body: bytes, text: bool) -> tuple[bytes, int, np.ndarray, np.ndarray]:
    """Return the name, the step, the tags and the values of a section of arrays."""
    tags: list[list[bytes]] = []
    for _ in range(3):  # names, real numbers, integers
        count, _, body = body.partition(b"\n")
        *these, body = body.split(b"\n", int(count))
        tags.append(these)
    (name, *_), (step, components, rows) = tags[0], (int(each) for each in tags[2][:3])
    if text:
        table = np.array(body.split(), np.float64).reshape(rows, 1 + components)
        given, values = table[:, 0].astype(np.int64), table[:, 1:]
    else:
        record = np.frombuffer(body, np.dtype([("tag", "<i4"), ("values", "<f8", (components,))]), rows)
        given, values = record["tag"].astype(np.int64), record["values"]
    return name.strip().strip(b'"'), step, given, values[:, 0] if components == 1 else values


def _head(content: bytes, with_arrays: bool = False) -> Head:
    found = _HEAD.match(content)
    if found is None or found[1] not in (b"2", b"2.2", b"4.1", *[b"4"] * (not with_arrays)):
        version = "no Gmsh format" if found is None else f"Gmsh format {found[1].decode(errors='replace')}"
        raise ValueError(f"got {version}; expected 2.2 or 4.1. Convert the file by gmsh -format msh41")
    return Head(int(found[1][:1]), found[2] == b"0", int(found[3]))


def _section(content: bytes, name: bytes) -> bytes:
    start, end = re.search(rb"\$" + name + rb"[ \t]*\r?\n", content), content.rfind(b"$End" + name)
    if start is None or end < start.end():
        raise ValueError(f"the file has no complete section ${name.decode()}")
    return content[start.end() : end]


def _lines(section: bytes) -> list[bytes]:
    return [line for line in section.splitlines() if line.strip()]


def _numbers(data: bytes, count: int, dtype: str, offset: int = 0) -> Int[np.ndarray, " n"]:
    return np.frombuffer(data, dtype, count, offset).astype(np.int64)


def _node_tags(content: bytes, head: Head) -> Int[np.ndarray, " n"]:
    section = _section(content, b"Nodes")
    if head.version == 2:
        if head.text:
            return np.array(section.split()[1::4], np.int64)
        count, _, rows = section.partition(b"\n")
        return np.frombuffer(rows, "<i4, (3,)<f8", int(count))["f0"].astype(np.int64)
    if head.text:
        return _tags_in_text(section, of_nodes=True)
    found, at = [], 4 * head.width
    while at < len(section) - head.width:
        (dimension, _, parametric), n = _block(section, at, head)
        at += 12 + head.width
        found.append(_numbers(section, n, f"<u{head.width}", at))
        at += n * (head.width + 8 * (3 + dimension * parametric))
    return np.concatenate(found)


def _element_tags(content: bytes, head: Head, corners: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    section = _section(content, b"Elements")
    if head.text and head.version == 2:
        return np.array([int(line.split(maxsplit=1)[0]) for line in _lines(section)[1:]], np.int64)
    if head.text:
        return _tags_in_text(section, of_nodes=False)
    tags, done = np.zeros(len(corners), np.int64), 0
    at, kind = (section.index(b"\n") + 1, "i4") if head.version == 2 else (4 * head.width, f"u{head.width}")
    while done < len(corners):
        if head.version == 2:
            _, n, more = _numbers(section, 3, "<i4", at).tolist()
            at, columns = at + 12, 1 + more + int(corners[done])
        else:
            n = _block(section, at, head)[1]
            at, columns = at + 12 + head.width, 1 + int(corners[done])
        tags[done : done + n] = _numbers(section, n * columns, f"<{kind}", at)[::columns]
        at, done = at + n * columns * int(kind[1]), done + n
    return tags


def _block(section: bytes, at: int, head: Head) -> tuple[list[int], int]:
    """Return the three integers at the head of a block of format 4.1, and its number of nodes or elements."""
    return _numbers(section, 3, "<i4", at).tolist(), int(_numbers(section, 1, f"<u{head.width}", at + 12)[0])


def _tags_in_text(section: bytes, of_nodes: bool) -> Int[np.ndarray, " n"]:
    """Return the tags in the blocks of format 4.1; in blocks of nodes, the coordinates follow all tags."""
    lines, tags, at = _lines(section), [], 1
    while at < len(lines):
        n = int(lines[at].split()[3])
        tags += [int(line.split(maxsplit=1)[0]) for line in lines[at + 1 : at + 1 + n]]
        at += 1 + n * (1 + of_nodes)
    return np.array(tags, np.int64)
