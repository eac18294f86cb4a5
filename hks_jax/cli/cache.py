"""Keeping what was compiled from one command to the next."""

import os
import sys
from collections.abc import Mapping
from pathlib import Path

_WORTH = 0.1
"""Seconds of compilation from which on a program is kept. JAX's own default of one second would leave out most."""


def keep_compiled(wanted: bool) -> None:
    """Let JAX keep what it compiles in the user's cache folder; or, if not wanted, in none.

    A folder that the user gave to JAX (``JAX_COMPILATION_CACHE_DIR``) stays the one. Where none can be written, there
    is no cache.
    """
    import jax

    if not wanted:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    folder = cache_folder(sys.platform, os.environ, Path.home())
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH)


def cache_folder(platform: str, environment: Mapping[str, str], home: Path) -> Path:
    """Return where caches go by the platform's convention: XDG's on Linux, and those of macOS and Windows."""
    if platform == "darwin":
        return home / "Library" / "Caches" / "hks-jax"
    if platform == "win32":
        return Path(environment.get("LOCALAPPDATA") or home / "AppData" / "Local") / "hks-jax" / "Cache"
    given = Path(environment.get("XDG_CACHE_HOME", ""))
    return (given if given.is_absolute() else home / ".cache") / "hks-jax"  # XDG: a relative path is to be ignored
