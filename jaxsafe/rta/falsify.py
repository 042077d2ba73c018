"""`python -m jaxsafe.rta.falsify env=docking2d rta=default`: tries to break a filter, and counts what happened.

Every adversary acts for a number of steps from the task's own starts. Episodes begin anew where they end. Violations are
counted at the samples, and inside the steps by moving the platforms to `PARTS` instants of each with the control held, with
the closest approach on the straight way between two of them.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxsafe import cli

PARTS = 8
OPTIONS = ("env", "rta", "steps", "lanes", "seed", "policies", "actions", "variant", "out")


def attack(env: Any, name: str, num_steps: int, num_lanes: int, key: Any) -> dict[str, Any]:
    """Let one adversary act.

    Args:
        env: the environment, with or without run time assurance.
        name: of the adversary, see `adversaries.ADVERSARIES`.
        num_steps: steps in each lane.
        num_lanes: episodes side by side.
        key: a typed PRNG key.

    Returns:
        Plain numbers: steps, episodes, violations, worst margins, interventions, mean correction, unsafe starts.
    """
    import numpy as np

    counts = {one: np.asarray(value, float) for one, value in _run(env, name, num_steps, num_lanes, key).items()}
    steps = num_steps * num_lanes
    episodes = num_lanes + counts["ended"].sum()
    return {
        "policy": name,
        "steps": steps,
        "episodes": int(episodes),
        "violating_steps": int(counts["violating"].sum()),
        "violating_steps_inside": int(counts["violating_inside"].sum()),
        "worst_margin": float(counts["lowest"].min()),
        "worst_margin_inside": float(counts["lowest_inside"].min()),
        "intervention_rate": float(counts["intervening"].sum() / steps),
        "mean_correction": float(counts["correction"].sum() / steps),
        "uncertified_steps": int(counts["uncertified"].sum()),
        "infeasible_steps": int(counts["infeasible"].sum()),
        "unsafe_starts": float(counts["unsafe_starts"].sum() / episodes),
        "violation_bound": 3.0 / steps,
    }


def report(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a table."""
    lines = [
        f"{'policy':12} {'steps':>10} {'violating':>10} {'inside':>8} {'worst h':>10} {'inside':>10}"
        f" {'altered':>8} {'‖Δu‖':>8}"
    ]
    lines += [
        f"{row['policy']:12} {row['steps']:>10,} {row['violating_steps']:>10,} {row['violating_steps_inside']:>8,}"
        f" {row['worst_margin']:>10.3g} {row['worst_margin_inside']:>10.3g} {row['intervention_rate']:>8.2%}"
        f" {row['mean_correction']:>8.3g}"
        for row in rows
    ]
    clean = [row for row in rows if not row["violating_steps"]]
    if clean:
        steps = sum(row["steps"] for row in clean)
        lines.append(
            f"{len(clean)} of {len(rows)} without a violation: below {3.0 / steps:.1g} a step with 95 % confidence"
        )
    return "\n".join(lines)


@functools.cache
def _compiled() -> Any:
    import jax

    return functools.partial(jax.jit, static_argnums=(1, 2, 3))(_attack)


def _run(*arguments: Any) -> Any:
    return _compiled()(*arguments)


