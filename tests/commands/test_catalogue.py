"""What `jaxsafe config types` says, and the schema that `jaxsafe config schema` writes."""

import copy
import json
import re
import sys
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

import jaxsafe
from jaxsafe.commands import catalogue, config, config_schema, config_types
from jaxsafe.envs import TASKS
from jaxsafe.schema import yaml12
from jaxsafe.schema.component import choices, fields
from jaxsafe.schema.convert import bare, is_component, to_data
from jaxsafe.schema.errors import ConfigError
from jaxsafe.schema.user_modules import imports_allowed

ROOT = Path(__file__).parents[2]
OWN = '''
from jaxsafe.parts import Status, StatusName


class Doubled(Status, type="doubled_of_catalogue_test"):
    """Twice another status."""

    status: StatusName
    """What is doubled."""
'''


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    def run(*words: str) -> str:
        assert config_types.main(words) == 0
        return capsys.readouterr().out

    return run


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a user's module with a type of its own."""
    (tmp_path / "own_of_catalogue_test.py").write_text(OWN, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    return "own_of_catalogue_test"


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    return config_schema.environment_schema()


@pytest.fixture(scope="module")
def faults(schema: dict[str, Any]) -> Callable[[Any], list[str]]:
    """Return a function that returns where data break the schema."""
    validator = Draft202012Validator(schema)
    return lambda data: [error.json_path for error in validator.iter_errors(data)]


# Types


def test_all_sections_are_listed_with_their_types(printed: Callable[..., str]) -> None:
    lines = printed().splitlines()
    assert [line for line in lines if len(line) > 100] == []
    assert [line for line in lines if not line.startswith(" ")] == [*catalogue.SECTIONS]
    told = {line.split()[0] for line in lines if line.startswith("  ")}
    for task in TASKS.values():
        types = re.findall(r"'type': '(\w+)'", str(to_data(task.environment())))
        assert set(types) <= told
    assert any(
        re.match(r"  timeout +More than `limit` seconds have passed", line) for line in lines
    )


def test_no_part_of_an_environment_or_an_agent_is_left_out() -> None:
    known = {base for section in catalogue.SECTIONS.values() for base in section.bases}
    for base in known:
        for cls in [*choices(base).values()] or [base]:
            hints = [bare(field.hint) for field in fields(cls).values()]
            parts = [bare(item) for hint in hints for item in (hint, *typing.get_args(hint))]
            assert {part for part in parts if is_component(part)} <= known, cls


def test_a_section_is_explained_type_by_type(printed: Callable[..., str]) -> None:
    for name in ("reward", "rewards"):
        blocks = printed(name).split("\n\n")
        assert {block.split("\n")[0] for block in blocks} >= {"distance_change", "delta_v", "bound"}
    assert printed("distance_change").splitlines() == [
        "distance_change",
        "  Change of an exponential potential of a distance d over a step.",
        "  It is scale·(e^(−a d_t) − e^(−a d_(t−1))) with a = ln 2 / half_distance.",
        "    bound          bound (default none)",
        "    distance       a name of status",
        "    half_distance  a number in m or ft > 0",
        "    scale          a number (default 2)",
    ]


def test_types_of_one_name_in_several_sections_are_all_explained(
    printed: Callable[..., str],
) -> None:
    assert printed("constraint").startswith("separation\n") or "separation\n" in printed(
        "constraint"
    )
    assert printed("tie").splitlines()[0] == "tie"


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("distance_chang", "Did you mean 'distance_change'"),
        ("regiosn", "Did you mean 'regions'"),
        ("zzz", "ppo$"),
    ],
)
def test_an_unknown_type_is_one_line_with_near_names(name: str, hint: str) -> None:
    with pytest.raises(ConfigError, match=rf"^types: nothing is called '{name}'.*{hint}") as told:
        config_types.main([name])
    assert "\n" not in str(told.value)


def test_types_of_a_users_module_are_explained(printed: Callable[..., str], own: str) -> None:
    assert printed("doubled_of_catalogue_test", f"modules={own}").splitlines() == [
        "doubled_of_catalogue_test",
        "  Twice another status.",
        "    status  a name of status",
        "            What is doubled.",
    ]
    assert re.search(r"^  doubled_of_catalogue_test +Twice another", printed(), re.MULTILINE)
    with pytest.raises(ConfigError, match=r"^imports: cannot import 'no_such_module'"):
        config_types.main(["modules=no_such_module"])
    with imports_allowed(False), pytest.raises(ConfigError, match="imports=false refuses that"):
        config_types.main([f"modules={own}"])


def test_the_page_of_the_site_has_the_types_that_are_printed() -> None:
    page = (ROOT / "docs" / "reference" / "parts.md").read_text(encoding="utf-8")
    for name in re.findall(r"^### `(\w+)`", page, re.MULTILINE):
        assert name in {catalogue.title(cls) for cls in catalogue.find(name)} | {
            *catalogue.SECTIONS
        }


