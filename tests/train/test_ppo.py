from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough
from probe_environments import Allowed, Constant, Match, Position, probe

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.networks import GRU, MLP, Network
from jaxsafe.config import build
from jaxsafe.environment import Environment
from jaxsafe.metrics import Episode
from jaxsafe.processors.constraint import SpeedLimit
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train import ppo as ppo_module
from jaxsafe.train.hyperparameters import PPO, check_cost_limit, discount, learning_rate
from jaxsafe.train.ppo import (
    TrainState,
    collect,
    dual_ascent,
    explained_variance,
    gae,
    init,
    price,
    update,
)
from jaxsafe.types import Sim

AGENT = normalise(Agent(actor=MLP(hidden=(16,))))
SMALL = normalise(
    PPO(
        num_envs=8,
        num_steps=16,
        num_epochs=8,
        num_minibatches=2,
        gamma=0.9,
        gae_lambda=0.95,
        final_learning_rate=3e-3,
    )
)


@partial(jax.jit, static_argnums=4)
def trained(env: Environment, agent: Agent, ppo: PPO, key: jax.Array, updates: int) -> TrainState:
    return jax.lax.fori_loop(
        0,
        updates,
        lambda _, state: update(env, agent, ppo, updates, state)[0],
        init(env, agent, ppo, key),
    )


def train(
    env: Environment, updates: int = 40, ppo: PPO = SMALL, agent: Agent = AGENT
) -> TrainState:
    return trained(env, agent, ppo, jax.random.key(0), updates)


