"""A result says on which sources and machine it depends, and machines are not mixed."""

import importlib
import json
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
HERE = {
    "processor": "a processor",
    "cores": 2,
    "python": "3.11.7",
    "jax": "1",
    "jaxlib": "1",
    "sources": "abc",
    "changed": False,
}


@pytest.fixture
def fingerprint(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("fingerprint")


@pytest.fixture
def everything(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """`all.py`, with two scripts whose results are current."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    module = importlib.import_module("all")
    monkeypatch.setattr(module, "RESULTS", tmp_path)
    monkeypatch.setattr(module, "SCRIPTS", {"first": (), "second": ("repeats=2",)})
    monkeypatch.setattr(module, "about", lambda script: HERE)
    for name in ("first", "second"):
        write(tmp_path / f"{name}.json", HERE)
    return module


def write(path: Path, entry: dict[str, Any]) -> None:
    path.write_text(json.dumps({"rows": [{"part": entry}]}))


def run(module: ModuleType, monkeypatch: pytest.MonkeyPatch, *given: str) -> int:
    monkeypatch.setattr(sys, "argv", ["all.py", *given])
    return module.main()


def test_texts_do_not_count_and_code_that_is_needed_does(
    fingerprint: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    files = {
        "benchmarks/script.py": '"""Text."""\nimport jaxsafe\n\njaxsafe.make(1)\njaxsafe.f()\n'
        'command("e", "x=1")\nrun(["-m", "jaxsafe.g"])\n',
        "jaxsafe/__init__.py": "from jaxsafe.a import make\nfrom jaxsafe.b import fly\n"
        "if TYPE_CHECKING:\n    from jaxsafe.f.f import f\nelse:\n    from jaxsafe import f\n",
        "jaxsafe/a.py": "import jaxsafe.c\n\ndef make(x):\n    import jaxsafe.later\n",
        "jaxsafe/b.py": "fly = 1\n",
        "jaxsafe/c.py": "if TYPE_CHECKING:\n    import jaxsafe.d\n",
        "jaxsafe/d.py": "hint = 1\n",
        "jaxsafe/later.py": "late = 1\n",
        "jaxsafe/e/__main__.py": "from jaxsafe.command import run\n",
        "jaxsafe/command.py": "run = 1\n",
        "jaxsafe/f/__init__.py": "make_callable('jaxsafe.f.f')\n",
        "jaxsafe/f/f.py": "f = 1\n",
        "jaxsafe/g/__main__.py": "g = 1\n",
        "configs/recipe.yaml": "steps: 1\n",
    }

    def changed(name: str = "", text: str = "") -> str:
        for path, content in (files | ({name: text} if name else {})).items():
            place = tmp_path / path
            place.parent.mkdir(exist_ok=True, parents=True)
            place.write_text(content)
        fingerprint._tree.cache_clear()
        return fingerprint.fingerprint(tmp_path / "benchmarks" / "script.py")

    monkeypatch.setattr(fingerprint, "ROOT", tmp_path)
    monkeypatch.setattr(fingerprint, "BENCHMARKS", tmp_path / "benchmarks")
    monkeypatch.setattr(fingerprint, "LEFT_OUT", (tmp_path / "jaxsafe" / "__init__.py",))
    before = changed()
    same = {
        "benchmarks/script.py": files["benchmarks/script.py"].replace("Text", "Another # text"),
        "jaxsafe/b.py": "fly = 2\n",
        "jaxsafe/d.py": "hint = 2\n",
    }
    for name, text in same.items():
        assert changed(name, text) == before, name
    other = {
        "benchmarks/script.py": "import jaxsafe\n\njaxsafe.make(2)\n",
        "jaxsafe/a.py": "import jaxsafe.c\n\ndef make(x):\n    return 1\n",
        "jaxsafe/c.py": "number = 1\n",
        "jaxsafe/later.py": "late = 2\n",
        "jaxsafe/command.py": "run = 2\n",
        "jaxsafe/f/f.py": "f = 2\n",
        "jaxsafe/g/__main__.py": "g = 2\n",
        "configs/recipe.yaml": "steps: 2\n",
    }
    for name, text in other.items():
        assert changed(name, text) != before, name
    assert changed() == before


def test_a_script_depends_on_the_environment_and_not_on_figures(fingerprint: ModuleType) -> None:
    root = BENCHMARKS.parent
    paths = {
        str(path.relative_to(root)) for path in fingerprint.sources(BENCHMARKS / "environments.py")
    }
    assert {
        "jaxsafe/environment.py",
        "jaxsafe/simulation/cwh.py",
        "benchmarks/isolated.py",
    } <= paths
    assert not [path for path in paths if path.startswith(("jaxsafe/plot", "jaxsafe/verify"))]


@pytest.mark.parametrize(
    ("script", "module"),
    [
        ("controllers", "evaluate/evaluate"),
        ("verification", "verify/verify"),
        ("far_starts", "train/ppo"),
        ("constraints", "commands/evaluate"),
        ("five_tasks", "devices/program_store"),
        ("startup", "commands/train"),
        ("datasets", "dataset/collect"),
        ("attacks", "evaluate/run_adversaries"),
    ],
)
def test_a_script_depends_on_what_it_calls_and_on_the_commands_that_it_runs(
    script: str, module: str, fingerprint: ModuleType
) -> None:
    needed = fingerprint.sources(BENCHMARKS / f"{script}.py")
    assert BENCHMARKS.parent / "jaxsafe" / f"{module}.py" in needed


def test_every_script_that_writes_results_is_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    scripts = {
        path.stem
        for path in BENCHMARKS.glob("*.py")
        if "about(__file__)" in path.read_text(encoding="utf-8")
    }
    everything = importlib.import_module("all")
    run = {everything.script_of(name).stem for name in everything.SCRIPTS}
    assert run == scripts - {"accelerator", "all"}


def test_every_result_but_that_of_a_gpu_is_refreshed_by_one_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    everything = importlib.import_module("all")
    results = {
        path.relative_to(everything.RESULTS).with_suffix("").as_posix()
        for path in everything.RESULTS.rglob("*.json")
    }
    assert results == {*everything.SCRIPTS, "accelerator"}


@pytest.mark.parametrize("key", ["processor", "cores", "python", "jax", "jaxlib", "sources"])
def test_a_result_of_another_machine_or_code_is_stale(
    everything: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    key: str,
) -> None:
    assert run(everything, monkeypatch, "measure=false") == 0
    assert re.findall("current", capsys.readouterr().out) == ["current"] * 2
    write(tmp_path / "second.json", HERE | {key: "another"})
    assert run(everything, monkeypatch, "measure=false") == 1
    line = f"{'second':34s}{key}: another, here {HERE[key]}"
    assert line in capsys.readouterr().out
    with pytest.raises(SystemExit, match=f"^names: second is stale too \\({key}: another"):
        run(everything, monkeypatch, "names=first")


@pytest.mark.parametrize(
    ("option", "error"),
    [
        ("measure=maybe", "measure: found 'maybe'; choose from true, false"),
        ("published=nowhere.onnx", "published: no file 'nowhere.onnx'"),
    ],
)
def test_a_wrong_option_ends_the_command_before_anything_is_measured(
    everything: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    option: str,
    error: str,
) -> None:
    monkeypatch.setattr(everything.subprocess, "run", None)
    (tmp_path / "second.json").unlink()
    with pytest.raises(SystemExit, match=f"^{re.escape(error)}$"):
        run(everything, monkeypatch, option)


def test_only_what_is_stale_is_measured(
    everything: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    commands = []

    def record(command: list[Any], check: bool) -> Any:
        commands.append([Path(command[1]).name, *command[2:]])
        return type("Finished", (), {"returncode": 0})

    monkeypatch.setattr(everything.subprocess, "run", record)
    assert run(everything, monkeypatch) == 0
    assert commands == []
    (tmp_path / "second.json").unlink()
    assert everything.reason("second") == "not measured"
    assert run(everything, monkeypatch) == 0
    assert commands == [["second.py", "repeats=2"]]


def test_code_that_is_not_committed_is_not_measured(
    everything: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(everything, "about", lambda script: HERE | {"changed": True})
    with pytest.raises(SystemExit, match="commit it first"):
        run(everything, monkeypatch)


def test_rows_that_were_not_measured_again_stay_and_keep_the_results_stale(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    machine = importlib.import_module("machine")
    out = tmp_path / "results.json"
    old = {**HERE, "command": "all", "commit": "a", "sources": "old"}
    new = {**HERE, "command": "one", "commit": "b"}
    one, two = {"task": "one", "value": 1}, {"task": "two", "value": 2}
    results = {**new, "rows": [{**two, "value": 3}]}
    assert machine.with_kept(out, results, same=["task"]) == results
    out.write_text(json.dumps({**old, "rows": [one, two]}))
    own = {"command": "one", "commit": "b", "processor": HERE["processor"]}
    rows = [one, {"task": "two", "value": 3, **own}]
    assert machine.with_kept(out, results, same=["task"]) == {**old, "rows": rows}
    results["rows"] += [one]
    assert machine.with_kept(out, results, same=["task"]) == results
