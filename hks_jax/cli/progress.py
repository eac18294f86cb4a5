"""Report progress on stderr: the stage, the elapsed and the remaining time, and warnings of the library.

tqdm and rich estimate the remaining time from counted steps; here, the solver estimates it. A log file gets a line
every few seconds, where rich writes nothing before the end, and tqdm writes one line with carriage returns.
"""

import io
import shutil
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from hks_jax.naming import with_option

WIDTH = 20
INTERVAL = 5.0
"""The seconds between updates within a stage if stderr is not a terminal."""
TICK = 0.5
"""The seconds after which the line on a terminal is redrawn with the elapsed time."""


def bar(done: float) -> str:
    """Return a progress bar for the completed fraction `done`, 0 … 1."""
    filled = round(WIDTH * min(max(done, 0.0), 1.0))
    return "[" + "#" * filled + "." * (WIDTH - filled) + "]"


def duration(seconds: float) -> str:
    """Return a duration as text, rounded to the accuracy of estimates: ``40 s``, ``3 min``, ``1 h 20 min``."""
    if seconds < 95:
        return f"{max(5 * round(seconds / 5), 5)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60 // 10 * 10} min"


class Progress:
    """Print stages and warnings as they occur, and store them for the report.

    Attributes:
        start: the time from which elapsed times count.
        timings: the seconds of each stage.
        warnings: the messages of warnings, without duplicates.
    """

    _LINE_END = "\n"

    def __init__(self, quiet: bool = False, stream: TextIO | io.StringIO | None = None) -> None:
        self.quiet = quiet
        self.stream = stream or sys.stderr or io.StringIO()  # stderr is None if it is closed
        self.timings: dict[str, float] = {}
        self.warnings: list[str] = []
        self.start = self._last = self._begin = time.perf_counter()
        self._subject = self._stage = self._text = ""
        self._end: float | None = None
        self._open_line = False
        self._lock = threading.RLock()

    @contextmanager
    def stage(self, name: str, detail: str = "") -> Iterator[None]:
        """Announce a stage and measure its time."""
        begin = self._begin = self._last = time.perf_counter()
        self._stage, self._text, self._end = f"{name}: {detail}" if detail else name, "", None
        over = threading.Event()
        if self._on_terminal:
            self._draw()
            threading.Thread(target=self._tick, args=(over,), daemon=True).start()
        else:
            self.note(self._stage)
        try:
            yield
        finally:
            over.set()
            self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - begin
            self._close_line()

    def update(self, text: str) -> None:
        """Show the progress of the current stage, in place on a terminal or otherwise every few seconds.

        If the text has an estimate of the remaining time (`hks_jax.eigen.solver.Status`), the estimate and a bar of the
        elapsed fraction are also shown.
        """
        now, left = time.perf_counter(), getattr(text, "seconds_left", None)
        with self._lock:
            self._text, self._end = str(text), None if left is None else now + left
        if self._on_terminal:
            self._draw()
        elif now - self._last >= INTERVAL:
            self._last = now
            self.note(f"{self._stage}, {self._text}{'' if left is None else f', about {duration(left)} left'}")

    def note(self, text: str) -> None:
        """Print a text that is not a warning."""
        if not self.quiet:
            self._close_line()
            print(f"[{time.perf_counter() - self.start:7.1f} s] {text}", file=self.stream, flush=True)

    def warn(self, message: str) -> None:
        """Print a warning, unless it was printed before; `quiet` does not suppress it."""
        if message not in self.warnings:
            self.warnings.append(message)
            self._close_line()
            print(f"warning: {self._subject}{': ' * bool(self._subject)}{message}", file=self.stream)

    @contextmanager
    def catching_warnings(self) -> Iterator[None]:
        """Print each warning of the library in one line."""

        def show(message: Warning | str, category: type[Warning], *_position: Any, **more: Any) -> None:
            if issubclass(category, UserWarning):
                self.warn(with_option(str(message)))

        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
            yield

    @property
    def _on_terminal(self) -> bool:
        return self.stream.isatty() and not self.quiet

    def _tick(self, over: threading.Event) -> None:
        while not over.wait(TICK):
            with self._lock:
                if not over.is_set():
                    self._draw()

    def _draw(self) -> None:
        with self._lock:
            self.stream.write(f"\r{self._line()[: shutil.get_terminal_size().columns - 1]}\x1b[K")
            self.stream.flush()
            self._open_line = True

    def _line(self) -> str:
        """Return the line on the terminal: elapsed time, stage, bar, remaining time and text."""
        now, shown = time.perf_counter(), ", ".join(filter(None, (self._stage, self._text)))
        if self._end is not None:
            left = max(self._end - now, 0.0)
            done = (now - self._begin) / max(now - self._begin + left, 1e-9)
            remaining = f"about {duration(left)} left" if left else "longer than estimated"
            shown = f"{bar(done)} {remaining}, {self._text}, {self._stage}"
        return f"[{now - self.start:7.1f} s] {shown}"

    def _close_line(self) -> None:
        with self._lock:
            if self._open_line:
                self.stream.write(self._LINE_END)
                self._open_line = False