@pytest.mark.parametrize(
    ("words", "begins"),
    [
        (["types", "bound"], "bound\n  End of the episode"),
        (["types"], "environment\n"),
        (["types", "help"], "usage: jaxsafe config types"),
        (["schema", "help"], "usage: jaxsafe config schema"),
    ],
)
def test_the_commands_are_called_by_two_words(
    words: list[str],
    begins: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["jaxsafe config", *words])
    with pytest.raises(SystemExit) as left:
        config.command()
    assert left.value.code == 0
    assert capsys.readouterr().out.startswith(begins)


# Schema


def test_the_schema_is_one(schema: dict[str, Any]) -> None:
    Draft202012Validator.check_schema(schema)
    assert json.loads(json.dumps(schema, allow_nan=False)) == schema


def test_every_file_and_every_task_with_every_filter_keeps_to_the_schema(
    faults: Callable[[Any], list[str]],
) -> None:
    files = [*(ROOT / "configs" / "envs").glob("*.yaml"), ROOT / "configs" / "custom_env.yaml"]
    assert len(files) > 5
    for file in files:
        assert faults(yaml12.read(file)) == [], file
    for task in TASKS.values():
        for rta in (lambda: None, *task.filters.values()):
            assert faults(to_data(task.environment().replace(rta=rta()))) == [], task.name
    env = jaxsafe.make("docking2d", {"terminal.distance.limit": float("inf")})
    assert faults(yaml12.parse(jaxsafe.dump(env), "")) == []


def test_words_that_stand_for_parts_keep_to_the_schema(faults: Callable[[Any], list[str]]) -> None:
    data = yaml12.read(ROOT / "configs" / "custom_env.yaml")
    data["platforms"][0]["controller"] = "uncontrolled"
    data["status"].append({"type": "mine.parts:Energy", "name": "energy", "of": "deputy"})
    data |= {"imports": ["mine"], "randomize": {"deputy.mass": [1, 2]}}
    data["recipes"] = {"mine": {"ppo.gamma": 0.5, "ppo": {"gamma": 1}, "steps": 1e6}, "none": None}
    assert faults(data) == []
    data["recipes"] = {"mine": {"stps": 3}}
    assert faults(data)


def change(data: dict[str, Any], path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    """Return a copy of data with one value changed, or taken out if it is None."""
    data = copy.deepcopy(data)
    inner: Any = data
    for key in path[:-1]:
        inner = inner[key]
    if value is None:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return data


@pytest.mark.parametrize(
    ("path", "value", "place"),
    [
        (("platforms", 1, "mas"), 12.0, "$.platforms[1]"),
        (("platforms", 1, "mass"), "12 kg", "$.platforms[1].mass"),
        (("platforms", 1, "mass"), -1.0, "$.platforms[1].mass"),
        (("platforms", 1, "mass"), [1.0], "$.platforms[1].mass"),
        (("platforms", 1, "start", 0, "distance"), [1.0], "$.platforms[1].start[0].distance"),
        (("platforms", 1, "type"), "spacecraf", "$.platforms[1].type"),
        (("platforms", 1, "dimension"), 2.5, "$.platforms[1].dimension"),
        (("reward", 1, "bound", "below"), True, "$.reward[1].bound"),
        (("terminal", 0, "ends"), "stopped", "$.terminal[0].ends"),
        (("terminal", 0, "type"), None, "$.terminal[0]"),
        (("terminal", 3, "limit"), None, "$.terminal[3]"),
        (("terminl",), [], "$"),
        (("agent",), None, "$"),
        (("status",), {}, "$.status"),
        (("rta",), "non", "$.rta"),
        (("tied", "deputy.mass"), {"too": "dt"}, "$.tied['deputy.mass']"),
        (("recipe",), 3, "$.recipe"),
    ],
)
def test_a_mistake_breaks_the_schema(
    faults: Callable[[Any], list[str]], path: tuple[Any, ...], value: Any, place: str
) -> None:
    data = yaml12.read(ROOT / "configs" / "envs" / "docking2d.yaml")
    assert place in faults(change(data, path, value))


def test_the_schema_explains_fields_with_their_units(schema: dict[str, Any]) -> None:
    spacecraft = schema["$defs"]["jaxsafe_simulation_cwh_Spacecraft"]["properties"]
    assert spacecraft["mass"] == {
        "type": "number",
        "exclusiveMinimum": 0.0,
        "description": "A number in kg > 0.",
        "default": 12.0,
    }
    distance = schema["$defs"]["jaxsafe_processors_terminal_TooFar"]["properties"]["distance"]
    assert distance == {"type": "string", "description": "A name of `status`."}


def test_the_schema_is_written_to_a_file_with_a_users_types(
    own: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.schema.json"
    assert config_schema.main([f"out={file}", f"modules={own}"]) == 0
    assert capsys.readouterr().out == f"schema: {file}\n"
    text = file.read_text(encoding="utf-8")
    assert "doubled_of_catalogue_test" in text
    assert config_schema.main([]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(text)
