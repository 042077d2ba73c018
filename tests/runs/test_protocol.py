"""What the protocol asks of results."""

import copy
import json
from pathlib import Path

import pytest
from submission_files import as_evaluation, complete_results, write, write_policies

from jaxsafe.commands.check import main
from jaxsafe.commands.evaluate import main as evaluate
from jaxsafe.evaluate.hidden_seed import read_hidden_seed, read_or_draw_hidden_seed
from jaxsafe.runs.protocol import TRAINING, Submission, findings, read_submission
from jaxsafe.schema.errors import ConfigError

FILTER = "with and without a filter"
STARTS = "the fixed starts of the task"
COST = "steps and violating steps of the training"
ENOUGH = "10 seeds or more, none diverged"


@pytest.fixture(scope="module")
def complete(whole: Path) -> tuple[dict, list[dict]]:
    """Return results that have everything, and those of two further evaluations."""
    return complete_results(whole)


@pytest.fixture
def of_policies(whole: Path, tmp_path: Path) -> Path:
    """Return a directory with three evaluations of each of ten policies from elsewhere."""
    write_policies(whole, tmp_path / "ten")
    return tmp_path / "ten"


def missing(results: dict, others: list[dict]) -> list[str]:
    return lacking(Submission(results, others))


def lacking(submission: Submission) -> list[str]:
    return [finding.what for finding in findings(submission) if not finding.reported]


def details(submission: Submission) -> dict[str, str]:
    return {finding.what: finding.detail for finding in findings(submission)}


def test_a_complete_result_lacks_nothing(complete: tuple[dict, list[dict]]) -> None:
    assert missing(*complete) == []


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"task": {"id": "jaxsafe/Docking2D-v0", "changes": ["dt"]}}, "the task as it is"),
        ({"seeds": 9}, ENOUGH),
        ({"diverged": [{"seed": 1, "step": None}]}, ENOUGH),
        ({"episodes": 100}, "1,000 episodes per seed or more"),
        ({"versions": {}}, "versions and the machine"),
        ({"training_cost": {}}, COST),
    ],
)
def test_what_is_missing_is_named(
    change: dict, what: str, complete: tuple[dict, list[dict]]
) -> None:
    results, others = complete
    others = [{**other, "task": change.get("task", other["task"])} for other in others]
    changed = {**results, **change}
    # Another number of seeds is missing in the further evaluations too.
    also = [FILTER, STARTS] if "seeds" in change else []
    assert missing(changed, others) == [what, *also]
    found = details(Submission(changed, others))
    for option in ("seeds", "episodes"):
        if option in change:
            assert found[what].endswith(f"; train with {option}={results[option]}")


@pytest.mark.parametrize(
    ("change", "lacks"),
    [
        ({"seeds": 1}, None),
        ({"checkpoint": "best"}, None),
        ({"task": {"id": "jaxsafe/Docking2D-v0", "changes": ["dt"]}}, None),
        ({"diverged": [{"seed": 1, "step": None}]}, ENOUGH),
        ({"episodes": 1}, "1,000 episodes per seed or more"),
        ({"evaluation": ["deterministic"]}, "deterministic and sampled actions"),
    ],
)
def test_an_evaluation_needs_all_that_the_results_need(
    change: dict, lacks: str | None, complete: tuple[dict, list[dict]]
) -> None:
    results, (filtered, cases) = complete
    if "evaluation" in change:
        kinds = change["evaluation"]
        change = {"evaluation": {kind: filtered["evaluation"][kind] for kind in kinds}}
    for what, others in (
        (FILTER, [filtered | change, cases]),
        (STARTS, [filtered, cases | change]),
    ):
        assert missing(results, others) == [what]
        detail = details(Submission(results, others))[what]
        assert (f"lacks {lacks}; jaxsafe evaluate RUN" in detail) == (lacks is not None)
        # A complete evaluation beside the other one is enough.
        assert missing(results, [*others, filtered, cases]) == []


def test_two_filters_do_not_stand_for_none(complete: tuple[dict, list[dict]]) -> None:
    results, (filtered, cases) = complete
    guarded = results | {"rta": "simplex"}
    assert missing(guarded, [filtered, cases | {"rta": "simplex"}]) == [FILTER]
    detail = details(Submission(guarded, [filtered]))[FILTER]
    assert detail == "only rta=simplex; jaxsafe evaluate RUN rta=none"
    # Fixed starts with another filter, or none, are not those of the results.
    assert missing(guarded, [as_evaluation(results), cases]) == [STARTS]
    assert missing(results, [filtered | {"cases": "docking2d"}, cases]) == [FILTER]


