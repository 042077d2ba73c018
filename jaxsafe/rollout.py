"""Episodes that run back to back: automatic reset, batches of environments, and scans over time."""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, overload

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsafe.autoreset import choose, renew
from jaxsafe.devices.shard import WHOLE, Shard
from jaxsafe.environment import Environment, require_environment, reset, step
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.types import Key, Record, State, TimeStep, Transition, require_key

Policy = Callable[[Key, Array], Array]
"""`policy(key, observation)` returns an action. Both are batched if the environments are."""

RECORDS = ("timesteps", "transitions", "states")
"""What `rollout` can record."""


@dataclass(frozen=True, eq=False)
class RecurrentPolicy:
    """A policy that remembers.

    It can stand wherever a policy is run step by step. Its memory starts again with each episode.
    """

    act: Callable[[Key, Array, Any], tuple[Array, Any]]
    """`act(key, observation, memory)` returns an action and the memory after it.

    All are batched if the environments are.
    """
    memory: Any
    """What the policy remembers at the start of an episode, without batch axes."""


def first_memory(policy: Policy | RecurrentPolicy, num_envs: int | None = None) -> Any:
    """Return the memory of a policy at the start of episodes. It is `()` if it has none.

    Args:
        policy: the policy.
        num_envs: number of environments, which is the leading axis of the memory. None is one
            environment without a batch axis.
    """
    if not isinstance(policy, RecurrentPolicy):
        return ()
    batch = () if num_envs is None else (num_envs,)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, batch + jnp.shape(x)), policy.memory)


def act(
    policy: Policy | RecurrentPolicy, key: Key, observation: Array, memory: Any
) -> tuple[Array, Any]:
    """Return the action of a policy, and the memory of the policy after it.

    Raises:
        ConfigError: a `RecurrentPolicy` returns no pair, or a memory of another shape.
    """
    with _policy_hints(policy, observation):
        if not isinstance(policy, RecurrentPolicy):
            return policy(key, observation), memory
        returned = policy.act(key, observation, memory)
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise ConfigError(
            f"policy: expected an action and the memory after it, found {show(returned)}"
        )
    before, after = (jax.tree.map(jnp.shape, tree) for tree in (memory, returned[1]))
    if before != after:
        raise ConfigError(
            f"policy: expected a memory of shape {show(before)} after each action, as before it, "
            f"found {show(after)}"
        )
    return returned


@contextmanager
def _policy_hints(policy: Policy | RecurrentPolicy, observation: Array) -> Iterator[None]:
    """Add a note to every error inside that names the policy and says what it must be like.

    A compiled program does not contain it, because it runs only while the program is traced.
    """
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:
        if isinstance(error, jax.errors.JAXTypeError):
            hint = "it is compiled, so write jnp in place of np, and jnp.where in place of if"
        elif jnp.ndim(observation) > 1:
            hint = (
                f"it gets a batch, observations of shape {jnp.shape(observation)}; "
                "for a policy of one observation, write jax.vmap around it"
            )
        else:
            hint = f"it gets a key and an observation of shape {jnp.shape(observation)}"
        function = policy.act if isinstance(policy, RecurrentPolicy) else policy
        name = getattr(function, "__qualname__", type(function).__name__)
        error.add_note(f"in the policy {function.__module__}:{name}: {hint}")
        raise


class RolloutState(Record):
    """The end of a rollout, from which another rollout can go on.

    With a batch of environments every array has a leading axis of that size.
    """

    state: State
    observation: Float[Array, " observation"]
    memory: Any  # what a `RecurrentPolicy` remembers, else `()`


@overload
def rollout(
    env: Environment,
    policy: Policy | RecurrentPolicy,
    key: Key,
    num_steps: int,
    num_envs: int | None = None,
    *,
    record: Literal["timesteps"] = "timesteps",
    start: RolloutState | None = None,
) -> TimeStep: ...


@overload
def rollout(
    env: Environment,
    policy: Policy | RecurrentPolicy,
    key: Key,
    num_steps: int,
    num_envs: int | None = None,
    *,
    record: Literal["transitions", "states"],
    start: RolloutState | None = None,
) -> tuple[RolloutState, Transition]: ...


