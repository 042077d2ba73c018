import importlib
import io
import json
import os
import random
import re
import subprocess
import sys
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from numpy.lib import format as npy

from jaxsafe import commands
from jaxsafe.agents import policy_file as policy_module
from jaxsafe.agents.policy_file import read_policy
from jaxsafe.commands import cli, falsify
from jaxsafe.commands import config as config
from jaxsafe.commands import evaluate as evaluate
from jaxsafe.commands import export as export
from jaxsafe.commands import plot as plot
from jaxsafe.commands import train as train
from jaxsafe.commands import tune as tune
from jaxsafe.config.arguments import Arguments
from jaxsafe.evaluate.evaluator import Evaluator
from jaxsafe.schema import yaml12
from jaxsafe.schema.errors import ConfigError, ConfigWarning
from jaxsafe.storage.text_table import columns
from jaxsafe.train.host import options as config_module
from jaxsafe.train.host.options import RENAMED, resolve
from jaxsafe.train.host.session import Training
from jaxsafe.tune import batched_training


@pytest.fixture
def fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., str]:
    """Return a function that runs a command in an empty directory and returns its error.

    The command must leave with code 2 and one line on standard error.
    """
    monkeypatch.chdir(tmp_path)

    def run(module: object, *words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["jaxsafe", *words])
        with pytest.raises(SystemExit) as exit_info:
            cli.run(module.main, module.Options)  # type: ignore[attr-defined]
        captured = capsys.readouterr()
        assert exit_info.value.code == 2
        assert captured.err.count("\n") == 1
        assert captured.err.startswith("error: ")
        return captured.err

    return run


