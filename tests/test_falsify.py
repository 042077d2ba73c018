"""The file that the falsifier writes says what it was made by."""

import json
from pathlib import Path

from jaxsafe.rta.falsify import main


def test_the_numbers_name_the_command_and_the_versions_that_made_them(tmp_path: Path) -> None:
    argv = ["env=docking2d", "steps=40", "lanes=4", "policies=[uniform]", f"out={tmp_path / 'found.json'}"]
    assert main(argv) == 0
    found = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert found["command"] == " ".join(["python -m jaxsafe.rta.falsify", *argv])
    assert {"jaxsafe", "jax", "device", "processor"} <= set(found["versions"])
    assert [(row["policy"], row["steps"], row["violating_steps"]) for row in found["policies"]] == [("uniform", 40, 0)]
