"""Measure what is possible: bounds from theory, and the best flights that optimisation finds.

From every start the script flies the controllers and the packaged policy. Then it improves these
flights: corrections of their actions are found by gradient ascent through `jaxsafe.step`, each from
several restarts that are to arrive at different times. For docking it also looks for the least Δv,
from transfers by one push. A flight counts as the environment scores it, and only if it is a
success without a violation. Results are written to `benchmarks/results/possible.json` after every
task, where the rows of other tasks stay, and the table of docs/possible.md is printed:

    python benchmarks/possible.py [starts=32] [rounds=300] [tasks=docking3d,rejoin2d] [flights=true]

With `flights=false` the bounds alone are measured again, and the flights of the file stay.
"""

from __future__ import annotations

import functools
import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from isolated import several, words
from jaxtyping import Array, Float
from machine import about, with_kept
from tables import possible

import jaxsafe
from jaxsafe.bounds import best_possible
from jaxsafe.control import Align
from jaxsafe.control.docking import linear_model
from jaxsafe.control.law import ControlLaw
from jaxsafe.envs import STARTERS, TASKS, find_task
from jaxsafe.envs.rejoin import HOLD
from jaxsafe.evaluate.episodes import run_episodes
from jaxsafe.processors.terminal import time_limit
from jaxsafe.rollout import reset_batch
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.storage.files import read_json, write_json
from jaxsafe.types import State, TimeStep

OUT = Path(__file__).parent / "results" / "possible.json"
PPO = "ppo"
"""Name of the policy that comes with the package."""

LATER = {"docking": (0.1, 0.3, 0.6), "rejoin": (0.15, 0.3, 0.5, 0.75)}
"""When the restarts arrive, as shares of the way from the least length to that of the policy."""

TRANSFERS = (800, 1200, 1600, 2000, 2500, 3000)
"""Lengths of the transfers by one push [steps], as far as the timeout allows them."""

PUSHED = 24
"""Number of steps at the start of such a transfer whose thrust may be corrected."""

TURNED = 60
"""Number of steps before, in which a deputy that thrusts along its axis turns by 90° at most."""

FASTER = {"docking2d_oriented": (Align(share=0.97, approach=0.2), Align(share=0.985, approach=0.3))}
"""Controllers that fly nearer to the limit than those of the task, and break it from some starts.

Their flights are improved like the others.
"""

RATES = {"docking": 0.003, "rejoin": 0.03, "transfer": 0.0005}
"""First step sizes of Adam, in units of the action. They fall to 0."""

Base = Callable[[State, Array], Array]
"""Returns the action of a policy for one state and one observation."""


class Flights(NamedTuple):
    """Flights, each array [flights]."""

    succeeded: np.ndarray
    """Whether a flight succeeds without a violation."""
    length: np.ndarray
    episode_return: np.ndarray
    delta_v: np.ndarray


def base_policy(task: str, name: str | ControlLaw, env: jaxsafe.Environment) -> Base:
    """Return the packaged policy or a controller as a function of state and observation."""
    if name != PPO:
        law = isinstance(name, ControlLaw)
        policy: Any = (
            name.policy(env) if law else jaxsafe.load_policy(f"controller/{name}", env=env)
        )
        return lambda state, observation: policy.action(state)
    packaged: Any = jaxsafe.load_policy(task, env=env)
    return lambda state, observation: packaged(jax.random.key(0), observation[None])[0]


def coast(state: State, observation: Array) -> Array:
    """Return an action without thrust."""
    return jnp.zeros(state.sim.control_actual.shape)


def fly(
    env: jaxsafe.Environment,
    base: Base,
    start: tuple[State, TimeStep],
    corrections: Float[Array, "t m"],
) -> dict[str, Array]:
    """Fly one episode and return what is known of each step, arrays [t]."""

    @jax.checkpoint
    def one_step(carry: tuple[State, Array], correction: Array) -> tuple[Any, dict[str, Array]]:
        action = jnp.clip(base(*carry) + correction, -1.0, 1.0)
        state, timestep = jaxsafe.step(env, carry[0], action)
        seen = {
            "reward": timestep.reward,
            "cost": timestep.cost,
            "done": timestep.done,
            "outcome": timestep.info.outcome,
            **timestep.info.status,
        }
        if "rejoin_region" in state.sim.regions:
            region = state.sim.regions["rejoin_region"].position
            seen["to_region"] = region - state.sim.platforms[env.agent].position
        return (state, timestep.observation), seen

    state, timestep = start
    return jax.lax.scan(one_step, (state, timestep.observation), corrections)[1]


