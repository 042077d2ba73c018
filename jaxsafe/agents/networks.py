"""Networks of the agent as parts, built in Flax.

A subclass of `Network` with a `type` is chosen by `agent.actor=TYPE`, in YAML as on the command
line. Flax is imported when the first network is built, so that `import jaxsafe` does not need it.
"""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsafe.autoreset import choose
from jaxsafe.schema.component import Component, Range
from jaxsafe.types import Key

if TYPE_CHECKING:
    from flax import linen

Tree = TypeVar("Tree")

Params = dict[str, Any]
"""Parameters by name, as Flax keeps them: arrays, or a dict for each layer."""

Memory = Any
"""What a recurrent network remembers: arrays with the batch axes of its inputs. `()` for others."""

Normal = Callable[[tuple[int, ...]], Array]
"""A function from a shape to independent standard normal numbers."""

MAX_LAYERS = 64
"""Largest number of hidden layers. Each layer is traced and compiled by itself."""

OUTPUT = "output"
"""Name of the last layer of the networks here."""

CELL = "cell"
"""Name of the recurrent cell of the networks here."""

Width = Annotated[int, Range(1, largest=2**16)]
"""Number of units of a layer."""

Hidden = Annotated[tuple[int, ...], Range(1, largest=2**16)]
"""Numbers of units of the hidden layers."""

Activation = Literal["tanh", "relu", "elu", "gelu", "silu"]
"""Name of the function between two layers, as in `flax.linen`."""


class Network(Component):
    """Base of the networks of actor and critic.

    A network defines its Flax module. `module` is the only method that it must have.
    """

    field_word: ClassVar[str] = "option"
    recurrent: ClassVar[bool] = False
    """Whether the module is called as `(memory, inputs) -> (memory, outputs)`, step by step."""

    @property
    def like_critic(self) -> Network:
        """The network of a critic beside an actor like this one."""
        return self

    @abstractmethod
    def module(self, num_outputs: int, output_gain: float) -> linen.Module:
        """Return the module that computes outputs `[*batch, num_outputs]` of inputs `[*batch, i]`.

        Args:
            num_outputs: number of outputs.
            output_gain: how large the kernel of the last layer should start. It is 0.01 for an
                actor, whose first actions are then nearly the same everywhere, and 1 for a critic.
        """

    def init(self, key: Key, normal: Normal, module: linen.Module, *inputs: Array) -> Params:
        """Return fresh parameters. Here the initializers of the module's layers draw them.

        Args:
            key: a PRNG key.
            normal: a source of standard normal numbers, which may be used instead of the key. All
                numbers that the networks of an agent take from it come from one draw. This makes
                a program compile sooner, because each draw compiles to a loop of its own.
            module: what `module` returned.
            *inputs: arguments with which the module can be called.
        """
        variables: Any = module.init(key, *inputs)
        return variables["params"]

    def memory(self) -> Memory:
        """Return what a recurrent network remembers at the start of an episode."""
        return ()

    def problem(self) -> str | None:
        """Return what is wrong with the fields taken together, or None if nothing is."""
        layers = len(getattr(self, "hidden", ()))
        if layers > MAX_LAYERS:
            return f"hidden: expected at most {MAX_LAYERS} layers, found {layers}"
        return None


class MLP(Network, type="mlp"):
    """A multilayer perceptron. Its kernels start orthogonal, with a gain of √2 in hidden layers."""

    hidden: Hidden = (64, 64)
    """Numbers of units of the hidden layers."""
    activation: Activation = "tanh"
    """Function between two layers."""
    layer_norm: bool = False
    """Whether each hidden layer is normalised before its activation."""

    def module(self, num_outputs: int, output_gain: float) -> linen.Module:
        from jaxsafe.agents.flax_modules import Perceptron

        return Perceptron(
            hidden=self.hidden,
            activation=self.activation,
            layer_norm=self.layer_norm,
            num_outputs=num_outputs,
            output_gain=output_gain,
        )

    def init(self, key: Key, normal: Normal, module: Any, *inputs: Array) -> Params:
        return orthogonal_params(normal, module, *inputs)


class Directional(Network, type="directional"):
    """A perceptron that weighs vectors. The control is their sum and one vector more.

    The vectors are the last of the inputs, so the features must end with some, as `far_directions`
    does. The last of them counts as it is, and each of the others has a weight from −2 to 2. The
    perceptron, whose layers have tanh, sees the inputs before the vectors. If those do not change
    when the scene is turned, the control turns with it, and what is learnt in one direction holds
    in all.
    """

    hidden: Hidden = (64, 64)
    """Numbers of units of the hidden layers."""
    vectors: Annotated[int, Range(2, largest=2**16)] = 3
    """Number of vectors, each as long as the control."""

    @property
    def like_critic(self) -> Network:
        """A perceptron of the same size. A value has no direction."""
        return MLP(hidden=self.hidden)

    def module(self, num_outputs: int, output_gain: float) -> linen.Module:
        from jaxsafe.agents.flax_modules import WeightedVectors

        return WeightedVectors(
            hidden=self.hidden,
            vectors=self.vectors,
            num_outputs=num_outputs,
            output_gain=output_gain,
        )

    def init(self, key: Key, normal: Normal, module: Any, *inputs: Array) -> Params:
        return orthogonal_params(normal, module, *inputs)


