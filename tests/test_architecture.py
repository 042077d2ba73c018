"""The packages stand on floors: nothing imports what stands above it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import jaxsafe

PACKAGE = Path(jaxsafe.__file__).parent
FACE = "__init__"


def imports(tree: ast.Module) -> Iterator[str]:
    """Yield the modules of jaxsafe that a file imports.

    Imports for types only, and those for running the file as a command, are left out.
    """
    skipped = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If)
        and ("TYPE_CHECKING" in ast.dump(node.test) or "__main__" in ast.dump(node.test))
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.ImportFrom) and node.module == "jaxsafe":
            yield from (f"jaxsafe.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def rooms() -> dict[str, set[str]]:
    """Return the packages and the modules beside them, each with the others that it imports."""
    used: dict[str, set[str]] = {}
    for file in PACKAGE.rglob("*.py"):
        room = file.relative_to(PACKAGE).with_suffix("").parts[0]
        names = [name.split(".") for name in imports(ast.parse(file.read_text(encoding="utf-8")))]
        used.setdefault(room, set()).update(
            name[1] for name in names if name[0] == "jaxsafe" and len(name) > 1
        )
        used[room].discard(room)
    return {room: others for room, others in used.items() if room != FACE}


def test_no_two_rooms_import_each_other_even_through_others() -> None:
    left = rooms()
    assert len(left) > 15
    while left:
        ground = {room for room, others in left.items() if not others & left.keys()}
        assert ground, f"these import each other: {left}"
        left = {room: others for room, others in left.items() if room not in ground}


def test_the_lowest_and_the_highest_floor() -> None:
    packages = rooms()
    assert not packages["schema"]
    assert not [room for room, others in packages.items() if "commands" in others]
    assert not packages["evaluate"] & {"train", "plot", "tune"}
    assert not packages["plot"] & {"train", "evaluate"}
    assert not packages["rta"] & {"environment", "rollout"}
    assert packages["transition"] <= {"schema", "simulation", "types"}


def test_the_picture_of_the_house_is_short_and_names_every_room() -> None:
    page = (PACKAGE.parent / "docs/architecture.md").read_text(encoding="utf-8")
    assert len(page.splitlines()) <= 90
    small = {"address_space", "quiet", "garbage_collection", "report", "__main__", "pretrained"}
    drawn = page.split("```")[1].split()
    missing = rooms().keys() - small - set(drawn)
    assert not missing
