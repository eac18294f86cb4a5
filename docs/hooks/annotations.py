"""A griffe extension, for what griffe takes for something else.

Shapes of jaxtyping stay text, where griffe takes ``"n_times *shape"`` for a product. What stands under "Returns:" is a
description, where griffe takes all of it that comes before a colon for a type.
"""

import re
from collections.abc import Iterator
from typing import Any

import griffe

DTYPES = {"Bool", "Complex", "Float", "Inexact", "Int", "Integer", "Num", "Real", "Shaped"}


def shapes(expression: griffe.Expr) -> Iterator[griffe.ExprTuple]:
    """Yield what is between the brackets of every ``Float[Array, "…"]`` in an expression."""
    if isinstance(expression, griffe.ExprSubscript) and expression.canonical_name in DTYPES:
        if isinstance(expression.slice, griffe.ExprTuple):
            yield expression.slice
        return
    for part in expression.iterate(flat=False):
        if isinstance(part, griffe.Expr) and part is not expression:  # a name yields itself
            yield from shapes(part)


def restore(annotation: Any) -> None:
    """Put the shapes in an annotation back as they were written, less a blank in front."""
    if isinstance(annotation, griffe.Expr):
        for found in list(shapes(annotation)):
            array, shape = found.elements
            text = str(shape).replace(" * ", " *").strip("\"'").strip()
            found.elements = [array, f'"{text}"']


class Annotations(griffe.Extension):
    """Restores the annotations of functions, their arguments, and attributes; and what functions return."""

    def on_function(self, *, func: griffe.Function, **kwargs: Any) -> None:
        """Restore what a function takes and returns."""
        for annotation in (func.returns, *(argument.annotation for argument in func.parameters)):
            restore(annotation)
        if func.docstring:
            # A colon at the start is one that separates nothing.
            func.docstring.value = re.sub(r"(?<=\nReturns:\n)( +)(?=\S)", r"\1: ", func.docstring.value)

    def on_attribute(self, *, attr: griffe.Attribute, **kwargs: Any) -> None:
        """Restore an attribute, or a property."""
        restore(attr.annotation)