@partial(jax.jit, static_argnames="updates")
def latter_half(env: Environment, agent: Agent, ppo: PPO, updates: int = 200) -> Episode:
    """Return the mean episode of the latter half of a training.

    With a Lagrangian the cost swings about its limit, so the last update alone says little.
    """

    def step(state: TrainState, _: None) -> tuple[TrainState, Episode]:
        state, _ = update(env, agent, ppo, updates, state)
        return state, state.window.episodes

    _, episodes = jax.lax.scan(step, init(env, agent, ppo, jax.random.key(0)), length=updates)
    return jax.tree.map(lambda x: jnp.mean(x[updates // 2 :]), episodes)


def value(state: TrainState, observation: float) -> float:
    return float(AGENT.value(state.params, jnp.array([observation])))


def test_gae_equals_a_table_worked_out_by_hand() -> None:
    # There is one environment, γ = 0.5 and λ = 0.5. Step 0 runs on, step 1 is truncated, step 2
    # runs on, step 3 terminates, and step 4 is cut off by the end of the batch.
    reward = jnp.array([1.0, 2.0, 3.0, 4.0, 5.0])[:, None]
    values = jnp.array([10.0, 20.0, 30.0, 40.0, 50.0])[:, None]
    next_values = jnp.array([20.0, 8.0, 40.0, 99.0, 60.0])[:, None]
    terminated = jnp.array([False, False, False, True, False])[:, None]
    done = jnp.array([False, True, False, True, False])[:, None]
    # δ = 1+10−10 = 1, 2+4−20 = −14, 3+20−30 = −7, 4+0−40 = −36, 5+30−50 = −15
    expected = [1.0 - 14.0 / 4, -14.0, -7.0 - 36.0 / 4, -36.0, -15.0]
    computed = gae(reward, values, next_values, terminated, done, jnp.array(0.5), jnp.array(0.5))
    np.testing.assert_allclose(computed[:, 0], expected, rtol=1e-6)


def test_gae_equals_a_loop_over_random_episodes() -> None:
    rng = np.random.default_rng(0)
    reward, values, next_values = (rng.normal(size=(50, 3)) for _ in range(3))
    terminated, truncated = rng.random((2, 50, 3)) < 0.1
    done = terminated | truncated
    expected = np.zeros((50, 3))
    following = np.zeros(3)
    for t in reversed(range(50)):
        delta = reward[t] + 0.97 * next_values[t] * ~terminated[t] - values[t]
        following = delta + 0.97 * 0.8 * ~done[t] * following
        expected[t] = following
    arrays = (jnp.asarray(x, jnp.float32) for x in (reward, values, next_values))
    computed = gae(
        *arrays, jnp.asarray(terminated), jnp.asarray(done), jnp.array(0.97), jnp.array(0.8)
    )
    np.testing.assert_allclose(computed, expected, atol=1e-5)


@pytest.mark.thorough
def test_the_critic_learns_a_constant() -> None:
    state = train(probe(Constant(name="reward")))
    assert value(state, 1.0) == pytest.approx(1.0, abs=0.05)


@pytest.mark.thorough
def test_the_critic_learns_from_the_observation() -> None:
    state = train(probe(Position(name="reward")))
    assert value(state, 1.0) == pytest.approx(1.0, abs=0.1)
    assert value(state, -1.0) == pytest.approx(-1.0, abs=0.1)


@pytest.mark.thorough
def test_what_is_learnt_does_not_depend_on_how_many_samples_go_through_the_networks_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = probe(Position(name="reward"))
    agent = AGENT.replace(cost_critic=True)
    whole = train(env, updates=3, agent=agent)
    monkeypatch.setattr(ppo_module, "CHUNK", 16)  # a minibatch has 64 samples, a batch 128
    assert [ppo_module._num_chunks(samples) for samples in (64, 128)] == [4, 8]
    parts = train(env, updates=3, agent=agent)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), whole.params, parts.params
    )


@pytest.mark.thorough
def test_a_terminated_episode_counts_nothing_beyond_its_end() -> None:
    state = train(probe(Constant(name="reward"), steps=2), updates=80)
    # The two steps look alike, so the critic learns the mean of 1 and 1 + γ.
    assert value(state, 1.0) == pytest.approx((1.0 + 1.9) / 2, abs=0.1)


@pytest.mark.thorough
def test_a_critic_that_sees_the_totals_tells_first_steps_from_second_ones() -> None:
    agent = AGENT.replace(critic_sees_totals=True)
    state = train(probe(Constant(name="reward"), steps=2), updates=80, agent=agent)
    for total, expected in ((0.0, 1.9), (1.0, 1.0)):
        inputs = agent.critic_inputs(jnp.array([1.0]), {"reward": jnp.array(total)})
        assert float(agent.value(state.params, inputs)) == pytest.approx(expected, abs=0.1)


@pytest.mark.thorough
def test_a_truncated_episode_counts_what_would_follow() -> None:
    state = train(probe(Constant(name="reward"), steps=2, ends="truncated"), updates=150)
    assert value(state, 1.0) == pytest.approx(1.0 / (1.0 - 0.9), rel=0.1)


@pytest.mark.thorough
def test_an_episode_of_training_is_truncated_after_its_limit() -> None:
    limited = SMALL.replace(max_episode_steps=jnp.array(3.0))
    state = init(probe(Constant(name="reward"), steps=1000), AGENT, limited, jax.random.key(0))
    _, transitions = collect(
        probe(Constant(name="reward"), steps=1000), AGENT, limited, state, jax.random.key(1)
    )
    done = jnp.arange(1, SMALL.num_steps + 1) % 3 == 0
    np.testing.assert_array_equal(
        transitions.done, jnp.broadcast_to(done[:, None], transitions.done.shape)
    )
    assert not transitions.terminated.any()
    assert not transitions.episode.outcome.any()


@pytest.mark.parametrize("discrete", [False, thorough(True)], ids=["gaussian", "categorical"])
def test_the_policy_learns_the_action_that_the_observation_calls_for(discrete: bool) -> None:
    env = probe(Match(name="reward"), discrete=discrete)
    state = train(env, updates=100)
    for observation in (-1.0, 1.0):
        mode = AGENT.distribution(env, state.params, jnp.array([observation])).mode()
        if discrete:
            # The points are −1, −0.5, 0, 0.5, 1.
            assert int(mode[0]) == (3 if observation > 0 else 1)
        else:
            assert float(mode[0]) == pytest.approx(0.5 * observation, abs=0.1)


@pytest.mark.thorough
def test_the_learning_rate_falls_linearly_to_its_end() -> None:
    env = probe(Match(name="reward"))
    frozen = SMALL.replace(learning_rate=jnp.array(1e-3), final_learning_rate=jnp.array(0.0))
    state = init(env, AGENT, frozen, jax.random.key(0)).replace(num_updates=jnp.array(10))
    # At progress 1 the rate is 0, so nothing moves.
    after = update(env, AGENT, frozen, 10, state)[0]
    jax.tree.map(np.testing.assert_array_equal, after.params, state.params)
    earlier = update(env, AGENT, frozen, 20, state)[0]
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), earlier.params, state.params)
    assert max(jax.tree.leaves(moved)) > 1e-4


