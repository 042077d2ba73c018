from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats

import jaxsafe
from jaxsafe.agents.agent import Agent, num_outputs
from jaxsafe.agents.distributions import Categorical, Gaussian, Joint
from jaxsafe.agents.features import DockingFeatures
from jaxsafe.schema.component import normalise

KEY = jax.random.key(3)


def test_the_gaussian_agrees_with_scipy() -> None:
    mean = jax.random.normal(KEY, (5, 3))
    log_std = jnp.array([-0.7, 0.0, 0.4])
    policy = Gaussian(mean=mean, log_std=log_std)
    action = policy.sample(jax.random.key(1))
    reference = scipy.stats.norm(np.asarray(mean), np.exp(np.asarray(log_std)))
    np.testing.assert_allclose(
        policy.log_prob(action), reference.logpdf(np.asarray(action)).sum(-1), rtol=1e-5
    )
    np.testing.assert_allclose(
        policy.entropy(), np.broadcast_to(reference.entropy(), (5, 3)).sum(-1), rtol=1e-5
    )
    np.testing.assert_array_equal(policy.mode(), mean)


def test_gaussian_samples_have_the_stated_distribution() -> None:
    policy = Gaussian(mean=jnp.full((4000, 1), 0.3), log_std=jnp.array([-0.5]))
    sample = np.asarray(policy.sample(KEY))[:, 0]
    assert scipy.stats.kstest(sample, scipy.stats.norm(0.3, np.exp(-0.5)).cdf).pvalue > 0.001


def test_the_factored_categorical_agrees_with_the_product_of_its_factors() -> None:
    logits = jax.random.normal(KEY, (6, 5))
    policy = Categorical(logits=logits, points=(2, 3))
    first = jax.nn.softmax(logits[:, :2])
    second = jax.nn.softmax(logits[:, 2:])
    action = policy.sample(jax.random.key(1))
    rows = np.arange(6)
    expected = np.log(
        np.asarray(first)[rows, action[:, 0]] * np.asarray(second)[rows, action[:, 1]]
    )
    np.testing.assert_allclose(policy.log_prob(action), expected, rtol=1e-5)
    entropy = scipy.stats.entropy(np.asarray(first), axis=1) + scipy.stats.entropy(
        np.asarray(second), axis=1
    )
    np.testing.assert_allclose(policy.entropy(), entropy, rtol=1e-5)
    np.testing.assert_array_equal(policy.mode()[:, 1], jnp.argmax(logits[:, 2:], axis=1))


def test_categorical_samples_have_the_stated_frequencies() -> None:
    logits = jnp.tile(jnp.log(jnp.array([0.2, 0.3, 0.5])), (6000, 1))
    counts = np.bincount(
        np.asarray(Categorical(logits=logits, points=(3,)).sample(KEY))[:, 0], minlength=3
    )
    assert scipy.stats.chisquare(counts, 6000 * np.array([0.2, 0.3, 0.5])).pvalue > 0.001


def test_a_joint_distribution_is_the_product_of_its_parts() -> None:
    normal = Gaussian(mean=jax.random.normal(KEY, (6, 2)), log_std=jnp.array([-0.7, 0.4]))
    logits = jax.random.normal(jax.random.key(1), (6, 5))
    policy = Joint(
        normal=normal, choices=Categorical(logits=logits, points=(2, 3)), points=(2, 0, 3, 0)
    )
    action = np.asarray(policy.sample(jax.random.key(2)))
    assert action.shape == (6, 4)
    first, second = (scipy.special.softmax(part, axis=1) for part in (logits[:, :2], logits[:, 2:]))
    chosen = action[:, [0, 2]].astype(int)
    np.testing.assert_array_equal(action[:, [0, 2]], chosen)
    reference = scipy.stats.norm(np.asarray(normal.mean), np.exp(np.asarray(normal.log_std)))
    rows = np.arange(6)
    choices = np.log(first[rows, chosen[:, 0]] * second[rows, chosen[:, 1]])
    expected = reference.logpdf(action[:, [1, 3]]).sum(-1) + choices
    np.testing.assert_allclose(policy.log_prob(action), expected, rtol=1e-5)
    entropy = np.broadcast_to(reference.entropy(), (6, 2)).sum(-1)
    entropy = entropy + sum(scipy.stats.entropy(part, axis=1) for part in (first, second))
    np.testing.assert_allclose(policy.entropy(), entropy, rtol=1e-5)
    np.testing.assert_array_equal(policy.mode()[:, 1], normal.mean[:, 0])
    np.testing.assert_array_equal(policy.mode()[:, 2], jnp.argmax(logits[:, 2:], axis=1))


