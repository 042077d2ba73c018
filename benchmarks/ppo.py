"""Measure how many samples a second PPO learns from, beside other implementations.

All have the same settings on the same task: 2048 environments × 32 steps, 4 epochs of 8
minibatches, actor and critic of 2 × 64 tanh, on the task's observation. rejax, Brax and
Stable-Baselines3 take the task through `jaxsafe.adapters`. Stable-Baselines3 has its own loop and
takes 64 × 1024.

Each measurement is a process of its own, on one pinned core and on all. Peers run in Python
environments that this script builds in `benchmarks/peers`, since their versions exclude each other.
Compile time is measured apart. Numbers are medians of some repeats, in which all take turns. Other
rows are:

- ten seeds at once against one,
- this PPO with the sort of `jax.random.permutation` for its shuffle,
- PPO as it is mostly written in JAX (`usual_ppo.py`),
- `networks only` on one core, which takes a batch through the networks, forwards and backwards,
  steps with Adam, and does nothing else. What this PPO takes longer is spent elsewhere.

Results are written to `benchmarks/results/ppo.json`:

    python benchmarks/ppo.py [task=docking2d] [peers=rejax,brax,sb3] [repeats=3]
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from isolated import interpreter, probe, several, versions, words

OUT = Path(__file__).parent / "results" / "ppo.json"
NUM_ENVS = 2048
NUM_STEPS = 32
NUM_EPOCHS = 4
NUM_MINIBATCHES = 8
HIDDEN = (64, 64)
UPDATES = 8
BATCH = NUM_ENVS * NUM_STEPS
NETWORKS = "networks only"
PEERS = ("rejax", "brax", "sb3")


def main() -> None:
    """Measure, write the results and print the table."""
    options = words(task="docking2d", peers=",".join(PEERS), repeats="3")
    task = options["task"]
    repeats = int(options["repeats"])
    if "probe" in options:
        print(json.dumps(PROBES[options["probe"]](task)))
        return
    import tables
    from machine import about

    from jaxsafe.devices.seed_mapper import usable_cores

    here = about(__file__)
    peers = several("peers", options["peers"], PEERS)
    python = {name: interpreter(name) for name in PROBES if name in peers}
    cores = [1, usable_cores()]
    names = [name for name in PROBES if name in peers or name not in PEERS]
    rates_of: dict[tuple[str, int], list[float]] = {
        (name, count): [] for name in names for count in cores if count == 1 or name != NETWORKS
    }
    for _ in range(repeats):
        for name, count in rates_of:
            rates_of[name, count].append(
                probe(
                    __file__,
                    [f"probe={name}", f"task={task}"],
                    count,
                    python.get(name, sys.executable),
                )
            )
    rows = [
        {"peer": name, "cores": count, "samples_per_s": rates}
        for (name, count), rates in rates_of.items()
    ]
    content = {**here, "peers": versions(python), "task": task, "repeats": repeats, "runs": rows}
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print(tables.ppo(content))


def ours(task: str, seeds: int = 1, sort: bool = False) -> float:
    """Measure the samples a second of our PPO, as `jaxsafe.train` runs it, over all seeds.

    Args:
        task: the task.
        seeds: number of seeds.
        sort: whether the sort of `jax.random.permutation` replaces its shuffle.
    """
    from jaxsafe.devices.seed_mapper import claim_cores

    claim_cores()
    import jax

    from jaxsafe.train import ppo

    if sort:
        ppo.shuffle = jax.random.permutation
    fresh, advance, keys, shared = our_programs(task, seeds, UPDATES)
    state = fresh(shared, keys)
    advance = advance.lower(shared, state).compile()
    state, _ = jax.block_until_ready(advance(shared, state))
    start = time.perf_counter()
    jax.block_until_ready(advance(shared, state))
    return seeds * UPDATES * BATCH / (time.perf_counter() - start)


def our_programs(
    task: str, seeds: int, updates: int, num_envs: int = NUM_ENVS
) -> tuple[Any, Any, Any, Any]:
    """Return the two programs of our PPO, the keys of the seeds, and what all seeds share.

    The first program takes what is shared and the keys, and makes a fresh state. The second takes
    what is shared and a state, and makes some updates.
    """
    from jaxsafe.devices.seed_mapper import SeedMapper
    from jaxsafe.train.train import programs

    config, env = settings(task, num_envs)
    mapper = SeedMapper(seeds, config.shares)
    shared = mapper.replicate((env, config.agent, config.ppo))
    return *programs(mapper, updates, config.num_updates), mapper.keys(0), shared


def settings(task: str, num_envs: int = NUM_ENVS) -> tuple[Any, Any]:
    """Return the configuration of our PPO and the environment."""
    from jaxsafe.train.host.options import resolve

    config, env, _ = resolve(options_of(task, num_envs))
    return config, env


def options_of(task: str, num_envs: int = NUM_ENVS) -> dict[str, Any]:
    """Return the options with which `jaxsafe train` has the settings of this script."""
    return {
        "env": task,
        "preset": "observation_only",
        "agent.actor.hidden": [*HIDDEN],
        "steps": 10 * UPDATES * num_envs * NUM_STEPS,
        "ppo.num_envs": num_envs,
        "ppo.num_steps": NUM_STEPS,
        "ppo.num_epochs": NUM_EPOCHS,
        "ppo.num_minibatches": NUM_MINIBATCHES,
    }


def networks_only(task: str) -> float:
    """Measure the samples a second of the networks and Adam in our updates.

    There are no environments, no advantages and no shuffle.
    """
    from jaxsafe.devices.seed_mapper import claim_cores

    claim_cores()
    import jax
    import jax.numpy as jnp

    from jaxsafe.train import ppo

    config, env = settings(task)
    agent = config.agent
    hyper = config.ppo
    normal = lambda *shape: jax.random.normal(jax.random.key(len(shape)), (BATCH, *shape))  # noqa: E731
    batch = ppo.Batch(
        normal(env.observation_size), {}, normal(env.action_size), normal(), normal(), normal()
    )
    chunks = jax.tree.map(lambda x: x.reshape(NUM_MINIBATCHES, -1, ppo.CHUNK, *x.shape[1:]), batch)

    def forwards(params: Any, part: ppo.Batch) -> Any:
        """Run the actor once, as in a step, and the critic twice, on a state and on the next."""
        action = agent.distribution(env, params, part.inputs).mode()
        return (
            action.sum(),
            agent.value(params, part.inputs),
            agent.value(params, part.inputs + 1.0),
        )

    def minibatch(carry: Any, parts: ppo.Batch) -> tuple[Any, None]:
        params, optimizer = carry

        def add(total: Any, part: ppo.Batch) -> tuple[Any, None]:
            gradient, _ = jax.grad(ppo.loss, has_aux=True)(params, env, agent, hyper, part)
            return jax.tree.map(jnp.add, total, gradient), None

        gradient, _ = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), parts)
        step, optimizer = ppo._optimizer(hyper).update(gradient, optimizer)
        return (jax.tree.map(lambda p, s: p - 1e-4 * s, params, step), optimizer), None

    def update(carry: Any, _: None) -> tuple[Any, Any]:
        seen = jax.lax.map(
            lambda parts: jax.lax.map(lambda part: forwards(carry[0], part), parts), chunks
        )
        carry, _ = jax.lax.scan(
            lambda carry, _: jax.lax.scan(minibatch, carry, chunks), carry, None, NUM_EPOCHS
        )
        return carry, jax.tree.map(jnp.sum, seen)

    params = agent.init(jax.random.key(0), env)
    start = (params, ppo._optimizer(hyper).init(params))
    return timed(jax.jit(lambda carry: jax.lax.scan(update, carry, None, UPDATES)), start)


def usual_way(task: str) -> float:
    """Measure one seed of `usual_ppo.py`."""
    import jax

    run, start = usual_program(task)
    return timed(jax.jit(run), start(jax.random.key(0)))


def usual_program(task: str, num_envs: int = NUM_ENVS) -> tuple[Callable, Callable]:
    """Return a function that makes some updates of `usual_ppo.py`, and one that makes its start.

    The first takes a carry, the second a key, of which it makes the first carry.
    """
    import jax
    import usual_ppo

    import jaxsafe

    env = jaxsafe.make(task)

    def update(carry: Any, _: None) -> tuple[Any, None]:
        return usual_ppo.update(env, NUM_STEPS, NUM_EPOCHS, NUM_MINIBATCHES, carry), None

    return lambda carry: jax.lax.scan(update, carry, None, UPDATES), partial(
        usual_ppo.init, env, HIDDEN, num_envs
    )


def timed(run: Callable, start: Any) -> float:
    """Return the samples a second of the updates. The first call compiles and is not counted."""
    import jax

    jax.block_until_ready(run(start))
    began = time.perf_counter()
    jax.block_until_ready(run(start))
    return UPDATES * BATCH / (time.perf_counter() - began)


def rejax(task: str) -> float:
    """Measure the PPO of rejax, without its evaluations."""
    import jax

    return timed(rejax_trainer(task, UPDATES), jax.random.PRNGKey(0))


def rejax_trainer(task: str, updates: int, num_envs: int = NUM_ENVS) -> Any:
    """Return a function that makes some updates of rejax from a key."""
    import jax
    from rejax import PPO  # pyright: ignore[reportMissingImports]

    from jaxsafe.adapters.gymnax import GymnaxEnv

    env = GymnaxEnv(task, legacy=True)
    steps = updates * num_envs * NUM_STEPS
    algorithm = PPO.create(
        env=env,
        env_params=env.default_params,
        total_timesteps=steps,
        eval_freq=steps,
        skip_initial_evaluation=True,
        num_envs=num_envs,
        num_steps=NUM_STEPS,
        num_epochs=NUM_EPOCHS,
        num_minibatches=NUM_MINIBATCHES,
        learning_rate=3e-4,
        agent_kwargs={"hidden_layer_sizes": HIDDEN, "activation": "tanh"},
    )
    return jax.jit(algorithm.replace(eval_callback=lambda *_: ()).train)


def brax(task: str) -> float:
    """Return the samples a second that Brax's PPO reports itself.

    They leave out evaluations, and the first epoch, which compiles.
    """
    from brax.training.agents.ppo import train as ppo  # pyright: ignore[reportMissingImports]
    from brax.training.agents.ppo.networks import make_ppo_networks  # pyright: ignore[reportMissingImports]
    from jax.nn import tanh

    from jaxsafe.adapters.brax import BraxEnv, mend_brax, wrap

    mend_brax()
    seen = []
    networks = partial(
        make_ppo_networks,
        activation=tanh,
        policy_hidden_layer_sizes=HIDDEN,
        value_hidden_layer_sizes=HIDDEN,
    )
    ppo.train(
        BraxEnv(task),
        2 * UPDATES * BATCH,
        wrap_env_fn=wrap,
        episode_length=2000,
        num_envs=NUM_ENVS,
        num_evals=3,
        unroll_length=NUM_STEPS,
        batch_size=NUM_ENVS // NUM_MINIBATCHES,
        num_minibatches=NUM_MINIBATCHES,
        num_eval_envs=1,
        num_updates_per_batch=NUM_EPOCHS,
        network_factory=networks,
        progress_fn=lambda _, metrics: seen.append(metrics),
    )
    return float(seen[-1]["training/sps"])


def sb3(task: str) -> float:
    """Measure Stable-Baselines3's PPO over two rollouts of 64 × 1024."""
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]

    from jaxsafe.adapters.stable_baselines3 import SB3VecEnv

    torch.set_num_threads(len(os.sched_getaffinity(0)))
    model = PPO(
        "MlpPolicy",
        SB3VecEnv(task, 64),
        n_steps=BATCH // 64,
        batch_size=BATCH // NUM_MINIBATCHES,
        n_epochs=NUM_EPOCHS,
        policy_kwargs={"net_arch": list(HIDDEN)},
    )
    model.learn(BATCH)
    start = time.perf_counter()
    model.learn(2 * BATCH)
    return 2 * BATCH / (time.perf_counter() - start)


PROBES: dict[str, Callable[[str], float]] = {
    "jaxsafe": ours,
    "jaxsafe, ten seeds": partial(ours, seeds=10),
    "jaxsafe, sorting": partial(ours, sort=True),
    NETWORKS: networks_only,
    "usual way": usual_way,
    "rejax": rejax,
    "brax": brax,
    "sb3": sb3,
}

if __name__ == "__main__":
    main()
