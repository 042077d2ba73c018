"""Values and derivatives are finite where they are hard to define.

These are the points where a norm, a quotient or a root has none of its own.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind, thorough

import jaxsafe
from jaxsafe.agents.agent import Agent
from jaxsafe.agents.features import ApproachFeatures, DockingFeatures, Features
from jaxsafe.agents.networks import MLP
from jaxsafe.agents.policy_file import find_policy, read_policy
from jaxsafe.envs import TASKS
from jaxsafe.schema.component import normalise
from jaxsafe.train.hyperparameters import PPO
from jaxsafe.train.ppo import Batch, loss

DOCKING = {
    "at the chief": {"position": 0.0, "velocity": 0.1},
    "at rest": {"position": 20.0, "velocity": 0.0},
    "at rest at the chief": {"position": 0.0, "velocity": 0.0},
    "along an axis": {"position": (20.0, 0.0, 0.0), "velocity": (-0.1, 0.0, 0.0)},
}
REJOIN = {
    "at the lead": {"position": 0.0},
    "with the lead's velocity": {"position": (-400.0, 300.0, 0.0)},
    "across": {"position": (-400.0, 300.0, 0.0), "heading": jnp.pi / 2},
    "against it": {"position": (400.0, 0.0, 0.0), "heading": jnp.pi},
}


def starts(task: str, env: jaxsafe.Environment) -> dict[str, dict[str, Any]]:
    """Return the starts of a task at which something is zero or has no direction."""

    def full(platform: str, **given: Any) -> dict[str, jax.Array]:
        rest = vars(env.platform(platform).rest())
        drawn = [initializer.name for initializer in env.platform(platform).start]

        def vector(value: Any, like: jax.Array) -> jax.Array:
            return (
                jnp.asarray(value)[: like.size] if np.ndim(value) else jnp.full(like.shape, value)
            )

        return {name: vector(given.get(name, 0.0), rest[name]) for name in drawn}

    if task.startswith("docking"):
        return {name: {"deputy": full("deputy", **given)} for name, given in DOCKING.items()}
    lead = full("lead", speed=250.0)
    return {
        name: {"lead": lead, "wingman": full("wingman", **{"speed": 250.0, **given})}
        for name, given in REJOIN.items()
    }


def assert_finite(tree: Any, what: str) -> None:
    for path, leaf in jax.tree.leaves_with_path(tree):
        assert bool(jnp.isfinite(leaf).all()), f"{what}: {jax.tree_util.keystr(path)}"


@pytest.mark.parametrize("task", one_of_each_kind(TASKS, ["docking3d"]))
def test_an_episode_has_derivatives_wherever_it_may_be(task: str) -> None:
    saved = read_policy(find_policy(task))
    env = saved.env
    act = saved.agent.policy(saved.env, saved.params, True)

    def numbers(start: Any) -> list[jax.Array]:
        state, before = jaxsafe.reset_to(env, start)
        _, timestep = jaxsafe.step(env, state, act(jax.random.key(0), before.observation))
        info = timestep.info
        seen = (
            before.observation,
            timestep.observation,
            timestep.reward,
            info.margins,
            info.severity,
            info.status,
        )
        return [leaf.astype(float) for leaf in jax.tree.leaves(seen)]

    def total(start: Any) -> jax.Array:
        return jnp.sum(jnp.stack([jnp.sum(leaf) for leaf in numbers(start)]))

    computed = jax.jit(lambda start: (numbers(start), jax.grad(total)(start)))
    for name, start in starts(task, env).items():
        assert_finite(computed(start), f"{task} {name}")


@pytest.mark.parametrize("task", one_of_each_kind(TASKS))
def test_a_policy_has_a_value_and_a_jacobian_for_every_observation(task: str) -> None:
    policy = jaxsafe.load_policy(task)
    size = read_policy(find_policy(task)).env.observation_size
    function = jax.jit(
        lambda o: (
            policy(jax.random.key(0), o),
            jax.jacrev(lambda o: policy(jax.random.key(0), o))(o),
        )
    )
    for observation in (jnp.zeros(size), jnp.ones(size), *jnp.eye(size)):
        assert_finite(function(observation), task)


@pytest.mark.parametrize("features", [DockingFeatures(), ApproachFeatures()])
def test_features_are_those_of_the_plain_norm_bit_for_bit(features: Features) -> None:
    env = jaxsafe.make("docking3d")
    position = jax.random.normal(jax.random.key(0), (100, 3))
    rest = jax.random.uniform(jax.random.key(1), (100, env.observation_size - 3), minval=0.1)
    inputs = features(env, jnp.concatenate([position, rest], axis=1))
    distance = jnp.linalg.norm(position, axis=-1, keepdims=True)
    start = env.observation_size
    np.testing.assert_array_equal(inputs[:, start : start + 3], position / (distance + 0.01))
    np.testing.assert_array_equal(inputs[:, start + 3 : start + 4], jnp.log(distance + 0.005))


loss_and_gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))

OLD_LOG_PROB = [-90.0, -1e30, 0.0, 90.0, 1e30, -25.0, -0.5]


@pytest.mark.thorough
@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("advantage", [1.0, -1.0])
@pytest.mark.parametrize("old", one_of_each_kind(OLD_LOG_PROB, [-1e30, 0.0, 90.0]))
def test_the_loss_and_its_gradient_are_finite_however_far_the_policies_are_apart(
    old: float, advantage: float, discrete: bool
) -> None:
    env = jaxsafe.make("docking2d", actions="discrete" if discrete else "continuous")
    agent = normalise(Agent(actor=MLP(hidden=(4,))))
    ppo = normalise(PPO())
    params = agent.init(jax.random.key(0), env)
    action = jnp.zeros((1, 2), int if discrete else float)
    batch = Batch(
        jnp.zeros((1, 6)), {}, action, jnp.full(1, old), jnp.full(1, advantage), jnp.zeros(1)
    )
    computed = loss_and_gradient(params, env, agent, ppo, batch)
    assert_finite(computed, f"{old}, {advantage}")
    (_, terms), _ = computed
    assert terms["approx_kl"] >= 0.0


@pytest.mark.parametrize("old", [thorough(-90.0), -1e30])
def test_a_bad_action_that_became_far_likelier_is_still_made_less_likely(old: float) -> None:
    env = jaxsafe.make("docking2d")
    agent = normalise(Agent(actor=MLP(hidden=(4,))))
    ppo = normalise(PPO())
    params = agent.init(jax.random.key(0), env)
    action = jnp.array([[0.5, -0.5]])

    def log_prob(params: Any) -> jax.Array:
        return agent.distribution(env, params, jnp.ones((1, 6))).log_prob(action)[0]

    batch = Batch(jnp.ones((1, 6)), {}, action, jnp.array([old]), jnp.array([-1.0]), jnp.zeros(1))
    (value, _), gradient = loss_and_gradient(params, env, agent, ppo, batch)
    assert float(value) > 1e8
    towards = jax.grad(log_prob)(params)["actor"]
    product = jax.tree.map(lambda a, b: jnp.sum(a * b), gradient["actor"], towards)
    # A step down the gradient lowers the probability.
    assert float(jax.tree.reduce(jnp.add, product)) > 0.0


@pytest.mark.thorough
@pytest.mark.parametrize("old", [thorough(-10.0), -1.0, thorough(0.3)])
def test_ordinary_ratios_are_what_they_were(old: float) -> None:
    env = jaxsafe.make("docking2d")
    agent = normalise(Agent(actor=MLP(hidden=(4,))))
    ppo = normalise(PPO())
    params = agent.init(jax.random.key(0), env)
    key = jax.random.key(1)
    action = jax.random.normal(key, (50, 2))
    batch = Batch(
        jnp.ones((50, 6)),
        {},
        action,
        jnp.full(50, old),
        jax.random.normal(key, (50,)),
        jnp.zeros(50),
    )

    def plain(params: Any) -> jax.Array:
        policy = agent.distribution(env, params, batch.inputs)
        ratio = jnp.exp(policy.log_prob(batch.action) - batch.log_prob)
        clipped = jnp.clip(ratio, 1.0 - ppo.clip, 1.0 + ppo.clip)
        surrogate = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
        value_error = 0.5 * (agent.value(params, batch.inputs) - batch.value_target) ** 2
        return jnp.mean(
            -surrogate
            + ppo.value_coefficient * value_error
            - ppo.entropy_coefficient * policy.entropy()
        )

    (value, _), gradient = jax.value_and_grad(loss, has_aux=True)(params, env, agent, ppo, batch)
    computed = (value, gradient)
    jax.tree.map(np.testing.assert_array_equal, computed, jax.value_and_grad(plain)(params))
