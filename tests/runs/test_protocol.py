"""What the protocol asks of results."""

import copy
import json
from pathlib import Path

import pytest

from jaxsafe.commands.check import main
from jaxsafe.evaluate.hidden_seed import read_hidden_seed, read_or_draw_hidden_seed
from jaxsafe.runs.protocol import findings, read_all
from jaxsafe.schema.errors import ConfigError


@pytest.fixture(scope="module")
def complete(whole: Path) -> tuple[dict, list[dict]]:
    """Return results that have everything, and those of two further evaluations."""
    results = json.loads((whole / "results.json").read_text())
    results |= {
        "seeds": 10,
        "episodes": 1000,
        "task": {"id": "jaxsafe/Docking2D-v0", "changes": []},
    }
    filtered = {**results, "rta": "discrete_asif"}
    return results, [filtered, {**results, "cases": "docking2d"}]


def missing(results: dict, others: list[dict]) -> list[str]:
    return [finding.what for finding in findings(results, others) if not finding.reported]


def test_a_complete_result_lacks_nothing(complete: tuple[dict, list[dict]]) -> None:
    assert missing(*complete) == []


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"task": {"id": "jaxsafe/Docking2D-v0", "changes": ["dt"]}}, "the task as it is"),
        ({"seeds": 9}, "10 seeds or more, none diverged"),
        ({"diverged": [{"seed": 1, "step": None}]}, "10 seeds or more, none diverged"),
        ({"episodes": 100}, "1,000 episodes per seed or more"),
        ({"versions": {}}, "versions and the machine"),
        ({"training_cost": {}}, "steps and violating steps of the training"),
    ],
)
def test_what_is_missing_is_named(
    change: dict, what: str, complete: tuple[dict, list[dict]]
) -> None:
    results, others = complete
    others = [{**other, "task": change.get("task", other["task"])} for other in others]
    assert missing({**results, **change}, others) == [what]
    found = {finding.what: finding.detail for finding in findings({**results, **change}, others)}
    for option in ("seeds", "episodes"):
        if option in change:
            assert found[what].endswith(f"; train with {option}={results[option]}")


def test_evaluations_are_missing_where_there_are_none(complete: tuple[dict, list[dict]]) -> None:
    results, others = complete
    assert missing(results, []) == ["with and without a filter", "the fixed starts of the task"]
    found = {finding.what: finding.detail for finding in findings(results, [], "runs/x")}
    assert found["with and without a filter"].endswith("; jaxsafe evaluate runs/x rta=default")
    assert found["the fixed starts of the task"] == "jaxsafe evaluate runs/x cases=docking2d"
    elsewhere = [{**other, "task": {"id": None, "changes": []}} for other in others]
    assert missing(results, elsewhere) == missing(results, [])
    tailless = copy.deepcopy(results)
    del tailless["evaluation"]["stochastic"]["episode_violation_severity_p99"]
    assert missing(tailless, others) == ["the tail of the severity of violations"]
    del tailless["evaluation"]["stochastic"]
    assert missing(tailless, others) == ["deterministic and sampled actions"]


def test_the_command_reads_a_run_and_its_evaluations(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(whole)]) == 1
    told = capsys.readouterr().out
    assert "MISSING   10 seeds or more, none diverged" in told
    assert "reported  deterministic and sampled actions" in told
    assert len(read_all(str(whole))) == 1 + len([*whole.glob("evaluations/*/results.json")])
    assert main([f"run={whole / 'results.json'}"]) == 1
    with pytest.raises(ConfigError, match=r"run: .*nothing: cannot be read"):
        main([str(tmp_path / "nothing")])


def test_a_commitment_fits_its_seed_alone(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = tmp_path / "secret.json"
    hidden = read_or_draw_hidden_seed(secret)
    assert read_hidden_seed(secret) == hidden != read_or_draw_hidden_seed(tmp_path / "other.json")
    results = tmp_path / "results.json"
    content = json.loads((whole / "results.json").read_text())
    told = {}
    for name, commitment in (
        ("right", {"seed_commitment": hidden.commitment}),
        ("wrong", {"seed_commitment": hidden._replace(seed=hidden.seed ^ 1).commitment}),
        ("none", {}),
    ):
        results.write_text(json.dumps(content | commitment))
        main([f"run={results}", f"hidden_seed={secret}"])
        told[name] = capsys.readouterr().out
    assert f"{hidden.seed}, as committed in 1 of 1 results" in told["right"]
    assert "MISSING   the hidden seed" not in told["right"]
    assert f"the file has the commitment {hidden.commitment}, a result has" in told["wrong"]
    assert "MISSING   the hidden seed" in told["wrong"]
    assert "no result has a commitment; evaluate with hidden_seed=FILE" in told["none"]