def test_a_path_that_looks_like_a_number_stays_as_typed() -> None:
    arguments = Arguments.parse(["out=2024.10", "run=007", "env.timeout=10.0"])
    assert (arguments.pop_text("out"), arguments.pop_text("run")) == ("2024.10", "007")
    assert arguments.pop_overrides() == {"timeout": 10.0}
    assert Arguments.parse(["run=[a, b]"]).pop("run") == ["a", "b"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["env=doking3d"],
            "env: unknown task 'doking3d' and not a .yaml file. Did you mean 'docking3d'? "
            "Choose from rejoin2d, rejoin3d, docking2d, docking3d, docking2d_oriented, docking1d\n",
        ),
        (["seeds=2"], "env: missing; for instance env=docking3d"),
        (["env="], "env: expected a name or a path, found None"),
        (["env=docking3d", "sedes=2"], "sedes: unknown option 'sedes'. Did you mean 'seeds'?\n"),
        (
            ["env=docking3d", "mass=14"],
            "mass: unknown option; a field of the environment is written env.deputy.mass",
        ),
        (["env=docking3d", "gpu=1"], "gpu: unknown option 'gpu'; choose from preset"),
        (["env=docking3d", "seeds=0"], "seeds: expected a whole number ≥ 1, found 0"),
        (["env=docking3d", "seeds=ten"], "seeds: expected a whole number ≥ 1, found 'ten'"),
        (["env=docking3d", "seeds=2.5"], "seeds: expected a whole number ≥ 1, found 2.5"),
        (["env=docking3d", "seed=-1"], "seed: expected a whole number in [0, 2"),
        (["env=docking3d", "seeds=2", "seeds=3"], "seeds: given twice"),
        (["env=docking3d", "seeds"], "argument 'seeds': expected key=value"),
        (
            ["env=docking3d", "preset=engineered_featurs"],
            "preset: unknown preset 'engineered_featurs'. Did you mean 'engineered_features'? "
            "Choose from engineered_features, observation_only, many_envs, shortest_time, wide\n",
        ),
        (["env=docking3d", "ppo.gama=0.9"], "ppo.gama: unknown option 'gama'"),
        (["env=docking3d", "ppo.gamma=1.5"], "ppo.gamma: expected a number in [0, 1], found 1.5"),
        (
            ["env=docking3d", "ppo.gamma=high"],
            "ppo.gamma: expected a number in [0, 1], found 'high'",
        ),
        (["env=docking3d", "ppo.gamma=true"], "ppo.gamma: expected a number in [0, 1], found True"),
        (
            ["env=docking3d", "ppo.learning_rate=.nan"],
            "ppo.learning_rate: expected a number > 0, found nan",
        ),
        (
            ["env=docking3d", "ppo.num_envs=16", "ppo.num_minibatches=3"],
            "ppo.num_minibatches: expected a divisor of",
        ),
        (
            ["env=docking3d", "ppo.num_envs=16", "devices_per_seed=3"],
            "devices_per_seed: expected one of 1, 2, 4, 8, 16, which divide",
        ),
        (
            ["env=docking3d", "ppo.learning_rate_decay=exponential", "ppo.final_learning_rate=0"],
            "ppo.final_learning_rate: expected a number > 0 for an exponential decay, found 0",
        ),
        (
            ["env=docking3d", "agent.log_std=[-1,-2]"],
            "agent.log_std: expected one number or 3, one for each action, found 2",
        ),
        (
            ["env=docking3d", "agent.features=dock"],
            "agent.features: found 'dock'. Did you mean 'docking'? "
            "Choose from none, docking, approach, far_approach, far_directions, far_oriented,"
            " rejoin\n",
        ),
        (["env=docking3d", "actions=discret"], "Did you mean 'discrete'?"),
        (
            ["env=docking3d", "tensorboard=maybe"],
            "tensorboard: expected true or false, found 'maybe'",
        ),
        (
            ["env=docking3d", "distributed=maybe"],
            "distributed: expected true or false, found 'maybe'",
        ),
        (
            ["env=docking3d", "env.reward.delta_v.scal=1"],
            "reward.delta_v.scal: unknown field 'scal'",
        ),
        (
            ["env=docking3d", "env.deputy.mass=-1"],
            "deputy.mass: expected a number in kg > 0, found -1",
        ),
        (["env=nowhere.yaml"], "nowhere.yaml: cannot be read: No such file or directory"),
        (["resume=runs/x"], "resume: no run in 'runs/x' (a directory with config.yaml)"),
        (["resume=runs/x", "seeds=5"], "seeds: no option beside resume. Did you mean 'steps'?"),
        (["env=docking3d", "out=/proc/nowhere"], "out: cannot write /proc/nowhere"),
    ],
)
def test_bad_options_of_train_are_told_in_one_line(
    fails: Callable[..., str], words: list[str], message: str
) -> None:
    assert message in fails(train, *words)
    assert list(Path.cwd().rglob("*")) == []  # nothing was begun


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("gamma=0.9", "gamma: unknown option 'gamma'. Did you mean 'ppo.gamma'"),
        ("lr=1e-3", "lr: unknown option 'lr'. Did you mean 'ppo.learning_rate'"),
        ("ppo.lr=1e-3", "ppo.lr: unknown option 'lr'. Did you mean 'learning_rate'"),
        ("ent_coef=0", "Did you mean 'ppo.entropy_coefficient'"),
        # names of CleanRL and Stable-Baselines3
        ("anneal_lr=true", "Did you mean 'ppo.learning_rate_decay'"),
        ("batch_size=64", "batch_size: unknown option 'batch_size'. Did you mean 'ppo.num_min"),
        ("ppo.batch_size=64", "Did you mean 'num_minibatches'"),
        ("clip_coef=0.1", "Did you mean 'ppo.clip'"),
        ("clip_range=0.1", "Did you mean 'ppo.clip'"),
        ("gae_lambda=0.9", "Did you mean 'ppo.gae_lambda'"),
        ("lr_schedule=linear", "Did you mean 'ppo.learning_rate_decay'"),
        ("max_grad_norm=1", "Did you mean 'ppo.max_grad_norm'"),
        ("n_epochs=3", "Did you mean 'ppo.num_epochs'"),
        ("n_steps=64", "Did you mean 'ppo.num_steps'"),
        ("net_arch=64,64", "Did you mean 'agent.actor.hidden'"),
        ("num_envs=4", "Did you mean 'ppo.num_envs'"),
        ("total_timesteps=1000", "Did you mean 'steps'"),
        ("update_epochs=3", "Did you mean 'ppo.num_epochs'"),
        ("vf_coef=0.5", "Did you mean 'ppo.value_coefficient'"),
        ("env.obs=position", "Did you mean 'observation'"),
        ("env.mass=14", "env.mass: unknown field 'mass'. Did you mean 'env.deputy.mass'"),
        ("deputy.mass=14", "deputy.mass: unknown option; .* is written env.deputy.mass"),
        ("pppo.gamma=0.9", "Did you mean 'ppo'"),
        ("env.deputy.mas=14", "env.deputy.mas: unknown field 'mas'. Did you mean 'mass'"),
    ],
)
def test_near_misses_lead_on(fails: Callable[..., str], word: str, message: str) -> None:
    assert re.search(message, fails(train, "docking3d", word))