def test_the_learning_rate_falls_as_it_is_told() -> None:
    for decay, middle in (("linear", 5.05e-3), ("exponential", 1e-3)):
        ppo = normalise(
            PPO(learning_rate=1e-2, final_learning_rate=1e-4, learning_rate_decay=decay)
        )
        rates = [float(learning_rate(ppo, progress)) for progress in (0.0, 0.5, 1.0)]
        np.testing.assert_allclose(rates, [1e-2, middle, 1e-4], rtol=1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("discrete", [thorough(False), True], ids=["gaussian", "categorical"])
def test_the_noise_falls_besides_what_is_learnt(discrete: bool) -> None:
    env = probe(Constant(name="reward"), discrete=discrete)
    state = init(env, AGENT, SMALL, jax.random.key(0))
    kept = update(env, AGENT, SMALL, 10, state)[0].params["log_std"]
    less = update(env, AGENT, SMALL.replace(noise_decay=jnp.array(2.0)), 10, state)[0].params[
        "log_std"
    ]
    np.testing.assert_allclose(kept - less, 0.2, rtol=1e-5)


def test_the_horizon_grows_exponentially_to_its_end() -> None:
    ppo = normalise(PPO(gamma=0.9, horizon_growth=4.0))
    horizons = [1.0 / (1.0 - float(discount(ppo, progress))) for progress in (0.0, 0.5, 1.0)]
    np.testing.assert_allclose(horizons, [10.0, 20.0, 40.0], rtol=1e-5)
    assert float(discount(normalise(PPO(gamma=0.97)), 0.7)) == pytest.approx(0.97)


@pytest.mark.thorough
def test_the_discount_of_an_update_is_that_of_its_progress() -> None:
    env = probe(Position(name="reward"), steps=4)
    growing = SMALL.replace(gamma=jnp.array(0.5), horizon_growth=jnp.array(10.0))
    state = init(env, AGENT, growing, jax.random.key(0)).replace(num_updates=jnp.array(10))
    computed, *others = (
        jnp.concatenate(
            [leaf.ravel() for leaf in jax.tree.leaves(update(env, AGENT, ppo, 10, state)[0].params)]
        )
        for ppo in (
            growing,
            SMALL.replace(gamma=jnp.array(0.95)),
            SMALL.replace(gamma=jnp.array(0.5)),
        )
    )
    at_the_end, at_the_start = (float(jnp.abs(computed - other).max()) for other in others)
    assert at_the_end < 1e-5
    assert at_the_start > 1e-4


@pytest.mark.thorough
def test_hyperparameters_are_leaves_that_vmap() -> None:
    env = probe(Constant(name="reward"))
    rates = jnp.array([1e-3, 3e-3])
    state = init(env, AGENT, SMALL, jax.random.key(0))

    def bias(rate: jax.Array) -> jax.Array:
        ppo = SMALL.replace(learning_rate=rate)
        return update(env, AGENT, ppo, 10, state)[0].params["critic"]["hidden_0"]["bias"]

    together = jax.vmap(bias)(rates)
    np.testing.assert_allclose(together, jnp.stack([bias(rate) for rate in rates]), atol=1e-6)


@pytest.mark.thorough
def test_no_gradient_is_larger_than_allowed() -> None:
    env = probe(Position(name="reward"))
    tiny = SMALL.replace(max_grad_norm=jnp.array(1e-30))
    state = init(env, AGENT, tiny, jax.random.key(0))
    # The gradient is clipped below Adam's ε, so the networks hardly move.
    after, _ = update(env, AGENT, tiny, 10, state)
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), after.params, state.params)
    assert max(jax.tree.leaves(moved)) < 1e-6


