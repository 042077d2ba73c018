"""One program for all seeds: each device has a shard of the seeds.

A CPU device is a core with one thread, and maps its seeds one after another. Independent seeds side
by side use both caches and need no communication, while `vmap` over seeds gains nothing. An
accelerator maps its seeds by one `vmap`. Where there are more devices than seeds, some devices
share the environments of a seed.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Sequence
from functools import partial
from itertools import zip_longest
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxsafe.devices import processes
from jaxsafe.devices.shard import Shard
from jaxsafe.schema.errors import ConfigError
from jaxsafe.types import is_key

SPLIT_BY_SEED = PartitionSpec("seeds")
"""Sharding of arrays [seeds]: every device has the entries of its seeds."""

SPLIT_BY_ENV = PartitionSpec("seeds", "envs")
"""Sharding of arrays [seeds, environments]: every device has the entries of its environments."""


def claim_cores() -> None:
    """Make every usable core a JAX device with one thread.

    Call this before JAX touches its devices. Flags that the user has set stay.

    A loop whose body touches less than 1 MB becomes one function. Otherwise XLA starts each
    operation of the loop by itself, which takes longer than the operation in a small batch. With 16
    environments on one core a step of rejoin3d took twice as long, and one with its filter 2.6
    times.

    LLVM's expensive passes are switched off, because they take time to compile and gave no faster
    program on a CPU. They stay on if JAX has a plugin for an accelerator, because without them an
    update of PPO took 13 % longer on a GPU.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    defaults = {
        "--xla_force_host_platform_device_count": str(usable_cores()),
        "--xla_cpu_multi_thread_eigen": "false",
        "--xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=1000000",
    }
    if not accelerator_installed():
        defaults["--xla_llvm_disable_expensive_passes"] = "true"
    for name, value in defaults.items():
        if name not in flags:
            flags += f" {name}={value}"
    os.environ["XLA_FLAGS"] = flags.strip()


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    has_affinity = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1


def accelerator_installed() -> bool:
    """Return whether JAX may find an accelerator here.

    JAX itself is not asked, because it would set up its devices to answer.
    """
    only_cpu = os.environ.get("JAX_PLATFORMS") == "cpu"
    return not only_cpu and importlib.util.find_spec("jax_plugins") is not None


class SeedMapper:
    """Mapping of functions over the seed axis of their second argument, sharded over devices.

    The seed axis is the leading one.
    """

    def __init__(self, num_seeds: int, shares: Sequence[int] = (1,)) -> None:
        """Choose as many devices as there is work for.

        Seeds are spread evenly over the devices and padded with repeats of the last one.

        Args:
            num_seeds: number of seeds.
            shares: numbers of devices that may share a seed. The largest number that leaves devices
                for all seeds is taken.

        Raises:
            ConfigError: there are too few devices, or too few seeds for all processes.
        """
        groups = _device_groups(num_seeds, sorted(shares, reverse=True))
        self.num_seeds = num_seeds
        self.padded = -(-num_seeds // len(groups)) * len(groups)
        self.mesh = Mesh(np.array(groups), ("seeds", "envs"))
        self.shard = Shard("envs", len(groups[0]))
        self.one_by_one = groups[0][0].platform == "cpu"
        self.num_local_devices = sum(
            device.process_index == jax.process_index() for device in self.mesh.devices.flat
        )

    def map(
        self,
        function: Callable[[Any, Any], Any],
        in_specs: Any = SPLIT_BY_SEED,
        out_specs: Any = SPLIT_BY_SEED,
        as_pair: bool = False,
    ) -> Any:
        """Return a jitted function of `(shared, seeds)` that maps `function` over all seeds.

        The arrays of `seeds` and of the result have a leading axis of `padded` seeds.

        Args:
            function: what to do for one seed: `function(shared, seed)`.
            in_specs: how the arrays of `seeds` are sharded: `SPLIT_BY_SEED`, `SPLIT_BY_ENV`, or a
                tree of both whose leaves stand for parts of the tree `seeds`.
            out_specs: how the arrays that the function returns are sharded.
            as_pair: whether a device with only one seed maps it twice. This is for cheap functions
                that may be fused with their surroundings. The compiler makes no loop for one seed,
                and without a loop the starts of oriented docking differed in the last bit.
        """

        def map_shard(shared: Any, seeds: Any) -> Any:
            if not self.one_by_one:
                return jax.vmap(function, in_axes=(None, 0))(shared, seeds)
            map_seeds = partial(jax.lax.map, lambda seed: isolated(function)(shared, seed))
            if as_pair and len(jax.tree.leaves(seeds)[0]) == 1:
                pair = jax.tree.map(lambda x: jnp.repeat(x, 2, axis=0), seeds)
                return jax.tree.map(lambda x: x[:1], map_seeds(pair))
            return map_seeds(seeds)

        sharded = jax.shard_map(
            map_shard,
            mesh=self.mesh,
            in_specs=(PartitionSpec(), in_specs),
            out_specs=out_specs,
            check_vma=False,
        )
        return jax.jit(sharded)

    def keys(self, first: int) -> jax.Array:
        """Return the keys of seeds first, first + 1, …, [padded]. The padding repeats the last."""
        seeds = self.pad(first + np.arange(self.num_seeds))
        return self.place(jax.vmap(jax.random.key)(jnp.asarray(seeds)))

    def place(self, tree: Any, specs: Any = SPLIT_BY_SEED) -> Any:
        """Distribute arrays over the devices as `map` takes them.

        Args:
            tree: arrays [num_seeds] or [padded]. Every process has them whole.
            specs: how they are sharded, as `in_specs` of `map`.
        """

        def place_part(spec: PartitionSpec, part: Any) -> Any:
            sharding = NamedSharding(self.mesh, spec)
            return jax.tree.map(lambda x: _distribute(self.pad(x), sharding), part)

        return jax.tree.map(place_part, specs, tree)

    def like(self, shapes: Any, specs: Any = SPLIT_BY_SEED) -> Any:
        """Return shapes with shardings, with which what `map` returns can be compiled ahead.

        Args:
            shapes: shapes of arrays [padded].
            specs: how the arrays will be sharded, as `in_specs` of `map`.
        """

        def add_sharding(spec: PartitionSpec, part: Any) -> Any:
            sharding = NamedSharding(self.mesh, spec)
            return jax.tree.map(
                lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), part
            )

        return jax.tree.map(add_sharding, specs, shapes)

    def pad(self, values: Any) -> Any:
        """Repeat the last seed's entry up to `padded` entries."""
        if len(values) == self.padded:
            return values
        return values[np.minimum(np.arange(self.padded), len(values) - 1)]

    def replicate(self, tree: Any) -> Any:
        """Give every device a copy."""
        sharding = NamedSharding(self.mesh, PartitionSpec())
        return jax.tree.map(lambda x: _distribute(x, sharding), tree)

    def gather(self, tree: Any) -> Any:
        """Return the arrays on the host of every process, without the padding.

        PRNG keys become the words that they consist of.
        """
        return jax.tree.map(lambda x: processes.gather(x)[: self.num_seeds], tree)