def docking_loss(seen: Mapping[str, Array], length: Array) -> Array:
    """Return Δv and penalties of a flight that is to dock after `length` steps."""
    step = jnp.arange(1, len(seen["reward"]) + 1)
    counted = step <= length
    miss = jnp.sum(jnp.where(step == length, seen["docking_distance"], 0.0))
    excess = jnp.maximum(seen["speed"] - seen["velocity_limit"] + 5e-4, 0.0)
    return (
        jnp.sum(jnp.where(counted, seen["delta_v"], 0.0))
        + 50.0 * jnp.maximum(miss - 0.45, 0.0) ** 2
        + 3000.0 * jnp.sum(jnp.where(counted, excess, 0.0) ** 2)
    )


def rejoin_loss(seen: Mapping[str, Array], length: Array) -> Array:
    """Return the penalties of a flight that is to succeed after `length` steps, less its gain."""
    step = jnp.arange(1, len(seen["reward"]) + 1)
    inside = (step >= length - HOLD) & (step <= length)
    way = seen["to_region"]
    radius = 145.0 if way.shape[-1] == 2 else 96.0
    outside = jnp.maximum(jnp.linalg.norm(way[:, :2] + 1e-6, axis=-1) / radius - 1.0, 0.0)
    if way.shape[-1] == 3:
        outside = outside + jnp.maximum(jnp.abs(way[:, 2]) / 145.0 - 1.0, 0.0)
    too_close = jnp.maximum(1.3 - seen["lead_distance"] / 100.0, 0.0)
    at_end = jnp.sum(jnp.where(step == length, seen["lead_distance"], 0.0))
    return (
        jnp.sum(jnp.where(inside, outside**2, 0.0))
        + jnp.sum(jnp.where(step <= length, too_close**2, 0.0))
        + 1e-4 * at_end
    )


