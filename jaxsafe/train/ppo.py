"""Proximal policy optimisation of one seed, a pure function from training state to training state.

If the agent has a critic of the cost, this is PPO-Lagrangian (Ray, Achiam and Amodei 2019), which
maximises rewards less a multiplier times costs. The multiplier grows while the episodes cost more
than `cost_limit`. Each constraint may have a limit and a multiplier of its own. With further gains
a PID controller moves the multiplier (Stooke, Achiam and Abbeel 2020).

`update` reads like the algorithm: collect a batch, estimate advantages, improve the networks over
some epochs. Seeds, devices and files are the caller's business.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.agents.agent import Agent, Sequences
from jaxsafe.agents.networks import Memory, Params, unroll
from jaxsafe.autoreset import choose
from jaxsafe.devices.backend import accelerated, packing, scan_packed
from jaxsafe.devices.shard import WHOLE, Shard
from jaxsafe.environment import Environment
from jaxsafe.metrics import Episode, accumulate, begin, full_controls
from jaxsafe.rollout import reset_batch, step_or_reset_batch
from jaxsafe.train.hyperparameters import (
    MULTIPLIERS,
    PPO,
    discount,
    learning_rate,
    longest_training_episode,
    on_the_way,
)
from jaxsafe.train.recent_episodes import Window, empty_window, latest_cost, push
from jaxsafe.train.shuffle import shuffle
from jaxsafe.types import Key, Record, State, TimeStep

CHUNK = 512
"""Number of samples that a CPU takes through the networks at once.

The activations of this many samples stay in a core's cache.
"""

MAX_LOG_RATIO = 20.0
"""Largest logarithm of the ratio of new to old probabilities. A larger ratio is taken as e²⁰.

Where a ratio overflows, the loss or its gradient is not a number. This bound also leaves room for
the squares in the norm of the gradient.
"""

Diagnostics = dict[str, Array]
"""Numbers that describe how an update learns, by column of the progress log."""

LOSSES = (
    "policy_loss",
    "value_loss",
    "cost_value_loss",
    "entropy",
    "approx_kl",
    "clip_fraction",
    "grad_norm",
)
"""Diagnostics that are averages over the minibatch steps of an update."""

DIAGNOSTICS = (*LOSSES, "explained_variance", "learning_rate", "gamma", "action_std")
"""All diagnostics, in the order of the progress log.

Only an agent with a critic of the cost has `cost_value_loss`.
"""


class TrainState(Record):
    """Everything that training needs to go on. A checkpoint holds it."""

    params: Params
    optimizer: optax.OptState
    env_state: State  # [num_envs]
    observation: Float[Array, "num_envs o"]
    episode: Episode  # sums of the running episodes, [num_envs]
    memory: Mapping[str, Memory]
    """What each network remembers of the running episodes, [num_envs, …], or `()` for nothing."""
    window: Window  # the latest finished episodes
    key: Key
    """Key of the whole run. Update i uses fold_in(key, i)."""
    num_updates: Int[Array, ""]
    average: Params
    """Average of the networks over the latest updates. It is evaluated and kept."""
    multiplier: Any = ()
    """Multiplier of the cost, or of each of the agent's `cost_names` [c], with PPO-Lagrangian.

    It is the part that the integral gain moves. `price` returns the whole multiplier.
    """
    multiplier_boost: Any = ()
    """What the other gains add to the multiplier's logarithm, in the shape of `multiplier`."""
    cost_excess: Any = ()
    """The latest excess of the cost as a share of its limit, in the shape of `multiplier`."""


class Transition(NamedTuple):
    """One step of every environment, stacked [num_steps, num_envs]."""

    inputs: Float[Array, "t n i"]  # what the actor saw
    totals: Mapping[str, Float[Array, "t n"]]
    """The sum of each reward term before the step, if the critic sees it."""
    action: Array
    log_prob: Float[Array, "t n"]
    reward: Float[Array, "t n"]
    terminated: Bool[Array, "t n"]
    done: Bool[Array, "t n"]
    next_inputs: Float[Array, "t n i"]
    """Inputs of the true next observation, before any reset."""
    episode: Episode  # sums including this step
    cost: Any = ()
    """The cost of the step, if there is a critic of it. With `cost_names` it is [t, n, c]."""