def rollout(
    env: Environment,
    policy: Policy | RecurrentPolicy,
    key: Key,
    num_steps: int,
    num_envs: int | None = None,
    *,
    record: str = "timesteps",
    start: RolloutState | None = None,
) -> TimeStep | tuple[RolloutState, Transition]:
    """Run a policy for a number of steps. A fresh random start follows every finished episode.

    The time step that ends an episode holds the episode's true last observation. The policy acts
    next on the observation of the new start, which is not part of the time steps.

    For `jax.jit`, `policy`, `num_steps`, `num_envs` and `record` are static arguments.

    Args:
        env: the environment.
        policy: `policy(key, observation)` returns an action. With `num_envs` both have a leading
            axis of that size. It may be a `RecurrentPolicy`.
        key: a typed PRNG key.
        num_steps: number of steps in each environment.
        num_envs: number of environments side by side. None is one environment without a batch axis.
            With `start` it may be left out.
        record: what to return. `timesteps` are what the environment returns. `transitions` are what
            a learner needs: they also hold the observation that was acted on, and the action.
            `states` are transitions that hold the state before each step too.
        start: where to begin, as an earlier call with `record="transitions"` returned it. None
            stands for fresh random starts.

    Returns:
        The time steps, stacked [num_steps] or [num_steps, num_envs]. With another `record` a pair:
        the `RolloutState` after the last step, and the transitions, stacked alike.

    Raises:
        ConfigError: `num_steps` or `num_envs` is not a whole number or is too small, `record` is
            unknown, `start` is not a `RolloutState` or has a batch of another size, the key is a
            plain number, the policy is no function, or the actions have another shape.
    """
    require_environment("rollout: env", env)
    require_count("rollout: num_steps", num_steps, least=0)
    if num_envs is not None:
        require_count("rollout: num_envs", num_envs, least=1)
    require_key("rollout: key", key)
    require_policy(policy)
    if record not in RECORDS:
        raise ConfigError(
            f"rollout: record: unknown record {show(record)}{choices_text(record, RECORDS)}"
        )
    if start is not None:
        num_envs = _num_envs(start, num_envs)
    key_start, key_run = jax.random.split(key)
    start_memory = first_memory(policy, num_envs)
    if start is not None:
        carry = (start.state, start.observation, start.memory)
        if num_envs is not None:
            carry = (*_move_batch((start.state, start.observation), 0, -1), start.memory)
    else:
        if num_envs is None:
            state, timestep = reset(env, key_start)
        else:
            state, timestep = reset_batch(env, key_start, num_envs, axis=-1)
        carry = (state, timestep.observation, start_memory)

    def one_step(carry: tuple[State, Array, Any], key: Key) -> tuple[Any, Any]:
        state, observation, memory = carry
        key_policy, key_reset = jax.random.split(key)
        if num_envs is None:
            action, next_memory = act(policy, key_policy, observation, memory)
            after, timestep = step_or_reset(env, state, action, key_reset)
        else:
            action, next_memory = act(policy, key_policy, observation.T, memory)
            require_batch(env, action, num_envs)
            after, timestep = step_or_reset_batch(env, state, action.T, key_reset, axis=-1)
        carry = (*after, choose(timestep.done, start_memory, next_memory))
        if record == "timesteps":
            return carry, (timestep, ())
        seen = (observation, state if record == "states" else None)
        return carry, ((timestep, *seen), (action, memory))

    # The axis of the environments is the last one in `moved` and the first one in `acted`.
    carry, (moved, acted) = jax.lax.scan(one_step, carry, jax.random.split(key_run, num_steps))
    if num_envs is not None:
        moved = _move_batch(moved, -1, 1)
    if record == "timesteps":
        return moved
    state, observation, memory = carry
    if num_envs is not None:
        state, observation = _move_batch((state, observation), -1, 0)
    end = RolloutState(state=state, observation=observation, memory=memory)
    return end, _transition(*moved, *acted)


