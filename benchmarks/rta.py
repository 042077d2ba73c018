"""Measure what run time assurance costs and how much it changes.

- `calls`: filter calls a second on a batch of 4096 states, in float32. The states are met under
  random actions. Compiling is measured apart, and numbers are medians.
- `reserve`: seconds for rejoin3d's default filter close to the lead, at the task's starts and far
  away, as a multiple of those of a filter that predicts all backup controllers at every step.
- `qp`: the small quadratic program.
- `change`: how often and how much each docking filter alters random actions.
- `starts`: what becomes of starts that are not certified.
- `training`: what a filter in the loop adds to the wall time of training. Training with it and
  without it take turns.

All is measured on one core, with JAX set up as commands do it.

Where cbfpy or run-time-assurance is installed, its filter runs in the same invocation. Results are
written to `benchmarks/results/rta.json`, and the tables are printed:

    python benchmarks/rta.py [parts=calls,reserve,qp,change,starts,training] [repeats=7]
"""

from __future__ import annotations

import functools
import importlib
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from isolated import several, words
from machine import about
from tables import markdown

import jaxsafe
from jaxsafe.agents.agent import Agent
from jaxsafe.config import override
from jaxsafe.control.law import action_of
from jaxsafe.devices.seed_mapper import claim_cores
from jaxsafe.envs import TASKS
from jaxsafe.evaluate.adversaries import intercept
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.rollout import reset_batch, step_or_reset_batch
from jaxsafe.rta.qp import nearest_solution
from jaxsafe.rta.simplex import Simplex
from jaxsafe.schema.component import fields, normalise
from jaxsafe.train.hyperparameters import PPO
from jaxsafe.train.ppo import init, update
from jaxsafe.transition import bounds

OUT = Path(__file__).parent / "results" / "rta.json"
BATCH = 4096


def main() -> None:
    """Measure the chosen parts, write the results and print the tables."""
    parts = {
        "calls": calls,
        "reserve": reserves,
        "qp": programs,
        "change": changes,
        "starts": starts,
        "training": training,
    }
    claim_cores()
    options = words(repeats="7", parts=",".join(parts))
    repeats = int(options["repeats"])
    chosen = several("parts", options["parts"], parts)
    content = json.loads(OUT.read_text()) if OUT.exists() else {}
    for name in chosen:
        here = about(__file__)
        rows = parts[name](repeats)
        content[name] = {**here, "rows": rows}
        print(
            f"\n{name}\n"
            + markdown(list(rows[0]), ([_short(value) for value in row.values()] for row in rows))
        )
        OUT.write_text(json.dumps(content, indent=1) + "\n")


