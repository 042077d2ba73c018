"""A batch of environments that is stepped from Python.

A step is one compiled call. It takes one array of states and returns one.

A call costs some microseconds for each array that it hands over. An environment, its state and a
time step are a hundred arrays. So the environment is packed into one array of words, bit by bit,
and states and time steps into another. The compiled program unpacks them.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsafe.adapters import refuse_fork
from jaxsafe.autoreset import renew
from jaxsafe.environment import Environment, reset, step
from jaxsafe.rollout import cut_short
from jaxsafe.types import State, TimeStep


class Episodes(NamedTuple):
    """Episodes side by side, [num_envs]."""

    state: State
    timestep: TimeStep
    """The latest time step."""


class Packing:
    """The layout of the leaves of a pytree in one array of words, dtype by dtype.

    The array is [words], or [words, num_envs] for a batch.

    Compiled programs belong to one `Packing` object. So a process has only one object for each
    structure, and `packing` returns it. A copy, or what is read from a pickle, is that same object.
    """

    def __init__(
        self, structure: Any, shapes: tuple[tuple[tuple[int, ...], np.dtype], ...]
    ) -> None:
        """Lay out the leaves.

        Args:
            structure: the structure of the pytree.
            shapes: shape and dtype of each leaf. The shapes leave out the axis of the batch.
        """
        self._structure = structure
        self._shapes = shapes
        # A block is a dtype, the range of its words, and its leaves. A leaf is its index among all
        # leaves and the range of its words within the block.
        self._blocks: list[tuple[np.dtype, int, int, list[tuple[int, int, int]]]] = []
        end = 0
        for dtype in sorted({dtype for _, dtype in shapes}, key=str):
            start = end
            parts = []
            for i, (shape, _) in enumerate(shapes):
                if shapes[i][1] == dtype:
                    size = int(np.prod(shape, dtype=int))
                    parts.append((i, end - start, end - start + size))
                    end += size
            self._blocks.append((dtype, start, end, parts))
        self._size = end

    def __reduce__(self) -> tuple[Any, ...]:
        return _packing, (self._structure, self._shapes)

    def empty(self, num_envs: int) -> np.ndarray:
        """Return words that stand for no tree yet, [words, num_envs].

        Args:
            num_envs: number of environments.
        """
        return np.zeros((self._size, num_envs), _unsigned(jnp.result_type(float)))

    def pack(self, tree: Any) -> Array:
        """Return the words of a tree, [words] or [words, num_envs]."""
        leaves = jax.tree.leaves(tree)
        word = _unsigned(jnp.result_type(float))

        def words(leaf: Array, shape: tuple[int, ...], dtype: np.dtype) -> Array:
            bits = (
                leaf if dtype.kind == "b" else jax.lax.bitcast_convert_type(leaf, _unsigned(dtype))
            )
            return bits.astype(word).reshape((*leaf.shape[: leaf.ndim - len(shape)], -1)).T

        ordered = [i for *_, parts in self._blocks for i, _, _ in parts]
        return jnp.concatenate([words(leaves[i], *self._shapes[i]) for i in ordered])

    def unpack(self, words: Array) -> Any:
        """Return the tree whose words these are."""

        def typed(block: Array, dtype: np.dtype) -> Array:
            if dtype.kind == "b":
                return block.astype(bool)
            return jax.lax.bitcast_convert_type(block.astype(_unsigned(dtype)), dtype)

        def leaf(part: Array, shape: tuple[int, ...]) -> Array:
            return part.T.reshape((*words.shape[1:], *shape))

        return self._tree(words, typed, leaf)

    def receive(self, words: Array) -> Any:
        """Return the tree of a batch as NumPy arrays. They must not be written to.

        Args:
            words: the words of the batch, [words, num_envs].
        """

        def typed(block: np.ndarray, dtype: np.dtype) -> np.ndarray:
            return block.astype(_unsigned(dtype), copy=False).view(dtype)

        def leaf(part: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
            if not shape:
                return part[0]
            return part.T.reshape((-1, *shape)) if len(shape) > 1 else part.T

        return self._tree(np.asarray(words), typed, leaf)

    def _tree(self, words: Any, typed: Any, leaf: Any) -> Any:
        """Return the tree whose words these are.

        Args:
            words: the words, [words] or [words, num_envs].
            typed: returns the elements of a dtype from the words of its block.
            leaf: returns a leaf of some shape from its elements.
        """
        leaves: list[Any] = [None] * len(self._shapes)
        for dtype, start, end, parts in self._blocks:
            block = typed(words[start:end], dtype)
            for i, first, last in parts:
                leaves[i] = leaf(block[first:last], self._shapes[i][0])
        return jax.tree.unflatten(self._structure, leaves)


def packing(example: Any, num_batch_axes: int = 0) -> Packing:
    """Return the packing of trees shaped like `example`.

    Examples of the same structure, shapes and dtypes get the very same object, so that they share
    compiled programs.

    Args:
        example: a tree of arrays or of their shapes.
        num_batch_axes: number of leading axes that are batch axes. They are not part of the layout.
    """
    leaves, structure = jax.tree.flatten(example)
    return _packing(
        structure, tuple((leaf.shape[num_batch_axes:], np.dtype(leaf.dtype)) for leaf in leaves)
    )


@functools.cache
def _packing(structure: Any, shapes: tuple[tuple[tuple[int, ...], np.dtype], ...]) -> Packing:
    return Packing(structure, shapes)


def _unsigned(dtype: Any) -> np.dtype:
    """Return the unsigned integer dtype that is as wide as a dtype."""
    return np.dtype(f"u{np.dtype(dtype).itemsize}")


class Layout(NamedTuple):
    """The packings of an environment and its episodes, and the kind of their PRNG keys."""

    env: Packing
    episodes: Packing
    key_impl: str
    """The kind of PRNG keys, as `jax.random.key(seed, impl=…)` takes it."""


class PackedBatch:
    """A batch of environments, with their episodes and the chains of PRNG keys of their starts."""

    def __init__(self, env: Environment, num_envs: int, max_episode_steps: float) -> None:
        """Pack the environment. No episode runs yet.

        Args:
            env: the environment.
            num_envs: number of environments in the batch.
            max_episode_steps: number of steps after which an episode is truncated. Infinity stands
                for no limit.
        """
        impl: Any = jax.config.jax_default_prng_impl  # pyright: ignore[reportAttributeAccessIssue]
        keys = np.zeros((num_envs, *_key_shape(impl)), np.uint32)
        episodes = jax.eval_shape(functools.partial(_start, impl), env, keys)[1]
        self._layout = Layout(packing(env), packing(episodes, num_batch_axes=1), impl)
        self._env = np.asarray(self._layout.env.pack(env))
        self._limit = np.float32(max_episode_steps)
        # The next key of each environment's chain as raw words, [num_envs, words of a key].
        self._keys: Any = keys
        self._words: Any = self._layout.episodes.empty(num_envs)
        self.running = False

    @property
    def now(self) -> Any:
        """Return the `Episodes` as NumPy arrays. They must not be written to."""
        return self._layout.episodes.receive(self._words)

    def seed(self, mask: np.ndarray, seeds: Sequence[int]) -> None:
        """Begin new chains of keys.

        A chain begins at `jax.random.key(seed)`. If the seed has more than 32 bits, it begins at
        the key of the lowest 32 bits, into which the other bits are folded.

        Args:
            mask: which environments begin a new chain, [num_envs].
            seeds: a seed for each environment of the batch.
        """
        refuse_fork()
        size = max(1, *(-(-seed.bit_length() // 32) for seed in seeds))
        words = [[seed >> 32 * i & 0xFFFFFFFF for i in range(size)] for seed in seeds]
        keys = _raw_keys(self._layout.key_impl, np.array(words, np.uint32))
        self._keys = np.where(mask[:, None], keys, self._keys)

    def restart(self, mask: np.ndarray) -> None:
        """Start an episode at random in each environment of the mask, [num_envs].

        Before the first step, every environment of the batch must have been started.
        """
        refuse_fork()
        self._keys, self._words = restart(self._layout, self._env, self._keys, self._words, mask)
        self.running = True

    def place(self, mask: np.ndarray, episode: Episodes) -> None:
        """Let the environments of the mask go on from an episode. Their chains of keys stay.

        Args:
            mask: which environments take the episode, [num_envs].
            episode: the episode of one environment, without a batch axis.
        """
        refuse_fork()
        words = pack(self._layout.episodes, jax.tree.map(lambda x: x[None], episode))
        self._words = np.where(mask, words, self._words)
        self.running = True

    def step(self, actions: np.ndarray) -> None:
        """Advance every environment by its action, [num_envs, action]."""
        refuse_fork()
        self._words = advance(self._layout, self._env, self._words, actions, self._limit)


@functools.partial(jax.jit, static_argnums=0)
def pack(packing: Packing, tree: Any) -> Array:
    """Return the words of a tree, [words] or [words, num_envs]."""
    return packing.pack(tree)


@functools.partial(jax.jit, static_argnums=0)
def restart(
    layout: Layout, env: Array, keys: Array, words: Array, mask: Array
) -> tuple[Array, Array]:
    """Return the next keys and words, with a new episode in each environment of the mask.

    Args:
        layout: the packings.
        env: the words of the environment, [words].
        keys: the next key of each environment's chain as raw words, [num_envs, words of a key].
        words: the words of the episodes, [words, num_envs].
        mask: which environments start an episode, [num_envs].
    """
    running = (keys, layout.episodes.unpack(words))

    def draw(parameters: tuple[Array, Array], indices: Array) -> tuple[Array, Episodes]:
        env, keys = parameters
        return _start(layout.key_impl, layout.env.unpack(env), keys[indices])

    keys, episodes = renew(mask, draw, (env, keys), running)
    return keys, layout.episodes.pack(episodes)


@functools.partial(jax.jit, static_argnums=0)
def advance(layout: Layout, env: Array, words: Array, action: Array, limit: float) -> Array:
    """Return the words of the episodes one step later, [words, num_envs].

    Args:
        layout: the packings.
        env: the words of the environment, [words].
        words: the words of the episodes, [words, num_envs].
        action: an action for each environment, [num_envs, action].
        limit: number of steps after which an episode is truncated.
    """
    state, timestep = layout.episodes.unpack(words)
    unpacked = layout.env.unpack(env)
    state, timestep = jax.vmap(step, in_axes=(None, 0, 0))(unpacked, state, action)
    return layout.episodes.pack(Episodes(state, cut_short(unpacked, state, timestep, limit)))


@functools.partial(jax.jit, static_argnums=0)
def _raw_keys(impl: str, seeds: Array) -> Array:
    """Return the PRNG key of each seed as raw words, [num_envs, words of a key].

    Args:
        impl: the kind of keys, as `jax.random.key` takes it.
        seeds: words of 32 bits for each seed, the lowest first, [num_envs, words].
    """

    def raw_key(words: Array) -> Array:
        raw = jax.random.key_data(jax.random.key(words[0], impl=impl))
        for i in range(1, words.size):
            folded = jax.random.fold_in(jax.random.wrap_key_data(raw, impl=impl), words[i])
            # The split tells apart seeds whose words are in another order. For keys of the kind
            # `unsafe_rbg`, folding alone gives the same key in any order.
            folded, _ = jax.random.split(folded)
            raw = jnp.where(jnp.any(words[i:] > 0), jax.random.key_data(folded), raw)
        return raw

    return jax.lax.map(raw_key, seeds)


def _key_shape(impl: str) -> tuple[int, ...]:
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0, impl=impl))).shape


def _start(impl: str, env: Environment, keys: Array) -> tuple[Array, Episodes]:
    """Return the next keys of the chains, and an episode in each environment."""

    def start(key: Array) -> tuple[Array, Episodes]:
        following, now = jax.random.split(jax.random.wrap_key_data(key, impl=impl))
        return jax.random.key_data(following), Episodes(*reset(env, now))

    # Under vmap, what keys of another kind than threefry draw depends on the key of the first
    # environment of the batch. An environment would start where it started before.
    over_batch = (
        jax.vmap(start) if impl == "threefry2x32" else functools.partial(jax.lax.map, start)
    )
    return over_batch(keys)
