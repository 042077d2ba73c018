"""The commands in double precision. Each runs in a process of its own, as users start it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from tiny_run import TINY

RUNS = [word for word in TINY if not word.startswith(("seeds", "env="))]


def command(module: str, *words: str, code: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", f"jaxsafe.{module}", *words],
        env={**os.environ, "JAX_ENABLE_X64": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
def test_every_command_works_in_double_precision(tmp_path: Path) -> None:
    run = tmp_path / "run"
    command("train", "env=docking2d", "seeds=2", *RUNS, f"out={run}")
    results = json.loads((run / "results.json").read_text())
    assert results["evaluation"]["stochastic"]["average_return"]["mean"] is not None
    policy = np.load(run / "policy" / "seed_0.npz")
    kernels = [policy[name] for name in policy.files if name.endswith("kernel")]
    assert {kernel.dtype for kernel in kernels} == {np.dtype(np.float64)}

    (run / "results.json").unlink()
    command("train", f"resume={run}")
    again = json.loads((run / "results.json").read_text())
    assert again["evaluation"] == results["evaluation"]

    command("evaluate", f"run={run}", "episodes=4", "seed=1", f"out={tmp_path / 'evaluation'}")
    command("plot", f"run={run}", "x=wall")
    command(
        "tune",
        "env=docking2d",
        "seeds=2",
        *RUNS,
        "sweep.ppo.gamma=[0.9,0.99]",
        f"out={tmp_path / 'sweep'}",
    )
    assert len((tmp_path / "sweep" / "settings.jsonl").read_text().splitlines()) == 2
    command(
        "rta.falsify", "env=docking2d", "rta=default", "policies=uniform", "steps=32", "num_envs=8"
    )

    for words in (
        ["out=a.onnx"],
        ["format=stablehlo", "out=b.stablehlo"],
        ["format=vnnlib", "steps=2", "out=c.vnnlib"],
    ):
        command(
            "export", f"run={run}", *words[:-1], f"out={tmp_path / words[-1].removeprefix('out=')}"
        )
    session = onnxruntime.InferenceSession(str(tmp_path / "a.onnx"))
    assert session.run(None, {"input": np.zeros((1, 6), np.float32)})[0].dtype == np.float32
