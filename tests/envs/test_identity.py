"""What results say about their task, and that a task does not change without a new version."""

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe.envs import find_task
from jaxsafe.envs.identity import identity
from jaxsafe.evaluate.cases import load_cases, reset_to_cases
from jaxsafe.types import State

CASES = Path(__file__).parents[2] / "configs" / "cases"


def test_a_task_is_itself_with_every_filter() -> None:
    for name in jaxsafe.TASKS:
        expected = {"id": find_task(name).gymnasium_id, "changes": []}
        assert expected["id"]
        assert identity(jaxsafe.make(name)) == expected
    assert identity(jaxsafe.make("docking2d", rta="default"))["changes"] == []


def test_what_is_not_as_in_the_task_is_named_by_its_path() -> None:
    env = jaxsafe.make("docking2d", {"deputy.mass": 11.0, "observation.position.scale": 2.0})
    assert identity(env)["changes"] == ["deputy.mass", "observation.position.scale"]
    assert identity(jaxsafe.load(jaxsafe.dump(env)))["id"] is None


VERSIONS = {
    "jaxsafe/Rejoin2D-v0": (-46.9213, 0.683980, 0),
    "jaxsafe/Rejoin3D-v0": (-13.3236, 0.601746, 0),
    "jaxsafe/Docking2D-v0": (-68.2745, 1.952987, 1907),
    "jaxsafe/Docking3D-v0": (-82.3969, 2.013873, 1939),
    "jaxsafe/Docking2DOriented-v0": (-73.5020, 2.197601, 1844),
}
"""What `flown` gives in each version of a task: sum of rewards, mean magnitude of the last
observations, number of violating steps."""


def flown(task: str) -> tuple[float, float, float]:
    env = jaxsafe.make(task)
    cases = load_cases(env, str(CASES / f"{task}.csv")).part(0, 20)
    phases = jnp.arange(20)[:, None] + jnp.arange(env.action_size)

    def advance(state: State, number: jax.Array) -> tuple[State, tuple]:
        action = jnp.sin(0.05 * number + phases)
        state, timestep = jax.vmap(jaxsafe.step, in_axes=(None, 0, 0))(env, state, action)
        return state, (timestep.reward, timestep.observation, timestep.cost)

    state, _ = reset_to_cases(env, cases, jax.random.key(0))
    _, (reward, observation, cost) = jax.lax.scan(advance, state, jnp.arange(100))
    return float(reward.sum()), float(jnp.abs(observation[-1]).mean()), float(cost.sum())


@pytest.mark.parametrize(
    "task", [thorough(task) if task != "docking2d" else task for task in jaxsafe.TASKS]
)
def test_a_task_that_changes_gets_a_new_version(task: str) -> None:
    recorded = VERSIONS[str(find_task(task).gymnasium_id)]
    assert flown(task) == pytest.approx(recorded, rel=2e-4), (
        "the task is another one: raise the version in its gymnasium_id, and record it here"
    )