@pytest.mark.parametrize("command", [evaluate, config])
def test_a_field_of_the_environment_without_env_is_led_on(
    command: Any, fails: Callable[..., str]
) -> None:
    assert "is written env.deputy.mass" in fails(command, "docking2d", "deputy.mass=14")


def test_lists_of_a_training_need_no_brackets(fails: Callable[..., str]) -> None:
    config, env, _ = resolve({"env": "docking2d", "agent.actor.hidden": "32,16"})
    assert config.agent.actor.hidden == (32, 16)  # pyright: ignore[reportAttributeAccessIssue]
    words = {"env.observation": "velocity,position", "env.deputy.start.position.distance": "9,11"}
    _, env, _ = resolve({"env": "docking2d", "preset": "observation_only", **words})
    assert [part.name for part in env.observation] == ["velocity", "position"]
    assert "steps: expected a whole number ≥ 1, found '100,000'" in fails(
        train, "docking2d", "steps=100,000"
    )


def test_steps_that_are_rounded_are_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object) -> None:
        raise RuntimeError("far enough")

    monkeypatch.setattr(Training, "prepare", stop)
    sizes = ["ppo.num_envs=24", "ppo.num_steps=64", f"out={tmp_path / 'run'}"]
    for words, told in ((["steps=100_000"], True), (["steps=15_360"], False), ([], False)):
        with pytest.raises(RuntimeError, match="far enough"):
            train.main(["docking2d", *words, *sizes])
        line = "steps: 100,000 becomes 101,376, a whole number of updates of 1,536\n"
        assert (line in capsys.readouterr().out) == told


def test_numbers_in_exponent_form_are_numbers(fails: Callable[..., str]) -> None:
    assert "found -1000000" in fails(train, "env=docking3d", "steps=-1e6")
    assert "steps: expected a whole number ≥ 1, found 0.0003" in fails(
        train, "env=docking3d", "steps=3e-4"
    )