def test_outputs_of_a_mixed_actor_belong_to_the_actuators_in_their_order() -> None:
    thrust_y = "deputy.controller.actuators.thrust_y"
    env = jaxsafe.make(
        "docking2d", {f"{thrust_y}.discrete": True, f"{thrust_y}.points": 3}, actions="mixed"
    )
    assert num_outputs(env) == 4
    agent = normalise(Agent(log_std=-1.2, prior_std=0.3))
    params = jax.eval_shape(lambda: agent.init(KEY, env))
    assert params["log_std"].shape == (2,)
    first = agent._first_log_std(env)
    np.testing.assert_allclose(first, [-1.2, np.log(0.3)], rtol=1e-6)
    out = jnp.array([0.5, 1.0, 2.0, 4.0])
    policy = agent._head(env, {"log_std": first}, out)
    assert isinstance(policy, Joint)
    np.testing.assert_array_equal(policy.normal.mean, [0.5])
    # The sharpness is 1 at the start, and a prior makes the middle likely.
    np.testing.assert_allclose(
        policy.choices.logits, [1.0 - 0.5 / 0.09, 2.0, 4.0 - 0.5 / 0.09], rtol=1e-5
    )


@pytest.mark.thorough
@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_an_untrained_policy_is_centred_and_as_wide_as_configured(actions: str) -> None:
    env = jaxsafe.make("docking2d", actions=actions)  # type: ignore[arg-type]
    agent = normalise(Agent(features=DockingFeatures(), log_std=-1.2, prior_std=0.3))
    params = agent.init(KEY, env)
    _, timestep = env.reset(KEY)
    act = lambda key: agent.act(env, params, key, timestep.observation, False)[0]  # noqa: E731
    actions_drawn = jax.vmap(act)(jax.random.split(KEY, 2000))
    pushes = (
        np.asarray(actions_drawn) / 5.0 - 1.0
        if actions == "discrete"
        else np.asarray(actions_drawn)
    )
    assert abs(pushes.mean()) < 0.05
    assert pushes.std() == pytest.approx(0.3, abs=0.02)


@pytest.mark.thorough
def test_a_smaller_log_std_sharpens_the_choice_of_its_actuator_and_leaves_the_mode() -> None:
    env = jaxsafe.make(
        "docking2d", {"deputy.controller.actuators.thrust_x.points": 5}, actions="discrete"
    )
    agent = normalise(Agent(prior_std=0.4))
    params = agent.init(KEY, env)
    params = {**params, "actor": jax.tree.map(lambda x: 20.0 * x, params["actor"])}
    inputs = jax.random.normal(jax.random.key(1), (50, 6))
    wide = agent.distribution(env, params, inputs)
    narrow = agent.distribution(
        env, {**params, "log_std": params["log_std"] - jnp.array([0.0, 0.5])}, inputs
    )
    np.testing.assert_array_equal(wide.mode(), narrow.mode())
    assert isinstance(wide, Categorical)
    assert isinstance(narrow, Categorical)
    np.testing.assert_allclose(narrow.logits[:, :5], wide.logits[:, :5], rtol=1e-6)
    np.testing.assert_allclose(narrow.logits[:, 5:], np.exp(1.0) * wide.logits[:, 5:], rtol=1e-5)
    assert np.all(narrow.entropy() < wide.entropy())


def test_the_critic_sees_the_totals_in_any_order_and_the_actor_does_not() -> None:
    env = jaxsafe.make("docking2d")
    blind = Agent()
    seeing = Agent(critic_sees_totals=True)
    inputs = jnp.arange(6.0)
    totals = {term.name: jnp.array(float(i)) for i, term in enumerate(env.reward)}
    np.testing.assert_array_equal(blind.critic_inputs(inputs, totals), inputs)
    seen = seeing.critic_inputs(inputs, totals)
    np.testing.assert_array_equal(
        seen, seeing.critic_inputs(inputs, dict(reversed(totals.items())))
    )
    np.testing.assert_array_equal(np.sort(seen[6:]), np.arange(len(env.reward)))
    shapes = jax.tree.map(jnp.shape, [normalise(agent).init(KEY, env) for agent in (blind, seeing)])
    assert shapes[0]["actor"] == shapes[1]["actor"]
    rows = [shape["critic"]["hidden_0"]["kernel"][0] for shape in shapes]
    assert rows[1] == rows[0] + len(env.reward)


def test_networks_of_many_seeds_are_orthogonalised_one_by_one_with_the_same_numbers() -> None:
    """Orthogonalising many networks at once has hung, see `_orthogonal`."""
    env = jaxsafe.make("docking2d")
    agent = normalise(Agent(features=DockingFeatures()))

    def init(key: jax.Array) -> Any:
        return agent.init(key, env)

    keys = jax.random.split(jax.random.key(0), 3)
    shapes = [
        list(value.aval.shape)
        for jaxpr in _inner(jax.make_jaxpr(jax.vmap(init))(keys).jaxpr)
        for equation in jaxpr.eqns
        if equation.primitive.name in ("geqrf", "qr", "householder_product")
        for value in equation.outvars
    ]
    assert shapes
    assert max(len(shape) for shape in shapes) == 2
    many = jax.jit(jax.vmap(init))(keys)
    one = jax.jit(init)(keys[1])  # compiled as well, because operations one by one round otherwise
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[1], b, atol=1e-6), many, one)


def _inner(jaxpr: Any) -> Iterator[Any]:
    yield jaxpr
    for equation in jaxpr.eqns:
        for value in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from _inner(inner)