def _device_groups(num_seeds: int, shares: Sequence[int]) -> list[list[Any]]:
    """Return at most `num_seeds` groups of devices. The devices of a group share a seed.

    The devices of a group belong to one process, unless that would leave a process out.

    Args:
        num_seeds: number of seeds.
        shares: numbers of devices that a group may have, the largest first.

    Raises:
        ConfigError: there are too few devices, or too few seeds for all processes.
    """
    by_process = [jax.local_devices(process) for process in range(jax.process_count())]
    for share in shares:
        in_turn = [
            group
            for turn in zip_longest(*(_cut(devices, share) for devices in by_process))
            for group in turn
            if group is not None
        ]
        across = _cut([device for devices in by_process for device in devices], share)
        for groups in (in_turn, across):
            enough = len(groups) >= num_seeds or (groups and share == shares[-1])
            reached = {device.process_index for group in groups[:num_seeds] for device in group}
            if enough and len(reached) == len(by_process):
                return groups[:num_seeds]
    if jax.device_count() < shares[-1]:
        raise ConfigError(
            f"devices_per_seed: found {shares[-1]}, there are {jax.device_count()} devices"
        )
    raise ConfigError(
        f"seeds: expected one for each of {len(by_process)} processes, found {num_seeds}"
    )


def _cut(devices: Sequence[Any], size: int) -> list[list[Any]]:
    """Cut a list of devices into groups of this size, and leave out the rest."""
    return [list(devices[i : i + size]) for i in range(0, len(devices) - size + 1, size)]


def _distribute(x: Any, sharding: NamedSharding) -> jax.Array:
    """Put an array, or PRNG keys, on the devices of all processes."""
    if is_key(x):
        return jax.random.wrap_key_data(_distribute(jax.random.key_data(x), sharding))
    if sharding.is_fully_addressable:
        return jax.device_put(x, sharding)
    host = np.asarray(x, jnp.result_type(x))
    return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])


def isolated(function: Callable[..., Any]) -> Callable[..., Any]:
    """Keep the compiler from fusing a seed's program with its surroundings.

    Then the bits of its results do not depend on the surroundings. The first two arguments of the
    function are arrays, further ones are static.
    """

    def alone(shared: Any, seed: Any, *static: Any) -> Any:
        shared, seed = jax.lax.optimization_barrier((shared, seed))
        return jax.lax.optimization_barrier(function(shared, seed, *static))

    return alone