class Batch(NamedTuple):
    """The samples of an update, with what the loss needs of each."""

    inputs: Array
    totals: Mapping[str, Array]
    action: Array
    log_prob: Array
    advantage: Array
    value_target: Array
    cost_target: Any = ()
    """(1 − γ) times the discounted cost to come, if there is a critic of it, as in `Transition`."""
    weight: Any = ()
    """The weight of each sample, with `complete_episodes`. The mean over the whole batch is 1."""
    sequences: Sequences | None = None
    """Memories and ends of episodes, if a network is recurrent. Samples are sequences [n, t, …]."""


def by_axes(whole: Any, split: Any) -> TrainState:
    """Return a `TrainState` with one of two values in each field, such as two shardings.

    Args:
        whole: the value of fields that all devices of a seed have whole.
        split: the value of fields with an axis of environments. Each device that shares the
            environments of a seed has the entries of its own environments.
    """
    names = {field.name for field in dataclasses.fields(TrainState)}
    by_environment = {"env_state", "observation", "episode", "memory"}
    return TrainState(**{name: split if name in by_environment else whole for name in names})


def init(env: Environment, agent: Agent, ppo: PPO, key: Key, shard: Shard = WHOLE) -> TrainState:
    """Return the state of one seed with fresh networks and episodes.

    Args:
        env: the environment.
        agent: the agent.
        ppo: the hyperparameters.
        key: the key of the seed.
        shard: the part of the environments that this device has.
    """
    key_params, key_reset, key_run = jax.random.split(key, 3)
    params = agent.init(key_params, env)
    env = on_the_way(env, ppo, 0.0)
    env_state, timestep = reset_batch(env, key_reset, ppo.num_envs, shard)
    episode = begin(timestep, cost_names=agent.cost_names, measure=env.measure)
    multiplier: Any = ()
    no_excess: Any = ()
    if agent.cost_critic:
        shape = (len(agent.cost_names),) if agent.cost_names else ()
        multiplier = jnp.broadcast_to(_by_name(ppo.multiplier, agent.cost_names), shape)
        no_excess = jnp.zeros_like(multiplier)
    return TrainState(
        params=params,
        optimizer=_optimizer(ppo).init(params),
        env_state=env_state,
        observation=timestep.observation,
        episode=episode,
        memory=_fresh_memory(agent, timestep.observation.shape[0]),
        window=empty_window(episode),
        key=key_run,
        num_updates=jnp.zeros((), jnp.int32),
        average=params,
        multiplier=multiplier,
        multiplier_boost=no_excess,
        cost_excess=no_excess,
    )


