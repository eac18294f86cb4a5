"""Name an argument in a message: as in Python, or as an option of the command line."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType

_OPTIONS: ContextVar[Mapping[str, str]] = ContextVar("options", default=MappingProxyType({}))


@contextmanager
def named_as_options(options: Mapping[str, str]) -> Iterator[None]:
    """Name the given arguments by their options in messages that are made within the context."""
    token = _OPTIONS.set(options)
    try:
        yield
    finally:
        _OPTIONS.reset(token)


def argument(name: str, value: str | float | bool | None = None) -> str:
    """Return an argument, with its value if there is one, as a user writes it.

    For example ``frame="fsl"`` and ``clean=True``, or as options ``--frame fsl`` and ``--clean``.
    """
    option = _OPTIONS.get().get(name)
    if value is None or (option and value is True):
        return option or name
    if option is None:
        return f'{name}="{value}"' if isinstance(value, str) else f"{name}={value}"
    return f"{option} {value}"


def with_option(message: str) -> str:
    """Return a message about an argument, ``k: got 0``, about its option if it has one, ``-k: got 0``."""
    name, colon, rest = message.partition(": ")
    return f"{_OPTIONS.get().get(name, name)}{colon}{rest}"
