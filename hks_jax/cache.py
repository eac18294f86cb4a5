"""A persistent cache of compiled programs."""

import os
from pathlib import Path

import jax
import platformdirs


def keep_compiled(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Let JAX store compiled programs in a folder, from which later processes read them instead of compiling again.

    Call this function once, before any computation. JAX has one cache of programs per process, so your own programs are
    stored in the same folder. Importing the package does not turn the cache on. If JAX's configuration or the
    environment already sets ``jax_compilation_cache_dir``, the cache stays in that folder.

    Args:
        folder: the folder, by default ``hks-jax`` in the platform's folder of user caches.

    Returns:
        The folder; None if the folder cannot be written, so that no program is stored.

    Examples:
        >>> path = hj.keep_compiled(folder / "compiled")
        >>> path == pathlib.Path(jax.config.jax_compilation_cache_dir)
        True
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
    # By default, JAX stores only programs whose compilation takes at least a second. Reading is ten times as fast as
    # compiling.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return path
