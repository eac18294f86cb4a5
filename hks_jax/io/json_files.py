"""Write and read JSON, which has neither NaN nor infinity, and no tuples, arrays or paths."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hks_jax.storage import atomic_path


def plain(value: Any) -> Any:
    """Convert a value for JSON: NaN and infinity become None, arrays and tuples lists, and paths texts."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # NumPy's and JAX's arrays and scalars
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def tuples(value: Any) -> Any:
    """Return a value from JSON with tuples in place of lists."""
    return tuple(map(tuples, value)) if isinstance(value, list) else value


def write_json(path: Path, content: Mapping[str, Any]) -> Path:
    """Write a JSON file of `plain` values atomically and return its path."""
    with atomic_path(path) as temporary:
        text = json.dumps(plain(content), indent=2, ensure_ascii=False) + "\n"
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")  # file names may be invalid in UTF-8
    return path


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file, or an empty object if the file is missing, invalid or contains no object."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
