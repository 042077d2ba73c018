"""The agent: features of the observation, multilayer perceptrons, and a distribution over actions.

One perceptron is the actor and one the critic. Parameters are a plain dict of arrays, so a policy
file is an .npz of them. The features belong to the agent: the environment's observation is the
paper's in every preset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import broadcast_to_rank
from jaxtyping import Array, Float

from jaxsafe.agents.distributions import Categorical, Gaussian
from jaxsafe.agents.features import FEATURES
from jaxsafe.environment import Environment
from jaxsafe.rollout import Policy
from jaxsafe.schema.component import ANY, Component, Range, Unit
from jaxsafe.types import Dimensionless, Key, Number

Params = dict[str, Any]
"""Parameters of the networks by name, and `log_std` [actuators]."""


class Agent(Component):
    """Actor and critic of the same shape, which share nothing.

    Their inputs and outputs follow from the spaces of the environment.
    """

    hidden: Annotated[tuple[int, ...], Range(1, largest=2**16)] = (64, 64)
    """Sizes of the hidden layers."""
    features: Literal["none", "docking", "approach", "rejoin"] = "none"
    """Name of the features that are appended to the observation."""
    log_std: Annotated[Number, Unit("1", length=ANY), Range(largest=20.0)] = -0.7
    """Initial logarithm of the standard deviation of continuous actions in [−1, 1].

    It is one number, or one for each action. It is learnt, and the same for all states.
    """
    prior_std: Annotated[Dimensionless, Range(0.0, open_low=True, smallest=1e-6, largest=1e6)] = 0.3
    """Standard deviation of discrete actions at the start, in units of half the range.

    Its logarithm is the initial log_std of each actuator. That is learnt like the log_std of
    continuous actions. A smaller one sharpens the choice in all states.
    """
    critic_sees_totals: bool = False
    """Whether the critic also sees what each reward term has summed to in the episode.

    What a term will still pay may depend on its sum, and the observation hides the sum. The policy
    never sees it, because only training needs the critic.
    """
    cost_critic: bool = False
    """Whether a second critic expects the cost to come. `algorithm=ppo_lagrangian` sets it."""

    def init(self, key: Key, env: Environment) -> Params:
        """Return fresh parameters.

        Args:
            key: a PRNG key.
            env: the environment. Its spaces decide the sizes of inputs and outputs.
        """
        inputs = self.inputs(env, jnp.zeros(env.observation_size)).shape[-1]
        outputs = sum(env.num_action_points) or env.action_size
        seen = len(env.reward) if self.critic_sees_totals else 0
        actor, critic = (inputs, *self.hidden, outputs), (inputs + seen, *self.hidden, 1)
        networks = {
            "actor": actor,
            "critic": critic,
            **({"cost_critic": critic} if self.cost_critic else {}),
        }
        normals = iter(
            _normals(key, [shape for sizes in networks.values() for shape in pairwise(sizes)])
        )
        params: Params = {
            name: _layers(
                [next(normals) for _ in pairwise(sizes)], last_gain=0.01 if name == "actor" else 1.0
            )
            for name, sizes in networks.items()
        }
        log_std = jnp.log(self.prior_std) if env.num_action_points else jnp.asarray(self.log_std)
        return {**params, "log_std": jnp.broadcast_to(log_std, env.action_size)}

    def inputs(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch i"]:
        """Return what the networks see of observations `[*batch, o]`: inputs `[*batch, i]`.

        Raises:
            ConfigError: the environment does not observe what the features need.
        """
        return FEATURES[self.features](env, observation)

    def distribution(
        self, env: Environment, params: Params, inputs: Float[Array, "*batch i"]
    ) -> Gaussian | Categorical:
        """Return the policy, a distribution over actions.

        Args:
            env: the environment.
            params: the parameters.
            inputs: what `inputs` returns, `[*batch, i]`.
        """
        out, points = mlp(params["actor"], inputs), env.num_action_points
        if not points:
            return Gaussian(mean=out, log_std=params["log_std"])
        # There is one sharpness for each actuator. Below it is repeated for each of its logits.
        sharpness = (self.prior_std * jnp.exp(-params["log_std"])) ** 2
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
            reward_totals: what each reward term has summed to in the episode, `[*batch]` each. They
                are seen with `critic_sees_totals`.
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
        return mlp(params["critic"], critic_inputs)[..., 0]

    def cost_rate(
        self, params: Params, critic_inputs: Float[Array, "*batch c"]
    ) -> Float[Array, "*batch"]:
        """Return the cost critic's (1 − γ)·V_C(s) `[*batch]`, given what `critic_inputs` returns.

        It is what a step costs on the average from here on, whatever the horizon.
        """
        return mlp(params["cost_critic"], critic_inputs)[..., 0]

    def act(
        self,
        env: Environment,
        params: Params,
        key: Key,
        observation: Array,
        deterministic: Array | bool,
    ) -> Array:
        """Return an action for each observation.

        Args:
            env: the environment.
            params: the parameters.
            key: a PRNG key.
            observation: observations `[*batch, o]`.
            deterministic: whether the actions are the mode of the distribution. Otherwise they are
                a sample.
        """
        distribution = self.distribution(env, params, self.inputs(env, observation))
        return jax.tree.map(
            lambda mode, sample: jnp.where(deterministic, mode, sample),
            distribution.mode(),
            distribution.sample(key),
        )

    def policy(self, env: Environment, params: Params, deterministic: Array | bool) -> Policy:
        """Return `act` as a function of key and observation alone."""
        return lambda key, observation: self.act(env, params, key, observation, deterministic)


def mlp(layers: Sequence[Params], x: Float[Array, "*batch i"]) -> Float[Array, "*batch o"]:
    """Return the output of a perceptron, with tanh between layers and none after the last.

    Args:
        layers: for each layer its `kernel` [inputs, outputs] and `bias` [outputs].
        x: the inputs `[*batch, i]`.
    """
    for layer in layers[:-1]:
        x = jnp.tanh(_affine(layer, x))
    return _affine(layers[-1], x)


def _affine(layer: Params, x: Float[Array, "*batch i"]) -> Float[Array, "*batch o"]:
    return x @ layer["kernel"] + broadcast_to_rank(layer["bias"], x.ndim)


def _normals(key: Key, shapes: Sequence[tuple[int, int]]) -> list[Array]:
    """Return standard normal matrices of these shapes.

    All come from one draw, because every draw compiles to a loop of its own.
    """
    ends = np.cumsum([rows * columns for rows, columns in shapes])
    parts = jnp.split(jax.random.normal(key, (ends[-1],)), ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def _layers(normals: Sequence[Array], last_gain: float) -> list[Params]:
    """Return layers with orthogonal kernels and zero biases.

    The gain of a kernel is √2, that of the last one `last_gain`.
    """
    gains = [2.0**0.5] * (len(normals) - 1) + [last_gain]
    return [
        {"kernel": gain * _orthogonal(normal), "bias": jnp.zeros(normal.shape[1])}
        for gain, normal in zip(gains, normals, strict=True)
    ]


@jax.custom_batching.sequential_vmap
def _orthogonal(normal: Float[Array, "m n"]) -> Float[Array, "m n"]:
    """Return a matrix with orthonormal rows or columns, whichever are fewer.

    It is uniform over all such matrices: the Q of a QR decomposition, with the signs of diag R.

    Matrices are decomposed one at a time even under `vmap`. On a CPU the QR of many matrices waits
    in a thread of XLA's pool for other threads of that pool. As many of these at once as there are
    cores would wait forever (jaxlib 0.10).
    """
    q, r = jnp.linalg.qr(normal if normal.shape[0] >= normal.shape[1] else normal.T)
    q = q * jnp.sign(jnp.diagonal(r))[None]
    return q if q.shape == normal.shape else q.T


def _prior(points: Sequence[int], std: Array | float) -> Float[Array, " points"]:
    """Return the constant logits −(u/u_max/std)²/2, with u/u_max from −1 to 1.

    They make an untrained policy nearly a normal distribution of width `std` about 0.
    """
    return jnp.concatenate([-0.5 * (jnp.linspace(-1.0, 1.0, n) / std) ** 2 for n in points])