def _fresh_memory(agent: Agent, num_envs: int) -> dict[str, Memory]:
    """Return what the networks remember at the start of episodes, [num_envs, …]."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (num_envs, *x.shape)), agent.memory())


def update(
    env: Environment,
    agent: Agent,
    ppo: PPO,
    total_updates: Array | int,
    state: TrainState,
    shard: Shard = WHOLE,
) -> tuple[TrainState, Diagnostics]:
    """Collect one batch with the current policy, and improve policy and value on it.

    Devices that share the environments share the work. Each runs its own environments and takes its
    part of every minibatch.

    Args:
        env: the environment.
        agent: the agent.
        ppo: the hyperparameters.
        total_updates: number of updates of the whole training. Schedules run over it.
        state: the state before the update.
        shard: the part of the environments that this device has.

    Returns:
        The state after the update, and the diagnostics of the update.
    """
    key_collect, key_learn = jax.random.split(jax.random.fold_in(state.key, state.num_updates))
    progress = state.num_updates / total_updates
    env = on_the_way(env, ppo, progress)
    if ppo.complete_episodes:
        key_start, key_collect = jax.random.split(key_collect)
        state = _start_afresh(env, agent, ppo, state, key_start, shard)
    memory = state.memory
    state, transitions = collect(env, agent, ppo, state, key_collect, shard)
    gamma = discount(ppo, progress)
    step_size = learning_rate(ppo, progress)
    counts = _counts(env, ppo, transitions) if ppo.complete_episodes else None
    state, batch, explained = _to_batch(
        agent, ppo, gamma, state, transitions, memory, counts, shard
    )
    params, optimizer, losses = learn(env, agent, ppo, step_size, state, batch, key_learn, shard)
    params = {**params, "log_std": params["log_std"] - ppo.noise_decay / total_updates}
    episode, done, counts = shard.join((transitions.episode, transitions.done, counts), axis=1)
    window = push(state.window, episode, done, counts)
    if agent.cost_critic:
        state = dual_ascent(env, agent, ppo, state, window, done)
    share = 1.0 / jnp.maximum(ppo.averaging * total_updates, 1.0)
    average = jax.tree.map(
        lambda old, new: (1.0 - share) * old + share * new, state.average, params
    )
    state = state.replace(
        params=params,
        optimizer=optimizer,
        window=window,
        num_updates=state.num_updates + 1,
        average=average,
    )
    diagnostics = {
        **losses,
        "explained_variance": explained,
        "learning_rate": step_size,
        "gamma": gamma,
        "action_std": action_std(params),
    }
    dtype = jnp.result_type(float)
    return state, {name: jnp.asarray(value, dtype) for name, value in diagnostics.items()}


def _start_afresh(
    env: Environment, agent: Agent, ppo: PPO, state: TrainState, key: Key, shard: Shard
) -> TrainState:
    """Return the state with a fresh start in every environment."""
    env_state, timestep = reset_batch(env, key, ppo.num_envs, shard)
    return state.replace(
        env_state=env_state,
        observation=timestep.observation,
        episode=begin(timestep, cost_names=agent.cost_names, measure=env.measure),
        memory=_fresh_memory(agent, timestep.observation.shape[0]),
    )


def _counts(env: Environment, ppo: PPO, transitions: Transition) -> Bool[Array, "t n"]:
    """Return which steps are part of an episode that counts.

    Whether an episode counts follows from its first step alone. If short episodes counted because
    they ended in time, the policy would learn to end its episodes.
    """
    steps = jnp.arange(ppo.num_steps)[:, None]
    first = steps + 1 - transitions.episode.length
    longest = longest_training_episode(env, ppo)
    return first.astype(longest.dtype) + longest <= ppo.num_steps


def no_diagnostics(agent: Agent) -> Diagnostics:
    """Return the diagnostics of an update that does not take place. All are NaN."""
    names = [name for name in DIAGNOSTICS if name != "cost_value_loss" or agent.cost_critic]
    return {name: jnp.full((), jnp.nan) for name in names}


def action_std(params: Params) -> Array:
    """Return the standard deviation of the actions, averaged over the actuators.

    Actions are in units of half their range. For discrete actions it is the standard deviation that
    an untrained network would give at the present sharpness, because the spread of a trained one
    differs from state to state.
    """
    return jnp.mean(jnp.exp(params["log_std"]))


def explained_variance(target: Array, value: Array, weight: Array | tuple = ()) -> Array:
    """Return the share of the targets' variance that the values explain.

    It is 1 for a perfect critic, and 0 for a critic whose value is the same in all states. Samples
    may have weights, whose mean is 1.
    """
    return 1.0 - _variance(target - value, weight) / _variance(target, weight)


def _mean(values: Array, weight: Array | tuple) -> Array:
    """Return the mean of samples. They may have weights, whose mean over the whole batch is 1."""
    return jnp.mean(values if isinstance(weight, tuple) else weight * values)


def _variance(values: Array, weight: Array | tuple) -> Array:
    if isinstance(weight, tuple):
        return jnp.var(values)
    return _mean((values - _mean(values, weight)) ** 2, weight)


def diverged(state: TrainState) -> Bool[Array, ""]:
    """Return whether the networks, or the returns of the latest episodes, are no longer finite.

    From then on nothing more is learnt.
    """
    # One vector compiles to fewer loops than an array for each parameter.
    watched, _ = ravel_pytree((state.params, state.window.episodes.episode_return))
    return ~jnp.all(jnp.isfinite(watched))


def dual_ascent(
    env: Environment, agent: Agent, ppo: PPO, state: TrainState, window: Window, done: Array
) -> TrainState:
    """Return the state with its multiplier λ after an update. It changes only if episodes ended.

    Its logarithm rises by rate·e, where e = clip(J_C/limit − 1, −1, 1) and J_C is the mean cost of
    the latest finished episodes. The rule acts on the logarithm, because what a violating step is
    worth in reward differs by orders of magnitude between tasks. A multiplier whose limit is 0
    never falls: its logarithm rises by the rate while there is any cost.

    The other gains of a PID controller add K_P·e + K_D·max(0, e − e') to the logarithm, where e' is
    the excess before the update.

    Args:
        env: the environment.
        agent: the agent. Each of its `cost_names` has a limit, or one number is the limit of all.
        ppo: the hyperparameters.
        state: the state before the update.
        window: the latest finished episodes, including those of this update.
        done: whether episodes ended, by step and environment.
    """
    limit = _by_name(ppo.cost_limit, agent.cost_names)
    episodes = window.episodes
    costs = episodes.severity_sum if env.cost == "severity" else episodes.violating_steps
    if agent.cost_names:
        costs = jnp.stack([episodes.costs[name] for name in agent.cost_names], axis=-1)
    cost = latest_cost(window, costs)
    excess = jnp.clip(cost / limit - 1.0, -1.0, 1.0)
    excess = jnp.where(limit > 0.0, excess, jnp.sign(cost))
    following = state.multiplier * jnp.exp(ppo.multiplier_rate * excess)
    following = jnp.clip(following, *MULTIPLIERS)
    growth = jnp.maximum(excess - state.cost_excess, 0.0)
    boost = ppo.multiplier_proportional * excess + ppo.multiplier_derivative * growth
    known = jnp.any(done)
    return state.replace(
        multiplier=jnp.where(known, following, state.multiplier),
        multiplier_boost=jnp.where(known, boost, state.multiplier_boost),
        cost_excess=jnp.where(known, excess, state.cost_excess),
    )


def _by_name(numbers: Any, names: Sequence[str]) -> Array:
    """Return the number of each constraint [c] in the order of `names`, or the number of all."""
    if not isinstance(numbers, Mapping):
        return jnp.asarray(numbers)
    return jnp.stack([jnp.asarray(numbers[name]) for name in names])


def price(state: TrainState) -> Array:
    """Return the multiplier of the cost, or of each constraint that has one [c]."""
    return state.multiplier * jnp.exp(state.multiplier_boost)


def collect(
    env: Environment, agent: Agent, ppo: PPO, state: TrainState, key: Key, shard: Shard = WHOLE
) -> tuple[TrainState, Transition]:
    """Run every environment for `num_steps`. Episodes go on from one update to the next.

    Args:
        env: the environment.
        agent: the agent.
        ppo: the hyperparameters.
        state: the state.
        key: a PRNG key.
        shard: the part of the environments that this device has.

    Returns:
        The state with the environments after these steps, and the transitions.
    """
    start = (state.env_state, state.observation, state.episode, state.memory["actor"])
    fresh_memory = _fresh_memory(agent, state.observation.shape[0])["actor"]
    full = full_controls(env)

    def one_step(
        carry: tuple[State, Array, Episode, Memory], key: Key
    ) -> tuple[tuple[State, Array, Episode, Memory], Transition]:
        env_state, observation, episode, memory = carry
        key_act, key_reset = jax.random.split(key)
        inputs = agent.inputs(env, observation)
        totals = env_state.reward_totals if agent.critic_sees_totals else {}
        policy, memory = agent.distribution_step(env, state.params, inputs, memory)
        action = policy.sample(key_act, shard)
        (env_state, observation), timestep = step_or_reset_batch(
            env, env_state, action, key_reset, ppo.max_episode_steps, shard
        )
        if ppo.learns_from == "actual":
            action = _acted(env, action, timestep)
        done = timestep.done
        episode = accumulate(episode, timestep, full)
        transition = Transition(
            inputs=inputs,
            totals=totals,
            action=action,
            log_prob=policy.log_prob(action),
            reward=timestep.reward,
            terminated=timestep.terminated,
            done=done,
            next_inputs=agent.inputs(env, timestep.observation),
            episode=episode,
            cost=_costs(agent, timestep) if agent.cost_critic else (),
        )
        return (
            env_state,
            observation,
            jax.tree.map(lambda x: jnp.where(done, jnp.zeros_like(x), x), episode),
            choose(done, fresh_memory, memory),
        ), transition

    scan = scan_packed if accelerated() else jax.lax.scan
    end, transitions = scan(one_step, start, jax.random.split(key, ppo.num_steps))
    env_state, observation, episode, actor_memory = end
    state = state.replace(
        env_state=env_state,
        observation=observation,
        episode=episode,
        memory={**state.memory, "actor": actor_memory},
    )
    return state, transitions


def _costs(agent: Agent, timestep: TimeStep) -> Float[Array, "n ..."]:
    """Return the cost of the step [n], or that of each of the agent's `cost_names` [n, c]."""
    if not agent.cost_names:
        return timestep.cost
    return jnp.stack([timestep.costs[name] for name in agent.cost_names], axis=-1)


def _acted(env: Environment, action: Array, timestep: TimeStep) -> Array:
    """Return the actions to learn from.

    Where run time assurance intervened, they are the actions that give the actual control.
    """
    controller: Any = env.agent_platform.controller
    acted = jax.vmap(controller.action)(timestep.info.control_actual)
    return jnp.where(timestep.info.intervening[:, None], acted, action)


def gae(
    reward: Array,
    value: Array,
    next_value: Array,
    terminated: Array,
    done: Array,
    gamma: Array,
    lam: Array,
) -> Array:
    """Return generalised advantage estimates along the leading axis (Schulman et al. 2016).

    δ_t = r_t + γ V(s_{t+1})(1 − terminated_t) − V(s_t),  A_t = δ_t + γλ(1 − done_t) A_{t+1}

    V(s_{t+1}) is the value of the state that the step led to, before any reset. So an episode that
    is truncated, or still running at the end of the batch, counts what would follow. An episode
    that terminated does not.

    Args:
        reward: rewards r [t, …].
        value: values V(s_t) [t, …].
        next_value: values V(s_{t+1}) [t, …].
        terminated: whether the task ended with the step, [t, …].
        done: whether the episode ended with the step, terminated or truncated, [t, …].
        gamma: the discount factor γ.
        lam: λ of the estimates.
    """
    terminated = terminated.astype(reward.dtype)
    done = done.astype(reward.dtype)
    delta = reward + gamma * next_value * (1.0 - terminated) - value

    def backward(following: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        delta_t, done_t = now
        advantage = delta_t + gamma * lam * (1.0 - done_t) * following
        return advantage, advantage

    return jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, done), reverse=True)[1]


