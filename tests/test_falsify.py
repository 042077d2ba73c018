"""The file that the falsifier writes says what it was made by."""

import json
from pathlib import Path

from jaxsafe.rta.falsify import main, report


def test_the_numbers_name_the_command_and_the_versions_that_made_them(tmp_path: Path) -> None:
    argv = ["env=docking2d", "steps=40", "lanes=4", "policies=[uniform]", f"out={tmp_path / 'found.json'}"]
    assert main(argv) == 0
    found = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert found["command"] == " ".join(["python -m jaxsafe.rta.falsify", *argv])
    assert {"jaxsafe", "jax", "device", "processor"} <= set(found["versions"])
    assert [(row["policy"], row["steps"], row["violating_steps"]) for row in found["policies"]] == [("uniform", 40, 0)]


def test_a_violation_is_the_exit_code_and_bounds_nothing(tmp_path: Path) -> None:
    out = tmp_path / "found.json"
    assert main(["env=docking2d", "rta=none", "steps=2000", "lanes=10", "policies=[inward]", f"out={out}"]) == 1
    [row] = json.loads(out.read_text(encoding="utf-8"))["policies"]
    assert row["violating_steps"] > 0
    assert row["violation_bound"] is None
    assert "without a violation" not in report([row])
    assert "without a violation" not in report([{**row, "violating_steps": 0}])  # inside steps they count as well


def test_what_an_episode_draws_is_the_plant_that_is_counted_on() -> None:
    """The nominal limit is exceeded all the time; the one that every episode draws never is."""
    loose = "env.randomize={status.velocity_limit.floor: [50, 60]}"
    argv = [
        "env=docking2d",
        "rta=none",
        "steps=200",
        "lanes=10",
        "policies=[inward]",
        "env.deputy.start.velocity.share=[0,0.1]",
    ]
    assert main([*argv, loose]) == 0
    assert main(argv) == 1
