"""What goes to stderr: what is being done, since when, and messages of the library in the command line's words."""

import re
import shutil
import sys
import threading
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

READING = ("order", "frame", "array", "spacing", "confidence", "mask", "components", "repair", "unit", "bvec_frame")
"""The options of the commands that read tensors."""

OPTIONS = (
    *READING,
    *("k", "boundary", "metric", "solver", "times", "through", "interpolation", "normalisation", "method"),
    *("erode", "slice", "bval", "bvec", "b_max"),
)
"""Those that arguments of the library correspond to."""


def as_options(message: str, names: Iterable[str]) -> str:
    """Return a message in which the named arguments of the library are spelled as the options of a command.

    ``Pass array`` becomes ``Pass --array``, ``pass frame "fsl"`` and ``pass frame="fsl"`` become ``pass --frame fsl``,
    and ``k: got 0`` at the beginning becomes ``-k: got 0``.
    """
    for name in names:
        option = ("-" if len(name) == 1 else "--") + name.replace("_", "-")
        message = re.sub(rf"^{re.escape(name)}: ", f"{option}: ", message)
        argument = rf"\b([Pp]ass|[Cc]hoose|or|try) {re.escape(name)}\b(?! [a-z])(?: \({option}\))?"
        message = re.sub(rf'{argument}(?: |=|: )"([\w/-]+)"', rf"\1 {option} \2", message)
        message = re.sub(argument, rf"\1 {option}", message)
    return message.replace("clean=True puts right what it can: see read_mesh", "--clean puts right what it can")


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


INTERVAL = 5.0
"""Seconds between updates within a stage where stderr is no terminal."""
TICK = 0.5
"""Seconds after which a terminal's line is drawn again, with the time that has passed."""


class Progress:
    """Prints stages and warnings as they come, and remembers them for the report.

    Attributes:
        timings: seconds by stage.
        warnings: messages, each once.
    """

    def __init__(self, quiet: bool = False, stream: TextIO | None = None) -> None:
        self.quiet = quiet
        self.stream = sys.stderr if stream is None else stream
        self.timings: dict[str, float] = {}
        self.warnings: list[str] = []
        self._start = self._last = self._begin = time.perf_counter()
        self._stage = self._text = ""
        self._end: float | None = None
        self._open_line = False
        self._lock = threading.RLock()

    @contextmanager
    def stage(self, name: str, detail: str = "") -> Iterator[None]:
        """Announce a stage and time it."""
        begin = self._begin = self._last = time.perf_counter()
        self._stage, self._text, self._end = f"{name}: {detail}" if detail else name, "", None
        over = threading.Event()
        if self.stream.isatty() and not self.quiet:
            self._draw()
            threading.Thread(target=self._tick, args=(over,), daemon=True).start()
        else:
            self._print(self._stage)
        try:
            yield
        finally:
            over.set()
            self.timings[name] = time.perf_counter() - begin
            self._close_line()

    def update(self, text: str) -> None:
        """Show how far the present stage is: in place on a terminal, else every few seconds.

        A text that comes with an estimate of what is left (`hks_jax.eigen.solver.Status`) is shown with it, and with a
        bar of the time that has passed in all.
        """
        now = time.perf_counter()
        left = getattr(text, "seconds_left", None)
        with self._lock:
            self._text, self._end = str(text), None if left is None else now + left
        if self.quiet:
            return
        if self.stream.isatty():
            self._draw()
        elif now - self._last >= INTERVAL:
            self._last = now
            self._print(f"{self._stage}, {self._text}{'' if left is None else f', about {duration(left)} left'}")

    def note(self, text: str) -> None:
        """Say something that is no warning."""
        self._print(text)

    def warn(self, message: str) -> None:
        """Show a warning, once; also where progress is not shown."""
        if message not in self.warnings:
            self.warnings.append(message)
            self._close_line()
            print(f"warning: {message}", file=self.stream)

    @contextmanager
    def catching_warnings(self) -> Iterator[None]:
        """Show the library's warnings as one line each."""

        def show(message: Warning | str, category: type[Warning], *_position: Any, **more: Any) -> None:
            if issubclass(category, UserWarning):
                self.warn(as_options(str(message), READING))

        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
            yield

    def _tick(self, over: threading.Event) -> None:
        while not over.wait(TICK):
            with self._lock:
                if not over.is_set():
                    self._draw()

    def _draw(self) -> None:
        """Draw the terminal's last line: the time, the stage, a bar, what is left, and the text."""
        with self._lock:
            now, shown = time.perf_counter(), f"{self._stage}, {self._text}" if self._text else self._stage
            if self._end is not None:
                left = max(self._end - now, 0.0)
                done = (now - self._begin) / max(now - self._begin + left, 1e-9)
                remaining = f"about {duration(left)} left" if left else "longer than estimated"
                shown = f"{bar(done)} {remaining}, {self._text}, {self._stage}"
            line = f"[{now - self._start:7.1f} s] {shown}"[: shutil.get_terminal_size().columns - 1]
            self.stream.write(f"\r{line}\x1b[K")
            self.stream.flush()
            self._open_line = True

    def _print(self, text: str) -> None:
        if not self.quiet:
            self._close_line()
            print(f"[{time.perf_counter() - self._start:7.1f} s] {text}", file=self.stream, flush=True)

    def _close_line(self) -> None:
        with self._lock:
            if self._open_line:
                self.stream.write("\n")
                self._open_line = False
