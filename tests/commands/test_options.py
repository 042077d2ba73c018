"""Every option stands in one class: from there the parser, the errors and the help text take it."""

import importlib
import re
import sys
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import pytest

from jaxsafe import commands
from jaxsafe.commands import cli, plot
from jaxsafe.commands.help_text import REST, entries, grouped, help_text
from jaxsafe.commands.options import CommandOptions, Count, Option, Seed
from jaxsafe.schema.errors import ConfigError
from jaxsafe.schema.field_docs import field_docs
from jaxsafe.train.host.options import recipe


class Options(CommandOptions):
    name: Annotated[str, Option(first=True, examples=("name=this", "name=that"))]
    """What it is called."""
    count: Annotated[Count, Option(alias="number")] = 3
    """How many there are.

    More of them take longer.
    """
    seed: Seed = 0
    ends: Annotated[tuple[float, float], Option(takes="two ends")] | None = None
    kinds: Annotated[tuple[str, ...], Option(kind="kind", names=("small", "large"))] | None = None
    color: Literal["red", "blue"] = "red"
    fast: bool = False
    overrides: Annotated[Mapping[str, Any], Option(prefix="env.", placeholder="PATH")]
    boxes: Annotated[Mapping[str, Any], Option(prefix="box.", placeholder="PATH", lists=True)]


def test_options_have_the_type_of_their_annotation() -> None:
    words = ["name=7", "number=1e3", "ends=[0,2.5]", "kinds=small", "fast=true", "env.a.b=[1]"]
    options = Options.parse(words)
    assert options.name == "7"
    assert (options.count, options.seed) == (1000, 0)
    assert options.ends == (0.0, 2.5)
    assert options.kinds == ("small",)
    assert (options.color, options.fast, options.imports) == ("red", True, True)
    assert options.overrides == {"a.b": [1]}
    assert options.without("name", "number") == {
        "ends": [0, 2.5],
        "kinds": "small",
        "fast": True,
        "env.a.b": [1],
    }


@pytest.mark.parametrize(
    ("word", "message"),
    [
        (
            "nam=x",
            r"nam: unknown option. Did you mean 'name'\? Choose from name, count, .*, imports$",
        ),
        ("given=x", "given: unknown option"),
        ("overrides=x", "overrides: unknown option"),
        ("name=[x]", r"name: expected a name or a path, found \['x'\]"),
        ("count=few", "count: expected a whole number ≥ 1, found 'few'"),
        ("number=0", "number: expected a whole number ≥ 1, found 0"),
        ("count=1e10", "count: expected a whole number from 1 to 2,147,483,647, found 1000"),
        ("seed=true", "seed: expected a whole number ≥ 0, found True"),
        ("ends=[2,1]", r"ends: expected two ends, found \[2, 1\]"),
        (
            "kinds=[small,larg]",
            r"kinds: unknown kind 'larg'. Did you mean 'large'\? Choose from small, large$",
        ),
        ("kinds=[]", "kinds: expected at least one of small, large, found none"),
        ("color=blu", r"color: found 'blu'. Did you mean 'blue'\? Choose from red, blue$"),
        ("fast=1", "fast: expected true or false, found 1"),
        ("imports=no", "imports: expected true or false, found 'no'"),
        ("fast", "argument 'fast': expected key=value"),
        ("--fast=true", "argument '--fast=true': options have no dashes; write fast=true$"),
        ("--kinds-of", "argument '--kinds-of': options have no dashes; write kinds_of=…$"),
    ],
)
def test_what_is_wrong_is_one_line_with_place_and_what_is_allowed(word: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}") as raised:
        Options.parse([word] if word.startswith("name=") else ["name=x", word])
    assert "\n" not in str(raised.value)


def test_an_option_that_is_missing_or_there_twice_is_told() -> None:
    with pytest.raises(ConfigError, match=r"^name: missing; for instance name=this or name=that$"):
        Options.parse(["count=2"])
    with pytest.raises(ConfigError, match=r"^name: given twice$"):
        Options.parse(["name=a", "name=b"])
    with pytest.raises(ConfigError, match=r"^number: is another name of count; leave one out$"):
        Options.parse(["name=a", "number=2", "count=2"])
    with pytest.raises(ConfigError, match=r"^seed: means nothing here; leave it out$"):
        Options.parse(["name=a", "seed=0"]).refuse_beside(["count", "seed"], "here")
    with pytest.raises(ConfigError, match=r"^seed: no option beside name; choose from name$"):
        Options.parse(["name=a", "imports=false", "seed=0"]).refuse_others("name")


def test_the_value_of_the_first_option_may_stand_alone_as_the_first_word() -> None:
    assert Options.parse(["this", "count=2"]).name == "this"
    assert Options.parse(["imports=false", "this"]).name == "this"
    with pytest.raises(ConfigError, match=r"^argument 'this': expected key=value"):
        Options.parse(["count=2", "this"])
    with pytest.raises(ConfigError, match=r"^name: given twice$"):
        Options.parse(["this", "name=that"])
    with pytest.raises(ConfigError, match=r"^argument '': expected key=value"):
        Options.parse([""])


def test_a_pattern_that_the_shell_has_replaced_is_a_list() -> None:
    for words in (["runs/a", "runs/b"], ["runs/a,runs/b"], ["imports=false", "runs/a", "runs/b"]):
        assert plot.Options.parse([*words, "x=wall"]).run == ("runs/a", "runs/b")
    assert plot.Options.parse(["runs/a", "x=wall"]).given["run"] == "runs/a"
    with pytest.raises(ConfigError, match=r"^argument 'runs/b': expected key=value; the word help"):
        plot.Options.parse(["runs/a", "x=wall", "runs/b"])


