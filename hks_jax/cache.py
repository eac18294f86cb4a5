"""Keeping what was compiled from one process to the next."""

import os
from pathlib import Path

import jax
import platformdirs


def keep_compiled(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Let JAX keep what it compiles in a folder, from which later processes read it in place of compiling again.

    Call it once, before anything is computed. JAX has one such cache in a process: programs of your own are kept there,
    too. It is a setting of yours, so importing the package does not touch it. A folder that JAX has already, by
    ``jax_compilation_cache_dir`` or the environment, stays the one.

    Args:
        folder: where; None is a folder ``hks-jax`` where the platform has the user's caches.

    Returns:
        The folder; None where it cannot be written, and nothing is kept.
    """
    given = jax.config.values["jax_compilation_cache_dir"]
    if given is not None:
        return Path(given)
    path = platformdirs.user_cache_path("hks-jax", appauthor=False) if folder is None else Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(path, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    # JAX keeps what took a second or more. To read a small program takes a tenth of the time to compile it.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return path
