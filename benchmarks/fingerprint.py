"""A fingerprint of the sources on which a result of a benchmark depends.

Texts do not count: docstrings and comments may change, and the fingerprint stays.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BENCHMARKS = ROOT / "benchmarks"

NAMED = re.compile(r"jaxsafe(\.\w+)+")
"""The name of a module of jaxsafe."""

LEFT_OUT = (ROOT / "jaxsafe" / "__init__.py", BENCHMARKS / "tables.py")


def fingerprint(script: Path) -> str:
    """Return a hash of the code of a script and of all that it depends on in this repository.

    Recipes count as well, because a training depends on them.

    Args:
        script: the path of the script.
    """
    digest = hashlib.sha256()
    for path in [*sources(script), *sorted((ROOT / "configs").rglob("*.yaml"))]:
        python = path.suffix == ".py"
        code = ast.unparse(_tree(path)) if python else path.read_text(encoding="utf-8")
        digest.update(f"{path.relative_to(ROOT)}\n{code}\n".encode())
    return digest.hexdigest()[:12]


def sources(script: Path) -> list[Path]:
    """Return the paths of a script and of the modules of this repository that it needs, in order.

    These are the modules that it names, those of the commands that it runs, and all that these
    import, when they are imported or when they are called. Of the face of jaxsafe only the
    functions that the script calls count. Tables are made after the measurement.
    """
    script = script.resolve()
    found = {script}
    waiting = [script]
    while waiting:
        path = waiting.pop()
        for name in _needed(path):
            new = {module for module in _modules(name) if module not in found}
            found |= new
            waiting += new
    return sorted(found)


def _needed(path: Path) -> set[str]:
    """Return the dotted names that a module needs. Some may be no modules."""
    tree = _tree(path)
    if path.parent != BENCHMARKS:
        return set(_imported(_that_runs(tree)))
    nodes = list(ast.walk(tree))
    called = {
        node.attr
        for node in nodes
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "jaxsafe"
    }
    # A package that can be called has the name of the function that it calls, so both count.
    face = _imported(ast.walk(_tree(ROOT / "jaxsafe" / "__init__.py")))
    functions = {name for name in face if name.rpartition(".")[2] in called}
    return {*_imported(nodes), *functions, *_run(nodes)}


def _run(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the names of modules of jaxsafe that these nodes run by name, mostly as commands.

    They are the texts `"jaxsafe.train"`, and the first arguments of `isolated.command`.
    """
    for node in nodes:
        if isinstance(node, ast.Constant) and NAMED.fullmatch(str(node.value)):
            yield from (str(node.value), f"{node.value}.__main__")
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "command":
            yield f"jaxsafe.{ast.literal_eval(node.args[0])}.__main__"


def _that_runs(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes but those that only a type checker reads."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        yield node
        yield from _that_runs(node)


def _imported(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the dotted names that these nodes import."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _modules(name: str) -> Iterator[Path]:
    """Yield the files that run when a dotted name is imported, if they are of this repository."""
    for root in (ROOT, BENCHMARKS):
        place = root
        for word in name.split("."):
            place /= word
            for path in (place.with_suffix(".py"), place / "__init__.py"):
                if path.is_file() and path not in LEFT_OUT:
                    yield path


@functools.cache
def _tree(path: Path) -> ast.Module:
    """Return the code of a module without docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [  # type: ignore[attr-defined]
                item
                for item in body
                if not (isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant))
            ]
    return tree
