"""Policies that were trained elsewhere: an ONNX graph, or layers in an .npz, from the paper's observation to the action.

The output of a continuous policy is the action in [−1, 1]; that of a discrete one the logits of each actuator's choices,
one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.agents.agent import Params
from jaxsafe.agents.distributions import Categorical, Gaussian
from jaxsafe.agents.onnx_reader import Network, read_graph
from jaxsafe.agents.policy_file import MAX_LAYERS
from jaxsafe.environment import Environment
from jaxsafe.rollout import Policy
from jaxsafe.schema.errors import ConfigError, nearest
from jaxsafe.storage.archive import open_archive

ACTIVATIONS: Mapping[str, Callable[[Array], Array]] = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "swish": jax.nn.swish,
}
"""Between the layers of an .npz."""

MAX_NAMES = 200
"""Letters of the names in a file that a message repeats."""


@jax.tree_util.register_static
class ForeignAgent:
    """Acts as an `Agent` where only acting is needed; sampled actions are the modes."""

    def __init__(self, network: Network) -> None:
        """`network(weights, observation)` of one observation."""
        self.network = network

    def inputs(
        self, env: Environment, observation: Float[Array, "batch o"]
    ) -> Float[Array, "batch o"]:
        """Return what the network sees: the observation as it is."""
        return observation

    def distribution(
        self, env: Environment, params: Params, inputs: Array
    ) -> Categorical | Gaussian:
        """Return what the network says of one observation or a batch; only its mode means something."""
        out = jnp.vectorize(lambda one: self.network(params, one), signature="(o)->(a)")(inputs)
        if env.num_action_points:
            return Categorical(logits=out, points=env.num_action_points)
        return Gaussian(mean=out, log_std=jnp.zeros(env.action_size))

    def policy(self, env: Environment, params: Params, deterministic: Array | bool) -> Policy:
        """Return the action for each of a batch of observations."""
        return lambda key, observation: self.distribution(
            env, params, self.inputs(env, observation)
        ).mode()


class ForeignPolicy(NamedTuple):
    """What `jaxsafe.agents.policy_file.SavedPolicy` is for a policy of our own, as far as acting needs it."""

    env: Environment
    agent: ForeignAgent
    params: Params


def read_foreign(path: Path, env: Environment, activation: str = "tanh") -> ForeignPolicy:
    """The policy in a file, to act in an environment.

    Args:
        path: `.onnx`, or `.npz` with `kernel_0` (inputs, outputs), `bias_0`, `kernel_1`, ….
        env: where it will act.
        activation: between the layers of an .npz: `tanh`, `relu` or `swish`.

    Raises:
        ConfigError: the file cannot be read, or its inputs and outputs are not those of the environment.
    """
    if path.suffix == ".onnx":
        network, weights = read_graph(path)
        _check(path, env, network, weights)
    else:
        network, weights = _read_layers(path, env, activation)
    return ForeignPolicy(env, ForeignAgent(network), weights)


def _check(path: Path, env: Environment, network: Network, weights: Mapping[str, Any]) -> None:
    """Raise a ConfigError unless a network, of these weights or their shapes, takes observations and gives actions."""
    wanted = sum(env.num_action_points) or env.action_size
    observation = jax.ShapeDtypeStruct((env.observation_size,), jnp.float32)
    try:
        found = jax.eval_shape(network, weights, observation)
    except Exception as error:  # JAX and the operators below refuse in many ways
        reason = str(error).partition("\n")[0]
        raise ConfigError(
            f"{path}: does not take an observation of {env.observation_size} numbers: {reason}"
        ) from None
    if found.shape != (wanted,):
        raise ConfigError(
            f"{path}: expected {wanted} outputs ({', '.join(env.action_names)}), found shape {found.shape}"
        )
    if not jnp.issubdtype(found.dtype, jnp.floating):
        raise ConfigError(f"{path}: expected outputs that are real numbers, found {found.dtype}")


def _read_layers(
    path: Path, env: Environment, activation: str
) -> tuple[Network, dict[str, np.ndarray]]:
    """Read the layers in an .npz, after their names and shapes alone have shown that they fit."""
    if activation not in ACTIVATIONS:
        raise ConfigError(
            f"activation: found {activation!r}; choose from {nearest(activation, ACTIVATIONS)}"
        )
    with open_archive(path, "cannot be read: not an .npz of numbers") as archive:
        count = len(archive.names) // 2
        expected = {f"{kind}_{i}" for i in range(count) for kind in ("kernel", "bias")}
        if not count or set(archive.names) != expected or count > MAX_LAYERS:
            found = ", ".join(sorted(archive.names))[:MAX_NAMES] or "nothing"
            raise ConfigError(f"{path}: expected kernel_0, bias_0, kernel_1, …, found {found}")
        network, shapes = _network(count, activation), {}
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
    """Return the function of so many layers."""

    def network(weights: Mapping[str, Array], x: Array) -> Array:
        for i in range(count):
            x = x @ weights[f"kernel_{i}"] + weights[f"bias_{i}"]
            x = ACTIVATIONS[activation](x) if i < count - 1 else x
        return x

    return network
