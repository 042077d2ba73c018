"""The agent: features of the observation, networks, and a distribution over actions.

One network is the actor and another the critic. Parameters are nested dicts of arrays, so a policy
file is an .npz of them. The features belong to the agent: the environment's observation is the
paper's in every preset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import broadcast_to_rank
from jaxtyping import Array, Bool, Float

from jaxsafe.agents.distributions import Categorical, Distribution, action_distribution
from jaxsafe.agents.features import Features, PlainFeatures
from jaxsafe.agents.networks import (
    MLP,
    Directional,
    Memory,
    Network,
    Normal,
    Params,
    from_one_draw,
    unroll,
)
from jaxsafe.control.law import ControlLaw
from jaxsafe.environment import Environment
from jaxsafe.rollout import Policy, RecurrentPolicy
from jaxsafe.schema.component import ANY, Component, Range, Unit
from jaxsafe.schema.errors import ConfigError, show, summarise_error
from jaxsafe.schema.user_modules import modules
from jaxsafe.types import Dimensionless, Key, Number


class Sequences(NamedTuple):
    """What recurrent networks need to know of the sequences that they see."""

    memory: dict[str, Memory]
    """The memory of each network before the first step, `[n, …]`."""
    done: Bool[Array, "n t"]
    """Whether the episode ended with the step."""


class Agent(Component):
    """Actor and critic, which share nothing.

    Their inputs and outputs follow from the spaces of the environment.
    """

    field_word: ClassVar[str] = "option"

    actor: Network = MLP()
    """The network that decides the actions: mlp, directional, gru or one of your own."""
    critic: Network | None = None
    """The network of each critic. None stands for one like the actor's."""
    features: Features = PlainFeatures()
    """What the networks see of the observation."""
    controller: ControlLaw | None = None
    """A control law whose action the actor corrects: align, pd, pursuit or one of your own.

    The mean of the policy is the law's action plus the actor's outputs (residual policy learning,
    Silver et al. 2018). The networks see the law's action before the features.
    """
    log_std: Annotated[Number, Unit("1", length=ANY), Range(largest=20.0)] = -0.7
    """Initial logarithm of the standard deviation of continuous actions in [−1, 1].

    It is one number, or one for each action. It is learnt, and the same for all states.
    """
    prior_std: Annotated[Dimensionless, Range(0.0, open_low=True, smallest=1e-6, largest=1e6)] = 0.3
    """Standard deviation of discrete actions at the start, in units of half the range.

    Its logarithm is the initial log_std of each actuator, which is learnt as for continuous
    actions. A smaller log_std makes the choice sharper in all states.
    """
    critic_sees_totals: bool = False
    """Whether the critic also sees the sum of each reward term in the episode so far.

    What a term will still pay may depend on its sum, which the observation does not show. The
    policy never sees the sums. The critic may, because only training needs it.
    """
    cost_critic: bool = False
    """Whether a second critic estimates the future cost. `algorithm=ppo_lagrangian` sets it."""
    cost_names: tuple[str, ...] = ()
    """The constraints whose costs the second critic estimates, one output each.

    Without any it has one output, for the cost of the step. A `cost_limit` or a `ppo.multiplier`
    with names sets it.
    """

    @property
    def networks(self) -> dict[str, Network]:
        """The networks by name: `actor`, `critic`, and `cost_critic` if there is one."""
        critic = self.actor.like_critic if self.critic is None else self.critic
        networks = {"actor": self.actor, "critic": critic}
        return {**networks, "cost_critic": critic} if self.cost_critic else networks

    @property
    def recurrent(self) -> bool:
        """Whether any network remembers, so that training needs whole sequences of steps."""
        return any(network.recurrent for network in self.networks.values())

    def memory(self) -> dict[str, Memory]:
        """Return what the networks remember at the start of an episode, by name."""
        return {name: network.memory() for name, network in self.networks.items()}

    def init(self, key: Key, env: Environment) -> Params:
        """Return fresh parameters: those of each network by name, and `log_std` `[actuators]`.

        Args:
            key: a PRNG key.
            env: the environment. Its spaces decide the sizes of inputs and outputs.
        """
        arguments = self._first_arguments(env)
        keys = [jax.random.fold_in(key, index) for index in range(len(arguments))]

        def build(normal: Normal) -> Params:
            return {
                name: self.networks[name].init(own_key, normal, self._module(name, env), *inputs)
                for own_key, (name, inputs) in zip(keys, arguments.items(), strict=True)
            }

        params = from_one_draw(key, build)
        return {**params, "log_std": jnp.broadcast_to(self._first_log_std(env), env.action_size)}

    def _first_log_std(self, env: Environment) -> Array:
        """Return the initial log_std, one number or one for each actuator."""
        if env.action_kind == "continuous":
            return jnp.asarray(self.log_std)
        if env.action_kind == "discrete":
            return jnp.log(self.prior_std)
        choices = np.array(env.num_action_points) > 0
        return jnp.where(choices, jnp.log(self.prior_std), jnp.asarray(self.log_std))

    def first_outputs(self, env: Environment) -> dict[str, Array]:
        """Return the outputs of fresh networks for an observation of zeros, by name."""
        params = self.init(jax.random.key(0), env)
        outputs = {}
        for name, inputs in self._first_arguments(env).items():
            returned = self._apply(name, env, params, *inputs)
            outputs[name] = returned[1] if self.networks[name].recurrent else returned
        return outputs

    def _first_arguments(self, env: Environment) -> dict[str, tuple]:
        """Return arguments with which the module of each network can be called, by name."""
        inputs = self.inputs(env, jnp.zeros(env.observation_size))
        totals = {term.name: jnp.zeros(()) for term in env.reward}
        arguments = {}
        for name, network in self.networks.items():
            seen = inputs if name == "actor" else self.critic_inputs(inputs, totals)
            arguments[name] = (network.memory(), seen) if network.recurrent else (seen,)
        return arguments

    def inputs(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch i"]:
        """Return what the networks see of observations `[*batch, o]`: inputs `[*batch, i]`.

        Raises:
            ConfigError: the environment does not observe what the features need.
        """
        features = self.features(env, observation)
        if self.controller is None:
            return features
        action = self.controller.policy(env).observed_action(observation)
        return jnp.concatenate([action, features], axis=-1)

    def distribution(
        self,
        env: Environment,
        params: Params,
        inputs: Float[Array, "*batch i"],
        sequences: Sequences | None = None,
    ) -> Distribution:
        """Return the policy, a distribution over actions.

        Args:
            env: the environment.
            params: the parameters.
            inputs: what `inputs` returns, `[*batch, i]`. For a recurrent actor they are sequences
                `[n, t, i]`.
            sequences: what else a recurrent actor needs to know of the sequences.
        """
        out = self._outputs("actor", env, params, inputs, sequences)
        return self._head(env, params, self._corrected(env, inputs, out))

    def distribution_step(
        self, env: Environment, params: Params, inputs: Float[Array, "*batch i"], memory: Memory
    ) -> tuple[Distribution, Memory]:
        """Return the policy for one step, and what the actor remembers after it.

        Args:
            env: the environment.
            params: the parameters.
            inputs: what `inputs` returns, `[*batch, i]`.
            memory: what the actor remembers before it, `[*batch, …]`.
        """
        if not self.actor.recurrent:
            return self.distribution(env, params, inputs), memory
        memory, outputs = self._apply("actor", env, params, memory, inputs)
        return self._head(env, params, self._corrected(env, inputs, outputs)), memory

    def _corrected(
        self, env: Environment, inputs: Float[Array, "*batch i"], out: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch o"]:
        """Return the outputs of the actor, added to the action of the law if there is one."""
        return out if self.controller is None else out + inputs[..., : env.action_size]

    def _head(
        self, env: Environment, params: Params, out: Float[Array, "*batch o"]
    ) -> Distribution:
        """Return the distribution over actions that the outputs of the actor stand for."""
        return action_distribution(env.num_action_points, out, params["log_std"], self._choices)

    def _choices(
        self, out: Float[Array, "*batch points"], log_std: Array, points: tuple[int, ...]
    ) -> Categorical:
        """Return the distribution over discrete actions that the outputs of the actor stand for.

        Args:
            out: the outputs.
            log_std: one number for each actuator, which decides how sharp its choice is.
            points: the number of choices of each actuator.
        """
        # An actuator has one sharpness, which is repeated below for each of its logits.
        sharpness = (self.prior_std * jnp.exp(-log_std)) ** 2
        sharpness = jnp.sum(
            sharpness[:, None] * np.repeat(np.eye(len(points), dtype=np.float32), points, axis=1),
            axis=0,
        )
        prior = broadcast_to_rank(_prior(points, self.prior_std), out.ndim)
        return Categorical(
            logits=broadcast_to_rank(sharpness, out.ndim) * (out + prior), points=points
        )

    def critic_inputs(
        self, inputs: Float[Array, "*batch i"], reward_totals: Mapping[str, Float[Array, "*batch"]]
    ) -> Float[Array, "*batch c"]:
        """Return what the critic sees: the inputs of the actor, and perhaps the totals.

        Args:
            inputs: the inputs of the actor, `[*batch, i]`.
            reward_totals: the sum of each reward term in the episode so far, `[*batch]` each. The
                critic sees them with `critic_sees_totals`.
        """
        # The totals are sorted by name, because the order of a dict does not survive compilation.
        seen = sorted(reward_totals) if self.critic_sees_totals else ()
        return jnp.concatenate(
            [inputs, *(reward_totals[name][..., None] for name in seen)], axis=-1
        )

    def value(
        self, params: Params, critic_inputs: Float[Array, "*batch c"]
    ) -> Float[Array, "*batch"]:
        """Return the critic's V(s) `[*batch]`, given what `critic_inputs` returns."""
        return self.critic_output("critic", params, critic_inputs)

    def critic_output(
        self,
        name: str,
        params: Params,
        critic_inputs: Float[Array, "*batch c"],
        sequences: Sequences | None = None,
    ) -> Float[Array, "*batch"]:
        """Return the output of a critic `[*batch]`.

        The output of `cost_critic` is (1 − γ)·V_C(s), the average cost of a step from here on. With
        `cost_names` it is that of each constraint, `[*batch, c]`.

        Args:
            name: `critic` or `cost_critic`.
            params: the parameters.
            critic_inputs: what `critic_inputs` returns, `[*batch, c]`. For a recurrent critic they
                are sequences `[n, t, c]`.
            sequences: what else a recurrent critic needs to know of the sequences.
        """
        return self._estimate(name, self._outputs(name, None, params, critic_inputs, sequences))

    def _estimate(
        self, name: str, outputs: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch"] | Float[Array, "*batch o"]:
        """Return the estimates of a critic. A single one has no axis of its own."""
        return outputs if name == "cost_critic" and self.cost_names else outputs[..., 0]

    def critic_step(
        self, name: str, params: Params, critic_inputs: Float[Array, "*batch c"], memory: Memory
    ) -> tuple[Float[Array, "*batch"], Memory]:
        """Return the output of a recurrent critic for one step, and what it remembers after it."""
        memory, outputs = self._apply(name, None, params, memory, critic_inputs)
        return self._estimate(name, outputs), memory

    def act(
        self,
        env: Environment,
        params: Params,
        key: Key,
        observation: Array,
        deterministic: Array | bool,
        memory: Memory = (),
    ) -> tuple[Array, Memory]:
        """Return an action for each observation, and what the actor remembers after it.

        Args:
            env: the environment.
            params: the parameters.
            key: a PRNG key.
            observation: observations `[*batch, o]`.
            deterministic: whether the actions are the mode of the distribution. Otherwise they are
                a sample.
            memory: what the actor remembers before it, `[*batch, …]`.
        """
        inputs = self.inputs(env, observation)
        distribution, memory = self.distribution_step(env, params, inputs, memory)
        action = jax.tree.map(
            lambda mode, sample: jnp.where(deterministic, mode, sample),
            distribution.mode(),
            distribution.sample(key),
        )
        return action, memory

    def policy(
        self, env: Environment, params: Params, deterministic: Array | bool
    ) -> Policy | RecurrentPolicy:
        """Return `act` as a function of key and observation, and of memory if the actor has one."""

        def act(key: Key, observation: Array, memory: Memory = ()) -> tuple[Array, Memory]:
            return self.act(env, params, key, observation, deterministic, memory)

        if self.actor.recurrent:
            return RecurrentPolicy(act, self.actor.memory())
        return lambda key, observation: act(key, observation)[0]

    def _module(self, name: str, env: Environment | None) -> Any:
        """Return the Flax module of a network. Only the actor depends on the environment."""
        network = self.networks[name]
        if name == "actor" and env is not None:
            return network.module(num_outputs(env), 0.01)
        return network.module(self._num_estimates(name), 1.0)

    def _num_estimates(self, name: str) -> int:
        """Return how many outputs a critic has."""
        return len(self.cost_names) or 1 if name == "cost_critic" else 1

    def _apply(self, name: str, env: Environment | None, params: Params, *arguments: Any) -> Any:
        """Return what the module of a network returns."""
        return self._module(name, env).apply({"params": params[name]}, *arguments)

    def _outputs(
        self,
        name: str,
        env: Environment | None,
        params: Params,
        inputs: Float[Array, "*batch i"],
        sequences: Sequences | None,
    ) -> Float[Array, "*batch o"]:
        """Return the outputs of a network for samples, or for whole sequences if it remembers."""
        network = self.networks[name]
        if not network.recurrent:
            return self._apply(name, env, params, inputs)
        if sequences is None:
            raise ConfigError(f"agent: {name} remembers, and so it needs sequences of steps")
        _, outputs = unroll(
            partial(self._apply, name, env, params),
            memory=sequences.memory[name],
            first_memory=network.memory(),
            inputs=inputs,
            done=sequences.done,
        )
        return outputs


def check_agent(agent: Agent, env: Environment, place: str = "agent") -> None:
    """Check that an agent can be built and fits an environment.

    Raises:
        ConfigError: it cannot be built, or does not fit. The message begins with the place.
    """
    for name in ("actor", "critic"):
        network = getattr(agent, name)
        problem = network and network.problem()
        if problem:
            raise ConfigError(f"{place}.{name}.{problem}")
    if isinstance(agent.critic, Directional):
        raise ConfigError(f"{place}.critic: 'directional' is for an actor; choose mlp")
    if isinstance(agent.actor, Directional):
        if env.action_kind != "continuous":
            raise ConfigError(
                f"{place}.actor: 'directional' needs continuous actions, found"
                f" {env.action_kind} ones; choose mlp"
            )
        if agent.actor.vectors != agent.features.num_vectors:
            raise ConfigError(
                f"{place}.actor: 'directional' needs features with {agent.actor.vectors} vectors,"
                f" found {show(agent.features.type_name)} with {agent.features.num_vectors}"
            )
    if agent.controller is not None:
        _check_controller(agent.controller, env, f"{place}.controller")
    count = jnp.size(agent.log_std)
    if count not in (1, env.action_size):
        raise ConfigError(
            f"{place}.log_std: expected one number or {env.action_size}, one for each action, "
            f"found {count}"
        )
    wanted = {name: agent._num_estimates(name) for name in agent.networks}
    wanted["actor"] = num_outputs(env)
    try:
        shapes = jax.eval_shape(lambda: agent.first_outputs(env))
    except ConfigError:
        raise
    except Exception as error:  # JAX and Flax raise many kinds of errors
        reason = summarise_error(error, modules(agent))
        raise ConfigError(f"{place}: does not fit the environment: {reason}") from None
    for name, outputs in shapes.items():
        if getattr(outputs, "shape", None) != (wanted[name],):
            raise ConfigError(
                f"{place}.{name}: expected {wanted[name]} outputs, "
                f"found {getattr(outputs, 'shape', type(outputs).__name__)}"
            )


def _check_controller(law: ControlLaw, env: Environment, place: str) -> None:
    """Check that an actor can correct the actions of a control law.

    Raises:
        ConfigError: it cannot. The message begins with the place.
    """
    if env.action_kind != "continuous":
        raise ConfigError(
            f"{place}: needs continuous actions, found {env.action_kind} ones; leave it out"
        )
    if law.designs:
        raise ConfigError(
            f"{place}: {law.type_name!r} computes gains before it flies, but the numbers of the"
            " environment may change in a training; choose pd, align or pursuit"
        )


def num_outputs(env: Environment) -> int:
    """Return how many outputs the actor has: one for each action or each discrete choice."""
    return sum(count or 1 for count in env.num_action_points) or env.action_size


def _prior(points: Sequence[int], std: Array | float) -> Float[Array, " points"]:
    """Return the constant logits −(u/u_max/std)²/2, with u/u_max from −1 to 1.

    They make an untrained policy nearly a normal distribution of width `std` about 0.
    """
    return jnp.concatenate([-0.5 * (jnp.linspace(-1.0, 1.0, n) / std) ** 2 for n in points])