def learn(
    env: Environment,
    agent: Agent,
    ppo: PPO,
    step_size: Array,
    state: TrainState,
    batch: Batch,
    key: Key,
    shard: Shard = WHOLE,
) -> tuple[Params, optax.OptState, Diagnostics]:
    """Take some epochs of minibatch steps. Each epoch has a new shuffle of the batch.

    Args:
        env: the environment.
        agent: the agent.
        ppo: the hyperparameters.
        step_size: the learning rate.
        state: the state. It holds the parameters and the optimizer's state before the first step.
        batch: the samples of all devices of the seed.
        key: a PRNG key.
        shard: the part of every minibatch that this device takes.

    Returns:
        The parameters and the optimizer's state after the last step, and the diagnostics in
        `LOSSES`.
    """
    pack, unpack = packing(state.params)
    names = [name for name in LOSSES if name != "cost_value_loss" or agent.cost_critic]

    def gradient(params: Params, rows: Array) -> tuple[Params, Array]:
        samples = jax.tree.map(lambda x: x[rows], batch)
        direction, terms = jax.grad(loss, has_aux=True)(params, env, agent, ppo, samples)
        # One vector compiles to fewer loops than a number for each term.
        return direction, jnp.stack([terms[name] for name in names if name in terms])

    def mean_gradient(params: Params, rows: Array) -> tuple[Params, Array]:
        parts = 1 if agent.recurrent else _num_chunks(rows.size)
        if parts == 1:
            return gradient(params, rows)

        def add(total: Params, part: Array) -> tuple[Params, Array]:
            summand, losses = gradient(params, part)
            return jax.tree.map(jnp.add, total, summand), losses

        zero = jax.tree.map(jnp.zeros_like, params)
        total, losses = jax.lax.scan(add, zero, rows.reshape(parts, -1))
        return jax.tree.map(lambda x: x / parts, total), jnp.mean(losses, axis=0)

    def minibatch_step(
        carry: tuple[Params, optax.OptState], rows: Array
    ) -> tuple[tuple[Params, optax.OptState], Array]:
        params, optimizer = carry
        gradient, losses = shard.mean(mean_gradient(unpack(params), shard.own(rows)))
        # Adam of optax raises a float to an integer power.
        with jax.numpy_dtype_promotion("standard"):
            step, optimizer = _optimizer(ppo).update(gradient, optimizer)
        # The optimizer takes the norm of the same vector, so XLA computes it once.
        losses = jnp.append(losses, optax.tree.norm(ravel_pytree(gradient)[0]))
        params = jax.tree.map(lambda p, s: p - step_size * s, params, pack(step))
        return (params, optimizer), losses

    def epoch(
        carry: tuple[Params, optax.OptState], key: Key
    ) -> tuple[tuple[Params, optax.OptState], Array]:
        rows = shuffle(key, ppo.rows(agent)).reshape(ppo.num_minibatches, -1)
        scan = scan_packed if accelerated() else jax.lax.scan
        return scan(minibatch_step, carry, rows)

    start = (pack(state.params), state.optimizer)
    keys = jax.random.split(key, ppo.num_epochs)
    (params, optimizer), losses = jax.lax.scan(epoch, start, keys)
    means = jnp.mean(losses, axis=(0, 1))
    return unpack(params), optimizer, dict(zip(names, means, strict=True))