def test_the_reward_of_a_training_with_a_filter_makes_no_other_task(
    complete: tuple[dict, list[dict]],
) -> None:
    results, others = complete
    task = {"id": "jaxsafe/Docking2D-v0", "changes": ["reward.intervention"]}
    guarded = results | {"task": task}
    assert missing(guarded, others) == []
    assert details(Submission(guarded, others))["the task as it is"] == (
        "jaxsafe/Docking2D-v0; returns include reward.intervention"
    )


def test_evaluations_are_missing_where_there_are_none(complete: tuple[dict, list[dict]]) -> None:
    results, others = complete
    assert missing(results, []) == [FILTER, STARTS]
    found = details(Submission(results, run="runs/x"))
    assert found[FILTER].endswith("; jaxsafe evaluate runs/x rta=default")
    assert found[STARTS] == "jaxsafe evaluate runs/x cases=docking2d"
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
    assert f"MISSING   {ENOUGH}" in told
    assert "reported  deterministic and sampled actions" in told
    evaluations = [*whole.glob("evaluations/*/results.json")]
    assert len(read_submission(str(whole)).others) == len(evaluations)
    assert main([f"run={whole / 'results.json'}"]) == 1
    with pytest.raises(ConfigError, match=r"run: .*nothing: cannot be read"):
        main([str(tmp_path / "nothing")])
    run = tmp_path / "unfinished"
    run.mkdir()
    (run / "config.yaml").write_text("")
    write(as_evaluation(json.loads((whole / "results.json").read_text())), run, "evaluations", "a")
    with pytest.raises(ConfigError, match=r"run: .*unfinished/results.json: cannot be read"):
        main([str(run)])