@pytest.mark.thorough
@pytest.mark.parametrize("discrete", [False, thorough(True)], ids=["gaussian", "categorical"])
def test_diagnostics_of_an_update_that_changes_nothing_are_those_of_its_batch(
    discrete: bool,
) -> None:
    env = probe(Position(name="reward"), discrete=discrete)
    frozen = SMALL.replace(learning_rate=jnp.array(0.0), final_learning_rate=jnp.array(0.0))
    frozen = frozen.replace(entropy_coefficient=jnp.array(0.3))
    state = init(env, AGENT, frozen, jax.random.key(0))
    _, computed = update(env, AGENT, frozen, 10, state)
    key = jax.random.split(jax.random.fold_in(state.key, 0))[0]
    _, t = collect(env, AGENT, frozen, state, key)
    values = AGENT.value(state.params, t.inputs)  # an episode has one step, so nothing follows
    error = t.reward - values
    entropy = AGENT.distribution(env, state.params, t.inputs).entropy().mean()
    expected = {
        "policy_loss": 0.0,  # the mean of the normalised advantages
        "value_loss": 0.5 * jnp.mean(error**2),
        "entropy": entropy,
        "approx_kl": 0.0,
        "clip_fraction": 0.0,
        "explained_variance": 1.0 - jnp.var(error) / jnp.var(t.reward),
        "learning_rate": 0.0,
        "gamma": 0.9,
        "action_std": jnp.exp(state.params["log_std"]).mean(),
    }
    assert computed.keys() == {*expected, "grad_norm"}
    for name, value in expected.items():
        assert float(computed[name]) == pytest.approx(float(value), rel=1e-4, abs=1e-5), name


@pytest.mark.thorough
def test_the_diagnostics_show_how_far_an_update_went() -> None:
    env = probe(Match(name="reward"))
    still = SMALL.replace(num_epochs=1, num_minibatches=1)
    state = init(env, AGENT, SMALL, jax.random.key(0))
    near, far = (
        update(env, AGENT, SMALL.replace(learning_rate=jnp.array(rate)), 10, state)[1]
        for rate in (1e-3, 3e-2)
    )
    assert 0.0 < near["approx_kl"] < far["approx_kl"]
    assert 0.0 <= near["clip_fraction"] < far["clip_fraction"] < 1.0
    # One step with the whole batch, so the norm is that before clipping whatever is allowed.
    norms = [
        float(update(env, AGENT, still.replace(max_grad_norm=most), 10, state)[1]["grad_norm"])
        for most in (jnp.array(1e-3), jnp.array(1e3))
    ]
    assert norms[0] == norms[1] > 1e-3


def test_the_explained_variance_is_1_for_a_perfect_critic_and_0_for_a_constant_one() -> None:
    target = jnp.array([1.0, 2.0, 4.0])
    assert float(explained_variance(target, target + 5.0)) == 1.0  # a bias is not seen
    assert float(explained_variance(target, jnp.full(3, 7.0))) == pytest.approx(0.0, abs=1e-6)
    assert float(explained_variance(target, -target)) == pytest.approx(-3.0)
    assert not jnp.isfinite(explained_variance(jnp.ones(3), target))


class Push(Match):
    """A reward for pushing to the right: the harder, the better."""

    def process(self, memory: object, sim: Sim) -> jax.Array:
        return sim.platforms["point"].push


@pytest.mark.parametrize(
    ("limit", "low", "high"),
    [thorough(0.5, 0.0, 0.5), thorough(0.1, 0.0, 0.1), thorough(5.0, 0.95, 1.0)],
)
def test_costs_are_kept_within_their_limit(limit: float, low: float, high: float) -> None:
    # The reward pays to break the rule. An episode has one step, so it costs 0 or 1.
    env = probe(Push(name="reward"), most=0.2)
    agent = AGENT.replace(cost_critic=True)
    ppo = SMALL.replace(cost_limit=limit, multiplier=2.0)
    state = train(env, 200, ppo, agent)
    assert low <= float(jnp.mean(state.window.episodes.violating_steps)) <= high
    assert float(price(state)) < 2.0  # the multiplier fell while nothing exceeded the limit


@pytest.mark.thorough
def test_the_critic_of_costs_expects_what_a_step_costs() -> None:
    env = probe(Constant(name="reward"), steps=3, most=-1.0)  # every push is too hard
    agent = AGENT.replace(cost_critic=True)
    state = train(env, 60, agent=agent)
    assert float(agent.critic_output("cost_critic", state.params, jnp.ones(1))) == pytest.approx(
        0.1 * (2.71 + 1.9 + 1.0) / 3, abs=0.05
    )