POLICY_COMMANDS = ("evaluate", "plot", "export", "dataset", "verify", "check")
"""Commands whose first word is a run or a policy."""


def test_every_command_has_an_option_that_may_stand_first() -> None:
    for name in commands.COMMANDS:
        options = importlib.import_module(f"jaxsafe.commands.{name}").Options
        expected = "run" if name in POLICY_COMMANDS else "env"
        assert options.arguments(["x"]) == {expected: "x"}


def test_a_list_needs_no_brackets_and_a_number_may_have_its_digits_in_groups() -> None:
    options = Options.parse(["x", "kinds=small,large", "ends=0,2.5", "count=100_000"])
    assert options.kinds == ("small", "large")
    assert options.ends == (0.0, 2.5)
    assert options.count == 100_000
    assert options.given["kinds"] == ["small", "large"]
    assert Options.parse(["x", "box.a=1_000,2"]).boxes == {"a": [1000, 2]}
    assert Options.parse(["x", "box.a=log(1,2)"]).boxes == {"a": "log(1,2)"}
    assert Options.parse(["x", "env.a=1_00", "env.b=1,2"]).overrides == {"a": "1_00", "b": "1,2"}


def test_options_with_dashes_are_told_as_they_are_written_here() -> None:
    for words, right in (
        (["--env", "docking3d"], "env=docking3d"),
        (["--eval-episodes=5"], "eval_episodes=5"),
        (["-n"], "n=…"),
        (["--fast", "seeds=2"], "fast=…"),
    ):
        with pytest.raises(ConfigError, match=rf"options have no dashes; write {right}$"):
            Options.parse(words)


def test_the_help_text_says_what_each_option_takes_and_means() -> None:
    lines = [line.strip() for line in help_text(Options, {}).splitlines()]
    assert lines[0].endswith(" this [option=value …]")
    at = lines.index("count     a whole number ≥ 1 (default 3)")
    assert lines[at + 1] == "How many there are. More of them take longer."
    assert "seed      a whole number ≥ 0 (default 0)" in lines
    assert "kinds     some of small, large" in lines
    assert "color     one of red, blue (default red)" in lines


def test_the_text_of_a_field_is_read_from_the_class_that_defines_it() -> None:
    docs = field_docs(Options)
    assert docs["name"] == "What it is called."
    assert docs["imports"].startswith("Whether files may name modules")
    assert "seed" not in docs


@pytest.mark.parametrize("word", ["-h", "--help", "help", None])
@pytest.mark.parametrize("name", commands.COMMANDS)
def test_help_of_a_command_explains_every_option(
    name: str,
    word: str | None,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["jaxsafe", name, *([word] if word else [])])
    with pytest.raises(SystemExit) as left:
        commands.main()
    captured = capsys.readouterr()
    assert left.value.code == (0 if word else 2)
    text = captured.out if word else captured.err
    assert text.startswith(f"usage: jaxsafe {name} ")
    assert re.search(r"^  imports +true or false \(default true\)$", text, re.MULTILINE)
    assert max(map(len, text.splitlines())) <= 100
    options = importlib.import_module(f"jaxsafe.commands.{name}").Options
    assert [entry.name for entry in entries(options) if not (entry.takes and entry.text)] == []
    groups = grouped(options, entries(options))
    assert all(groups.values())
    if options.groups:
        assert [entry.name for entry in groups[REST]] == ["imports"]


def explained(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str
) -> str:
    """Return what `jaxsafe` prints for these words."""
    monkeypatch.setattr(sys, "argv", ["jaxsafe", *words])
    with pytest.raises(SystemExit) as left:
        commands.main()
    captured = capsys.readouterr()
    assert left.value.code == (0 if captured.out else 2)
    return captured.out or captured.err


def test_help_on_a_training_shows_the_recipe_of_its_task(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = recipe("docking3d", "many_envs")
    text = explained(capsys, monkeypatch, "train", "docking3d", "preset=many_envs", "--help")
    assert "The defaults are those of docking3d with preset=many_envs." in text
    assert values["steps"] == 8_000_000
    assert re.search(r"^  steps +.* \(default 8_000_000\)$", text, re.MULTILINE)
    assert re.search(r"^  ppo.num_envs +.* \(default 4_096\)$", text, re.MULTILINE)
    assert re.search(r"^  agent.actor.hidden +.* \(default 64,64\)$", text, re.MULTILINE)
    assert explained(capsys, monkeypatch, "help", "train", "docking3d", "preset=many_envs") == text
    text = explained(capsys, monkeypatch, "train", "help")
    assert re.search(r"^  ppo.gamma +.* \(default from the recipe\)$", text, re.MULTILINE)
    assert re.search(r"^  seeds +.* \(default 1\)$", text, re.MULTILINE)
    assert explained(capsys, monkeypatch, "train", "docking4d", "help").startswith(
        "error: env: unknown task 'docking4d'"
    )


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_a_word_that_is_no_option_is_told_by_every_command(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = importlib.import_module(f"jaxsafe.commands.{name}")
    for word, message in (("imports", "expected key=value"), ("imports=2", "imports: expected")):
        monkeypatch.setattr(sys, "argv", ["jaxsafe", "env=docking2d", word])
        with pytest.raises(SystemExit) as left:
            cli.run(module.main, module.Options)
        assert left.value.code == 2
        assert message in capsys.readouterr().err