class GRU(Network, type="gru"):
    """Hidden layers with tanh, then gated recurrent units (Cho et al. 2014), then the outputs."""

    recurrent: ClassVar[bool] = True
    hidden: Hidden = (64,)
    """Numbers of units of the layers before the recurrent ones."""
    units: Width = 64
    """Number of recurrent units."""

    def module(self, num_outputs: int, output_gain: float) -> linen.Module:
        from jaxsafe.agents.flax_modules import Recurrent

        return Recurrent(
            hidden=self.hidden,
            units=self.units,
            num_outputs=num_outputs,
            output_gain=output_gain,
        )

    def init(self, key: Key, normal: Normal, module: Any, *inputs: Array) -> Params:
        return orthogonal_params(normal, module, *inputs)

    def memory(self) -> Memory:
        return jnp.zeros(self.units)


def orthogonal_params(normal: Normal, module: Any, *inputs: Array) -> Params:
    """Return parameters with orthogonal kernels, and zero biases.

    The gain of a kernel is √2 in a hidden layer, 1 in a recurrent cell, and the module's
    `output_gain` in the last layer. Scales of normalisations start at 1.

    Args:
        normal: the source of all random numbers.
        module: a module whose last layer is called `output` and whose cell is called `cell`. Its
            fields can be hashed.
        *inputs: arguments with which the module can be called.
    """
    leaves, structure = jax.tree.flatten(inputs)
    leaves = [jax.ShapeDtypeStruct(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves]
    shapes = _param_shapes(module, structure, *leaves)
    gains = {OUTPUT: module.output_gain, CELL: 1.0}

    def start(path: Any, leaf: jax.ShapeDtypeStruct) -> Array:
        name = path[-1].key
        if name != "kernel":
            return jnp.full(leaf.shape, 1.0 if name == "scale" else 0.0)
        return gains.get(path[0].key, 2.0**0.5) * _orthogonal(normal(leaf.shape))

    return jax.tree_util.tree_map_with_path(start, shapes)


@functools.lru_cache(maxsize=64)
def _param_shapes(module: Any, structure: Any, *leaves: jax.ShapeDtypeStruct) -> Any:
    """Return the shapes of a module's parameters. Flax takes long to trace its modules."""
    inputs = jax.tree.unflatten(structure, leaves)
    return jax.eval_shape(module.init, jax.random.key(0), *inputs)["params"]


def from_one_draw(key: Key, build: Callable[[Normal], Params]) -> Params:
    """Return `build(normal)`. All that `normal` returns are parts of one random draw.

    Args:
        key: a PRNG key.
        build: a function that asks for the same shapes in the same order whenever it is called.
    """
    sizes: list[int] = []

    def count(shape: tuple[int, ...]) -> Array:
        sizes.append(math.prod(shape))
        return jnp.zeros(shape)

    jax.eval_shape(lambda: build(count))
    ends = np.cumsum(sizes)[:-1]
    parts = iter(jnp.split(jax.random.normal(key, (sum(sizes),)), ends))
    return build(lambda shape: next(parts).reshape(shape))


def unroll(
    step: Callable[[Memory, Any], tuple[Memory, Tree]],
    memory: Memory,
    first_memory: Memory,
    inputs: Any,
    done: Bool[Array, "n t"],
) -> tuple[Memory, Tree]:
    """Call a recurrent network for each of a number of steps.

    Args:
        step: `(memory, inputs) -> (memory, outputs)` for one step of all environments.
        memory: the memory before the first step, `[n, …]`.
        first_memory: the memory of one environment at the start of an episode. It replaces the
            memory after each step that ended an episode.
        inputs: the inputs of all steps, `[n, t, …]`.
        done: whether the episode ended with the step, `[n, t]`.

    Returns:
        The memory after the last step, and the outputs of all steps, `[n, t, …]`.
    """
    fresh = jax.tree.map(lambda old, x: jnp.broadcast_to(x, old.shape), memory, first_memory)

    def one_step(memory: Memory, now: tuple[Any, Array]) -> tuple[Memory, Tree]:
        inputs, done = now
        memory, outputs = step(memory, inputs)
        return choose(done, fresh, memory), outputs

    over_time = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), (inputs, done))
    memory, outputs = jax.lax.scan(one_step, memory, over_time)
    return memory, jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1), outputs)


@jax.custom_batching.sequential_vmap
def _orthogonal(normal: Float[Array, "m n"]) -> Float[Array, "m n"]:
    """Return a matrix with orthonormal rows or columns, whichever are fewer.

    It is uniform over all such matrices: the Q of a QR decomposition, with the signs of diag R.

    Matrices are decomposed one at a time even under `vmap`. On a CPU the QR of many matrices waits
    in a thread of XLA's pool for other threads of that pool. If as many run at once as there are
    cores, they wait forever (jaxlib 0.10).
    """
    q, r = jnp.linalg.qr(normal if normal.shape[0] >= normal.shape[1] else normal.T)
    q = q * jnp.sign(jnp.diagonal(r))[None]
    return q if q.shape == normal.shape else q.T
