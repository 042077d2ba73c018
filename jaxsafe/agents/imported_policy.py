"""Policies that were trained elsewhere: an ONNX graph, or layers in an .npz.

They take the paper's observation. A policy with continuous actions returns the action in [−1, 1].
One with discrete actions returns the logits of each actuator's choices, one actuator after the
other. One with mixed actions returns, in the order of the actuators, an element of the action or
the logits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.agents.agent import num_outputs
from jaxsafe.agents.distributions import Categorical, action_distribution
from jaxsafe.agents.networks import MAX_LAYERS, Params
from jaxsafe.agents.onnx_reader import Network, read_graph
from jaxsafe.environment import Environment
from jaxsafe.rollout import Policy, RecurrentPolicy
from jaxsafe.schema.errors import ConfigError, choices_text
from jaxsafe.storage.archive import open_archive

ACTIVATIONS: Mapping[str, Callable[[Array], Array]] = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "swish": jax.nn.swish,
}
"""The functions that may stand between the layers of an .npz, by name."""

MAX_NAME_LETTERS = 200
"""How many letters of the names in a file a message repeats."""


class Choice(Protocol):
    """A distribution over actions. Only its mode is known."""

    def mode(self) -> Array:
        """Return the actions."""
        ...


@jax.tree_util.register_static
class ForeignAgent:
    """A stand-in for `Agent` where only acting is needed. Its sampled actions are the modes."""

    def __init__(self, network: Network) -> None:
        """Wrap `network(weights, observation)`, which takes one observation."""
        self.network = network

    def inputs(
        self, env: Environment, observation: Float[Array, "batch o"]
    ) -> Float[Array, "batch o"]:
        """Return the observation as it is. It is what the network sees."""
        return observation

    def distribution(self, env: Environment, params: Params, inputs: Array) -> Choice:
        """Return a distribution for one observation or a batch. Only its mode means something."""
        network = jnp.vectorize(lambda x: self.network(params, x), signature="(o)->(a)")
        return action_distribution(
            env.num_action_points,
            network(inputs),
            log_std=jnp.zeros(env.action_size),
            choose=lambda logits, _, points: Categorical(logits=logits, points=points),
        )

    def policy(
        self, env: Environment, params: Params, deterministic: Array | bool
    ) -> Policy | RecurrentPolicy:
        """Return a function of key and observations that returns an action for each observation."""
        return lambda key, observation: self.distribution(
            env, params, self.inputs(env, observation)
        ).mode()


class ForeignPolicy(NamedTuple):
    """A policy that was trained elsewhere, with all that acting needs.

    `jaxsafe.agents.policy_file.SavedPolicy` is its counterpart for policies of our own.
    """

    env: Environment
    agent: ForeignAgent
    params: Params


def read_foreign(path: Path, env: Environment, activation: str = "tanh") -> ForeignPolicy:
    """Return the policy in a file, to act in an environment.

    Args:
        path: `.onnx`, or `.npz` with `kernel_0` (inputs, outputs), `bias_0`, `kernel_1`, ….
        env: where it will act.
        activation: the function between the layers of an .npz: `tanh`, `relu` or `swish`.

    Raises:
        ConfigError: the file cannot be read, or its inputs and outputs are not those of the
            environment.
    """
    if path.suffix == ".onnx":
        network, weights = read_graph(path)
        _check(path, env, network, weights)
    else:
        network, weights = _read_layers(path, env, activation)
    return ForeignPolicy(env, ForeignAgent(network), weights)


def _check(path: Path, env: Environment, network: Network, weights: Mapping[str, Any]) -> None:
    """Check that a network takes observations of an environment and returns actions.

    Args:
        path: the file, for the message.
        env: the environment.
        network: the network.
        weights: its weights, or their shapes.

    Raises:
        ConfigError: it does not.
    """
    wanted = num_outputs(env)
    observation = jax.ShapeDtypeStruct((env.observation_size,), jnp.float32)
    try:
        outputs = jax.eval_shape(network, weights, observation)
    except Exception as error:  # JAX and the operators of a graph raise many kinds of errors
        reason = str(error).partition("\n")[0]
        raise ConfigError(
            f"{path}: does not take an observation of {env.observation_size} numbers: {reason}"
        ) from None
    if outputs.shape != (wanted,):
        raise ConfigError(
            f"{path}: expected {wanted} outputs ({', '.join(env.action_names)}), "
            f"found shape {outputs.shape}"
        )
    if not jnp.issubdtype(outputs.dtype, jnp.floating):
        raise ConfigError(f"{path}: expected outputs that are real numbers, found {outputs.dtype}")


def _read_layers(
    path: Path, env: Environment, activation: str
) -> tuple[Network, dict[str, np.ndarray]]:
    """Read the layers in an .npz, and return their function and their weights.

    The arrays are read only after their names and shapes have shown that they fit.

    Raises:
        ConfigError: the activation is not known, or the file holds something else.
    """
    if activation not in ACTIVATIONS:
        raise ConfigError(
            f"activation: found {activation!r}{choices_text(activation, ACTIVATIONS)}"
        )
    with open_archive(path, "cannot be read: not an .npz of numbers") as archive:
        count = len(archive.names) // 2
        expected = {f"{kind}_{i}" for i in range(count) for kind in ("kernel", "bias")}
        if not count or set(archive.names) != expected or count > MAX_LAYERS:
            found = ", ".join(sorted(archive.names))[:MAX_NAME_LETTERS] or "nothing"
            raise ConfigError(f"{path}: expected kernel_0, bias_0, kernel_1, …, found {found}")
        network = _network(count, activation)
        shapes = {}
        for name in archive.names:
            shape, dtype = archive.describe(name)
            if dtype.kind not in "fiu" or len(shape) != (2 if name.startswith("kernel") else 1):
                wanted = "a matrix" if name.startswith("kernel") else "a list"
                raise ConfigError(
                    f"{path}: {name}: expected {wanted} of numbers, found {dtype} of shape {shape}"
                )
            shapes[name] = jax.ShapeDtypeStruct(shape, jnp.float32)
        _check(path, env, network, shapes)
        return network, {name: archive.read(name).astype(np.float32) for name in archive.names}


def _network(count: int, activation: str) -> Network:
    """Return the function of a perceptron with this number of layers."""

    def network(weights: Mapping[str, Array], x: Array) -> Array:
        for i in range(count):
            x = x @ weights[f"kernel_{i}"] + weights[f"bias_{i}"]
            x = ACTIVATIONS[activation](x) if i < count - 1 else x
        return x

    return network