def loss(
    params: Params, env: Environment, agent: Agent, ppo: PPO, batch: Batch
) -> tuple[Array, Diagnostics]:
    """Return the clipped surrogate loss + value error − entropy bonus, averaged over the batch.

    This is minus the objective of PPO (Schulman et al. 2017). Samples count by their weights, if
    they have any. The second value has the terms of the loss, and how far the policy is from the
    one that collected the batch.
    """
    mean = partial(_mean, weight=batch.weight)
    policy = agent.distribution(env, params, batch.inputs, batch.sequences)
    log_ratio = policy.log_prob(batch.action) - batch.log_prob
    bounded = jax.lax.stop_gradient(jnp.minimum(log_ratio, MAX_LOG_RATIO))
    # The term in brackets is 0 and has the derivative.
    ratio = jnp.exp(bounded + (log_ratio - jax.lax.stop_gradient(log_ratio)))
    clipped = jnp.clip(ratio, 1.0 - ppo.clip, 1.0 + ppo.clip)
    surrogate = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    seen = agent.critic_inputs(batch.inputs, batch.totals)
    value = agent.critic_output("critic", params, seen, batch.sequences)
    value_error = 0.5 * (value - batch.value_target) ** 2
    entropy = policy.entropy()
    outside = jnp.abs(ratio - 1.0) > ppo.clip
    # Without the barrier XLA fuses the gradient in another way, which changes the last bits.
    alone = jax.lax.optimization_barrier(jax.lax.stop_gradient(policy))
    terms = {
        "policy_loss": -mean(surrogate),
        "value_loss": mean(value_error),
        "entropy": mean(alone.entropy()),
        # Never negative, and of less variance than the mean of −bounded (Schulman 2020).
        "approx_kl": mean(ratio - 1.0 - bounded),
        "clip_fraction": mean(outside.astype(ratio.dtype)),
    }
    if agent.cost_critic:
        rate = agent.critic_output("cost_critic", params, seen, batch.sequences)
        cost_error = _over_costs(agent, 0.5 * (rate - batch.cost_target) ** 2)
        terms["cost_value_loss"] = mean(cost_error)
        value_error += cost_error
    total = mean(
        -surrogate + ppo.value_coefficient * value_error - ppo.entropy_coefficient * entropy
    )
    return total, terms