def test_a_directory_that_holds_something_is_never_overwritten(
    fails: Callable[..., str], tmp_path: Path
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("precious")
    message = fails(train, "env=docking3d", "out=run")
    assert (
        "out: run already holds something and is never overwritten; continue it with resume=run"
        in message
    )
    assert "env: run is a run; resume=run goes on with it" in fails(train, "run")
    (tmp_path / "run" / "results.json").write_text("precious")
    message = fails(train, "env=docking3d", "out=run")
    assert "it is a finished run, which jaxsafe.open_run('run') opens" in message
    assert (tmp_path / "run" / "config.yaml").read_text() == "precious"


def test_what_fails_before_anything_comes_of_it_leaves_no_directory(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("a compiler that fails")

    monkeypatch.setattr(Training, "prepare", fail)
    monkeypatch.setattr(Evaluator, "run", fail)
    monkeypatch.setattr(batched_training, "train_all", fail)
    commands = (train, ["env=docking2d"]), (evaluate, ["run=pretrained/docking2d"])
    for command, words in (*commands, (tune, ["env=docking2d", "sweep.ppo.gamma=[0.9,0.95]"])):
        with pytest.raises(RuntimeError, match="a compiler that fails"):
            command.main([*words, f"out={tmp_path / 'made'}"])
        assert not (tmp_path / "made").exists()


@pytest.mark.skipif(os.sep != "/", reason="there a backslash is a slash")
def test_a_directory_that_checkpoints_would_not_find_is_refused(
    fails: Callable[..., str], tmp_path: Path
) -> None:
    assert r"out: expected a path without \, which checkpoints take for /, found a\b" in fails(
        train, "env=docking2d", r"out=a\b"
    )
    assert list(tmp_path.iterdir()) == []


def test_an_unwritable_output_is_told_in_one_line(
    fails: Callable[..., str], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    assert "out: cannot write" in fails(train, "env=docking3d", "out=file/run")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "run: missing"),
        (["run=runs/x"], "run: no run in 'runs/x'"),
        (["run=controler/lqr", "env=docking2d"], "config.yaml). Did you mean 'controller/lqr'?"),
        (["run=pretraned/docking3d"], "config.yaml). Did you mean 'pretrained/docking3d'?"),
        (["run=runs/x", "episodes=0"], "episodes: expected a whole number ≥ 1, found 0"),
        (
            ["run=runs/x", "deterministic=maybe"],
            "deterministic: expected true or false, found 'maybe'",
        ),
        (["run=pretrained/x"], "policy: 'pretrained/x' is no .npz file and not pretrained"),
        (["run=x.npz"], "x.npz: cannot be read: No such file or directory"),
        (
            ["run=runs/x", "render=avi"],
            "render: unknown format 'avi'; choose from gif, mp4, png, jsonl",
        ),
        (["run=runs/x", "episods=5"], "episods: unknown option. Did you mean 'episodes'?"),
        (
            ["docking3d"],
            "run: docking3d is a task; name a run of it, or pretrained/docking3d for the policy",
        ),
    ],
)
def test_bad_options_of_evaluate_are_told_in_one_line(
    fails: Callable[..., str], words: list[str], message: str
) -> None:
    assert message in fails(evaluate, *(words or ["seed=1"]))


def test_bad_options_of_plot_are_told_in_one_line(fails: Callable[..., str]) -> None:
    assert "run: no run in 'x'" in fails(plot, "run=x")
    assert "x: unknown axis 'stps'. Did you mean 'steps'? Choose from steps, wall" in fails(
        plot, "run=x", "x=stps"
    )


def test_bad_options_of_config_are_told_in_one_line(fails: Callable[..., str]) -> None:
    assert "Did you mean 'docking2d'?" in fails(config, "docking2")


