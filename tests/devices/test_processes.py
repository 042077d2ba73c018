"""Processes that train together. They find each other by what Slurm tells them."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tiny_run import TINY, assert_same_end

from jaxsafe.commands.train import main

LONG = [word for word in TINY if not word.startswith(("steps=", "checkpoint_every="))]
LONG += ["steps=4000000", "checkpoint_every=12800"]


def start(place: Path, *words: str, devices: tuple[int, ...] = (1, 1)) -> list[subprocess.Popen]:
    job = str(random.SystemRandom().randrange(1, 4000))  # the job decides the port
    processes = []
    for rank, count in enumerate(devices):
        slurm = {
            "JOB_ID": job,
            "STEP_NODELIST": "localhost",
            "NTASKS": len(devices),
            "PROCID": rank,
            "LOCALID": rank,
        }
        env = {**os.environ, **{f"SLURM_{name}": str(value) for name, value in slurm.items()}}
        env["XLA_FLAGS"] = env["XLA_FLAGS"].replace("device_count=2", f"device_count={count}")
        command = [sys.executable, "-m", "jaxsafe.train", "distributed=true", *words]
        with open(place / f"log{rank}", "w") as log:
            processes.append(subprocess.Popen(command, env=env, stdout=log, stderr=log))
    return processes


@pytest.mark.thorough
def test_two_processes_train_what_one_trains(whole: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    processes = start(tmp_path, *TINY, f"out={run}")
    assert [process.wait(300) for process in processes] == [0, 0], (tmp_path / "log0").read_text()
    assert_same_end(run, whole)
    assert "results in" in (tmp_path / "log0").read_text()
    assert "steps" not in (tmp_path / "log1").read_text()  # only process 0 reports
    again = start(tmp_path, *TINY, f"out={run}")
    assert [process.wait(300) for process in again] == [2, 2]
    for rank in range(2):
        assert (
            "already holds something and is never overwritten"
            in (tmp_path / f"log{rank}").read_text()
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seeds", "devices"),
    [(1, (1, 1)), (2, (2, 2))],
    # One seed is shared between the two processes. Two seeds are shared within each process, which
    # is faster.
)
def test_two_processes_whose_devices_share_seeds(
    seeds: int, devices: tuple[int, ...], tmp_path: Path
) -> None:
    # These options make five updates.
    shared = [
        f"seeds={seeds}",
        "steps=320",
        "ppo.num_minibatches=1",
        "devices_per_seed=2",
    ]
    words = [word for word in TINY if not word.startswith(("seeds=", "steps="))] + shared
    processes = start(tmp_path, *words, f"out={tmp_path / 'two'}", devices=devices)
    assert [process.wait(300) for process in processes] == [0, 0], (tmp_path / "log0").read_text()
    assert main([*words, f"out={tmp_path / 'one'}"]) == 0
    for seed in range(seeds):
        gathered, expected = (
            np.load(tmp_path / name / "policy" / f"seed_{seed}.npz") for name in ("two", "one")
        )
        assert list(gathered) == list(expected)
        for name in gathered:
            if gathered[name].dtype.kind == "f":
                np.testing.assert_allclose(gathered[name], expected[name], atol=1e-4)


@pytest.mark.thorough
def test_a_lost_process_ends_the_run(tmp_path: Path) -> None:
    lose_one(tmp_path, tmp_path / "run")


@pytest.mark.slow
def test_another_number_goes_on_after_a_process_is_lost(tmp_path: Path) -> None:
    run = tmp_path / "run"
    lose_one(tmp_path, run)
    alone = subprocess.Popen(
        [sys.executable, "-m", "jaxsafe.train", f"resume={run}"], stdout=subprocess.PIPE, text=True
    )
    grows(run, alone)
    alone.send_signal(signal.SIGINT)
    assert "stopped at step" in alone.communicate(timeout=60)[0]
    three = start(tmp_path, f"resume={run}", devices=(1, 1, 1))
    grows(run, three[0])
    three[2].send_signal(signal.SIGTERM)  # one process is asked to stop, and all do
    assert [process.wait(60) for process in three] == [130] * 3


def lose_one(place: Path, run: Path) -> None:
    """Train with two processes until the second is killed.

    The first ends with one line that tells how to go on.
    """
    processes = start(place, *LONG, f"out={run}")
    grows(run, processes[0])
    processes[1].kill()
    processes[1].wait()
    assert processes[0].wait(60) == 2
    told = (place / "log0").read_text().splitlines()[-1]
    assert told.startswith("error: distributed: another process of this run has ended")
    assert f"resume={run}" in told


def grows(run: Path, process: subprocess.Popen) -> None:
    """Wait until the run has one more checkpoint."""
    before = len(list(run.glob("checkpoints/*/state")))
    while len(list(run.glob("checkpoints/*/state"))) == before:
        assert process.poll() is None
        time.sleep(0.2)