@pytest.mark.thorough
def test_the_multiplier_follows_the_excess() -> None:
    env = probe(Constant(name="reward"), most=-1.0)
    agent = AGENT.replace(cost_critic=True)
    state = init(env, agent, SMALL, jax.random.key(0)).replace(multiplier=jnp.array(2.0))
    costs = state.window.episodes.replace(violating_steps=jnp.full(100, 3))
    window = state.window.replace(episodes=costs, count=jnp.array(100))
    some = jnp.array([True])
    none = jnp.array([False])
    rate = float(SMALL.multiplier_rate)
    for limit, change in ((3.0, 0.0), (6.0, -0.5 * rate), (2.0, 0.5 * rate), (0.1, rate)):
        ppo = SMALL.replace(cost_limit=jnp.array(limit))
        computed = price(dual_ascent(env, agent, ppo, state, window, some))
        assert float(computed) == pytest.approx(2.0 * np.exp(change), rel=1e-5)
        # Without finished episodes nothing new is known.
        assert float(price(dual_ascent(env, agent, ppo, state, window, none))) == 2.0


@pytest.mark.parametrize("network", [MLP(hidden=(16,)), thorough(GRU(hidden=(16,), units=16))])
def test_a_limit_of_the_only_constraint_is_a_limit_of_the_cost(network: Network) -> None:
    env = probe(Push(name="reward"), steps=3, most=0.2)
    agent = normalise(Agent(actor=network, cost_critic=True))
    whole = train(env, 3, SMALL.replace(cost_limit=0.5), agent)
    by_name = agent.replace(cost_names=("push",))
    named = train(env, 3, SMALL.replace(cost_limit={"push": jnp.array(0.5)}), by_name)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), named.params, whole.params
    )
    assert named.multiplier.shape == (1,)
    np.testing.assert_allclose(named.multiplier[0], whole.multiplier, rtol=1e-6)
    episodes = named.window.episodes
    np.testing.assert_array_equal(episodes.costs["push"], episodes.violating_steps)
    assert float(jnp.max(episodes.costs["push"])) > 0.0


def two_limits() -> Environment:
    """Return an environment that pays for pushing, with two constraints of the push."""
    env = probe(Push(name="reward"), most=0.2)
    return build(
        env.replace(
            status=(*env.status, Allowed(name="more", most=0.6)),
            constraints=(
                *env.constraints,
                SpeedLimit(name="hard_push", speed="hard", velocity_limit="more"),
            ),
        )
    )


def test_a_multiplier_with_a_rate_of_0_is_a_fixed_penalty() -> None:
    agent = AGENT.replace(cost_critic=True)
    fixed = SMALL.replace(multiplier=jnp.array(0.05), multiplier_rate=jnp.array(0.0))
    state = train(probe(Push(name="reward"), most=0.2), 3, fixed, agent)
    assert int(state.window.count) > 0
    assert float(price(state)) == float(fixed.multiplier)


def test_each_constraint_has_a_fixed_penalty_of_its_own() -> None:
    agent = AGENT.replace(cost_critic=True)
    penalties = {"push": jnp.array(2.0), "hard_push": jnp.array(1e-4)}
    fixed = SMALL.replace(multiplier=penalties, multiplier_rate=jnp.array(0.0))
    by_name = agent.replace(cost_names=fixed.cost_names)
    check_cost_limit(two_limits(), by_name, fixed)
    state = train(two_limits(), 3, fixed, by_name)
    assert int(state.window.count) > 0
    np.testing.assert_allclose(price(state), [1e-4, 2.0], rtol=1e-6)
    # A penalty on the only constraint is a penalty on the cost.
    env = probe(Push(name="reward"), steps=3, most=0.2)
    whole = train(env, 3, fixed.replace(multiplier=jnp.array(0.5)), agent)
    alone = fixed.replace(multiplier={"push": jnp.array(0.5)})
    named = train(env, 3, alone, agent.replace(cost_names=("push",)))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), named.params, whole.params
    )


