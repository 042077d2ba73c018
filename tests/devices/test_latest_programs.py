import gc
import importlib
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.devices import latest_programs


class Gain:
    """A policy that multiplies, and counts how often it is traced."""

    def __init__(self, gain: float) -> None:
        self.gain = jnp.asarray(gain)
        self.traces = 0

    def __call__(self, x: jax.Array) -> jax.Array:
        self.traces += 1
        return self.gain * x


def test_the_oldest_program_is_given_up_with_its_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latest_programs, "MAX_PROGRAMS", 2)
    run = latest_programs.latest_programs(lambda policy, x: policy(x))
    oldest = Gain(2.0)
    second = Gain(3.0)
    for policy in (oldest, second, oldest, second):
        np.testing.assert_array_equal(run(policy, jnp.arange(3.0)), policy.gain * np.arange(3.0))
    assert (oldest.traces, second.traces) == (1, 1)
    seen = weakref.ref(oldest)
    del oldest, policy
    gc.collect()
    assert seen() is not None
    run(Gain(4.0), jnp.arange(3.0))
    gc.collect()
    assert seen() is None
    run(second, jnp.arange(3.0))
    assert second.traces == 1


def test_arrays_of_another_structure_have_a_program_of_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(latest_programs, "MAX_PROGRAMS", 2)
    policy = Gain(2.0)
    run = latest_programs.latest_programs(lambda policy, tree: jax.tree.map(policy, tree))
    trees = [(jnp.ones(2),), {"x": jnp.ones(2)}, [jnp.ones(2)]]
    for tree in trees:
        run(policy, tree)
    run(policy, trees[2])
    assert policy.traces == 3
    run(policy, trees[0])
    assert policy.traces == 4


@pytest.mark.parametrize(
    ("module", "name", "run"),
    [("evaluate.evaluate", "_run", "evaluate"), ("flight", "_fly_on", "fly")],
)
def test_an_evaluation_or_a_flight_gives_up_earlier_policies(
    module: str, name: str, run: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latest_programs, "MAX_PROGRAMS", 1)
    place = importlib.import_module(f"jaxsafe.{module}")
    again = latest_programs.latest_programs(getattr(place, name).__wrapped__)
    monkeypatch.setattr(place, name, again)
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 3})
    options = {"num_episodes": 2} if run == "evaluate" else {}
    policy = jaxsafe.load_policy("docking2d")
    getattr(jaxsafe, run)(env, policy, **options)
    seen = weakref.ref(policy)
    del policy
    gc.collect()
    assert seen() is not None
    getattr(jaxsafe, run)(env, lambda key, observation: observation[..., :2], **options)
    gc.collect()
    assert seen() is None