def test_a_stranger_s_run_imports_nothing_where_that_is_refused(
    fails: Callable[..., str], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (tmp_path / "evil_of_cli.py").write_text("open('ran', 'w')")
    content = {"env": "docking2d", "training": {}, "environment": {"imports": ["evil_of_cli"]}}
    (run / "config.yaml").write_text(yaml12.write(content))
    for module, words in (
        (train, ["resume=run"]),
        (evaluate, ["run=run"]),
        (plot, ["run=run"]),
        (export, ["run=run"]),
    ):
        assert "whose code would run; imports=false refuses that" in fails(
            module, *words, "imports=false"
        )
    assert not (tmp_path / "ran").exists()
    assert "imports: expected true or false, found 'no'" in fails(plot, "run=run", "imports=no")


def test_a_broken_run_configuration_is_told_in_one_line(
    fails: Callable[..., str], tmp_path: Path
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(
        "env: docking2d\ntraining: {sedes: 3}\nenvironment: {}\n"
    )
    assert "config.yaml: training: unknown option 'sedes'" in fails(evaluate, "run=run")
    (tmp_path / "run" / "config.yaml").write_text("env: [\n")
    assert "not valid YAML" in fails(train, "resume=run")
    (tmp_path / "run" / "config.yaml").write_text(
        "env: !!python/object/apply:os.system ['touch hacked']\n"
    )
    assert "not valid YAML" in fails(train, "resume=run")
    assert not (tmp_path / "hacked").exists()


def test_policy_files_cannot_run_code_and_broken_ones_are_told_in_one_line(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple:
            return (Path.touch, (tmp_path / "hacked",))

    np.savez(tmp_path / "evil.npz", header=np.array(Evil(), dtype=object))
    with pytest.raises(ConfigError, match=r"evil\.npz: not a policy file"):
        read_policy(tmp_path / "evil.npz")
    assert not (tmp_path / "hacked").exists()
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(ConfigError, match="not a policy file"):
        read_policy(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", weights=np.ones(3))
    with pytest.raises(ConfigError, match="not a policy file"):
        read_policy(tmp_path / "other.npz")
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        read_policy(tmp_path / "none.npz")


TEBIBYTE = io.BytesIO()
npy.write_array_header_1_0(TEBIBYTE, {"descr": "<f4", "fortran_order": False, "shape": (2**38,)})


@pytest.mark.parametrize(
    "content",
    [b"", b"no array", b"\x93NUMPY\x03\x00", TEBIBYTE.getvalue()],
    ids=["empty", "no array", "another version", "1 TiB"],
)
@pytest.mark.parametrize("which", [0, -1])
def test_a_member_of_a_policy_file_that_is_no_array_is_told(
    tmp_path: Path, content: bytes, which: int
) -> None:
    path = tmp_path / "x.npz"
    with (
        zipfile.ZipFile(policy_module.find_policy("docking2d")) as old,
        zipfile.ZipFile(path, "w") as new,
    ):
        names = sorted(old.namelist(), key="header.npy".__ne__)
        for name in names:
            new.writestr(name, content if name == names[which] else old.read(name))
    with pytest.raises(ConfigError, match=r"x\.npz: ") as caught:
        read_policy(path)
    assert "\n" not in str(caught.value)


def rewritten(
    source: Path,
    target: Path,
    change: Callable[[dict], object],
    compression: int = zipfile.ZIP_STORED,
) -> Path:
    """Write a policy file with another header."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", compression) as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "header.npy":
                header = json.loads(str(np.load(io.BytesIO(content))))
                text = change(header)
                buffer = io.BytesIO()
                np.save(buffer, np.array(text if isinstance(text, str) else json.dumps(header)))
                content = buffer.getvalue()
            new.writestr(name, content)
    return target


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda header: header.update(seed="x"),
            "header: seed: expected a whole number ≥ 0, found 'x'",
        ),
        (
            lambda header: header.update(step=None),
            "header: step: expected a whole number ≥ 0, found None",
        ),
        (lambda header: header.update(env=[1]), r"header: env: expected text, found \[1\]"),
        (
            lambda header: header["agent"]["actor"].update(hidden=[1e30]),
            r"agent\.actor\.hidden\.\[0\]: expected .*, found 1e\+30",
        ),
        (
            lambda header: header["agent"]["actor"].update(hidden=[8] * 10**4),
            "agent.actor.hidden: expected at most 64 layers",
        ),
        (
            lambda header: header["agent"]["actor"].update(hidden=[9]),
            r"expected numbers of shape \(9,\), found float32 of shape",
        ),
        (lambda header: header["agent"].update(log_std=[0.0] * 7), "agent"),
        (lambda header: "[" * 10**5, "not a policy file"),
        (lambda header: "null", "expected format 'jaxsafe policy 2'"),
    ],
)
def test_the_header_of_a_policy_file_is_checked(
    tmp_path: Path, whole: Path, change: Callable[[dict], object], message: str
) -> None:
    path = rewritten(whole / "policy" / "seed_0.npz", tmp_path / "x.npz", change)
    with pytest.raises(ConfigError, match=message) as caught:
        read_policy(path)
    assert "\n" not in str(caught.value)


@pytest.mark.thorough
def test_a_damaged_policy_file_is_told_and_what_is_not_asked_for_is_not_read(
    tmp_path: Path, whole: Path
) -> None:
    source = whole / "policy" / "seed_0.npz"
    path = tmp_path / "x.npz"
    draw = random.Random(0)
    expected = read_policy(source)
    rewritten(source, path, lambda header: None, zipfile.ZIP_DEFLATED)
    content = path.read_bytes()
    for _ in range(25):
        damaged = bytearray(content)
        damaged[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
        path.write_bytes(damaged)
        try:
            policy = read_policy(path)
        except ConfigError:
            continue
        jax.tree.map(np.testing.assert_array_equal, policy.params, expected.params)
    np.save(tmp_path / "x.npy", np.ones(3))
    path.write_bytes((tmp_path / "x.npy").read_bytes())
    with pytest.raises(ConfigError, match="not a policy file"):
        read_policy(path)
    path.write_bytes(content)
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as file,
        file.open("more.npy", "w", force_zip64=True) as more,
    ):
        for _ in range(64):
            more.write(bytes(2**20))
    tracemalloc.start()
    jax.tree.map(np.testing.assert_array_equal, read_policy(path).params, expected.params)
    assert tracemalloc.get_traced_memory()[1] < 2**25
    tracemalloc.stop()


def test_a_package_without_its_files_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy_module, "_PRETRAINED", tmp_path / "x.zip" / "pretrained")
    with pytest.raises(
        ConfigError, match=r"policy: no policies in .*x\.zip.*; install the package unpacked"
    ):
        read_policy(policy_module.find_policy("docking2d"))
    monkeypatch.setattr(
        config_module, "__file__", str(tmp_path / "x.zip" / "jaxsafe" / "train" / "config.py")
    )
    with pytest.raises(
        ConfigError, match=r"preset: no recipes in .*x\.zip.*; install the package unpacked"
    ):
        config_module.recipe("docking2d", None)


def test_a_path_may_begin_with_the_home_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    arguments = Arguments.parse(["out=~/x", "run=[~/a,b/~,./~]", "env=~/mine.yaml", "rta=~x"])
    assert arguments.options == {
        "out": "/home/me/x",
        "run": ["/home/me/a", "b/~", "./~"],
        "env": "/home/me/mine.yaml",
        "rta": "~x",
    }
    with pytest.raises(
        ConfigError,
        match=r"^resume: no home directory for '~nobody-of-that-name/x'; write \./~nobody",
    ):
        Arguments.parse(["resume=~nobody-of-that-name/x"])


def test_columns_of_a_table_never_touch() -> None:
    lines = columns([["", "a"], ["x", "123,456,789,012.00 [1, 2] %"], ["a long name", "-"]])
    assert [line.split("  ")[-1] for line in lines] == [" a", "123,456,789,012.00 [1, 2] %", "-"]
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize("module", ["train", "evaluate", "plot", "config"])
def test_help_names_the_options(
    module: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = {"train": train, "evaluate": evaluate, "plot": plot, "config": config}[module]
    monkeypatch.setattr(sys, "argv", ["jaxsafe", "--help"])
    with pytest.raises(SystemExit) as exit_info:
        cli.run(command.main, command.Options)
    assert exit_info.value.code == 0
    assert f"usage: jaxsafe {module}" in capsys.readouterr().out


def test_import_draws_in_only_what_the_core_needs() -> None:
    heavy = ("yaml", "orbax", "optax", "matplotlib", "jaxsafe.adapters.gymnasium", "flax", "tqdm")
    code = f"import sys, jaxsafe; print([name for name in {heavy} if name in sys.modules])"
    process = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    )
    assert process.stdout.strip() == "[]"


def test_a_platform_of_jax_that_is_not_there_is_told_in_one_line() -> None:
    command = [sys.executable, "-m", "jaxsafe.config", "docking2d"]
    process = subprocess.run(
        command, env={**os.environ, "JAX_PLATFORMS": "rocm"}, capture_output=True, text=True
    )
    assert (process.returncode, process.stdout) == (2, "")
    assert process.stderr == (
        "error: JAX_PLATFORMS: no device of 'rocm' can be used here; leave it out, or choose cpu\n"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="ulimit -v means something on Linux")
@pytest.mark.parametrize("kilobytes", [400_000, 1_500_000])
@pytest.mark.parametrize(
    "command",
    ["train env=docking2d", "evaluate run=pretrained/docking2d", "rta.falsify env=docking2d"],
)
def test_too_little_address_space_is_told_in_one_line(
    command: str, kilobytes: int, tmp_path: Path
) -> None:
    script = f"ulimit -v {kilobytes}; exec {sys.executable} -m jaxsafe.{command}"
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[2])}
    process = subprocess.run(
        ["bash", "-c", script], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert (process.returncode, process.stdout) == (2, "")
    assert process.stderr == (
        f"error: memory is short: ulimit -v leaves {kilobytes / 2**20:.1f} GiB of address"
        f" space, a command needs 2.0 GiB\n"
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ImportError("lib.so: failed to map segment from shared object"),
        RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 64 bytes."),
    ],
)
def test_memory_that_is_short_is_told_in_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def main(argv: Sequence[str]) -> int:
        raise error

    monkeypatch.setattr(sys, "argv", ["command", "env=docking2d"])
    with pytest.raises(SystemExit) as left:
        cli.run(main, str)
    assert left.value.code == 2
    assert capsys.readouterr().err == f"error: memory is short: {str(error) or 'MemoryError'}\n"


def test_an_error_that_has_to_do_with_something_else_is_raised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def main(argv: Sequence[str]) -> int:
        raise ImportError("No module named 'mine'")

    monkeypatch.setattr(sys, "argv", ["command", "env=docking2d"])
    monkeypatch.setenv("JAX_PLATFORMS", "rocm")
    with pytest.raises(ImportError, match="mine"):
        cli.run(main, str)


def test_paths_are_taken_as_typed() -> None:
    words = [
        "out=my run #3",
        "run=a: b",
        "resume='x'",
        "runs=true",
        "policies=007",
        "env=my # task.yaml",
    ]
    arguments = Arguments.parse(words)
    assert [arguments.pop_text(word.partition("=")[0]) for word in words] == [
        word.partition("=")[2] for word in words
    ]
    assert Arguments.parse(["run=[2024.10, 007, true]"]).pop("run") == ["2024.10", "007", "true"]
    assert Arguments.parse(["out="]).pop("out", "") is None


HUGE = "9" * 4000


@pytest.mark.parametrize(
    ("module", "words", "message"),
    [
        (
            evaluate,
            ["run=pretrained/docking2d", "seed=1e38"],
            "seed: expected a whole number from 0 to 4,294,967,295",
        ),
        (
            evaluate,
            ["run=pretrained/docking2d", "seed=4294967296"],
            "4,294,967,295, found 4294967296",
        ),
        (
            evaluate,
            ["run=pretrained/docking2d", f"episodes={HUGE}"],
            "episodes: expected a whole number from 1 to",
        ),
        (
            falsify,
            ["env=docking2d", "seed=4294967296"],
            "seed: expected a whole number from 0 to 4,294,967,295",
        ),
        (
            falsify,
            ["env=docking2d", "steps=1e300"],
            "steps: expected a whole number from 1 to 2,147,483,647, found 1e+300",
        ),
        (
            tune,
            ["env=docking2d", "sweep.ppo.gamma=uniform(0.9,1)", "samples=1e38"],
            "samples: expected a whole",
        ),
        (
            tune,
            ["env=docking2d", "sweep.ppo.gamma=[0.9]", "draw=1e38"],
            "draw: expected a whole number from 0 to",
        ),
        (
            tune,
            [
                "env=docking2d",
                *(
                    f"sweep.ppo.{name}=[{', '.join(map(str, range(1, 102)))}]"
                    for name in ("num_envs", "num_steps")
                ),
            ],
            "sweep: expected at most 10,000 settings, found 10,201; samples=N draws some",
        ),
        (
            train,
            ["env=docking2d", "steps=1e300"],
            "steps: expected a whole number ≥ 1 of a magnitude up to 1,000,000,000",
        ),
        (
            train,
            ["env=docking2d", "steps=1e15", "ppo.num_envs=1", "ppo.num_steps=2"],
            "expected less than 2³¹ updates",
        ),
        (
            train,
            ["env=docking2d", f"eval_every={HUGE}"],
            "eval_every: expected a whole number ≥ 1 of a magnitude up to",
        ),
        (
            train,
            ["env=docking2d", f"checkpoint_every={HUGE}"],
            "found a number of thousands of digits",
        ),
        (
            train,
            ["env=docking2d", "eval_episodes=1e12"],
            "eval_episodes: expected a whole number ≥ 1 of a magnitude up to",
        ),
        (
            train,
            ["env=docking2d", "seeds=1e9"],
            "seeds: expected a whole number ≥ 1 of a magnitude up to 100,000",
        ),
        (
            train,
            ["env=docking2d", "ppo.num_epochs=1e300"],
            "ppo.num_epochs: expected a whole number ≥ 1 of a magnitude",
        ),
        (
            train,
            ["env=docking2d", f"agent.actor.hidden=[{HUGE}]"],
            "agent.actor.hidden.[0]: expected a list ≥ 1 of a magnitude up to",
        ),
        (
            train,
            ["env=docking2d", f"agent.actor.hidden=[{', '.join('1' * 65)}]"],
            "expected at most 64 layers, found 65",
        ),
        (
            train,
            ["env=docking2d", "agent.log_std=.inf"],
            "agent.log_std: expected a number or a list of numbers of",
        ),
        (
            train,
            ["env=docking2d", "ppo.horizon_growth=1e-30"],
            "expected at least 1 − ppo.gamma = 0.04",
        ),
        (
            train,
            ["env=docking2d", "agent={}"],
            "agent: name one of its options, for instance agent.features=…",
        ),
        (
            train,
            ["env=docking2d", "ppo={gamma: 0.9}"],
            "ppo: name one of its options, for instance ppo.gamma=…",
        ),
        (
            train,
            ["env=docking2d", "seeds=!!bool x"],
            "seeds, line 1: not valid YAML: found 'x' after the tag !!bool",
        ),
        (
            train,
            ["env=docking2d", "env.dt=1e30"],
            "dt: expected a number in s > 0 of a magnitude from 1e-06 to 100000",
        ),
    ],
)
def test_numbers_that_no_program_can_count_to_are_told_at_once(
    fails: Callable[..., str], module: object, words: list[str], message: str
) -> None:
    assert message in fails(module, *words)
    assert list(Path.cwd().rglob("*")) == []


def test_a_warning_is_one_line_and_the_command_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["jaxsafe", "docking2d", "env.reward.success.time_scale=50"])
    monkeypatch.setattr(warnings, "filters", [("default", None, Warning, None, 0)])
    with pytest.raises(SystemExit) as exit_info:
        cli.run(config.main, config.Options)
    captured = capsys.readouterr()
    assert exit_info.value.code == 0
    assert captured.err.startswith(
        "warning: reward.success.time_scale is set apart: it followed terminal.timeout.limit, and"
    )
    assert captured.err.count("\n") == 1
    assert "time_scale: 50.0" in captured.out


@pytest.mark.parametrize("words", [["jaxsafe"], ["jaxsafe", "help"], ["jaxsafe", "--help"]])
def test_alone_the_program_lists_its_commands(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", words)
    commands.main()
    told = capsys.readouterr().out
    assert [
        name for name in commands.COMMANDS | commands.SUBCOMMANDS if f"  {name} " not in told
    ] == []


@pytest.mark.parametrize("words", [["--version"], ["train", "--version"]])
def test_the_version_is_told(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["jaxsafe", *words])
    commands.main()
    assert re.fullmatch(r"jaxsafe \d+\.\d+\.\d+\n", capsys.readouterr().out)


def test_a_command_is_called_by_its_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["jaxsafe", "plot", "rnu=x"])
    with pytest.raises(SystemExit) as left:
        commands.main()
    assert left.value.code == 2
    assert "Did you mean 'run'?" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["jaxsafe", "trian"])
    with pytest.raises(SystemExit) as left:
        commands.main()
    assert left.value.code == 2
    assert capsys.readouterr().err == "error: unknown command 'trian'. Did you mean 'train'?\n"
    for name in commands.COMMANDS:
        assert callable(importlib.import_module(f"jaxsafe.commands.{name}").command)


@pytest.mark.thorough
def test_renamed_values_still_work_and_their_new_names_are_told() -> None:
    for option, names in RENAMED.items():
        for old, new in names.items():
            with pytest.warns(ConfigWarning, match=f"^{option}: {old} is now called {new}$"):
                config, _, _ = resolve({"env": "docking2d", "rta": "default", option: old})
            assert getattr(config, option) == new
