"""The pages that are written from the code are current.

The code in the tutorials runs and prints what they say.
"""

import json
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe.commands import COMMANDS
from jaxsafe.commands.catalogue import SECTIONS, title, types_of
from jaxsafe.config import dump, load
from jaxsafe.config.arguments import Arguments
from jaxsafe.envs import TASKS
from jaxsafe.metrics import METRICS
from jaxsafe.parts import (
    Constraint,
    Initializer,
    Observation,
    Region,
    Reward,
    Status,
    Terminal,
    Vector,
)
from jaxsafe.schema import yaml12
from jaxsafe.schema.component import fields
from jaxsafe.schema.convert import to_component
from jaxsafe.schema.dotted_paths import get_path
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host.options import recipe, resolve

ROOT = Path(__file__).parents[2]
CUSTOM = ROOT / "configs" / "custom_env.yaml"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SIGNATURE = re.compile(r'<dt class="sig [^"]*" id="([^"]+)"')
"""The name of something that a page of the API documents."""
MARK = "--- end of block ---"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]


@pytest.mark.parametrize("task", TASKS)
def test_the_page_of_a_task_is_current(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from make_tasks import page  # pyright: ignore[reportMissingImports]

    assert (ROOT / "docs" / "tasks" / f"{task}.md").read_text(encoding="utf-8") == page(task), (
        "run docs/make_tasks.py"
    )
    assert (ROOT / "docs" / "tasks" / f"{task}.png").is_file()


@pytest.fixture(scope="module")
def reference() -> dict[str, str]:
    """Return the pages of the reference, made in a process that knows no types of other tests."""
    program = "import json, make_reference as m; print(json.dumps([m.options(), m.parts()]))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT / "docs",
        capture_output=True,
        text=True,
        check=True,
    )
    return dict(zip(("options", "parts"), json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("name", ["options", "parts"])
def test_a_page_of_the_reference_is_current(name: str, reference: dict[str, str]) -> None:
    page = (ROOT / "docs" / "reference" / f"{name}.md").read_text(encoding="utf-8")
    assert page == reference[name], "run docs/make_reference.py"


def test_the_reference_has_every_type_and_every_option_of_the_tasks_and_recipes() -> None:
    reference = ROOT / "docs" / "reference"
    parts = (reference / "parts.md").read_text(encoding="utf-8")
    options = (reference / "options.md").read_text(encoding="utf-8")
    for task in TASKS:
        for kind in re.findall(r"\btype: (\w+)", dump(jaxsafe.make(task))):
            assert f"### `{kind}`" in parts
        for option in recipe(task, None):
            assert f"| `{option}` |" in options


@pytest.mark.parametrize("task", TASKS)
def test_the_file_of_a_task_is_current_and_is_the_task(task: str) -> None:
    file = ROOT / "configs" / "envs" / f"{task}.yaml"
    assert file.read_text(encoding="utf-8") == f"recipe: {task}\n{dump(jaxsafe.make(task))}", (
        f"jaxsafe config {task} > {file}"
    )
    assert load(file) == jaxsafe.make(task)


@pytest.mark.parametrize("task", TASKS)
def test_every_override_of_the_released_variant_is_explained(task: str) -> None:
    page = (ROOT / "docs" / "deviations.md").read_text(encoding="utf-8")
    assert [path for path in TASKS[task].released if f"`{path}`" not in page] == []


def test_what_no_variant_reproduces_is_told_with_its_numbers() -> None:
    page = (ROOT / "docs" / "deviations.md").read_text(encoding="utf-8")
    section = " ".join(page.split("## What no variant reproduces")[1].split("\n## ")[0].split())
    env = jaxsafe.make("docking2d")
    [deputy] = [platform for platform in env.platforms if platform.name == env.agent]
    mean_motion = float(deputy.mean_motion)
    assert "**Fastest start in docking.**" in section
    assert "the smaller of 0.2 + 2n‖r‖ and 10 m/s" in section
    assert f"from {(10.0 - 0.2) / (2.0 * mean_motion):,.0f} m on" in section
    assert "**Region offsets in space.**" in section
    assert "by the lead's whole attitude" in section


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_no_line_of_a_page_is_a_comment(page: Path) -> None:
    """The site leaves out a line that begins with a per cent sign."""
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    assert re.findall(r"^\s*%.*", text, re.MULTILINE) == []


@pytest.mark.thorough
def test_the_site_builds_without_a_warning_twice_and_with_its_own_extra_alone(
    tmp_path: Path,
) -> None:
    copy = tmp_path / "clone"
    shutil.copytree(
        ROOT / "docs", copy / "docs", ignore=shutil.ignore_patterns("_site", "jupyter_execute")
    )
    shutil.copy(ROOT / "README.md", copy)
    for beside in (
        "CITATION.cff",
        "LICENSE",
        "examples",
        "benchmarks",
        "configs",
        "tests",
        "jaxsafe",
    ):
        (copy / beside).symlink_to(ROOT / beside)
    for other in ("onnx", "onnxruntime", "tensorboardX", "brax", "gymnax", "stable_baselines3"):
        (tmp_path / f"{other}.py").write_text(f"raise ImportError(name={other!r})")
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    for _ in range(2):
        build = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "docs", "docs/_site"]
        ran = subprocess.run(
            build, cwd=copy, env=environment, capture_output=True, text=True, check=False
        )
        assert (ran.returncode, ran.stderr) == (0, "")
    first = (copy / "docs" / "_site" / "index.html").read_text(encoding="utf-8")
    assert 'class="card ' in first
    site = copy / "docs" / "_site"
    pages = {path.stem: path.read_text(encoding="utf-8") for path in site.glob("api/*.html")}
    pages["api"] = (site / "api.html").read_text(encoding="utf-8")
    del pages["adapters"]  # its libraries are not there
    names = {name: page for page in pages for name in SIGNATURE.findall(pages[page])}
    assert names["jaxsafe.reset_to"] == names["jaxsafe.train"] == "api"
    assert [name for name in names if not importable(name)] == []
    assert [page for page, text in pages.items() if re.search("[“”‘’]", text)] == []


def importable(name: str) -> bool:
    """Return whether a name leads to an object, or to a field of a class."""
    try:
        pkgutil.resolve_name(name)
    except AttributeError:
        owner, _, field = name.rpartition(".")
        return field in getattr(pkgutil.resolve_name(owner), "__annotations__", {})
    return True


def test_the_composed_environment_survives_a_round_trip() -> None:
    env = load(CUSTOM)
    assert load(dump(env)) == env


def test_the_composed_environment_can_be_solved_under_jit_and_vmap() -> None:
    env = jaxsafe.make(CUSTOM)
    outcomes, cost, margin = jax.jit(jax.vmap(fly_around, in_axes=(None, 0)))(
        env, jax.random.split(jax.random.key(0), 5)
    )
    assert [env.outcomes[outcome] for outcome in np.asarray(outcomes)] == ["success"] * 5
    assert float(cost.sum()) == 0.0
    assert float(margin.min()) > 0.0


def test_flying_straight_through_the_zone_fails() -> None:
    env = jaxsafe.make(CUSTOM)
    state, _ = jaxsafe.reset_to(
        env,
        {"deputy": {"position": [0.0, 71.0], "velocity": [0.0, -2.0]}},
        dict.fromkeys(env.randomize, 12.0),
    )
    _, timestep = jax.jit(jaxsafe.step)(env, state, jnp.zeros(2))
    assert env.outcomes[int(timestep.info.outcome)] == "keep_out"
    assert float(timestep.info.reward_terms["failure"]) == -1.0
    assert float(timestep.info.margins["keep_out"]) < 0.0
    assert float(timestep.cost) == 1.0


def fly_around(env: jaxsafe.Environment, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the first outcome, and up to it the cost and the smallest margin to the zone.

    The policy flies by a way-point.
    """

    def one_step(carry: tuple, _: None) -> tuple[tuple, tuple]:
        state, outcome = carry
        deputy = state.sim.platforms["deputy"]
        status = state.sim.status
        beside = jnp.array([jnp.where(deputy.position[0] < 0.0, -40.0, 40.0), 45.0])
        away = jnp.where(deputy.position[1] > 50.0, beside, 0.0) - deputy.position
        limit = jnp.minimum(status["velocity_limit"], status["keep_out_speed_limit"])
        thrust = 12.0 * (0.8 * limit * away / jnp.linalg.norm(away) - deputy.velocity)
        state, timestep = jaxsafe.step(env, state, thrust)
        cost = jnp.where(outcome == 0, timestep.cost, 0.0)
        margin = jnp.where(outcome == 0, timestep.info.margins["keep_out"], jnp.inf)
        return (state, jnp.where(outcome == 0, timestep.info.outcome, outcome)), (cost, margin)

    start = jaxsafe.reset(env, key)[0], jnp.zeros((), jnp.int32)
    (_, outcome), (cost, margin) = jax.lax.scan(one_step, start, None, 900)
    return outcome, cost.sum(), margin.min()


@pytest.mark.thorough
@pytest.mark.parametrize(
    "page",
    [
        "compose",
        "dynamics",
        thorough("extend"),
        thorough("extend_rta"),
        thorough("safety/own_simulator"),
        thorough("safety/presets"),
        thorough("safety/proofs"),
        thorough("controllers"),
        thorough("possible"),
        "deviations",
        thorough("adapters/gymnasium"),
        "adapters/safety_gymnasium",
        pytest.param("adapters/gymnax", marks=pytest.mark.peer),
    ],
)
def test_the_code_of_a_page_runs_and_prints_what_the_page_says(page: str, tmp_path: Path) -> None:
    """Blocks that begin with the name of a file are written to it.

    The others run in one program, in their order.

    Output follows its block as `text`. YAML without a name is quoted from the composed environment.
    A `console` block is a command and what it prints.
    """
    shutil.copy(CUSTOM, tmp_path)
    if page == "adapters/gymnax":
        pytest.importorskip("gymnax")
    program = ""
    expected = []
    for kind, text in BLOCK.findall((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")):
        named = re.match(r"# (\w+\.(?:py|yaml))\n", text)
        if named:
            (tmp_path / named[1]).write_text(text, encoding="utf-8")
        elif kind == "python":
            program += f"{text}\nprint({MARK!r})\n"
            expected.append("")
        elif kind == "text":
            expected[-1] = text
        elif kind == "yaml":
            assert text in CUSTOM.read_text(encoding="utf-8")
        else:
            command, output = text.removeprefix("$ jaxsafe ").split("\n", 1)
            process = run(["-m", "jaxsafe", *shlex.split(command)], tmp_path)
            assert process.stdout + process.stderr == output
    (tmp_path / "program.py").write_text(program, encoding="utf-8")
    process = run(["program.py"], tmp_path)
    assert process.returncode == 0, process.stderr
    assert process.stdout.split(f"{MARK}\n")[:-1] == expected


def trainings_of_the_page_of_constrained_learning() -> list[dict[str, Any]]:
    page = (ROOT / "docs" / "constrained.md").read_text(encoding="utf-8")
    lines = [line for line in page.splitlines() if line.startswith("jaxsafe train ")]
    return [Arguments.parse(shlex.split(line)[2:]).options for line in lines]


def test_the_trainings_of_the_page_of_constrained_learning_are_some(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(CUSTOM.parent)
    trainings = trainings_of_the_page_of_constrained_learning()
    names = [resolve(options)[0].agent.cost_names for options in trainings]
    assert ("keep_out", "velocity_limit") in names
    assert len(names) >= 8


def test_early_termination_ends_an_episode_at_its_first_violation() -> None:
    (options,) = (
        options
        for options in trainings_of_the_page_of_constrained_learning()
        if "env.terminal" in options
    )
    env = resolve(options)[1]
    step = jax.jit(jaxsafe.step)
    for speed, outcome in ((0.3, "running"), (0.5, "violation")):  # the limit is 0.41 m/s
        start = {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, speed]}}
        _, timestep = step(env, jaxsafe.reset_to(env, start)[0], jnp.zeros(2))
        assert env.outcomes[int(timestep.info.outcome)] == outcome
        assert bool(timestep.terminated) == (timestep.cost > 0.0) == (outcome == "violation")


def test_every_part_in_the_tables_of_the_vocabulary_is_one() -> None:
    bases = {
        "Regions": Region,
        "Vectors": Vector,
        "Statuses": Status,
        "Constraints": Constraint,
        "Ends": Terminal,
        "Rewards": Reward,
        "Observations": Observation,
        "Starts": Initializer,
    }
    page = (ROOT / "docs" / "compose.md").read_text(encoding="utf-8")
    vocabulary = page.split("## The vocabulary\n")[1].split("\n## ")[0]
    [_, *sections] = re.split(rf"\*\*({'|'.join(bases)})\*\*", vocabulary)
    found = set()
    for heading, text in zip(sections[::2], sections[1::2], strict=True):
        base = bases[heading]
        needed = {"on": None} if base is Region else {}
        needed = needed if base is Vector else {"name": "part", **needed}
        for written in re.findall(r"`(\{type.*?\})`", text.replace("\n", " ")):
            data = yaml12.parse(written.replace("VECTOR", "{type: position, of: deputy}"), "page")
            if "file" not in data:
                assert isinstance(to_component({**needed, **data}, base, written), base)
            found.add(data["type"])
    assert len(found) >= 40


def rows_of_the_paper() -> dict[str, list[list[str]]]:
    """Return the cells of each row about the paper, by section of the page."""
    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    sections = {}
    for text in page.split("\n## ")[1:]:
        heading, _, body = text.partition("\n")
        rows = [line.strip("| ").split(" | ") for line in body.splitlines() if line[:2] == "| "]
        sections[heading] = [row for row in rows if row[0] != "the paper"]
    return sections


def is_known(name: str) -> bool:
    """Return whether a name is importable, a type, a field, a number of a task, or a metric."""
    types = [cls for section in SECTIONS.values() for cls in types_of(section)]
    owner, _, field = name.partition(".")
    if owner == "jaxsafe":
        return importable(name)
    if owner == "timestep":
        record = "Info" if field.startswith("info.") else "TimeStep"
        return importable(f"jaxsafe.types.{record}.{field.rpartition('.')[2]}")
    if any(title(cls) == owner and field in ("", *fields(cls)) for cls in types):
        return True
    return name in (*SECTIONS, *METRICS) or any(leads_somewhere(task, name) for task in TASKS)


def leads_somewhere(task: str, path: str) -> bool:
    """Return whether a task has something at a dotted path."""
    try:
        get_path(jaxsafe.make(task), path)
    except (AttributeError, ConfigError, KeyError, TypeError):
        return False
    return True


def unknown_options(command: str) -> list[str]:
    """Return the options of a command line that its page of the reference does not have."""
    reference = (ROOT / "docs" / "reference" / "options.md").read_text(encoding="utf-8")
    words = command.split()[1:]
    named = [word for word in words if "=" not in word]
    heading = f"## jaxsafe {' '.join(named[: 2 if named[:2] == ['config', 'types'] else 1])}\n"
    assert heading in reference, command
    known = re.findall(r"^\| `(.*?)` \|", reference.split(heading)[1].split("\n## ")[0], re.M)
    options = [word.partition("=")[0].removeprefix("sweep.") for word in words if "=" in word]
    options = ["env.PATH" if option.startswith("env.") else option for option in options]
    training = reference.split("## jaxsafe train\n")[1].split("\n## ")[0]
    known += re.findall(r"^\| `(.*?)` \|", training, re.M) if named[0] == "tune" else []
    return [option for option in options if option not in known]


def test_every_name_on_the_page_of_the_paper_is_one() -> None:
    for rows in rows_of_the_paper().values():
        for _, _, names, _ in rows:
            shown = re.findall("`(.*?)`", names)
            assert shown or "](" in names, names
            for name in shown:
                if name.startswith("jaxsafe "):
                    assert unknown_options(name) == [], name
                else:
                    assert is_known(name), name
    assert not is_known("simplexx")
    assert not is_known("simplex.releas")
    assert not is_known("deputy.mas")
    assert not is_known("timestep.info.outcomes")
    assert unknown_options("jaxsafe train stepss=3 env.x=2") == ["stepss"]


def test_the_page_of_the_paper_gives_reasons_and_counts_its_rows() -> None:
    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    total = [0, 0, 0, 0]
    for heading, rows in rows_of_the_paper().items():
        answers = [answer.partition(": ") for *_, answer in rows]
        for answer, _, reason in answers:
            assert (answer == "yes") != bool(reason), (answer, reason)
        counts = [len(rows)]
        counts += [sum(word == answer for word, *_ in answers) for answer in ("yes", "other", "no")]
        assert counts[0] == sum(counts[1:])
        total = [a + b for a, b in zip(total, counts, strict=True)]
        anchor = heading.lower().replace(",", "").replace(" ", "-")
        assert f"| [{heading}](#{anchor}) | {' | '.join(map(str, counts))} |" in page
    assert f"| all | {' | '.join(map(str, total))} |" in page


@pytest.mark.thorough
def test_the_code_of_the_readme_runs(tmp_path: Path) -> None:
    blocks = BLOCK.findall((ROOT / "README.md").read_text(encoding="utf-8"))
    program = "\n".join(text for kind, text in blocks if kind == "python")
    [shown] = [text for kind, text in blocks if kind == "text"]
    (tmp_path / "program.py").write_text(program, encoding="utf-8")
    process = run(["program.py"], tmp_path)
    assert process.returncode == 0, process.stderr
    assert process.stdout.endswith(f"\n{shown}")
    assert (tmp_path / "flight.png").is_file()


def test_the_readme_is_short() -> None:
    """Code, pictures and addresses are not read as words."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for unread in (r"(?s)```.*?```", r"<img[^>]*>", r"!\[[^\]]*\]\([^)]*\)", r"(?<=\])\([^)]*\)"):
        text = re.sub(unread, "", text)
    assert len(re.findall(r"[A-Za-z0-9][\w\-.,/%]*", text)) <= 500