@functools.partial(jax.jit, static_argnames=("base", "loss", "rounds"))
def improve(
    env: jaxsafe.Environment,
    base: Base,
    loss: Callable[..., Array],
    starts: tuple[State, TimeStep],
    corrections: Float[Array, "n t m"],
    free: Float[Array, " t"],
    lengths: Float[Array, " n"],
    rate: float,
    rounds: int,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the flights before and after gradient ascent on the corrections of their actions.

    Args:
        env: the environment.
        base: the policy whose actions are corrected.
        loss: what falls.
        starts: the states and time steps at the start, [n].
        corrections: the first corrections, [n, t, m].
        free: 1 for the steps whose corrections may change, else 0.
        lengths: the number of steps after which each flight is to succeed.
        rate: the first step size.
        rounds: the number of rounds.
    """
    flights = jax.vmap(functools.partial(fly, env, base))

    def total(corrections: Array) -> Array:
        return jnp.sum(jax.vmap(loss)(flights(starts, corrections), lengths))

    optimiser = optax.adam(optax.cosine_decay_schedule(rate, rounds))

    def one_round(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        corrections, memory = carry
        slope = jnp.nan_to_num(jax.grad(total)(corrections)) * free[:, None]
        change, memory = optimiser.update(slope, memory)
        return (optax.apply_updates(corrections, change), memory), None

    begin = (corrections, optimiser.init(corrections))
    (found, _), _ = jax.lax.scan(one_round, begin, None, rounds)
    return flights(starts, corrections), flights(starts, found)


def scored(env: jaxsafe.Environment, seen: Mapping[str, Any]) -> Flights:
    """Return what the environment says of flights, given arrays [n, t]."""
    seen = {name: np.asarray(values) for name, values in seen.items()}
    last = np.argmax(seen["done"], axis=1)
    counted = np.arange(seen["done"].shape[1]) <= last[:, None]
    outcome = np.take_along_axis(seen["outcome"], last[:, None], axis=1)[:, 0]
    safe = np.sum(np.where(counted, seen["cost"], 0.0), axis=1) == 0.0
    delta_v = seen.get("delta_v", np.zeros(counted.shape))
    return Flights(
        succeeded=seen["done"].any(axis=1) & np.asarray(env.succeeded(outcome)) & safe,
        length=last + 1,
        episode_return=np.sum(np.where(counted, seen["reward"], 0.0), axis=1),
        delta_v=np.sum(np.where(counted, delta_v, 0.0), axis=1),
    )


def repeated(starts: Any, count: int) -> Any:
    """Return each start `count` times."""
    return jax.tree.map(lambda x: jnp.repeat(x, count, axis=0), starts)


def pushes(env: jaxsafe.Environment, states: Float[np.ndarray, "n x"], length: int) -> np.ndarray:
    """Return the thrusts of transfers to the chief by one constant push [N], (n, PUSHED, d).

    The push takes as few steps as 95 % of 1 N on each axis allow.

    Args:
        env: docking with a thrust along each axis.
        states: position and velocity at the start.
        length: the number of steps of the transfers.
    """
    a, b = linear_model(env)
    size = b.shape[1]
    powers = [np.linalg.matrix_power(a, length - 1)]
    back = np.linalg.inv(a)
    for _ in range(PUSHED):
        powers.append(back @ powers[-1])
    drift = (states @ np.linalg.matrix_power(a, length).T)[:, :size]
    thrusts = np.zeros((len(states), PUSHED, size))
    waiting = np.ones(len(states), bool)
    for count in range(1, PUSHED + 1):
        effect = np.sum([power @ b for power in powers[:count]], axis=0)[:size]
        thrust = -np.linalg.solve(effect, drift.T).T
        fits = waiting & (np.abs(thrust).max(axis=1) <= 0.95)
        thrusts[fits, :count] = thrust[fits, None]
        waiting &= ~fits
    return thrusts


def transfers(env: jaxsafe.Environment, starts: State, length: int) -> np.ndarray:
    """Return the first actions of transfers to the chief by one push, (starts, steps, m).

    A deputy that thrusts along its body axis first turns the nearer end of it to where the push
    must go. Its turn gets faster for two steps, and slower in the last two.
    """
    state = starts.sim.platforms[env.agent]
    states = np.concatenate([state.position, state.velocity], axis=-1).astype(float)
    if not isinstance(env.agent_platform, OrientedSpacecraft):
        return pushes(env, states, length)
    plain = jaxsafe.make("docking2d")  # it has the same mass and orbit
    after_turn = states @ np.linalg.matrix_power(linear_model(plain)[0], TURNED).T
    push = pushes(plain, after_turn, length - TURNED)
    wanted = np.arctan2(push[:, 0, 1], push[:, 0, 0]) - np.asarray(state.attitude)
    angle = (wanted + np.pi / 2.0) % np.pi - np.pi / 2.0
    turn = np.zeros((len(states), TURNED + PUSHED))
    turn[:, :2] = (angle / (2.0 * TURNED - 4.0))[:, None]
    turn[:, TURNED - 2 : TURNED] = -turn[:, :2]
    thrust = np.zeros(turn.shape)
    thrust[:, TURNED:] = np.linalg.norm(push, axis=-1) * np.cos(wanted - angle)[:, None]
    controls = {"thrust": thrust, "attitude_acceleration": turn}
    actions = [
        actuator.to_continuous(jnp.asarray(controls[actuator.name])) for actuator in env.actuators
    ]
    return np.stack(actions, axis=-1)


def candidates(
    task: str, env: jaxsafe.Environment, starts: Any, bounds: Mapping[str, Any], rounds: int
) -> list[Flights]:
    """Return flights from each start, in several ways. Every array is [starts, ways]."""
    domain = "rejoin" if "rejoin" in task else "docking"
    loss = rejoin_loss if domain == "rejoin" else docking_loss
    count = len(bounds["length"])
    ways = []
    names = [*find_task(task).controllers, *[PPO] * (task in TASKS)]
    names = [name for name in names if name not in ("lqr", "mpc")]
    for name in [*names, *FASTER.get(task, ())]:
        base = base_policy(task, name, env)
        horizon = 160 if domain == "rejoin" else 700
        no_change = jnp.zeros((count, horizon, env.action_size))
        flown = scored(env, jax.jit(jax.vmap(functools.partial(fly, env, base)))(starts, no_change))
        ways.append(Flights(*(array[:, None] for array in flown)))
        shares = np.asarray(LATER[domain])
        wanted = bounds["length"][:, None] + shares * (flown.length - bounds["length"])[:, None]
        lengths = np.round(wanted).reshape(-1)
        horizon = int(lengths.max()) + 1
        _, found = improve(
            env,
            base,
            loss,
            repeated(starts, len(shares)),
            jnp.zeros((len(lengths), horizon, env.action_size)),
            jnp.ones(horizon),
            jnp.asarray(lengths),
            RATES[domain],
            rounds,
        )
        ways.append(_by_start(scored(env, found), count))
    if domain == "docking":
        last = float(time_limit(env) or 0.0)
        for length in [length for length in TRANSFERS if length <= last]:
            push = transfers(env, starts[0], length)
            rest = np.zeros((count, length + 1 - push.shape[1], env.action_size))
            both = improve(
                env,
                coast,
                loss,
                starts,
                jnp.asarray(np.concatenate([push, rest], axis=1), jnp.float32),
                jnp.asarray(np.arange(length + 1) < push.shape[1], jnp.float32),
                jnp.full(count, float(length)),
                RATES["transfer"],
                rounds // 3,
            )
            ways += [_by_start(scored(env, seen), count) for seen in both]
    return ways


def _by_start(flights: Flights, count: int) -> Flights:
    return Flights(*(array.reshape(count, -1) for array in flights))


def bounded(env: jaxsafe.Environment, count: int) -> tuple[Any, dict[str, np.ndarray]]:
    """Return starts, which are those of `jaxsafe.evaluate`, and the bounds from each of them."""
    key_start, _ = jax.random.split(jax.random.key(0))
    starts = jax.jit(reset_batch, static_argnums=2)(env, key_start, count)
    return starts, best_possible(env, starts[0])


def measure_bounds(task: str, count: int) -> dict[str, Any]:
    """Return the row of a task in the file, with bounds that are measured again."""
    row = next(row for row in read_json(OUT)["rows"] if row["task"] == task)
    _, bounds = bounded(jaxsafe.make(task), count)
    return {**row, "bound": {name: float(np.mean(values)) for name, values in bounds.items()}}


def measure(task: str, count: int, rounds: int) -> dict[str, Any]:
    """Return the bounds of a task, the best flights found and those of policies, as means."""
    began = time.perf_counter()
    env = jaxsafe.make(task)
    starts, bounds = bounded(env, count)
    names = [*find_task(task).controllers, *[PPO] * (task in TASKS)]
    rows = []
    flown = []
    for name in names:
        policy = jaxsafe.load_policy(task if name == PPO else f"controller/{name}", env=env)
        sums = jax.jit(run_episodes, static_argnums=(1, 3))(env, policy, jax.random.key(0), count)
        succeeded = np.asarray(env.succeeded(np.asarray(sums.outcome)))
        safe = np.asarray(sums.violating_steps) == 0
        values = (succeeded & safe, sums.length, sums.episode_return, sums.delta_v)
        flown.append(Flights(*(np.asarray(value)[:, None] for value in values)))
        rows.append({"policy": name, **_means(flown[-1], bounds)})
    ways = [*flown, *candidates(task, env, starts, bounds, rounds)]
    every = Flights(*(np.concatenate(arrays, axis=1) for arrays in zip(*ways, strict=True)))
    best = _best(every)
    row = {
        "task": task,
        "bound": {name: float(np.mean(values)) for name, values in bounds.items()},
        "best": {name: float(np.mean(best[name])) for name in bounds},
        "policies": rows,
        "wall_s": round(time.perf_counter() - began, 1),
    }
    print(json.dumps(row), flush=True)
    return row


def _best(flights: Flights) -> dict[str, np.ndarray]:
    """Return the best of the flights [starts, ways] from each start, for each quantity."""
    fails = ~flights.succeeded
    return {
        "length": np.min(np.where(fails, np.inf, flights.length), axis=1),
        "return": np.max(np.where(fails, -np.inf, flights.episode_return), axis=1),
        "delta_v": np.min(np.where(fails, np.inf, flights.delta_v), axis=1),
    }


def _means(flights: Flights, bounds: Mapping[str, np.ndarray]) -> dict[str, float]:
    values = {
        "length": flights.length,
        "return": flights.episode_return,
        "delta_v": flights.delta_v,
    }
    return {name: float(np.mean(values[name])) for name in bounds}


def main() -> None:
    """Run the command."""
    known = [*STARTERS, *TASKS]
    options = words(starts="32", rounds="300", tasks=",".join(known), flights="true")
    tasks = several("tasks", options["tasks"], known)
    starts = int(options["starts"])
    results = {
        "command": f"python benchmarks/possible.py {' '.join(sys.argv[1:])}".strip(),
        "starts": starts,
        "rounds": int(options["rounds"]),
        **about(__file__),
        "rows": [],
    }
    for task in tasks:
        anew = options["flights"] != "false"
        rounds = int(options["rounds"])
        row = measure(task, starts, rounds) if anew else measure_bounds(task, starts)
        results["rows"].append(row)
        write_json(OUT, with_kept(OUT, results, same=["task"]))
    results = read_json(OUT)
    print(possible(results))


if __name__ == "__main__":
    main()
