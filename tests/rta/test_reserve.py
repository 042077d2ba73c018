"""The backup in reserve is predicted first, and the others where it does not suffice."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.environment import Environment
from jaxsafe.evaluate.adversaries import intercept
from jaxsafe.rta.backups import Brake, EitherWay, MatchVelocity
from jaxsafe.rta.simplex import Simplex
from jaxsafe.schema.component import fields
from jaxsafe.transition import others_later
from tests.default_cases import thorough

KEY = jax.random.key(7)


class AllPredicted(Simplex):
    """A simplex that always predicts all ways."""

    def _way(
        self, env: Environment, before: Any, sim: Any, memories: Any, reserve: Any, required: Any
    ) -> Any:
        return self._best(env, self.follow(env, before, sim, memories))


def near_the_lead(task: str) -> tuple[Environment, Environment]:
    """Return an environment with three or four backups, and one that predicts all their ways."""
    env = jaxsafe.make(task, {"wingman.start.position.distance": [700.0, 1500.0]}, rta="default")
    numbers = {name: getattr(env.rta, name) for name in fields(Simplex)}
    if task == "rejoin2d":
        left, right = env.rta.backups
        numbers["backups"] = (left, right, left.replace(name="short_left", away_time=5))
    return env.replace(rta=Simplex(**numbers)), env.replace(rta=AllPredicted(**numbers))


@pytest.mark.parametrize("task", ["rejoin2d", thorough("rejoin3d")])
def test_a_control_passes_if_any_way_certifies_it(task: str) -> None:
    env, all_predicted = near_the_lead(task)
    count = 64

    def one_step(state: Any, key: Any) -> tuple[Any, tuple[Any, ...]]:
        control = intercept(env, state.sim, key)
        action = jnp.stack(
            [actuator.to_continuous(u) for actuator, u in zip(env.actuators, control, strict=True)]
        )
        after, timestep = jaxsafe.step(env, state, action)
        expected, reference = jaxsafe.step(all_predicted, state, action)
        kept = after.memory.rta.backup_index == state.memory.rta.backup_index
        facts = (
            timestep.done,
            timestep.info.rta.certified,
            reference.info.rta.certified,
            timestep.info.control_actual,
            reference.info.control_actual,
            timestep.info.rta.correction > 0.0,
            kept,
            after.memory.rta.backup_index == expected.memory.rta.backup_index,
        )
        return after, facts

    def flight(key: Any) -> tuple[Any, ...]:
        state, _ = jaxsafe.reset(env, key)
        return jax.lax.scan(one_step, state, jax.random.split(key, 60))[1]

    done, certified, also, actual, expected, intervened, kept, same = jax.jit(jax.vmap(flight))(
        jax.random.split(KEY, count)
    )
    flying = np.cumsum(np.asarray(done), axis=1) == 0
    np.testing.assert_array_equal(certified[flying], also[flying])
    passed = flying & ~np.asarray(intervened)
    np.testing.assert_allclose(actual[flying], expected[flying], atol=1e-6)
    assert passed.sum() > 500
    assert (flying & np.asarray(intervened)).sum() > 50
    assert not np.asarray(same)[passed].all()  # a better one does not take over
    assert np.asarray(kept)[passed].mean() > 0.9
    assert not np.asarray(kept)[flying].all()


def test_a_filter_with_two_backups_predicts_both() -> None:
    env = jaxsafe.make("rejoin2d", rta="default")
    assert len(env.rta.backups) == 2
    state, _ = jaxsafe.reset(env, KEY)
    jaxpr = str(jax.make_jaxpr(jaxsafe.step)(env, state, jnp.zeros(2)))
    more, _ = near_the_lead("rejoin2d")
    gathered = str(jax.make_jaxpr(jaxsafe.step)(more, jaxsafe.reset(more, KEY)[0], jnp.zeros(2)))
    assert "only_where" not in jaxpr
    assert "only_where" in gathered


@pytest.mark.parametrize("task", ["rejoin2d", "rejoin3d"])
def test_one_controller_acts_as_each_of_several(task: str) -> None:
    env = jaxsafe.make(task, rta="default")
    backups = env.rta.backups

    def controls(key: Any) -> tuple[Any, Any]:
        state, _ = jaxsafe.reset(env, key)
        later = others_later(env, state.sim)
        each = jnp.stack([backup.control(env, state.sim, later) for backup in backups])

        def chosen(index: Any) -> Any:
            merged = backups[0].merged(backups, index)
            assert isinstance(merged, EitherWay)
            return merged.control(env, state.sim, later)

        return each, jax.vmap(chosen)(jnp.arange(len(backups)))

    each, chosen = jax.jit(jax.vmap(controls))(jax.random.split(KEY, 50))
    assert len(np.unique(np.asarray(each)[0], axis=0)) > 1
    np.testing.assert_allclose(chosen, each, rtol=1e-5, atol=1e-5)


def test_controllers_that_differ_in_more_than_their_side_are_not_merged() -> None:
    left = MatchVelocity(name="left", lead="lead", clearance=100.0, turn="left")
    index = jnp.zeros((), jnp.int32)
    for other in (
        Brake(name="brake"),
        left.replace(name="up", turn="right", climb="up"),
        left.replace(name="later", away_time=20),
    ):
        assert left.merged((left, other), index) is None
