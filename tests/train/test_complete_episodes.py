"""Batches of whole episodes."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe_environments import Constant, Match, probe

from jaxsafe import ConfigError
from jaxsafe.agents.agent import Agent
from jaxsafe.agents.networks import MLP
from jaxsafe.config import build
from jaxsafe.environment import Environment
from jaxsafe.processors.terminal import TooFar
from jaxsafe.schema.component import normalise
from jaxsafe.train.hyperparameters import PPO, check_complete_episodes
from jaxsafe.train.ppo import (
    Batch,
    TrainState,
    Transition,
    _counts,
    _to_batch,
    collect,
    gae,
    init,
    loss,
    update,
)
from jaxsafe.train.recent_episodes import total_cost
from jaxsafe.train.train import train

AGENT = normalise(Agent(actor=MLP(hidden=(4,))))
PPO_WHOLE = normalise(
    PPO(num_envs=6, num_steps=12, num_epochs=1, num_minibatches=1, complete_episodes=True)
)
LONGEST = 6  # a time limit of 3.5 s, and two steps more


def task() -> Environment:
    """Return a task whose episodes end after 4 steps, or earlier with a hard push."""
    env = probe(Match(name="match"), steps=4, most=0.4)
    early = TooFar(name="success", distance="hard", limit=0.8)
    return build(env.replace(terminal=(early, *env.terminal)))


@cache
def collected() -> tuple[Environment, TrainState, TrainState, Transition]:
    """Return the task, the states before and after a batch, and the batch."""
    env = task()
    state = init(env, AGENT, PPO_WHOLE, jax.random.key(0))
    run = jax.jit(lambda state, key: collect(env, AGENT, PPO_WHOLE, state, key))
    return env, state, *run(state, jax.random.key(1))


def whole_episodes(done: np.ndarray) -> list[tuple[slice, int]]:
    """Return the episodes that begin early enough to end whatever happens, by the definition."""
    found = []
    for n in range(done.shape[1]):
        first = 0
        for last in np.flatnonzero(done[:, n]):
            if first + LONGEST <= done.shape[0]:
                found.append((slice(first, last + 1), n))
            first = last + 1
    return found


@pytest.mark.thorough
def test_an_episode_counts_if_it_began_early_enough_for_any_length() -> None:
    env, _, _, transitions = collected()
    done = np.asarray(transitions.done)
    expected = np.zeros(done.shape, bool)
    for steps, n in whole_episodes(done):
        expected[steps, n] = True
    counts = np.asarray(_counts(env, PPO_WHOLE, transitions))
    np.testing.assert_array_equal(counts, expected)
    assert counts.any()
    assert (~counts & done).any()  # some episodes ended and still do not count
    lengths = {steps.stop - steps.start for steps, _ in whole_episodes(done)}
    assert len(lengths) > 1


@pytest.mark.thorough
def test_the_gradient_is_that_of_a_batch_of_these_episodes_alone() -> None:
    env, state, after, transitions = collected()
    gamma = jnp.array(0.9)
    counts = _counts(env, PPO_WHOLE, transitions)
    _, batch, _ = _to_batch(AGENT, PPO_WHOLE, gamma, after, transitions, state.memory, counts)

    def values(inputs: jax.Array) -> jax.Array:
        return AGENT.value(state.params, inputs)

    parts = []
    for steps, n in whole_episodes(np.asarray(transitions.done)):
        one = jax.tree.map(lambda x, steps=steps, n=n: x[steps, n], transitions)
        value = values(one.inputs)
        advantage = gae(
            one.reward,
            value,
            values(one.next_inputs),
            one.terminated,
            one.done,
            gamma,
            jnp.ones(()),
        )
        parts.append(Batch(one.inputs, {}, one.action, one.log_prob, advantage, advantage + value))
    by_hand = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    advantage = (by_hand.advantage - by_hand.advantage.mean()) / by_hand.advantage.std()
    by_hand = by_hand._replace(advantage=advantage)

    other = jax.tree.map(lambda x: x + 0.1, state.params)  # so that no ratio is 1
    gradient = jax.jit(jax.grad(partial(loss, env=env, agent=AGENT, ppo=PPO_WHOLE), has_aux=True))
    found, wanted = (gradient(other, batch=samples) for samples in (batch, by_hand))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), found, wanted)


@pytest.mark.thorough
def test_what_does_not_count_changes_nothing() -> None:
    env, state, after, transitions = collected()
    counts = _counts(env, PPO_WHOLE, transitions)
    beyond = jnp.where(counts, 0.0, 100.0)
    changed = transitions._replace(
        reward=transitions.reward + beyond,
        inputs=transitions.inputs + beyond[..., None],
        log_prob=transitions.log_prob + jnp.where(counts, 0.0, 1.0),
    )

    def gradient(transitions: Transition) -> tuple:
        _, batch, explained = _to_batch(
            AGENT, PPO_WHOLE, jnp.array(0.9), after, transitions, state.memory, counts
        )
        return explained, jax.grad(loss, has_aux=True)(state.params, env, AGENT, PPO_WHOLE, batch)

    found, wanted = map(jax.jit(gradient), (changed, transitions))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), found, wanted)


@pytest.mark.thorough
def test_an_update_starts_afresh_and_logs_what_counts_and_all_costs() -> None:
    env = task()
    state = init(env, AGENT, PPO_WHOLE, jax.random.key(0))
    run = jax.jit(lambda state: update(env, AGENT, PPO_WHOLE, 10, state))
    once, diagnostics = run(state)
    # What the environments were doing before does not matter.
    away = init(env, AGENT, PPO_WHOLE, jax.random.key(5))
    other, _ = run(state.replace(env_state=away.env_state, observation=away.observation))
    jax.tree.map(np.testing.assert_array_equal, once.params, other.params)
    assert all(np.isfinite(value) for value in diagnostics.values())
    assert once.window.count >= PPO_WHOLE.num_envs
    assert int(total_cost(once.window)) > 0
    assert int(once.window.running_cost) == 0
    twice, _ = run(once)
    assert int(total_cost(twice.window)) > int(total_cost(once.window))


@pytest.mark.thorough
def test_without_it_nothing_is_weighed() -> None:
    _, state, after, transitions = collected()
    gamma = jnp.array(0.9)
    _, batch, _ = _to_batch(AGENT, PPO_WHOLE, gamma, after, transitions, state.memory, None)
    assert batch.weight == ()


def test_a_batch_that_may_hold_no_whole_episode_is_refused() -> None:
    short = PPO_WHOLE.replace(num_steps=5)
    with pytest.raises(
        ConfigError,
        match=r"^ppo.num_steps: expected at least 6, the longest episode, with"
        r" ppo.complete_episodes, found 5$",
    ):
        train(task(), AGENT, short, jax.random.key(0), 1)
    check_complete_episodes(task(), short.replace(max_episode_steps=jnp.array(5.0)))
    endless = build(task().replace(terminal=task().terminal[:1]))
    with pytest.raises(ConfigError, match=r"^ppo.complete_episodes: the task has no time limit"):
        check_complete_episodes(endless, PPO_WHOLE)
    check_complete_episodes(endless, PPO_WHOLE.replace(complete_episodes=False))
    check_complete_episodes(probe(Constant(name="reward")), PPO_WHOLE)