@pytest.mark.thorough
def test_each_constraint_has_a_limit_of_its_own_and_others_have_none() -> None:
    agent = AGENT.replace(cost_critic=True)
    for limits in ({"hard_push": 0.2}, {"hard_push": 0.2, "push": 2.0}):
        some = SMALL.replace(cost_limit=limits, multiplier=2.0)
        state = train(two_limits(), 200, some, agent.replace(cost_names=tuple(sorted(limits))))
        episodes = state.window.episodes
        assert float(jnp.mean(episodes.costs["hard_push"])) <= 0.3
        assert float(jnp.mean(episodes.violating_steps)) > 0.9  # of the push that may be too hard


def test_each_multiplier_follows_the_excess_of_its_constraint() -> None:
    agent = AGENT.replace(cost_critic=True, cost_names=("hard_push", "push"))
    env = two_limits()
    state = init(env, agent, SMALL, jax.random.key(0))
    costs = {"hard_push": jnp.full(100, 1.0), "push": jnp.full(100, 3.0)}
    window = state.window.replace(
        episodes=state.window.episodes.replace(costs=costs), count=jnp.array(100)
    )
    rate = float(SMALL.multiplier_rate)
    for limits, changes in (
        ((1.0, 2.0), (0.0, 0.5 * rate)),
        ((4.0, 3.0), (-0.75 * rate, 0.0)),
        ((0.0, 6.0), (rate, -0.5 * rate)),
    ):
        ppo = SMALL.replace(cost_limit=dict(zip(agent.cost_names, limits, strict=True)))
        before = state.replace(multiplier=jnp.array([2.0, 1.0]))
        after = dual_ascent(env, agent, ppo, before, window, jnp.array([True]))
        np.testing.assert_allclose(price(after), [2.0, 1.0] * np.exp(changes), rtol=1e-5)


def test_the_critic_of_costs_must_be_that_of_the_limits() -> None:
    agent = AGENT.replace(cost_critic=True)
    for limits, names, message in (
        ({"push": 1.0}, (), r"agent.cost_names: expected the names .*, \['push'\], found \[\]"),
        (1.0, ("push",), r"agent.cost_names: expected the names .*, \[\], found \['push'\]"),
        ({"pull": 1.0}, ("pull",), "cost_limit: unknown constraint 'pull'. Did you mean 'push'"),
    ):
        with pytest.raises(ConfigError, match=message):
            check_cost_limit(
                two_limits(), agent.replace(cost_names=names), SMALL.replace(cost_limit=limits)
            )
    for multiplier, limits, message in (
        ({"pull": 1.0}, 1.0, "ppo.multiplier: unknown constraint 'pull'. Did you mean 'push'"),
        ({}, 1.0, "ppo.multiplier: expected a constraint; choose from"),
        (
            {"push": 1.0},
            {"push": 1.0, "hard_push": 0.0},
            "ppo.multiplier: expected a number for each of hard_push, push, as cost_limit has, "
            "found push",
        ),
    ):
        ppo = SMALL.replace(multiplier=multiplier, cost_limit=limits)
        with pytest.raises(ConfigError, match=message):
            check_cost_limit(two_limits(), agent.replace(cost_names=ppo.cost_names), ppo)


def test_a_multiplier_whose_limit_is_0_never_falls() -> None:
    env = probe(Push(name="reward"), most=0.2)
    agent = AGENT.replace(cost_critic=True)
    state = init(env, agent, SMALL, jax.random.key(0))
    window = state.window.replace(count=jnp.array(100))
    none_allowed = SMALL.replace(cost_limit=jnp.array(0.0))
    after = dual_ascent(env, agent, none_allowed, state, window, jnp.array([True]))
    assert float(after.multiplier) == float(state.multiplier)


def test_the_gains_of_pid_lagrangian_act_on_the_excess_and_on_its_growth() -> None:
    env = probe(Push(name="reward"), most=0.2)
    agent = AGENT.replace(cost_critic=True)
    state = init(env, agent, SMALL, jax.random.key(0))
    gains = {"multiplier_proportional": 0.2, "multiplier_derivative": 0.4}
    ppo = SMALL.replace(cost_limit=2.0, multiplier_rate=0.0, **gains)
    # An excess that did not grow has no derivative part.
    for cost, boost in (
        (3, 0.2 * 0.5 + 0.4 * 0.5),
        (3, 0.2 * 0.5),
        (8, 0.2 + 0.4 * 0.5),
        (1, -0.1),
    ):
        episodes = state.window.episodes.replace(violating_steps=jnp.full(100, cost))
        window = state.window.replace(episodes=episodes, count=jnp.array(100))
        state = dual_ascent(env, agent, ppo, state, window, jnp.array([True]))
        expected = float(SMALL.multiplier) * np.exp(boost)
        assert float(price(state)) == pytest.approx(expected, rel=1e-5)
        other = ppo.replace(cost_limit=1.0)
        unchanged = dual_ascent(env, agent, other, state, window, jnp.array([False]))
        assert float(price(unchanged)) == float(price(state))
    integral_only = dual_ascent(env, agent, SMALL, state, state.window, jnp.array([True]))
    assert float(price(integral_only)) == float(integral_only.multiplier)