def test_a_directory_with_the_results_of_a_run_is_a_submission(
    complete: tuple[dict, list[dict]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, (filtered, cases) = complete
    submission = write(results, tmp_path, "me-docking2d")
    write(filtered, submission, "evaluations", "filtered")
    assert main([str(submission)]) == 1
    assert "1 of 10 are missing" in capsys.readouterr().out
    write(cases, submission, "evaluations", "cases")
    assert main([str(submission)]) == 0
    assert capsys.readouterr().out.endswith("all is there\n")
    assert read_submission(str(submission)).file == submission / "results.json"
    # One evaluation is a directory too. It names the run whose training is missing.
    evaluation = submission / "evaluations" / "filtered"
    assert main([str(evaluation)]) == main([str(evaluation / "results.json")]) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[: len(told) // 2] == told[len(told) // 2 :]
    assert any("jaxsafe evaluate runs/x rta=none" in line for line in told)
    assert any(line.endswith("unknown; give the run directory") for line in told)
    write(results, tmp_path, "other-docking2d")
    with pytest.raises(ConfigError, match="expected the results of one training, found 2, for"):
        main([str(tmp_path)])


def test_ten_policies_from_elsewhere_are_a_submission(
    of_policies: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    submission = read_submission(str(of_policies))
    assert submission.results["seeds"] == 10
    assert submission.results["runs"] == [f"policy_{number}.onnx" for number in range(10)]
    success = submission.results["evaluation"]["deterministic"]["success_rate"]
    assert len(success["per_seed"]) == 10
    assert success["ci95"] is not None
    assert lacking(submission) == [COST]
    assert details(submission)[COST].startswith("unknown; write them into training.json")
    training = of_policies / TRAINING
    training.write_text('{"algorithm": "SAC", "steps": 1000, "violating_steps": [1, 2]}')
    with pytest.raises(
        ConfigError, match=r"training.json: violating_steps: expected a list of length 10"
    ):
        main([str(of_policies)])
    violating = [*range(10)]
    content = {"algorithm": "SAC", "steps": 1000, "violating_steps": violating}
    training.write_text(json.dumps(content))
    assert read_submission(str(of_policies)).training_cost == 4.5
    assert main([str(of_policies)]) == 0
    told = capsys.readouterr().out
    assert "deterministic alone, a policy from elsewhere" in told
    assert "1,000 and 4 per seed" in told
    # The nine others cannot stand for the one that was not flown with a filter.
    (of_policies / "3-filter" / "results.json").unlink()
    assert lacking(read_submission(str(of_policies))) == [FILTER]


@pytest.mark.thorough
def test_the_directory_of_an_evaluation_is_read(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "evaluation"
    assert evaluate([f"run={whole}", "episodes=2", "deterministic=true", f"out={out}"]) == 0
    submission = read_submission(str(out))
    assert submission.run == str(whole)
    assert submission.results["episodes"] == 2
    assert main([str(out)]) == 1
    assert "MISSING   deterministic and sampled actions" in capsys.readouterr().out


def test_a_policy_that_is_evaluated_twice_counts_once(of_policies: Path) -> None:
    file = of_policies / "4" / "results.json"
    file.write_text((of_policies / "3" / "results.json").read_text())
    submission = read_submission(str(of_policies))
    assert submission.results["seeds"] == 10 - 1
    assert details(submission)[ENOUGH].endswith(
        "9 of 9 seeds; evaluate 10 policies, one for each seed of the training"
    )


def test_a_policy_that_diverged_is_in_no_average(of_policies: Path) -> None:
    file = of_policies / "4" / "results.json"
    results = json.loads(file.read_text())
    for metric in results["evaluation"]["deterministic"].values():
        metric |= {"mean": None, "per_seed": [None]}
    file.write_text(json.dumps(results | {"diverged": [{"seed": 0, "step": None}]}))
    submission = read_submission(str(of_policies))
    assert ENOUGH in lacking(submission)
    assert details(submission)[ENOUGH].startswith("9 of 10 seeds")
    success = submission.results["evaluation"]["deterministic"]["success_rate"]
    assert success["mean"] is not None
    assert success["per_seed"][4] is None


def test_what_nobody_trained_has_no_seeds(
    of_policies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("1", "1-filter", "1-cases"):
        results = json.loads((of_policies / name / "results.json").read_text())
        controller = results | {"algorithm": "not trained", "run": "controller/lqr"}
        write(controller, tmp_path, "lqr", name)
        write(results, tmp_path, "function", name)
    assert main([str(tmp_path / "lqr")]) == 0
    assert f"reported  {ENOUGH}            none, it was not trained" in capsys.readouterr().out
    assert main([f"run={tmp_path / 'lqr' / '1'}"]) == 1
    assert "jaxsafe evaluate controller/lqr env=docking2d rta=default" in capsys.readouterr().out
    # A function or a file may be trained, so its submitter says that it is not.
    assert ENOUGH in lacking(read_submission(str(tmp_path / "function")))
    (tmp_path / "function" / TRAINING).write_text('{"algorithm": "a law", "steps": 0}')
    assert lacking(read_submission(str(tmp_path / "function"))) == []


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"task": "docking2d"}, "task: expected a mapping, found 'docking2d'"),
        ({"task": {"id": 5, "changes": []}}, "task.id: expected text or null, found 5"),
        ({"task": {"id": None}}, "task.changes: expected a list, found nothing"),
        ({"task": {"id": None, "changes": [1]}}, r"task.changes.\[0\]: expected text, found 1"),
        ({"episodes": "1000"}, "episodes: expected a whole number ≥ 0, found '1000'"),
        ({"seeds": "10"}, "seeds: expected a whole number ≥ 0, found '10'"),
        ({"env": None}, "env: expected text, found None"),
        ({"preset": []}, r"preset: expected text, found \[\]"),
        ({"rta": None}, "rta: expected text, found None"),
        ({"cases": 3}, "cases: expected text, found 3"),
        ({"steps": 1.5}, "steps: expected a whole number ≥ 0, found 1.5"),
        ({"diverged": 1}, "diverged: expected a list, found 1"),
        ({"versions": "1"}, "versions: expected a mapping, found '1'"),
        ({"training_cost": 3}, "training_cost: expected a mapping, found 3"),
        ({"evaluation": {"stochastic": 1}}, "evaluation.stochastic: expected a mapping, found 1"),
        ({"seed_commitment": 1}, "seed_commitment: expected text, found 1"),
        ({"algorithm": 1}, "algorithm: expected text, found 1"),
        ({"evaluation_seed": 0}, "run: expected text, found nothing"),
        ({"evaluation_seed": 0, "run": "x", "checkpoint": 1}, "checkpoint: expected text, found 1"),
        ({"results": 1}, "results: expected a mapping, found 1"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(
    change: dict, told: str, complete: tuple[dict, list[dict]], tmp_path: Path
) -> None:
    path = write(complete[0] | change, tmp_path, "run")
    for place in (path, path / "results.json"):
        with pytest.raises(ConfigError, match=rf"^run: .*results.json: {told}") as caught:
            main([str(place)])
        assert "\n" not in str(caught.value)


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