def _transition(
    timestep: TimeStep, observation: Array, state: State | None, action: Array, memory: Any
) -> Transition:
    return Transition(
        observation=observation,
        action=action,
        reward=timestep.reward,
        cost=timestep.cost,
        costs=timestep.costs,
        terminated=timestep.terminated,
        truncated=timestep.truncated,
        next_observation=timestep.observation,
        memory=memory,
        info=timestep.info,
        state=state,
    )


def _move_batch(tree: Any, source: int, destination: int) -> Any:
    """Move the axis of the environments in all leaves."""
    return jax.tree.map(lambda x: jnp.moveaxis(x, source, destination), tree)


def _num_envs(start: Any, num_envs: int | None) -> int | None:
    """Return the number of environments in the start of a rollout, None without a batch axis.

    Raises:
        ConfigError: `start` is not a `RolloutState`, or `num_envs` is another number.
    """
    if not isinstance(start, RolloutState):
        raise ConfigError(
            "rollout: start: expected the RolloutState that an earlier rollout returned, "
            f"found {show(start)}"
        )
    batch_size = start.observation.shape[0] if jnp.ndim(start.observation) > 1 else None
    if num_envs not in (None, batch_size):
        raise ConfigError(
            f"rollout: num_envs: expected {batch_size or 'nothing'} as in start, found {num_envs}"
        )
    return batch_size


def require_batch(env: Environment, action: Array, num_envs: int) -> None:
    """Refuse what is not one action for each observation of a batch.

    Raises:
        ConfigError: the shape of `action` is not (num_envs, env.action_size).
    """
    shape = jnp.shape(action)
    expected = (num_envs, env.action_size)
    if shape != expected:
        names = ", ".join(env.action_names)
        advice = (
            "; for a policy of one observation, write jax.vmap around it"
            if shape == expected[1:]
            else ""
        )
        raise ConfigError(
            f"policy: expected actions of shape {expected}, one ({names}) for each of "
            f"{num_envs} observations, found {shape}{advice}"
        )


def require_policy(policy: Policy | RecurrentPolicy) -> None:
    """Refuse what cannot be called, such as the name of a policy that is to be loaded first.

    Raises:
        ConfigError: it is neither a function nor a `RecurrentPolicy`, or it takes another number of
            arguments.
    """
    if not callable(policy) and not isinstance(policy, RecurrentPolicy):
        hint = f"; write jaxsafe.load_policy({show(policy)})" if isinstance(policy, str) else ""
        raise ConfigError(
            f"policy: expected a function of a key and an observation, found {show(policy)}{hint}"
        )
    function, arguments = (
        (policy.act, ("key", "observation", "memory"))
        if isinstance(policy, RecurrentPolicy)
        else (policy, ("key", "observation"))
    )
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # some callables that are not written in Python have none
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        name = getattr(function, "__name__", type(function).__name__)
        raise ConfigError(
            f"policy: expected a function of ({', '.join(arguments)}), found {name}{signature}"
        ) from None


def require_hashable(policy: Policy | RecurrentPolicy) -> None:
    """Refuse a policy that has no hash, because its compiled program could not be kept.

    Raises:
        ConfigError: the policy is no function or has no hash. Equinox modules with arrays have
            none.
    """
    require_policy(policy)
    try:
        hash(policy)
    except TypeError:
        kind = type(policy).__name__
        raise ConfigError(
            f"policy: expected a function, found {kind}, which has no hash; "
            "write lambda key, observation: … around it"
        ) from None


def require_count(place: str, value: Any, least: int) -> None:
    """Refuse a number of steps, environments or episodes that is not a whole number ≥ `least`.

    Without this check XLA would say so in many lines, or run no environment at all.

    Args:
        place: where the number was given. The message begins with it.
        value: the number.
        least: the smallest number that is allowed.

    Raises:
        ConfigError: the number is not a whole number, or is too small.
    """
    try:
        enough = operator.index(value) >= least
    except TypeError:
        enough = False
    if not enough:
        raise ConfigError(f"{place}: expected a whole number ≥ {least}, found {show(value)}")


