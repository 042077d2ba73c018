"""The texts that explain a component and its fields.

The text of a field is the string below it in the source of its class, which Sphinx shows too.
"""

from __future__ import annotations

import ast
import functools
import inspect
import textwrap
from itertools import pairwise

from jaxsafe.schema.component import Component


def paragraphs(cls: type[Component]) -> list[str]:
    """Return the paragraphs of the text about a component."""
    return inspect.cleandoc(cls.__doc__ or "").split("\n\n")


def summary(cls: type[Component]) -> str:
    """Return the first paragraph of the text about a component, in one line."""
    return " ".join(paragraphs(cls)[0].split())


@functools.cache
def field_docs(cls: type[Component]) -> dict[str, str]:
    """Return the text of each field that has one, by name, also of inherited fields.

    If Python cannot find the source of a class, the fields of that class have no texts.
    """
    inherited = [field_docs(base) for base in cls.__bases__ if issubclass(base, Component)]
    docs = {name: text for texts in inherited for name, text in texts.items()}
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls)))
    except (OSError, TypeError):
        return docs
    definition = tree.body[0]
    assert isinstance(definition, ast.ClassDef)
    for above, below in pairwise(definition.body):
        if isinstance(above, ast.AnnAssign) and isinstance(below, ast.Expr):
            text = below.value.value if isinstance(below.value, ast.Constant) else None
            if isinstance(above.target, ast.Name) and isinstance(text, str):
                docs[above.target.id] = inspect.cleandoc(text)
    return docs
