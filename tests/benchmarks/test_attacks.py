"""An attack of the benchmarks is a command, and its results say what they depend on."""

import importlib
import json
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def attacks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """`attacks.py`, which finds a repository in the directory of the test."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    module = importlib.import_module("attacks")
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "OUT", tmp_path / "results")
    module.OUT.mkdir()
    return module


def test_the_results_of_an_attack_say_what_they_depend_on(
    attacks: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ("env=docking2d", "policies=inward", "steps=64", "num_envs=8")
    monkeypatch.setitem(attacks.ATTACKS, "short", options)
    attacks.attack("short")
    results = json.loads((attacks.OUT / "short.json").read_text())
    assert results["command"] == f"jaxsafe falsify {' '.join(options)} out=results/short.json"
    assert results["policies"][0]["violating_steps"] == 0
    fingerprint = importlib.import_module("fingerprint").fingerprint
    assert results["sources"] == fingerprint(BENCHMARKS / "attacks.py")


def test_a_violation_ends_the_command(attacks: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ("env=docking2d", "rta=none", "policies=accelerate", "steps=6400", "num_envs=8")
    monkeypatch.setitem(attacks.ATTACKS, "broken", options)
    with pytest.raises(SystemExit, match=r"^1$"):
        attacks.attack("broken")
    assert "sources" not in json.loads((attacks.OUT / "broken.json").read_text())
