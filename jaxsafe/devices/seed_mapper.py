"""One program for all seeds: a shard of them on each device, and within a device one after another.

On a CPU a device is a core with one thread: independent seeds side by side use both caches and need no communication, where
`vmap` over seeds gains nothing. An accelerator gets its seeds as one `vmap`. Where there are more devices than seeds, some
devices share the environments of a seed.
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

SEEDS = PartitionSpec("seeds")
"""Arrays [seeds], of which every device has those of its seeds."""

LANES = PartitionSpec("seeds", "lanes")
"""Arrays [seeds, environments], of which every device has its environments."""


def claim_cores() -> None:
    """Make every usable core a JAX device with one thread. Call before JAX touches its devices; what the user set stays.

    LLVM's expensive passes take longer to compile and gave no faster program on a CPU. Where JAX has a plugin for an
    accelerator they stay: without them an update of PPO took 13 % longer on a GPU.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    passes = {} if accelerator_installed() else {"--xla_llvm_disable_expensive_passes": "=true"}
    for name, value in {
        "--xla_force_host_platform_device_count": f"={cores}",
        "--xla_cpu_multi_thread_eigen": "=false",
        **passes,
    }.items():
        if name not in flags:
            flags += f" {name}{value}"
    os.environ["XLA_FLAGS"] = flags.strip()


def accelerator_installed() -> bool:
    """Return whether JAX may find an accelerator here, without asking it: it would set up its devices."""
    only_cpu = os.environ.get("JAX_PLATFORMS") == "cpu"
    return not only_cpu and importlib.util.find_spec("jax_plugins") is not None


class SeedMapper:
    """Maps functions over the leading seed axis of their second argument, sharded over devices."""

    def __init__(self, num_seeds: int, shares: Sequence[int] = (1,)) -> None:
        """Use as many devices as there is work for; seeds are spread evenly, padded with repeats.

        Args:
            num_seeds: how many there are.
            shares: numbers of devices that may share a seed; the largest is taken that leaves devices for all seeds.

        Raises:
            ConfigError: there are too few devices, or too few seeds for all processes.
        """
        groups = _groups(num_seeds, sorted(shares, reverse=True))
        self.num_seeds = num_seeds
        self.padded = -(-num_seeds // len(groups)) * len(groups)
        self.mesh = Mesh(np.array(groups), ("seeds", "lanes"))
        self.shard = Shard("lanes", len(groups[0]))
        self.one_by_one = groups[0][0].platform == "cpu"
        self.num_local_devices = sum(device.process_index == jax.process_index() for device in self.mesh.devices.flat)

    def map(
        self, function: Callable[[Any, Any], Any], given: Any = SEEDS, returned: Any = SEEDS, pairs: bool = False
    ) -> Any:
        """`function(shared, one)` to a jittable `(shared, all)`, all with a leading axis of `padded` seeds.

        Args:
            function: of one seed.
            given: how the arrays of `all` lie on the devices, `SEEDS` or `LANES`, or a tree of both that stands for theirs.
            returned: the same of what the function returns.
            pairs: take a device's only seed twice, for what is cheap and may be fused with its surroundings: the compiler
                makes no loop for one seed, and there the starts of oriented docking differed in the last bit.
        """

        def shard(shared: Any, local: Any) -> Any:
            if not self.one_by_one:
                return jax.vmap(function, in_axes=(None, 0))(shared, local)
            each = partial(jax.lax.map, lambda one: isolated(function)(shared, one))
            if pairs and len(jax.tree.leaves(local)[0]) == 1:
                pair = jax.tree.map(lambda x: jnp.repeat(x, 2, axis=0), local)
                return jax.tree.map(lambda x: x[:1], each(pair))
            return each(local)

        return jax.jit(
            jax.shard_map(shard, mesh=self.mesh, in_specs=(PartitionSpec(), given), out_specs=returned, check_vma=False)
        )

    def keys(self, first: int) -> jax.Array:
        """The keys of seeds first, first + 1, …, [padded]; the padding repeats the last."""
        seeds = self.pad(first + np.arange(self.num_seeds))
        return self.place(jax.vmap(jax.random.key)(jnp.asarray(seeds)))

    def place(self, tree: Any, specs: Any = SEEDS) -> Any:
        """Distribute arrays [num_seeds] or [padded] over the devices, as `map` is given them; every process has all."""

        def part(spec: PartitionSpec, part: Any) -> Any:
            return jax.tree.map(lambda x: _spread(self.pad(x), NamedSharding(self.mesh, spec)), part)

        return jax.tree.map(part, specs, tree)

    def like(self, shapes: Any, specs: Any = SEEDS) -> Any:
        """Shapes [padded] with how such arrays lie on the devices, to compile what `map` makes before there are any."""

        def part(spec: PartitionSpec, part: Any) -> Any:
            sharding = NamedSharding(self.mesh, spec)
            return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), part)

        return jax.tree.map(part, specs, shapes)

    def pad(self, values: Any) -> Any:
        """Repeat the last seed's entry up to `padded`."""
        return values[np.minimum(np.arange(self.padded), len(values) - 1)]

    def replicate(self, tree: Any) -> Any:
        """Give every device a copy."""
        return jax.tree.map(lambda x: _spread(x, NamedSharding(self.mesh, PartitionSpec())), tree)

    def gather(self, tree: Any) -> Any:
        """Arrays on the host of every process, without the padding; of keys the words."""
        return jax.tree.map(lambda x: processes.gather(x)[: self.num_seeds], tree)


def _groups(num_seeds: int, shares: Sequence[int]) -> list[list[Any]]:
    """The devices that take a seed together, at most `num_seeds` groups; each of one process, if that leaves none out."""
    each = [jax.local_devices(process) for process in range(jax.process_count())]
    for share in shares:
        cut = lambda devices, n=share: [devices[i : i + n] for i in range(0, len(devices) - n + 1, n)]  # noqa: E731
        in_turn = [group for turn in zip_longest(*map(cut, each)) for group in turn if group is not None]
        across = cut([device for local in each for device in local])
        for groups in (in_turn, across):
            enough = len(groups) >= num_seeds or (groups and share == shares[-1])
            reached = {device.process_index for group in groups[:num_seeds] for device in group}
            if enough and len(reached) == len(each):
                return groups[:num_seeds]
    if jax.device_count() < shares[-1]:
        raise ConfigError(f"devices_per_seed: found {shares[-1]}, there are {jax.device_count()} devices")
    raise ConfigError(f"seeds: expected one for each of {len(each)} processes, found {num_seeds}")


def _spread(x: Any, sharding: NamedSharding) -> jax.Array:
    if is_key(x):
        return jax.random.wrap_key_data(_spread(jax.random.key_data(x), sharding))
    if sharding.is_fully_addressable:
        return jax.device_put(x, sharding)
    host = np.asarray(x, jnp.result_type(x))
    return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])


def isolated(function: Callable[..., Any]) -> Callable[..., Any]:
    """Keep the compiler from fusing a seed's program with its surroundings, so that its bits do not depend on them.

    The first two arguments are arrays, further ones are static.
    """

    def alone(shared: Any, one: Any, *static: Any) -> Any:
        return jax.lax.optimization_barrier(function(*jax.lax.optimization_barrier((shared, one)), *static))

    return alone
