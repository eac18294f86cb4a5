"""What checks annotations while tests run: beartype, to which an int is a float where one is expected (PEP 484)."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from inspect import isfunction
from types import CodeType
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))

of_jaxtyping = jaxtyping.jaxtyped
of_code: dict[CodeType, Callable] = {}
called = threading.local()


def jaxtyped(*, typechecker: Callable) -> Callable:
    """Return jaxtyping's decorator, which here writes the checks of a function within a function only once.

    To write them takes milliseconds, and the function is defined anew at every call of the outer one.
    """

    def with_checks(function: Callable) -> Callable:
        @wraps(function)
        def latest(*args: Any, **kwargs: Any) -> Any:
            return called.functions[-1](*args, **kwargs)

        checked = of_jaxtyping(latest, typechecker=typechecker)
        del latest.__wrapped__  # what this first function refers to would live as long
        return checked

    def decorate(function: Any) -> Any:
        # Defaults, which can be tracers, belong to one definition.
        within = isfunction(function) and "<locals>" in function.__qualname__
        if not within or function.__defaults__ or function.__kwdefaults__:
            return of_jaxtyping(function, typechecker=typechecker)
        if function.__code__ not in of_code:
            of_code[function.__code__] = with_checks(function)
        checked = of_code[function.__code__]

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            called.__dict__.setdefault("functions", []).append(function)
            try:
                return checked(*args, **kwargs)
            finally:
                called.functions.pop()

        return call

    return decorate


jaxtyping.jaxtyped = jaxtyped


@contextmanager
def unchecked() -> Iterator[None]:
    """Let arguments pass that annotations forbid, to see what users, who have no checker, are told of them."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