def _to_batch(
    agent: Agent,
    ppo: PPO,
    gamma: Array,
    state: TrainState,
    transitions: Transition,
    memory: Mapping[str, Memory],
    counts: Bool[Array, "t n"] | None,
    shard: Shard = WHOLE,
) -> tuple[TrainState, Batch, Array]:
    """Return the samples to learn from, with advantages and targets of the critics.

    Advantages are normalised over the whole batch.

    Args:
        agent: the agent.
        ppo: the hyperparameters.
        gamma: the discount factor.
        state: the state after the transitions.
        transitions: the transitions.
        memory: what the networks remembered before the transitions.
        counts: which transitions count. None stands for all.
        shard: the part of the environments that this device has.

    Returns:
        The state, in which the critics remember the transitions. The samples of all devices along
        the first axis: a sample is one step, or all steps of an environment if a network remembers.
        The explained variance of the critic on the whole batch.
    """
    t = transitions
    seen = agent.critic_inputs(t.inputs, t.totals)
    next_seen = agent.critic_inputs(t.next_inputs, t.episode.reward_totals)
    judge = partial(_judge, agent, state.params, seen=seen, next_seen=next_seen, done=t.done)
    value, next_value, critic_memory = judge("critic", memory["critic"])
    after = {**state.memory, "critic": critic_memory}
    advantage = gae(t.reward, value, next_value, t.terminated, t.done, gamma, ppo.gae_lambda)
    target = advantage + value
    cost_target = ()
    if agent.cost_critic:
        rate, next_rate, after["cost_critic"] = judge("cost_critic", memory["cost_critic"])
        terminated, done = t.terminated, t.done
        if agent.cost_names:
            terminated, done = terminated[..., None], done[..., None]
        cost_advantage = gae(
            (1.0 - gamma) * t.cost, rate, next_rate, terminated, done, gamma, ppo.gae_lambda
        )
        cost_target = cost_advantage + rate
        advantage -= _over_costs(agent, price(state) * cost_advantage / (1.0 - gamma))
    part = Batch(
        inputs=t.inputs,
        totals=t.totals,
        action=t.action,
        log_prob=t.log_prob,
        advantage=advantage,
        value_target=target,
        cost_target=cost_target,
    )
    if counts is not None:
        part = part._replace(weight=counts.astype(value.dtype))
    done = t.done if agent.recurrent else ()
    batch, value, done = shard.join((part, value, done), axis=1)
    if counts is not None:
        share = jnp.maximum(jnp.mean(batch.weight), 1e-8)
        batch = batch._replace(weight=batch.weight / share)
    explained = explained_variance(batch.value_target, value, batch.weight)
    centred = batch.advantage - _mean(batch.advantage, batch.weight)
    std = jnp.sqrt(_variance(batch.advantage, batch.weight))
    batch = batch._replace(advantage=centred / (std + 1e-8))
    state = state.replace(memory=after)
    if not agent.recurrent:
        batch = jax.tree.map(lambda x: x.reshape(ppo.batch_size, *x.shape[2:]), batch)
        return state, batch, explained
    batch, done = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (batch, done))
    sequences = Sequences(memory=shard.join(dict(memory)), done=done)
    return state, batch._replace(sequences=sequences), explained


