"""The share of steps from which a spacecraft would stay away without thrust."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.commands.evaluate import main
from jaxsafe.evaluate.passive_safety import with_passive_safety
from jaxsafe.schema.errors import ConfigError

CASES = Path(__file__).parents[2] / "configs" / "cases" / "docking3d.csv"
MEAN_MOTION = 0.001027


def least_distances(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the least distance of each state's drift over one orbit, at instants 2 s apart."""
    n = MEAN_MOTION
    rates = np.zeros((6, 6))
    rates[:3, 3:] = np.eye(3)
    rates[3, [0, 4]] = 3 * n**2, 2 * n
    rates[4, 3] = -2 * n
    rates[5, 2] = -(n**2)
    advance = np.asarray(jax.scipy.linalg.expm(jnp.asarray(2.0 * rates)), float)
    state = np.concatenate([position, velocity], axis=-1).T
    least = np.linalg.norm(state[:3], axis=0)
    for _ in range(int(2 * np.pi / n / 2.0)):
        state = advance @ state
        least = np.minimum(least, np.linalg.norm(state[:3], axis=0))
    return least


def test_the_bound_is_just_below_the_least_distance_of_the_drift() -> None:
    with jax.enable_x64(True):
        env = with_passive_safety(jaxsafe.make("docking3d"), 20.0)
        policy = jaxsafe.load_policy("controller/pd", env=env)
        _, flown = jaxsafe.rollout(env, policy, jax.random.key(1), 400, num_envs=4, record="states")
        sim = flown.state.sim
        own = sim.platforms["deputy"]
        bound = np.asarray(sim.status["drift_bound"]).ravel()
        safe = np.asarray(sim.status["passively_safe"]).ravel()
        truth = least_distances(
            np.asarray(own.position).reshape(-1, 3), np.asarray(own.velocity).reshape(-1, 3)
        )
    assert np.all(bound <= truth + 1e-3)
    assert np.all(bound >= truth - 0.25)
    assert not np.any(safe & (truth < 20.0 - 1e-3))
    assert safe.mean() == pytest.approx((truth >= 20.0).mean(), abs=0.01)
    assert 0.05 < safe.mean() < 0.5


def test_the_share_of_the_packaged_policy_on_fixed_starts(tmp_path: Path) -> None:
    file = tmp_path / "first.csv"
    file.write_text("".join(CASES.read_text().splitlines(keepends=True)[:21]))
    out = tmp_path / "out"
    words = ["run=pretrained/docking3d", f"cases={file}", "deterministic=true", f"out={out}"]
    assert main([*words, "passive_safety=20"]) == 0
    results = json.loads((out / "results.json").read_text())
    assert results["changes"] == {"passive_safety": 20}
    [share] = results["evaluation"]["deterministic"]["passively_safe.mean"]["per_seed"]
    assert share == pytest.approx(0.198, abs=0.01)


@pytest.mark.parametrize(
    ("task", "overrides", "found"),
    [
        ("rejoin2d", {}, "found dubins2d and 0 anchors"),
        ("docking2d", {"deputy.type": "two_body"}, "found two_body and 1 anchors"),
    ],
)
def test_what_does_not_drift_near_a_chief_is_refused(
    task: str, overrides: dict[str, str], found: str
) -> None:
    with pytest.raises(ConfigError, match=f"^passive_safety: expected .*, {found}$"):
        with_passive_safety(jaxsafe.make(task, overrides), 20.0)


@pytest.mark.parametrize("wrong", ["0", "-1", "[1,2]", "near", "true"])
def test_a_radius_is_a_positive_number(wrong: str) -> None:
    with pytest.raises(ConfigError, match=r"^passive_safety: expected a radius > 0 in m, found"):
        main(["pretrained/docking2d", f"passive_safety={wrong}"])
