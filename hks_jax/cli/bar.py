"""A progress bar and durations as text."""

WIDTH = 20


def bar(done: float) -> str:
    """Return a bar of which the part `done`, 0 … 1, is filled."""
    filled = round(WIDTH * min(max(done, 0.0), 1.0))
    return "[" + "#" * filled + "." * (WIDTH - filled) + "]"


def duration(seconds: float) -> str:
    """Return about how long, no finer than an estimate is: ``40 s``, ``3 min``, ``1 h 20 min``."""
    if seconds < 95:
        return f"{max(5 * round(seconds / 5), 5)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60 // 10 * 10} min"
