"""A user's package adds a task with one call.

Everything that takes the name of a task then knows it.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from tiny_run import TINY

import jaxsafe
from jaxsafe.envs import TASKS, Task, make, register
from jaxsafe.schema.errors import ConfigError

PAGE = Path(__file__).parents[2] / "docs" / "extend.md"
OPTIONS = [word for word in TINY if not word.startswith("env=")]


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """Return an empty directory with the module of the tutorial and a recipe for its task."""
    module = re.search(
        r"```python\n# my_tasks\.py\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
    )
    assert module
    text = module[1].replace(
        "filters=FILTERS,", "filters=FILTERS,\n        recipe=Path(__file__).parent / 'own.yaml',"
    )
    (tmp_path / "my_tasks.py").write_text(f"from pathlib import Path\n{text}", encoding="utf-8")
    (tmp_path / "own.yaml").write_text(
        "plain: {agent: {actor: {hidden: [8]}}}\nwide: {agent: {actor: {hidden: [12]}}}\n"
    )
    return tmp_path


def command(directory: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command of jaxsafe in a directory, with the tests' compilation cache."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)}  # type: ignore[attr-defined]
    environment = {**os.environ, **cache}
    line = [sys.executable, "-m", *words]
    return subprocess.run(
        line, cwd=directory, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.thorough
def test_a_task_of_ones_own_is_trained_and_evaluated_by_name(directory: Path) -> None:
    words = [word for word in OPTIONS if not word.startswith("agent.actor.hidden")]
    trained = command(
        directory,
        "jaxsafe.train",
        "env=my_tasks:heavy_docking",
        "rta=default",
        "preset=wide",
        *words,
    )
    assert trained.returncode == 0, trained.stderr
    run = directory / "runs" / "heavy_docking"
    config = (run / "config.yaml").read_text()
    assert re.search(r"hidden: \[12\]", config)
    assert "imports: [my_tasks]" in config
    results = json.loads((run / "results.json").read_text())
    assert results["env"] == "heavy_docking"
    words_of_evaluation = [f"run={run}", "rta=explicit_simplex", "episodes=2", "deterministic=true"]
    evaluated = command(directory, "jaxsafe.evaluate", *words_of_evaluation)
    assert evaluated.returncode == 0, evaluated.stderr
    refused = command(
        directory, "jaxsafe.train", "env=my_tasks:heavy_docking", "imports=false", *words
    )
    assert refused.returncode == 2
    assert "imports=false refuses that" in refused.stderr
    assert refused.stderr.count("\n") == 1


def test_a_task_that_a_module_does_not_register_is_told(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(directory))
    monkeypatch.delitem(TASKS, "heavy_docking", raising=False)
    with pytest.raises(
        ConfigError, match=r"unknown task 'heavy_dock' .* Did you mean 'heavy_docking'\?"
    ):
        make("my_tasks:heavy_dock")
    assert float(make("my_tasks:heavy_docking").platform("deputy").mass) == 40.0  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match="cannot import 'no_such_module'"):
        make("no_such_module:x")
    TASKS.pop("heavy_docking")


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (Task(name="my task", environment=lambda: make("docking2d")), "expected a name of letters"),
        (Task(name="all", environment=lambda: make("docking2d")), "expected a name of letters"),
        (
            Task(name="docking2d", environment=lambda: make("docking3d")),
            r"taken by jaxsafe\.envs\.docking",
        ),
        (
            Task(name="other", environment=lambda: make("docking2d"), gymnasium_id="CartPole-v1"),
            "Gymnasium has another environment called CartPole-v1",
        ),
    ],
)
def test_a_name_that_is_taken_or_cannot_be_typed_is_refused(task: Task, message: str) -> None:
    before = dict(TASKS)
    with pytest.raises(jaxsafe.ConfigError, match=message):
        register(task)
    assert before == TASKS