def _attack(env: Any, name: str, num_steps: int, num_lanes: int, key: Any) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp

    from jaxsafe.environment import step
    from jaxsafe.rollout import reset_batch
    from jaxsafe.rta.adversaries import ADVERSARIES, smallest_margin
    from jaxsafe.rta.prediction import advance

    physical = _with_physical_actions(env)

    def inside(before: Any, control: Any) -> Any:
        """The smallest h within the step."""
        shares = jnp.arange(1, PARTS + 1) / PARTS
        later = jax.vmap(lambda share: advance(physical.replace(dt=physical.dt * share), before, control))(shares)
        first = jax.tree.map(lambda start, way: jnp.concatenate([start[None], way[:-1]]), bare(before), bare(later))
        return jnp.min(jax.vmap(lambda a, b: smallest_margin(physical, b, a))(first, bare(later)))

    def bare(sim: Any) -> Any:
        return sim.replace(regions={}, status={})

    def one(carry: tuple[Any, Any], key: Any) -> tuple[tuple[Any, Any], dict[str, Any]]:
        state, counts = carry
        key_act, key_reset = jax.random.split(key)
        keys = jax.random.split(key_act, num_lanes)
        controls = jax.vmap(lambda s, k: ADVERSARIES[name](physical, s.sim, k))(state, keys)
        after, timestep = jax.vmap(step, in_axes=(None, 0, 0))(physical, state, controls)
        lowest = jax.vmap(lambda s: smallest_margin(physical, s.sim))(after)
        within = jax.vmap(inside)(state.sim, timestep.info.control_actual)
        assurance = timestep.info.rta
        yes = jnp.ones_like(timestep.done)
        facts = {
            "violating": lowest < 0.0,
            "violating_inside": within < 0.0,
            "ended": timestep.done,
            "intervening": timestep.info.intervening,
            "correction": jnp.zeros_like(lowest) if assurance is None else assurance.correction,
            "uncertified": yes if assurance is None else ~assurance.certified,
            "infeasible": ~yes if assurance is None else ~assurance.feasible,
        }
        fresh, first = reset_batch(physical, key_reset, num_lanes)
        unsafe = _unsafe(first)
        facts["unsafe_starts"] = timestep.done & unsafe
        counts = {
            **{name: counts[name] + value for name, value in facts.items()},
            "lowest": jnp.minimum(counts["lowest"], lowest),
            "lowest_inside": jnp.minimum(counts["lowest_inside"], within),
        }
        done = timestep.done
        chosen = jax.tree.map(lambda a, b: jnp.where(done.reshape(done.shape + (1,) * (a.ndim - 1)), a, b), fresh, after)
        return (chosen, counts), {}

    key_start, key_run = jax.random.split(key)
    state, first = reset_batch(physical, key_start, num_lanes)
    zero, much = jnp.zeros(num_lanes), jnp.full(num_lanes, jnp.inf)
    names = ("violating", "violating_inside", "ended", "intervening", "correction", "uncertified", "infeasible")
    counts = dict.fromkeys(names, zero) | {
        "unsafe_starts": zero + _unsafe(first),
        "lowest": much,
        "lowest_inside": much,
    }
    return jax.lax.scan(one, (state, counts), jax.random.split(key_run, num_steps))[0][1]


def _unsafe(first: Any) -> Any:
    import jax.numpy as jnp

    if first.info.rta is not None:
        return ~first.info.rta.certified
    return jnp.min(jnp.stack(list(first.info.margins.values())), axis=0) < 0.0


def _with_physical_actions(env: Any) -> Any:
    """The environment with the agent's actions in physical units."""
    from jaxsafe.paths import set_path
    from jaxsafe.simulation.controllers import Continuous

    actuators = tuple(one.replace(rescale=False) for one in env.agent_platform.controller.actuators)
    return set_path(env, f"{env.agent}.controller", Continuous(actuators=actuators))


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code: 1 if there was a violation."""
    cli.enable_compilation_cache()
    import jax

    from jaxsafe.envs import make
    from jaxsafe.errors import ConfigError, nearest
    from jaxsafe.rta.adversaries import ADVERSARIES
    from jaxsafe.train.files import write_text

    arguments = cli.Arguments.parse(argv)
    task, out = arguments.pop_text("env"), arguments.pop_text("out")
    options = {name: arguments.pop_text(name) for name in ("rta", "variant", "actions")}
    changes = arguments.pop_overrides()
    steps, lanes = arguments.pop_count("steps", 100_000), arguments.pop_count("lanes", 256)
    seed, policies = arguments.pop_count("seed", 0, least=0), arguments.pop("policies", list(ADVERSARIES))
    arguments.refuse_rest([*OPTIONS, "env.…"])
    if task is None:
        raise ConfigError("env: missing; for instance env=docking3d")
    for name in policies if isinstance(policies, list) else [policies]:
        if name not in ADVERSARIES:
            raise ConfigError(f"policies: unknown policy {name!r}; choose from {nearest(name, ADVERSARIES)}")
    env = make(task, changes, **{**options, "rta": options["rta"] or "default"})
    if not env.constraints:
        raise ConfigError(f"env: {task} has no safety constraint")
    rows = []
    for name in policies if isinstance(policies, list) else [policies]:
        rows.append(attack(env, name, -(-steps // lanes), lanes, jax.random.key(seed)))
        print(report(rows[-1:]).splitlines()[1] if len(rows) > 1 else "\n".join(report(rows).splitlines()[:2]), flush=True)
    if report(rows).splitlines()[-1].endswith("confidence"):
        print(report(rows).splitlines()[-1])
    if out:
        write_text(Path(out), json.dumps({"env": task, **options, "seed": seed, "policies": rows}, indent=1) + "\n")
        print(f"written to {out}")
    return int(any(row["violating_steps"] for row in rows))


def usage() -> str:
    """The help text."""
    return (
        "usage: python -m jaxsafe.rta.falsify env=TASK [key=value …]\n\n"
        "  rta=default            the filter to attack; none attacks the bare task\n"
        "  steps=N                steps of each adversary (default 100000), over lanes=N episodes at once (default 256)\n"
        "  policies=[a,b]         some adversaries only\n"
        "  seed=N                 (default 0)\n"
        "  env.PATH=VALUE         change the environment\n"
        "  out=FILE.json          write the numbers"
    )


if __name__ == "__main__":
    cli.run(main, usage)