def _over_costs(agent: Agent, values: Array) -> Array:
    """Return the sum of values over the agent's `cost_names`, which are the last axis if any."""
    return jnp.sum(values, axis=-1) if agent.cost_names else values


def _judge(
    agent: Agent,
    params: Params,
    name: str,
    memory: Memory,
    seen: Float[Array, "t n c"],
    next_seen: Float[Array, "t n c"],
    done: Bool[Array, "t n"],
) -> tuple[Float[Array, "t n ..."], Float[Array, "t n ..."], Memory]:
    """Return the output of a critic for each state, and for its successor before any reset.

    Args:
        agent: the agent.
        params: the parameters.
        name: the critic, `critic` or `cost_critic`.
        memory: what the critic remembers before the first step, [num_envs, …].
        seen: what the critic sees of each state.
        next_seen: what the critic sees of the successor of each state.
        done: whether the episode ended with the step.

    Returns:
        Both outputs, and what the critic remembers after the last step.
    """
    network = agent.networks[name]
    if not network.recurrent:
        critic = partial(agent.critic_output, name, params)
        return _in_chunks(critic, seen), _in_chunks(critic, next_seen), memory

    def step(memory: Memory, inputs: tuple[Array, Array]) -> tuple[Memory, tuple[Array, Array]]:
        now, following = inputs
        value, memory = agent.critic_step(name, params, now, memory)
        # This memory is dropped, because the critic goes on from the state after any reset.
        next_value, _ = agent.critic_step(name, params, following, memory)
        return memory, (value, next_value)

    sequences = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), ((seen, next_seen), done))
    memory, outputs = unroll(step, memory, network.memory(), *sequences)
    value, next_value = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), outputs)
    return value, next_value, memory


def _in_chunks(
    critic: Callable[[Array], Array], seen: Float[Array, "t n c"]
) -> Float[Array, "t n ..."]:
    """Return the output of a critic for each sample. On a CPU it sees `CHUNK` samples at a time."""
    t, n, size = seen.shape
    parts = _num_chunks(t * n)
    if parts == 1:
        return critic(seen)
    outputs = jax.lax.map(critic, seen.reshape(parts, -1, size))
    return outputs.reshape(t, n, *outputs.shape[2:])


def _num_chunks(samples: int) -> int:
    """Return the number of parts in which this many samples go through the networks."""
    return 1 if accelerated() or samples % CHUNK else samples // CHUNK


def _optimizer(ppo: PPO) -> optax.GradientTransformation:
    """Return gradient clipping, then Adam's direction. The step size comes from the schedule."""
    return optax.flatten(
        optax.chain(optax.clip_by_global_norm(ppo.max_grad_norm), optax.scale_by_adam(eps=1e-5))
    )
