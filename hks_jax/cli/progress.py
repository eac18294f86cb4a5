"""Progress on stderr: what is being done, and since when."""

import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

INTERVAL = 5.0
"""Seconds between updates within a stage where stderr is no terminal."""


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
        self._start = self._last = time.perf_counter()
        self._stage = ""
        self._open_line = False

    @contextmanager
    def stage(self, name: str, detail: str = "") -> Iterator[None]:
        """Announce a stage and time it."""
        begin = self._last = time.perf_counter()
        self._stage = f"{name}: {detail}" if detail else name
        self._print(self._stage)
        try:
            yield
        finally:
            self.timings[name] = time.perf_counter() - begin
            self._close_line()

    def update(self, text: str) -> None:
        """Show how far the present stage is: in place on a terminal, else every few seconds."""
        now = time.perf_counter()
        terminal = self.stream.isatty()
        if self.quiet or (not terminal and now - self._last < INTERVAL):
            return
        self._last = now
        if terminal:
            self.stream.write(f"\r[{now - self._start:7.1f} s] {self._stage}, {text}\x1b[K")
            self.stream.flush()
            self._open_line = True
        else:
            self._print(f"{self._stage}, {text}")

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

        def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
            if issubclass(category, UserWarning):
                self.warn(str(message))

        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
            yield

    def _print(self, text: str) -> None:
        if not self.quiet:
            self._close_line()
            print(f"[{time.perf_counter() - self._start:7.1f} s] {text}", file=self.stream, flush=True)

    def _close_line(self) -> None:
        if self._open_line:
            self.stream.write("\n")
            self._open_line = False
