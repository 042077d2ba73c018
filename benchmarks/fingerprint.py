"""A fingerprint of the sources on which a result of a benchmark depends.

Texts do not count: docstrings and comments may change, and the fingerprint stays.
"""

from __future__ import annotations

import ast
import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BENCHMARKS = ROOT / "benchmarks"
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

    These are the modules that it names anywhere, and those that a module imports when it is
    imported. Of the face of jaxsafe only the functions that the script calls count. Tables are made
    after the measurement.
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
        return set(_imported(_at_import(tree)))
    names = set(_imported(ast.walk(tree)))
    face = {
        name.rpartition(".")[2]: name
        for name in _imported(ast.walk(_tree(ROOT / "jaxsafe" / "__init__.py")))
    }
    called = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "jaxsafe"
    }
    return names | {face[name] for name in called & face.keys()}


def _at_import(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that run when a module is imported: those outside functions."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        yield node
        yield from _at_import(node)


def _imported(nodes: Iterator[ast.AST]) -> Iterator[str]:
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