class StudyProgress(Progress):
    """Progress over many subjects: the number of finished subjects, and the estimated time for the others.

    On a terminal, one line shows a bar and the stages of the current subject. Elsewhere, such as in a log file, one
    line is printed when a subject begins and one when it ends. A warning begins with the subject's name, and is stored
    in the subject's sidecar and log.
    """

    _LINE_END = "\r\x1b[K"

    def __init__(self, total: int, quiet: bool = False, stream: TextIO | io.StringIO | None = None) -> None:
        super().__init__(quiet, stream)
        self.total, self.ended, self._spent, self._begun = total, 0, 0.0, self.start
        self._log: TextIO | None = None

    @contextmanager
    def subject(self, name: str, log: Path) -> Iterator[None]:
        """Attribute warnings in the body to a subject, and use its time to estimate the time of other subjects.

        The file `log` has all stages, notes and warnings of the subject's last computation.
        """
        begun = self._begun = time.perf_counter()
        self._subject, self._stage, self._text, self.warnings = name, "", "", []
        if self._on_terminal:
            self._draw()
        else:
            super().note(f"{self.line()}: {name}")
        log.parent.mkdir(parents=True, exist_ok=True)
        try:
            with open(log, "w", encoding="utf-8", errors="backslashreplace") as self._log:
                yield
        finally:
            self._log = None
            self._spent += time.perf_counter() - begun
            self.ended += 1
            self._subject = ""

    def line(self) -> str:
        """Return the bar, the numbers of finished and all subjects, and after the first subject the remaining time."""
        text = f"{bar(self.ended / max(1, self.total))} {self.ended} of {self.total}"
        if not self.ended or self.ended == self.total:
            return text
        begun = time.perf_counter() - self._begun if self._subject else 0.0
        left = self._spent / self.ended * (self.total - self.ended) - begun
        return f"{text}, about {duration(max(left, 0.0))} left"

    @contextmanager
    def stage(self, name: str, detail: str = "") -> Iterator[None]:
        """Announce a stage and measure its time."""
        if self._on_terminal:  # where the stage is drawn, and not noted
            self.note(f"{name}: {detail}" if detail else name)
        with super().stage(name, detail):
            yield

    def note(self, text: str) -> None:
        """Write a text that is not a warning to the subject's log."""
        if self._log is not None:
            print(f"[{time.perf_counter() - self._begun:7.1f} s] {text}", file=self._log, flush=True)

    def warn(self, message: str) -> None:
        """Print a warning, unless it was printed before, and write it to the subject's log."""
        if message not in self.warnings:
            self.note(f"warning: {message}")
        super().warn(message)

    def end(self, text: str) -> None:
        """Print the result of a subject or of the study."""
        super().note(text)

    def _line(self) -> str:
        shown = ", ".join(filter(None, (self._stage, self._text)))
        return ": ".join(filter(None, (self.line(), self._subject, shown)))