def test_the_address_of_the_repository_is_written_in_one_place() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for address in re.findall(r"https://github\.com/\w+/jaxsafe\b", text):
            assert address == project["urls"]["Source"], page
    assert project["urls"]["Source"] in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.thorough
@pytest.mark.parametrize("page", ["quickstart", "concepts", "tasks/docking2d", "api/train"])
def test_the_code_of_a_first_page_runs(page: str, tmp_path: Path) -> None:
    blocks = BLOCK.findall((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8"))
    program = "\n".join(text for kind, text in blocks if kind == "python")
    (tmp_path / "program.py").write_text(program, encoding="utf-8")
    process = run(["program.py"], tmp_path)
    assert process.returncode == 0, process.stderr
    assert process.stdout.count("\n") == program.count("print(")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_are_those_of_any_shell(page: Path) -> None:
    """In zsh a word with brackets must be quoted, and a comment behind a command is part of it."""
    text = page.read_text(encoding="utf-8")
    typed = re.compile(rf"python -m jaxsafe|\bjaxsafe ({'|'.join(COMMANDS)})\b")
    commands = [line for line in text.splitlines() if typed.search(line)]
    words = [word for line in commands for word in line.split()]
    assert [word for word in words if re.match(r"[\w.]+=.*[\[*?]", word)] == []
    alone = [line for line in commands if not line.startswith("#") and "`" not in line]
    assert [line for line in alone if " # " in line] == []
    assert re.findall(r"`[\w.]+=\[", text) == []


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.stem)
def test_extras_are_installed_from_a_clone_and_quoted(page: Path) -> None:
    """No index of packages has jaxsafe yet. In zsh bare brackets are a pattern."""
    installs = re.findall(r"pip install ([^`\n]*)", page.read_text(encoding="utf-8"))
    assert [words for words in installs if "[" in re.sub(r"'[^']*'", "", words)] == []
    assert [words for words in installs if re.match(r"(-\S+ )*'?jaxsafe", words)] == []


@pytest.mark.slow
def test_terminal_sets_hold_where_the_page_says_so(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "safety" / "proofs.md").read_text(encoding="utf-8")
    script = next(
        text for _, text in BLOCK.findall(page) if text.startswith("# terminal_sets.py\n")
    )
    (tmp_path / "terminal_sets.py").write_text(script, encoding="utf-8")
    process = run(["terminal_sets.py"], tmp_path)
    assert process.returncode == 0, process.stderr
    lines = process.stdout.splitlines()
    assert len(lines) == 2
    assert all(line.endswith("below the margin: 0") for line in lines), process.stdout


def run(arguments: list[str], directory: Path) -> subprocess.CompletedProcess[str]:
    """Run Python on one device, with the tests' compilation cache."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)}  # type: ignore[attr-defined]
    # the pages compile many small programs
    cache["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    environment = {**os.environ, **cache, "PYTHONUTF8": "1", "XLA_FLAGS": ""}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, encoding="utf-8", check=False
    )