def timed(run: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Return the median wall time of a run and that of the first, in seconds."""
    began = time.perf_counter()
    jax.block_until_ready(run())
    first = time.perf_counter() - began
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - began)
    return statistics.median(times), first


def calls(repeats: int) -> list[dict[str, Any]]:
    """Measure filter calls a second."""
    rows = []
    for task in TASKS:
        presets = TASKS[task].filters
        for preset in (name for name in presets if name != "default"):
            env = jaxsafe.make(task, rta=preset)
            seconds, first = timed(functools.partial(filter_batch, env, *met(env)), repeats)
            rows.append(
                {
                    "task": task,
                    "filter": preset,
                    "calls_per_s": BATCH / seconds,
                    "compile_s": first - seconds,
                }
            )
            print(rows[-1], flush=True)
            jax.clear_caches()  # a process may have only so many programs
    return rows + cbfpy_calls(repeats) + run_time_assurance_calls(repeats)


DISTANCES: dict[str, tuple[float, float] | None] = {
    "close": (700.0, 1500.0),
    "as in the task": None,
    "far": (20_000.0, 30_000.0),
}
"""Distances to the lead [ft] at which the wingman starts, by name. None stands for the task's."""


class AllPredicted(Simplex):
    """A simplex that predicts the ways of all backup controllers at every step."""

    def _way(
        self, env: Any, before: Any, sim: Any, memories: Any, reserve: Any, required: Any
    ) -> Any:
        return self._best(env, self.follow(env, before, sim, memories))


def reserves(repeats: int) -> list[dict[str, Any]]:
    """Measure what is gained by predicting the backup controller in reserve first.

    The wingman intercepts the lead for 20 steps with the filter. Both filters then take turns in
    the states that are met.
    """
    rows = []
    for name, distance in DISTANCES.items():
        starts = {} if distance is None else {"wingman.start.position.distance": [*distance]}
        env = jaxsafe.make("rejoin3d", starts, rta="default")
        numbers = {field: getattr(env.rta, field) for field in fields(Simplex)}
        both = {"reserve": env, "all": env.replace(rta=AllPredicted(**numbers))}
        arguments = intercepting(env)
        times: dict[str, list[float]] = {kind: [] for kind in both}
        for _ in range(repeats + 1):  # in turns, and the first turn compiles
            for kind, each in both.items():
                run = functools.partial(filter_batch, each, *arguments)
                times[kind].append(timed(run, 1)[0])
        ratios = [a / b for a, b in zip(*(times[kind][1:] for kind in both), strict=True)]
        rows.append(
            {
                "task": "rejoin3d",
                "start": name,
                "calls_per_s": BATCH / statistics.median(times["reserve"][1:]),
                "all_calls_per_s": BATCH / statistics.median(times["all"][1:]),
                "ratio": statistics.median(ratios),
            }
        )
        print(rows[-1], flush=True)
    return rows


def intercepting(env: jaxsafe.Environment) -> tuple[Any, Any, jax.Array]:
    """Return simulations, the filter's memories, and controls towards where the lead will be."""

    def controls(sims: Any, key: jax.Array) -> jax.Array:
        return jax.vmap(functools.partial(intercept, env))(sims, jax.random.split(key, BATCH))

    @jax.jit
    def run(env: Any, key: jax.Array) -> Any:
        state, _ = reset_batch(env, key, BATCH)

        def one_step(state: Any, key: jax.Array) -> tuple[Any, None]:
            action = jax.vmap(functools.partial(action_of, env))(controls(state.sim, key))
            return step_or_reset_batch(env, state, action, key)[0][0], None

        return jax.lax.scan(one_step, state, jax.random.split(key, 20))[0]

    state = jax.block_until_ready(run(env, jax.random.key(0)))
    return state.sim, state.memory.rta, controls(state.sim, jax.random.key(1))


@jax.jit
def filter_batch(env: Any, sims: Any, memories: Any, desired: Any) -> Any:
    """Return what the filter of an environment returns for each of a batch of simulations."""
    return jax.vmap(functools.partial(env.rta.filter, env))(sims, memories, desired)


def memories(env: jaxsafe.Environment, sims: Any) -> Any:
    """Return the filter's memory at the start of an episode, for each simulation.

    It is None for an environment without a filter.
    """
    rta = env.rta
    return None if rta is None else jax.jit(jax.vmap(lambda sim: rta.begin(env, sim)[0]))(sims)


def met(env: jaxsafe.Environment, batch: int = BATCH) -> tuple[Any, Any, jax.Array]:
    """Return simulations, the filter's memories, and random controls.

    The simulations are those after 100 steps of random actions without a filter.
    """
    size = env.action_size
    low, high = bounds(env)

    @jax.jit
    def run(env: Any, key: jax.Array) -> Any:
        state, timestep = reset_batch(env, key, batch)

        def one_step(carry: Any, key: jax.Array) -> tuple[Any, None]:
            key_action, key_reset = jax.random.split(key)
            action = jax.random.uniform(key_action, (batch, size), minval=-1.0)
            return step_or_reset_batch(env, carry[0], action, key_reset)[0], None

        return jax.lax.scan(one_step, (state, timestep.observation), jax.random.split(key, 100))[0][
            0
        ]

    desired = low + (high - low) * jax.random.uniform(jax.random.key(1), (batch, size))
    sims = run(override(env, {"rta": None}), jax.random.key(0)).sim
    return jax.block_until_ready((sims, memories(env, sims), desired))


def docking_states() -> tuple[jax.Array, jax.Array]:
    """Return the states that peers filter, as vectors x, y, ẋ, ẏ, and random controls.

    They are those of `met` for docking2d.
    """
    sims, _, desired = met(jaxsafe.make("docking2d"))
    deputy = sims.platforms["deputy"]
    return jnp.concatenate([deputy.position, deputy.velocity], axis=-1), desired


def run_time_assurance_calls(repeats: int) -> list[dict[str, Any]]:
    """Measure the explicit ASIF of run-time-assurance for docking2d, where it is installed.

    It takes one state at a time.
    """
    try:
        docking = importlib.import_module("run_time_assurance.zoo.cwh.docking_2d")
    except ImportError:
        return []
    rta = docking.Docking2dExplicitOptimizationRTA()
    states, desired = (np.asarray(array)[:500] for array in docking_states())

    def run() -> None:
        for state, control in zip(states, desired, strict=True):
            rta.filter_control(state, 1.0, control)

    seconds, first = timed(run, repeats)
    row = {
        "task": "docking2d",
        "filter": "run-time-assurance, one at a time",
        "calls_per_s": len(states) / seconds,
    }
    return [row | {"compile_s": first - seconds}]


def cbfpy_calls(repeats: int) -> list[dict[str, Any]]:
    """Measure the filter of cbfpy for the docking constraint in a batch, where it is installed."""
    try:
        cbfpy = importlib.import_module("cbfpy")
    except ImportError:
        return []
    n = 0.001027
    mass = 12.0

    class Docking(cbfpy.CBFConfig):
        def __init__(self) -> None:
            super().__init__(n=4, m=2, u_min=-np.ones(2), u_max=np.ones(2))

        def f(self, z: jax.Array) -> jax.Array:
            return jnp.array([z[2], z[3], 3 * n**2 * z[0] + 2 * n * z[3], -2 * n * z[2]])

        def g(self, z: jax.Array) -> jax.Array:
            return jnp.concatenate([jnp.zeros((2, 2)), jnp.eye(2) / mass])

        def h_1(self, z: jax.Array) -> jax.Array:
            return jnp.array([0.2 + 2 * n * jnp.linalg.norm(z[:2]) - jnp.linalg.norm(z[2:])])

        def alpha(self, h: jax.Array) -> jax.Array:
            return 0.05 * h + 0.1 * h**3

    cbf = cbfpy.CBF.from_config(Docking())
    z, desired = docking_states()
    batched = jax.jit(jax.vmap(cbf.safety_filter))
    seconds, first = timed(lambda: batched(z, desired), repeats)
    return [
        {
            "task": "docking2d",
            "filter": "cbfpy, batched",
            "calls_per_s": BATCH / seconds,
            "compile_s": first - seconds,
        }
    ]


def programs(repeats: int) -> list[dict[str, Any]]:
    """Measure the small quadratic program: solutions a second, and the error against float64."""
    rng = np.random.default_rng(0)
    rows = []
    solve = jax.jit(jax.vmap(nearest_solution))
    for m in range(1, 7):
        problem = [
            rng.uniform(-1.0, 1.0, (BATCH, m)),
            -np.ones((BATCH, m)),
            np.ones((BATCH, m)),
            rng.normal(size=(BATCH, 2, m)),
            0.5 * rng.normal(size=(BATCH, 2)),
        ]
        single = [array.astype(np.float32) for array in problem]
        seconds, _ = timed(lambda single=single: solve(*single), repeats)
        solution = solve(*single)
        with jax.enable_x64():
            exact = solve(*(array.astype(np.float64) for array in single))
        both = np.asarray(solution.feasible & exact.feasible)
        error = np.abs(solution.control - exact.control).max(axis=1)[both]
        rows.append(
            {
                "variables": m,
                "rows": 2,
                "solutions_per_s": BATCH / seconds,
                "median_error": float(np.median(error)),
                "error_99_percent": float(np.quantile(error, 0.99)),
            }
        )
    return rows


def changes(repeats: int) -> list[dict[str, Any]]:
    """Count how often and how much random actions are altered.

    Also count the steps that violate a constraint all the same.
    """
    del repeats
    rows = []
    for task in ("docking2d", "docking3d"):
        for preset in ("discrete_asif", "explicit_simplex", "implicit_asif", "explicit_asif"):
            for policy in ("uniform", "bang_bang"):
                row = attack(jaxsafe.make(task, rta=preset), policy, 1000, 128, jax.random.key(0))
                names = ("violating_steps", "intervention_rate", "mean_correction", "worst_margin")
                rows.append(
                    {
                        "task": task,
                        "filter": preset,
                        "actions": policy,
                        **{name: row[name] for name in names},
                    }
                )
    return rows


def starts(repeats: int) -> list[dict[str, Any]]:
    """Count what becomes of the starts of oriented docking that are not certified, in 400 steps.

    The second pair of rows leaves out the fastest starts.
    """
    del repeats
    keys = jax.random.split(jax.random.key(7), 200_000)
    rows = []

    def uncertified(env: jaxsafe.Environment) -> Any:
        state, timestep = jax.jit(jax.vmap(jaxsafe.reset, in_axes=(None, 0)))(env, keys)
        return jax.tree.map(lambda leaf: leaf[~timestep.info.rta.certified], state)

    @jax.jit
    def margins(env: jaxsafe.Environment, lost: Any, action: jax.Array) -> jax.Array:
        array = jax.vmap(jaxsafe.step, in_axes=(None, 0, None))
        return jax.lax.scan(lambda state, _: array(env, state, action), lost, length=400)[
            1
        ].info.margins["velocity_limit"]

    for share in (1.0, 0.99):
        env = jaxsafe.make(
            "docking2d_oriented", {"deputy.start.velocity.share": [0.0, share]}, rta="default"
        )
        lost = uncertified(env)
        for name, value in (("coasting", 0.0), ("full thrust and turn", 1.0)):
            h = np.asarray(margins(env, lost, jnp.full(env.action_size, value)))
            steps = (h < 0.0).sum(axis=0)
            rows.append(
                {
                    "task": "docking2d_oriented",
                    "share of the limit": share,
                    "actions": name,
                    "starts": len(keys),
                    "not_certified": h.shape[1],
                    "violating": int((steps > 0).sum()),
                    "longest": int(steps.max(initial=0)),
                    "least_h": float(h.min()) if h.size else None,
                }
            )
    return rows


def training(repeats: int) -> list[dict[str, Any]]:
    """Measure the wall time of an update of PPO with a filter, as a multiple of that without."""
    agent = normalise(Agent())
    ppo = normalise(PPO(num_envs=64, num_steps=128))
    rows = []
    step = jax.jit(lambda env, state: update(env, agent, ppo, 100, state)[0])
    for task, presets in {
        "docking2d": ("explicit_simplex", "discrete_asif"),
        "docking3d": ("explicit_simplex", "discrete_asif"),
        "docking2d_oriented": ("default",),
        "rejoin2d": ("default",),
        "rejoin3d": ("default",),
    }.items():
        envs = {name: jaxsafe.make(task, rta=name) for name in ("none", *presets)}
        states = {name: init(env, agent, ppo, jax.random.key(0)) for name, env in envs.items()}
        times: dict[str, list[float]] = {name: [] for name in envs}
        for _ in range(repeats + 1):  # in turns, and the first turn compiles
            for name, env in envs.items():
                times[name].append(timed(functools.partial(step, env, states[name]), 1)[0])
        bare = times["none"][1:]
        for name in presets:
            ratios = [a / b for a, b in zip(times[name][1:], bare, strict=True)]
            rows.append(
                {
                    "task": task,
                    "filter": name,
                    "update_s": statistics.median(times[name][1:]),
                    "without_s": statistics.median(bare),
                    "ratio": statistics.median(ratios),
                }
            )
            print(rows[-1], flush=True)
    return rows


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
