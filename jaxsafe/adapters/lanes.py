"""A batch of environments that is stepped from Python: one compiled call, one array of states in, one out.

A call costs some microseconds for each array that it hands over, and an environment, its state and a time step are a
hundred. So each is packed into one array of words, bit by bit, and unpacked inside the compiled program.
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
    timestep: TimeStep  # the latest


class Packing:
    """How the leaves of a pytree lie in one array, [words] or with lanes [words, num_envs]: type by type.

    Compiled programs belong to one object, so a process has only one for each structure, see `packing`. Copies and what is
    read from a pickle are that object too.
    """

    def __init__(
        self, structure: Any, shapes: tuple[tuple[tuple[int, ...], np.dtype], ...]
    ) -> None:
        """Lay out leaves of these shapes, without the axis of lanes, and types."""
        self._structure, self._shapes = structure, shapes
        self._blocks: list[tuple[np.dtype, int, int, list[tuple[int, int, int]]]] = []
        end = 0
        for dtype in sorted({dtype for _, dtype in shapes}, key=str):
            start, parts = end, []
            for i, (shape, _) in enumerate(shapes):
                if shapes[i][1] == dtype:
                    size = int(np.prod(shape, dtype=int))
                    parts.append((i, end - start, end - start + size))
                    end += size
            self._blocks.append((dtype, start, end, parts))
        self._size = end

    def __reduce__(self) -> tuple[Any, ...]:
        return _packing, (self._structure, self._shapes)

    def empty(self, lanes: int) -> np.ndarray:
        """Words of no meaning."""
        return np.zeros((self._size, lanes), _unsigned(jnp.result_type(float)))

    def pack(self, tree: Any) -> Array:
        """The words of a tree."""
        leaves, word = jax.tree.leaves(tree), _unsigned(jnp.result_type(float))

        def words(leaf: Array, shape: tuple[int, ...], dtype: np.dtype) -> Array:
            bits = (
                leaf if dtype.kind == "b" else jax.lax.bitcast_convert_type(leaf, _unsigned(dtype))
            )
            return bits.astype(word).reshape((*leaf.shape[: leaf.ndim - len(shape)], -1)).T

        ordered = [i for *_, parts in self._blocks for i, _, _ in parts]
        return jnp.concatenate([words(leaves[i], *self._shapes[i]) for i in ordered])

    def unpack(self, words: Array) -> Any:
        """The tree of some words."""

        def typed(block: Array, dtype: np.dtype) -> Array:
            if dtype.kind == "b":
                return block.astype(bool)
            return jax.lax.bitcast_convert_type(block.astype(_unsigned(dtype)), dtype)

        def leaf(part: Array, shape: tuple[int, ...]) -> Array:
            return part.T.reshape((*words.shape[1:], *shape))

        return self._tree(words, typed, leaf)

    def receive(self, words: Array) -> Any:
        """The tree of some words with lanes, as NumPy arrays that must not be written to."""

        def typed(block: np.ndarray, dtype: np.dtype) -> np.ndarray:
            return block.astype(_unsigned(dtype), copy=False).view(dtype)

        def leaf(part: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
            return (
                part[0] if not shape else part.T.reshape((-1, *shape)) if len(shape) > 1 else part.T
            )

        return self._tree(np.asarray(words), typed, leaf)

    def _tree(self, words: Any, typed: Any, leaf: Any) -> Any:
        leaves: list[Any] = [None] * len(self._shapes)
        for dtype, start, end, parts in self._blocks:
            block = typed(words[start:end], dtype)
            for i, a, b in parts:
                leaves[i] = leaf(block[a:b], self._shapes[i][0])
        return jax.tree.unflatten(self._structure, leaves)


def packing(example: Any, lanes: int = 0) -> Packing:
    """That of trees like this one of arrays or their shapes, whose first `lanes` axes are not laid out.

    Like examples get the very same object, so that they share compiled programs.
    """
    leaves, structure = jax.tree.flatten(example)
    return _packing(structure, tuple((leaf.shape[lanes:], np.dtype(leaf.dtype)) for leaf in leaves))


@functools.cache
def _packing(structure: Any, shapes: tuple[tuple[tuple[int, ...], np.dtype], ...]) -> Packing:
    return Packing(structure, shapes)


def _unsigned(dtype: Any) -> np.dtype:
    """The unsigned type that is as wide."""
    return np.dtype(f"u{np.dtype(dtype).itemsize}")


class Layout(NamedTuple):
    """How an environment and its episodes are packed, and the kind of their keys."""

    env: Packing
    episodes: Packing
    key_impl: str  # as `jax.random.key(seed, impl=…)` takes it


class Lanes:
    """`num_envs` environments."""

    def __init__(self, env: Environment, num_envs: int, max_episode_steps: float) -> None:
        """Pack the environment; no episode runs yet."""
        impl: Any = jax.config.jax_default_prng_impl  # pyright: ignore[reportAttributeAccessIssue]
        keys = np.zeros((num_envs, *_key_shape(impl)), np.uint32)
        episodes = jax.eval_shape(functools.partial(_start, impl), env, keys)[1]
        self._layout = Layout(packing(env), packing(episodes, lanes=1), impl)
        self._env = np.asarray(self._layout.env.pack(env))
        self._limit = np.float32(max_episode_steps)
        self._keys: Any = keys  # raw, of the chains that starts come from
        self._words: Any = self._layout.episodes.empty(num_envs)
        self.running = False

    @property
    def now(self) -> Any:
        """The `Episodes`, of NumPy arrays that must not be written to."""
        return self._layout.episodes.receive(self._words)

    def seed(self, mask: np.ndarray, seeds: Sequence[int]) -> None:
        """Begin new chains of keys where the mask says, [num_envs], each at `jax.random.key(seed)`.

        A seed of more than 32 bits begins at the key of its lowest 32, folded with the others.
        """
        refuse_fork()
        size = max(1, *(-(-seed.bit_length() // 32) for seed in seeds))
        words = [[seed >> 32 * i & 0xFFFFFFFF for i in range(size)] for seed in seeds]
        keys = _raw_keys(self._layout.key_impl, np.array(words, np.uint32))
        self._keys = np.where(mask[:, None], keys, self._keys)

    def restart(self, mask: np.ndarray) -> None:
        """Start an episode where the mask says, [num_envs]; the first time, everywhere."""
        refuse_fork()
        self._keys, self._words = restart(self._layout, self._env, self._keys, self._words, mask)
        self.running = True

    def place(self, mask: np.ndarray, episode: Episodes) -> None:
        """Go on from this episode, that of one lane, where the mask says; the chains of keys stay as they are."""
        refuse_fork()
        words = pack(self._layout.episodes, jax.tree.map(lambda x: x[None], episode))
        self._words = np.where(mask, words, self._words)
        self.running = True

    def step(self, actions: np.ndarray) -> None:
        """Advance every lane by its action, [num_envs, action]."""
        refuse_fork()
        self._words = advance(self._layout, self._env, self._words, actions, self._limit)


@functools.partial(jax.jit, static_argnums=0)
def pack(packing: Packing, tree: Any) -> Array:
    """The words of a tree."""
    return packing.pack(tree)


@functools.partial(jax.jit, static_argnums=0)
def restart(
    layout: Layout, env: Array, keys: Array, words: Array, mask: Array
) -> tuple[Array, Array]:
    """The next keys and words, with a new episode where the mask says."""
    running = (keys, layout.episodes.unpack(words))

    def draw(parameters: tuple[Array, Array], lanes: Array) -> tuple[Array, Episodes]:
        env, keys = parameters
        return _start(layout.key_impl, layout.env.unpack(env), keys[lanes])

    keys, episodes = renew(mask, draw, (env, keys), running)
    return keys, layout.episodes.pack(episodes)


@functools.partial(jax.jit, static_argnums=0)
def advance(layout: Layout, env: Array, words: Array, action: Array, limit: float) -> Array:
    """The words one step later."""
    state, timestep = layout.episodes.unpack(words)
    state, timestep = jax.vmap(step, in_axes=(None, 0, 0))(layout.env.unpack(env), state, action)
    return layout.episodes.pack(Episodes(state, cut_short(state, timestep, limit)))


@functools.partial(jax.jit, static_argnums=0)
def _raw_keys(impl: str, seeds: Array) -> Array:
    """Return the key of each seed, given as words of 32 bits, the lowest first, [num_envs, words]."""

    def raw_key(words: Array) -> Array:
        raw = jax.random.key_data(jax.random.key(words[0], impl=impl))
        for i in range(1, words.size):
            folded = jax.random.fold_in(jax.random.wrap_key_data(raw, impl=impl), words[i])
            folded, _ = jax.random.split(folded)  # `unsafe_rbg` folds in any order alike
            raw = jnp.where(jnp.any(words[i:] > 0), jax.random.key_data(folded), raw)
        return raw

    return jax.lax.map(raw_key, seeds)


def _key_shape(impl: str) -> tuple[int, ...]:
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0, impl=impl))).shape


def _start(impl: str, env: Environment, keys: Array) -> tuple[Array, Episodes]:
    """The keys that follow, and an episode in each lane."""

    def start(key: Array) -> tuple[Array, Episodes]:
        following, now = jax.random.split(jax.random.wrap_key_data(key, impl=impl))
        return jax.random.key_data(following), Episodes(*reset(env, now))

    # What other kinds of keys draw under vmap depends on the first lane's key: a lane would start where it started before.
    over_lanes = (
        jax.vmap(start) if impl == "threefry2x32" else functools.partial(jax.lax.map, start)
    )
    return over_lanes(keys)
