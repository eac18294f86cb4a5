"""Progress over many subjects: how many are done, and how long the others will take."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from hks_jax.cli.progress import Progress, bar, duration


class StudyProgress(Progress):
    """One line with a bar on a terminal; elsewhere a line for each subject that begins and ends.

    What a single computation says of its stages is shown in the line, on terminals alone. Warnings are shown with the
    subject's name and kept for its sidecar.
    """

    def __init__(self, total: int, quiet: bool = False, stream: TextIO | None = None) -> None:
        super().__init__(quiet, stream)
        self.total, self.ended = total, 0
        self._subject, self._spent, self._begun = "", 0.0, time.perf_counter()

    @contextmanager
    def subject(self, name: str) -> Iterator[None]:
        """Work on a subject: its warnings are those of the body, and its seconds tell how long the others take."""
        self._subject, self._begun, self.warnings = name, time.perf_counter(), []
        self._say(f"{self.line()}: {name}")
        try:
            yield
        finally:
            self._spent += time.perf_counter() - self._begun
            self.ended += 1
            self._subject = ""

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.perf_counter() - self._start

    def line(self) -> str:
        """Return the bar, how many of how many are done, and the time left where one was computed already."""
        text = f"{bar(self.ended / max(1, self.total))} {self.ended} of {self.total}"
        if not self.ended or self.ended == self.total:
            return text
        begun = time.perf_counter() - self._begun if self._subject else 0.0
        left = self._spent / self.ended * (self.total - self.ended) - begun
        return f"{text}, about {duration(max(left, 0.0))} left"

    def update(self, text: str) -> None:
        """Show how far the present stage is, in place; where stderr is no terminal, nothing."""
        if self.stream.isatty():
            self._show(f"{self._stage}, {text}")

    def warn(self, message: str) -> None:
        """Show a warning, once for each subject; also where progress is not shown."""
        if message not in self.warnings:
            self.warnings.append(message)
            self._close_line()
            print(f"warning: {self._subject}{': ' * bool(self._subject)}{message}", file=self.stream)

    def note(self, text: str) -> None:
        """Say nothing: what was decided in reading a subject's files is in its sidecar."""

    def end(self, text: str) -> None:
        """Say how a subject, or the study, ended."""
        self._close_line()
        self._say(text)

    def _print(self, text: str) -> None:  # a stage
        if self.stream.isatty():
            self._show(text)

    def _close_line(self) -> None:
        """Clear the line, for what follows to take its place."""
        if self._open_line:
            self.stream.write("\r\x1b[K")
            self._open_line = False

    def _say(self, text: str) -> None:
        if self.stream.isatty() and self._subject:
            self._show("")
        else:
            super()._print(text)

    def _show(self, text: str) -> None:
        """Overwrite the line with the bar, the subject and a text, cut to the terminal's width."""
        if self.quiet:
            return
        line = ": ".join(filter(None, (self.line(), self._subject, text)))
        columns = shutil.get_terminal_size().columns
        self.stream.write("\r" + line[: columns - 1] + "\x1b[K")
        self.stream.flush()
        self._open_line = True
