"""One program for all seeds: a shard of them on each device, and within a device one after another.

On a CPU a device is a core with one thread: independent seeds side by side use both caches and need no communication, where
`vmap` over seeds gains nothing. An accelerator gets its seeds as one `vmap`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import zip_longest
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxsafe.errors import ConfigError
from jaxsafe.train import hosts
from jaxsafe.types import is_key

_SEEDS = PartitionSpec("seeds")


def claim_cores() -> None:
    """Make every usable core a JAX device with one thread. Call before JAX touches its devices; what the user set stays.

    LLVM's higher optimisation levels take longer to compile and gave no faster program.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for name, value in (
        ("--xla_force_host_platform_device_count", f"={cores}"),
        ("--xla_cpu_multi_thread_eigen", "=false"),
        ("--xla_backend_optimization_level", "=1"),
    ):
        if name not in flags:
            flags += f" {name}{value}"
    os.environ["XLA_FLAGS"] = flags.strip()


class SeedMapper:
    """Maps functions over the leading seed axis of their second argument, sharded over devices."""

    def __init__(self, num_seeds: int) -> None:
        """Use as many devices as there are seeds, at most; each takes the same number, padded with repeats.

        Raises:
            ConfigError: there are more processes than seeds.
        """
        if num_seeds < jax.process_count():
            raise ConfigError(f"seeds: expected one for each of {jax.process_count()} processes, found {num_seeds}")
        each = [jax.local_devices(process) for process in range(jax.process_count())]
        in_turn = [device for turn in zip_longest(*each) for device in turn if device is not None]
        devices = in_turn[: max(1, min(num_seeds, len(in_turn)))]
        self.num_seeds = num_seeds
        self.padded = -(-num_seeds // len(devices)) * len(devices)
        self.num_devices = len(devices)
        self.mesh = Mesh(np.array(devices), ("seeds",))
        self.one_by_one = devices[0].platform == "cpu"

    def map(self, function: Callable[[Any, Any], Any]) -> Any:
        """`function(shared, one)` to a jittable `(shared, all)`, all with a leading axis of `padded` seeds."""

        def shard(shared: Any, local: Any) -> Any:
            if not self.one_by_one:
                return jax.vmap(function, in_axes=(None, 0))(shared, local)
            return jax.lax.map(lambda one: _isolated(function)(shared, one), local)

        return jax.jit(
            jax.shard_map(shard, mesh=self.mesh, in_specs=(PartitionSpec(), _SEEDS), out_specs=_SEEDS, check_vma=False)
        )

    def keys(self, first: int) -> jax.Array:
        """The keys of seeds first, first + 1, …, [padded]; the padding repeats the last."""
        seeds = self.pad(first + np.arange(self.num_seeds))
        return self.place(jax.vmap(jax.random.key)(jnp.asarray(seeds)))

    def place(self, tree: Any) -> Any:
        """Distribute arrays [num_seeds] or [padded] over the devices; every process has all of them."""
        return jax.tree.map(lambda x: _spread(self.pad(x), NamedSharding(self.mesh, _SEEDS)), tree)

    def place_like(self, shapes: Any) -> Any:
        """The shapes with the placement that `place` gives, for restoring."""
        sharding = NamedSharding(self.mesh, _SEEDS)
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), shapes)

    def pad(self, values: Any) -> Any:
        """Repeat the last seed's entry up to `padded`."""
        return values[np.minimum(np.arange(self.padded), len(values) - 1)]

    def replicate(self, tree: Any) -> Any:
        """Give every device a copy."""
        return jax.tree.map(lambda x: _spread(x, NamedSharding(self.mesh, PartitionSpec())), tree)

    def gather(self, tree: Any) -> Any:
        """Arrays on the host of every process, without the padding; of keys the words."""
        return jax.tree.map(lambda x: hosts.gather(x)[: self.num_seeds], tree)


def _spread(x: Any, sharding: NamedSharding) -> jax.Array:
    if is_key(x):
        return jax.random.wrap_key_data(_spread(jax.random.key_data(x), sharding))
    if sharding.is_fully_addressable:
        return jax.device_put(x, sharding)
    host = np.asarray(x, jnp.result_type(x))
    return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])


def _isolated(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Keep the compiler from fusing a seed's program with its surroundings, so that its bits do not depend on them."""

    def isolated(shared: Any, one: Any) -> Any:
        return jax.lax.optimization_barrier(function(*jax.lax.optimization_barrier((shared, one))))

    return isolated
