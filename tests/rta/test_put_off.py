"""Predictions are put off where a bound says what they would find."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe.rollout import reset_batch, step_or_reset_batch
from jaxsafe.rta import CertifiedRTA, Simplex
from jaxsafe.types import Sim

TASKS = ["rejoin2d", thorough("rejoin3d")]


def flown(env: Any, sim: Sim, key: jax.Array, farthest: float) -> Sim:
    """Return a simulation with the wingman at 110 ft from the lead or more.

    Half of them fly nearly as the lead does, the others anyhow.
    """
    far, heading, speed, roll, climb, lead_climb, kind = jax.random.uniform(key, (7,))
    lead = sim.platforms["lead"]
    wingman = sim.platforms["wingman"]
    offset = jax.random.normal(jax.random.fold_in(key, 1), lead.position.shape)
    offset *= 110.0 * (farthest / 110.0) ** far / jnp.linalg.norm(offset)
    spread = jnp.where(kind < 0.5, 0.2, 1.0)
    fields = {
        "position": lead.position + offset,
        "heading": lead.heading + spread * jnp.pi * (2.0 * heading - 1.0),
        "speed": lead.speed + spread * 200.0 * (2.0 * speed - 1.0),
    }
    if hasattr(wingman, "roll"):
        plant = env.agent_platform
        lowest, highest = plant.flight_path_angle_limits
        lead = lead.replace(flight_path_angle=0.3 * (2.0 * lead_climb - 1.0))
        climb = lead.flight_path_angle + spread * 0.7 * (2.0 * climb - 1.0)
        fields["flight_path_angle"] = jnp.clip(climb, lowest, highest)
        fields["roll"] = spread * plant.roll_limits[1] * (2.0 * roll - 1.0)
    fields["speed"] = jnp.clip(fields["speed"], *env.agent_platform.speed_limits)
    platforms = {**sim.platforms, "lead": lead, "wingman": wingman.replace(**fields)}
    return sim.replace(platforms=platforms, regions={}, status={})


@pytest.mark.parametrize("task", TASKS)
def test_a_prediction_that_is_put_off_would_have_certified(task: str) -> None:
    env = jaxsafe.make(task, rta="default")
    rta: Any = env.rta

    @jax.jit
    @jax.vmap
    def look(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        sim = flown(env, jaxsafe.reset(env.replace(rta=None), key)[0].sim, key, 8000.0)
        margin = rta.margin_to_certify(env)
        certain = rta._certain(env, sim, sim, margin=margin)
        return certain, jnp.max(rta.certify(env, sim, sim)) >= margin

    certain, certified = look(jax.random.split(jax.random.key(0), 20_000))
    assert 0.1 < certain.mean() < certified.mean() < 1.0
    assert certified[certain].all()


@pytest.mark.parametrize(
    "task", [thorough("rejoin2d"), pytest.param("rejoin3d", marks=pytest.mark.slow)]
)
def test_putting_off_changes_no_decision(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = jaxsafe.make(task, rta="default")

    def fly(key: jax.Array) -> Any:
        """Fly at the lead with random turns, so that the filter has to act."""
        keys = jax.random.split(key, 300)
        sims = jax.vmap(lambda sim, key: flown(env, sim, key, 1000.0))(
            reset_batch(env, key, 300)[0].sim, keys
        )
        state, timestep = jax.vmap(lambda sim: jaxsafe.reset_to(env, sim.platforms))(sims)

        def one_step(carry: Any, key: jax.Array) -> Any:
            key_action, key_reset = jax.random.split(key)
            action = jax.random.uniform(key_action, (300, env.action_size), minval=-1.0)
            carry, timestep = step_or_reset_batch(env, carry[0], action, key_reset)
            info = timestep.info
            assert info.rta is not None
            seen = (timestep.reward, info.intervening, info.rta.certified, carry[1])
            return carry, seen

        keys = jax.random.split(key, 60)
        return jax.lax.scan(one_step, (state, timestep.observation), keys)[1]

    assert not Simplex.looks_at_backup
    put_off = jax.jit(lambda key: fly(key))(jax.random.key(0))
    monkeypatch.setattr(Simplex, "looks_at_backup", True)
    at_once = jax.jit(lambda key: fly(key))(jax.random.key(0))
    assert np.asarray(at_once[1]).sum() > 50
    jax.tree.map(np.testing.assert_array_equal, put_off, at_once)


def test_nothing_is_put_off_beside_a_lead_that_turns() -> None:
    env = jaxsafe.make("rejoin2d", rta="default")
    env = jaxsafe.override(env, {"lead.controller.commands.heading_rate.at": 0.01})
    _, timestep = jaxsafe.reset(env, jax.random.key(0))
    assert isinstance(env.rta, CertifiedRTA)
    assert timestep.info.rta is not None
    assert timestep.info.rta.certified
    assert timestep.info.rta.backup_index >= 0
    _, timestep = jaxsafe.reset(jaxsafe.make("rejoin2d", rta="default"), jax.random.key(0))
    assert timestep.info.rta is not None
    assert timestep.info.rta.backup_index == -1
