"""The agent: features of the observation, two multilayer perceptrons, and a distribution over actions.

Parameters are a plain dict of arrays, so a policy file is an .npz of them. The feature layer belongs to the agent: the
environment's observation is the paper's in every preset.
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


class Agent(Component):
    """Actor and critic of the same shape, with nothing shared, for a given environment's spaces."""

    hidden: Annotated[tuple[int, ...], Range(1, largest=2**16)] = (64, 64)
    features: Literal["none", "docking", "approach", "rejoin"] = (
        "none"  # appended to the observation
    )
    log_std: Annotated[Number, Unit("1", length=ANY), Range(largest=20.0)] = -0.7
    """Initial, of continuous actions in [−1, 1], one number or one for each; learnt, the same for all states."""
    prior_std: Annotated[Dimensionless, Range(0.0, open_low=True, smallest=1e-6, largest=1e6)] = 0.3
    """Of discrete actions at the start, in units of half the range. Its logarithm is their first log_std, one for each
    actuator, learnt as that of continuous actions: a smaller one sharpens the choice in all states."""
    critic_sees_totals: bool = False
    """Whether the critic, which only training needs, also sees what each reward term has summed to in the episode. What a
    term will still pay may depend on that, and the observation hides it."""
    cost_critic: bool = False  # whether a second critic expects the cost to come, as `algorithm=ppo_lagrangian` needs

    def init(self, key: Key, env: Environment) -> Params:
        """Return fresh parameters."""
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
        """Return what the networks see of an observation."""
        return FEATURES[self.features](env, observation)

    def distribution(
        self, env: Environment, params: Params, inputs: Float[Array, "*batch i"]
    ) -> Gaussian | Categorical:
        """Return the policy, a distribution over actions."""
        out, points = mlp(params["actor"], inputs), env.num_action_points
        if not points:
            return Gaussian(mean=out, log_std=params["log_std"])
        sharpness = (
            self.prior_std * jnp.exp(-params["log_std"])
        ) ** 2  # of each actuator, then of each of its logits
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
        """Return what the critic sees: the inputs of the actor, and perhaps the totals of the episode."""
        seen = (
            sorted(reward_totals) if self.critic_sees_totals else ()
        )  # a dict's order does not survive compilation
        return jnp.concatenate(
            [inputs, *(reward_totals[name][..., None] for name in seen)], axis=-1
        )

    def value(
        self, params: Params, critic_inputs: Float[Array, "*batch c"]
    ) -> Float[Array, "*batch"]:
        """Return the critic's V(s)."""
        return mlp(params["critic"], critic_inputs)[..., 0]

    def cost_rate(
        self, params: Params, critic_inputs: Float[Array, "*batch c"]
    ) -> Float[Array, "*batch"]:
        """Return the cost critic's (1 − γ)·V_C(s): what a step costs on the average from here on, whatever the horizon."""
        return mlp(params["cost_critic"], critic_inputs)[..., 0]

    def act(
        self,
        env: Environment,
        params: Params,
        key: Key,
        observation: Array,
        deterministic: Array | bool,
    ) -> Array:
        """Return an action for each observation: a sample, or the mode."""
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
    """Perceptron with tanh between layers and none after the last."""
    for layer in layers[:-1]:
        x = jnp.tanh(_affine(layer, x))
    return _affine(layers[-1], x)


def _affine(layer: Params, x: Float[Array, "*batch i"]) -> Float[Array, "*batch o"]:
    return x @ layer["kernel"] + broadcast_to_rank(layer["bias"], x.ndim)


def _normals(key: Key, shapes: Sequence[tuple[int, int]]) -> list[Array]:
    """Standard normal matrices, all from one draw: every draw compiles to a loop of its own."""
    ends = np.cumsum([rows * columns for rows, columns in shapes])
    parts = jnp.split(jax.random.normal(key, (ends[-1],)), ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def _layers(normals: Sequence[Array], last_gain: float) -> list[Params]:
    """Orthogonal kernels, gain √2 and `last_gain` at the end, zero biases."""
    gains = [2.0**0.5] * (len(normals) - 1) + [last_gain]
    return [
        {"kernel": gain * _orthogonal(normal), "bias": jnp.zeros(normal.shape[1])}
        for gain, normal in zip(gains, normals, strict=True)
    ]


@jax.custom_batching.sequential_vmap
def _orthogonal(normal: Float[Array, "m n"]) -> Float[Array, "m n"]:
    """Orthonormal rows or columns, whichever are fewer, uniform over all such matrices: Q of QR, signs of diag R.

    One at a time even under `vmap`: a QR of many on a CPU waits, in a thread of XLA's pool, for other threads of that pool,
    so as many at once as there are cores wait forever (jaxlib 0.10).
    """
    q, r = jnp.linalg.qr(normal if normal.shape[0] >= normal.shape[1] else normal.T)
    q = q * jnp.sign(jnp.diagonal(r))[None]
    return q if q.shape == normal.shape else q.T


def _prior(points: Sequence[int], std: Array | float) -> Float[Array, " points"]:
    """Constant logits −(u/u_max/std)²/2, u from −1 to 1: an untrained policy is nearly a normal of that width about 0."""
    return jnp.concatenate([-0.5 * (jnp.linspace(-1.0, 1.0, n) / std) ** 2 for n in points])