def test_the_cost_of_an_episode_may_be_its_severity() -> None:
    env = probe(Push(name="reward"), most=0.2).replace(cost="severity")
    agent = AGENT.replace(cost_critic=True)
    state = init(env, agent, SMALL, jax.random.key(0))
    episodes = state.window.episodes.replace(
        violating_steps=jnp.full(100, 3), severity_sum=jnp.full(100, 0.25)
    )
    window = state.window.replace(episodes=episodes, count=jnp.array(100))
    ppo = SMALL.replace(cost_limit=jnp.array(0.5))
    after = dual_ascent(env, agent, ppo, state, window, jnp.array([True]))
    assert float(after.cost_excess) == pytest.approx(-0.5)


@pytest.mark.thorough
def test_a_limit_of_the_severity_lets_small_violations_be() -> None:
    env = probe(Push(name="reward"), most=0.2).replace(cost="severity")
    agent = AGENT.replace(cost_critic=True)
    episode = latter_half(env, agent, SMALL.replace(cost_limit=0.5, multiplier=2.0))
    assert 0.3 < float(episode.severity_sum) < 0.7  # unlimited it is 4
    assert float(episode.violating_steps) > 0.7


def test_the_whole_multiplier_is_the_price_of_the_cost() -> None:
    env = probe(Push(name="reward"), most=0.2)
    agent = AGENT.replace(cost_critic=True)
    state = init(env, agent, SMALL, jax.random.key(0))
    one_update = jax.jit(lambda state: update(env, agent, SMALL, 10, state)[0].params)
    boosted = one_update(state.replace(multiplier_boost=jnp.log(jnp.array(300.0))))
    larger = one_update(state.replace(multiplier=300.0 * state.multiplier))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), boosted, larger)
    plain = one_update(state)
    assert float(jnp.max(jnp.abs(plain["log_std"] - boosted["log_std"]))) > 1e-3


@pytest.mark.thorough
def test_the_kept_networks_are_those_of_training_or_their_average() -> None:
    env = probe(Match(name="reward"))
    plain = train(env)
    averaged = train(env, ppo=SMALL.replace(averaging=0.5))
    assert jax.tree.all(
        jax.tree.map(lambda a, b: bool((a == b).all()), plain.average, plain.params)
    )
    assert jax.tree.all(
        jax.tree.map(lambda a, b: bool((a == b).all()), averaged.params, plain.params)
    )
    few = {
        n: train(env, n, SMALL.replace(averaging=1.0, final_learning_rate=SMALL.learning_rate))
        for n in (1, 2)
    }
    start = init(env, AGENT, SMALL, jax.random.key(0)).params
    expected = jax.tree.map(
        lambda a, b, c: 0.25 * a + 0.25 * b + 0.5 * c, start, few[1].params, few[2].params
    )
    for computed, wanted in zip(
        jax.tree.leaves(few[2].average), jax.tree.leaves(expected), strict=True
    ):
        np.testing.assert_allclose(computed, wanted, atol=1e-5)


def test_numbers_of_devices_that_may_share_a_seed_are_the_common_divisors_and_found_quickly() -> (
    None
):
    assert PPO(num_envs=24, num_steps=64, num_minibatches=2).shares(AGENT) == [
        1,
        2,
        3,
        4,
        6,
        8,
        12,
        24,
    ]
    assert PPO(num_envs=9, num_steps=1, num_minibatches=1).shares(AGENT) == [1, 3, 9]
    many = PPO(num_envs=2**30 - 1, num_steps=1, num_minibatches=1)
    assert many.shares(AGENT)[:4] == [1, 3, 7, 9]