def step_or_reset(
    env: Environment, state: State, action: Array, key: Key
) -> tuple[tuple[State, Array], TimeStep]:
    """Take one step. Where it ends the episode, the next state is a fresh start.

    Args:
        env: the environment.
        state: the state before the step.
        action: the action, as `step` takes it.
        key: a typed PRNG key for the start.

    Returns:
        The next state with the observation to act on, and the time step that was taken, which
        holds the observation that the step led to.
    """
    state, timestep = step(env, state, action)
    return restarted(env, state, timestep, key), timestep


def restarted(env: Environment, state: State, timestep: TimeStep, key: Key) -> tuple[State, Array]:
    """Return the state and the observation from which to go on after a time step.

    Where the time step ended the episode, they are those of a fresh start.
    """
    fresh_state, fresh = reset(env, key)
    return choose(timestep.done, (fresh_state, fresh.observation), (state, timestep.observation))


def reset_batch(
    env: Environment, key: Key, num_envs: int, shard: Shard = WHOLE, axis: Literal[0, -1] = 0
) -> tuple[State, TimeStep]:
    """Draw independent random starts of a batch of environments.

    Args:
        env: the environment.
        key: a typed PRNG key.
        num_envs: number of environments in the whole batch.
        shard: the part of the batch that this device has. Only its starts are returned.
        axis: the axis of the environments in all leaves, the first or the last.

    Returns:
        What `reset` returns, for each environment.
    """
    size = num_envs // shard.count
    return draw_starts(env, key, shard.first(size) + jnp.arange(size), axis)


def draw_starts(
    env: Environment,
    key: Key,
    indices: Int[Array, " n"],
    axis: Literal[0, -1] = 0,
    start: Callable[[Environment, Key], tuple[State, TimeStep]] = reset,
) -> tuple[State, TimeStep]:
    """Draw the starts of some environments of a batch, each from a key of its own.

    Args:
        env: the environment.
        key: a typed PRNG key of the batch.
        indices: the indices of the environments.
        axis: the axis of the environments in all leaves, the first or the last.
        start: what draws a start, as `reset` does.

    Returns:
        What `reset` returns, for each environment.
    """
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, indices)
    return jax.vmap(start, in_axes=(None, 0), out_axes=axis)(env, keys)


def step_or_reset_batch(
    env: Environment,
    state: State,
    action: Array,
    key: Key,
    max_episode_steps: Array | float = jnp.inf,
    shard: Shard = WHOLE,
    axis: Literal[0, -1] = 0,
) -> tuple[tuple[State, Array], TimeStep]:
    """Take one step in a batch of environments, and draw starts only where episodes end.

    Args:
        env: the environment.
        state: the states before the step.
        action: the actions.
        key: a typed PRNG key for the starts.
        max_episode_steps: number of actions after which an episode that is still running is
            truncated, without an outcome.
        shard: the part of the batch that this device has.
        axis: the axis of the environments in everything that goes in and comes out. With −1 it is
            the last one, [3, num_envs] for a position, and a CPU steps many environments faster.

    Returns:
        What `step_or_reset` returns, for each environment.
    """
    state, timestep = jax.vmap(step, in_axes=(None, axis, axis), out_axes=axis)(env, state, action)
    timestep = cut_short(env, state, timestep, max_episode_steps)
    first = shard.first(action.shape[axis])

    def draw(parameters: tuple[Environment, Key, Array], indices: Array) -> tuple[State, Array]:
        env, key, first = parameters
        fresh_state, fresh = draw_starts(env, key, first + indices, axis)
        return fresh_state, fresh.observation

    carry = renew(
        timestep.done,
        draw,
        parameters=(env, key, first),
        old=(state, timestep.observation),
        axis=axis,
    )
    return carry, timestep


def cut_short(
    env: Environment, state: State, timestep: TimeStep, max_episode_steps: Array | float
) -> TimeStep:
    """Return the time step, truncated if its episode runs on after `max_episode_steps` actions."""
    dtype = jnp.result_type(float)
    actions = state.num_steps.astype(dtype)
    if env.decision_period > 1:
        actions = actions / env.decision_period
    cut = ~timestep.done & (actions >= jnp.asarray(max_episode_steps, dtype))
    return timestep.replace(truncated=timestep.truncated | cut)
