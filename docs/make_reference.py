"""The pages `docs/reference/options.md` and `docs/reference/parts.md`, from the code itself.

Run `python docs/make_reference.py` after a change of an option or a component.
`tests/docs/test_docs.py` compares the committed pages with it.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from make_tasks import table, wrapped

from jaxsafe.commands import COMMANDS, SUBCOMMANDS
from jaxsafe.commands.catalogue import SECTIONS, Entry, describe, types_of
from jaxsafe.commands.help_text import entries, grouped, shown
from jaxsafe.envs import TASKS
from jaxsafe.train.host.options import recipe_paths
from jaxsafe.train.host.options import recipes as task_recipes

TARGET = Path(__file__).parent / "reference"


def options() -> str:
    """Return the page of all options of all commands."""
    blocks = [
        "<!-- Written by docs/make_reference.py. -->\n# Command line",
        (
            "`jaxsafe` lists the commands, and `jaxsafe COMMAND help` prints what this page says of"
            " one. `jaxsafe train TASK help` shows the defaults of the task's recipe. An option is"
            " written `name=value`, and the first word may be the value of `env` or `run` alone:"
            " `jaxsafe train docking3d`. A list is written with commas. `python -m jaxsafe.COMMAND`"
            " is the same as `jaxsafe COMMAND`; for `falsify` and `safe_set` it is"
            " `python -m jaxsafe.rta.falsify` and `python -m jaxsafe.plot.safe_set`."
        ),
        "The exit code is 0, or 2 after a mistake in an option or a file, 3 if a seed diverged, and"
        " 130 after Ctrl-C. `falsify` and `verify` exit with 1 if there was a"
        " violation, and `verify` with 3 if it is open.",
    ]
    for command in (*COMMANDS, *SUBCOMMANDS):
        module = importlib.import_module(f"jaxsafe.commands.{command.replace(' ', '_')}")
        blocks += [f"## jaxsafe {command}", _line(module.__doc__ or "")]
        for title, group in grouped(module.Options, entries(module.Options)).items():
            rows = ((f"`{row.name}`", row.takes, row.default, _line(row.text)) for row in group)
            blocks += [title, table(("option", "takes", "default", "meaning"), rows)]
    blocks += ["## Recipes", *recipes()]
    return _page(blocks)


def _line(text: str) -> str:
    return " ".join(text.split())


def recipes() -> Iterator[str]:
    """Yield what the recipes of the tasks put in the place of defaults, a table per preset."""
    yield (
        "A recipe puts its values in the place of the defaults above. `preset=` chooses one. An"
        " empty cell keeps the default."
    )
    found = {task: task_recipes(task) for task in TASKS}
    for preset in dict.fromkeys(name for presets in found.values() for name in presets):
        values = {
            task: recipe_paths(task, preset, presets[preset])
            for task, presets in found.items()
            if preset in presets
        }
        names = dict.fromkeys(name for flat in values.values() for name in flat)
        yield f"### preset={preset}"
        yield table(
            ("option", *values),
            (
                (
                    f"`{name}`",
                    *(shown(flat[name]) if name in flat else "" for flat in values.values()),
                )
                for name in names
            ),
        )


def parts() -> str:
    """Return the catalogue of everything that an environment or an agent is made of."""
    blocks = [
        "<!-- Written by docs/make_reference.py. -->\n# Configuration catalogue",
        (
            "These are the parts of an environment, a filter and an agent, as YAML and overrides"
            " name them. [Compose](../compose.md) puts them together, and"
            " [Extend](../extend.md) defines others. A part is written `{type: …, name: …, …}`."
            " The name is the user's choice, and the tables leave it out. Fields without a default"
            " must be given. A length is in metres for spacecraft and in feet for aircraft."
        ),
    ]
    for section in SECTIONS.values():
        blocks.append(f"## {section.heading}")
        for cls in types_of(section):
            blocks += part(describe(cls))
    return _page(blocks)


def part(entry: Entry) -> Iterator[str]:
    """Yield the name of a part, what it is, and its fields."""
    yield f"### `{entry.name}`"
    yield from entry.paragraphs
    heads = ("field", "takes", "default", "meaning")
    rows = [(f"`{row.name}`", *row[1:]) for row in entry.rows]
    if rows:
        columns = len(heads) if any(row[-1] for row in rows) else len(heads) - 1
        yield table(heads[:columns], (row[:columns] for row in rows))


def _page(blocks: Iterable[str]) -> str:
    return "\n\n".join(wrapped(block) for block in blocks if block) + "\n"


if __name__ == "__main__":
    TARGET.mkdir(exist_ok=True)
    (TARGET / "options.md").write_text(options(), encoding="utf-8")
    (TARGET / "parts.md").write_text(parts(), encoding="utf-8")
