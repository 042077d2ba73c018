import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from jaxsafe.commands.train import main
from jaxsafe.commands.tune import main as tune
from jaxsafe.devices import memory, processes
from jaxsafe.schema.errors import ConfigError


def test_a_training_that_would_not_fit_is_refused_before_it_starts(tmp_path: Path) -> None:
    words = [
        "env=docking2d",
        "seeds=2",
        f"out={tmp_path / 'run'}",
        "ppo.num_steps=1",
        "ppo.num_envs=1000000000",
    ]
    with pytest.raises(
        ConfigError,
        match=r"ppo.num_envs, .*: this training needs [\d,.]+ GiB of memory, [\d,.]+ GiB are free",
    ):
        main(words)
    with pytest.raises(
        ConfigError,
        match=r"ppo.num_envs × ppo.num_steps: expected less than 2³¹, found 8,000,000,000",
    ):
        main([*words[:-2], "ppo.num_envs=1000000000", "ppo.num_steps=8"])


@pytest.mark.thorough
@pytest.mark.parametrize("command", [main, tune])
def test_the_batch_of_an_update_is_counted(
    command: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "COMPILE_BYTES", 0)
    monkeypatch.setattr(memory, "RUN_BYTES", 0)
    # This is enough for the state, but not for the update.
    monkeypatch.setattr(memory, "available", lambda: 4 * 2**20)
    sizes = [
        "ppo.num_envs=1024",
        "ppo.num_steps=32",
        "ppo.num_minibatches=8",
        "steps=65536",
        "agent.actor.hidden=[8]",
    ]
    words = ["env=docking2d", "seeds=1", f"out={tmp_path / 'run'}", *sizes]
    if command is tune:
        words.append("sweep.ppo.gamma=[0.9,0.95]")
    with pytest.raises(
        ConfigError,
        match=r"ppo.num_envs, .*: this training needs [\d.]+ GiB of memory, 0.0 GiB are free",
    ):
        command(words)


@pytest.mark.parametrize("command", [main, tune])
def test_what_compiling_takes_is_counted(
    command: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # This is a hundred times the size of the state and the update.
    monkeypatch.setattr(memory, "available", lambda: memory.GIB)
    words = ["env=docking2d", "seeds=1", f"out={tmp_path / 'run'}", "steps=4096"]
    if command is tune:
        words.append("sweep.ppo.gamma=[0.9,0.95]")
    with pytest.raises(
        ConfigError, match=r"this training needs 1.2 GiB of memory, 1.0 GiB are free"
    ):
        command(words)


def test_what_a_process_takes_once_is_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 10 * memory.GIB)
    memory.require(4 * memory.GIB, 2, 2 * memory.GIB)
    with pytest.raises(ConfigError, match=r"seeds: this training needs 11.0 GiB of memory"):
        memory.require(4 * memory.GIB, 2, 3 * memory.GIB)


TRAINING = """
import sys
from pathlib import Path

from jaxsafe.devices.seed_mapper import claim_cores

claim_cores()
from jaxsafe.devices import memory
from jaxsafe.commands.train import main

def resident(which):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(which))

def require(needed, devices, once=0):
    found.append((resident("VmRSS"), needed * devices + once))

found = []
memory.require = require
assert main(sys.argv[1:]) == 0
peak = resident("VmHWM")
(begun, compiling), (compiled, running) = found
print(compiled - begun, compiling, peak - compiled, running)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is measured on Linux")
@pytest.mark.parametrize("task", ["docking2d", "rejoin3d"])
def test_a_training_takes_no_more_than_was_predicted(task: str, tmp_path: Path) -> None:
    words = [f"env={task}", "seeds=2", "steps=16384", "ppo.num_epochs=1", f"out={tmp_path / 'run'}"]
    # The empty cache makes the training compile everything.
    environment = {
        **os.environ,
        "XDG_CACHE_HOME": str(tmp_path),
        "XLA_FLAGS": "",
    }
    words += ["eval_episodes=1", "episodes=1"]
    done = subprocess.run(
        [sys.executable, "-c", TRAINING, *words],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    taken, predicted, later, predicted_later = map(int, done.stdout.split()[-4:])
    assert 0.5 * predicted < taken <= predicted
    assert later <= predicted_later <= later + memory.RUN_BYTES


def test_processes_of_one_machine_share_its_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 10 * memory.GIB)
    monkeypatch.setattr(processes, "count_on_this_machine", lambda: 4)
    with pytest.raises(
        ConfigError, match=r"seeds: this training needs 16.0 GiB of memory, 10.0 GiB are free"
    ):
        memory.require(2 * memory.GIB, 2)


@pytest.mark.parametrize(
    ("version", "path"), [(2, "/job/step"), (1, "/job/step"), (2, "/elsewhere")]
)
def test_limits_of_control_groups_are_known(
    version: int, path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    controllers = {2: "", 1: "memory"}[version]
    files = memory.CONTROL_GROUPS[controllers]
    for group, most, now in (("", "max", 900), ("job", "1000", 700), ("job/step", "2000", 600)):
        place = tmp_path / group
        place.mkdir(exist_ok=True)
        (place / files.limit).write_text(f"{most}\n")
        (place / files.used).write_text(f"{now}\n")
        (place / "memory.stat").write_text(f"{files.cache} 50\nother 7\n")
    monkeypatch.setitem(memory.CONTROL_GROUPS, controllers, files._replace(root=str(tmp_path)))
    lines = memory._lines
    own = ["3:cpu:/x", f"{2 - version}:{controllers}:{path}"]
    monkeypatch.setattr(
        memory, "_lines", lambda name: own if name == "/proc/self/cgroup" else lines(name)
    )
    assert memory._container() == (1000 - 700 + 50 if path == "/job/step" else None)


def test_the_limit_of_the_process_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (memory.GIB, resource.RLIM_INFINITY))
    lines = memory._lines
    monkeypatch.setattr(
        memory, "_lines", lambda name: ["100 50 7"] if name == "/proc/self/statm" else lines(name)
    )
    left = memory.GIB - 100 * resource.getpagesize()
    assert memory._process() == left
    available = memory.available()
    assert available is not None
    assert available <= left
    monkeypatch.setattr(resource, "getrlimit", lambda _: 2 * (resource.RLIM_INFINITY,))
    assert memory._process() is None


def test_devices_of_one_machine_share_its_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 10 * memory.GIB)
    memory.require(5 * memory.GIB, 2)
    with pytest.raises(
        ConfigError, match=r"seeds: this training needs 12.0 GiB of memory, 10.0 GiB are free"
    ):
        memory.require(4 * memory.GIB, 3)


def test_every_process_refuses_what_does_not_fit_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 10 * memory.GIB)
    monkeypatch.setattr(processes, "any_process", lambda _: True)
    with pytest.raises(
        ConfigError, match=r"seeds: this training needs 2.0 GiB of memory, another process has less"
    ):
        memory.require(memory.GIB, 2)


def test_what_is_counted() -> None:
    tree = {
        "numbers": jnp.zeros((3, 4)),
        "flags": jnp.zeros(5, bool),
        "keys": jax.random.split(jax.random.key(0), 2),
    }
    assert memory.size(tree) == 3 * 4 * 4 + 5 + 2 * 8
    x = jnp.zeros((1000, 1000))
    compiled = jax.jit(lambda x: (x @ x.T) @ x).lower(x).compile()
    assert 3 * x.nbytes <= memory.footprint(compiled) <= 4 * x.nbytes
    free = memory.available()
    assert free is None or free > 0
