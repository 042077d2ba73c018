"""A trained policy that flies the lead."""

import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.agents import Agent, Pilot, read_policy, save_policy
from jaxsafe.agents.policy_file import find_policy
from jaxsafe.schema.component import normalise

PILOT = {"type": "pilot", "policy": "rejoin2d", "platforms": ["guide", "lead"]}
START = {
    "guide": {"position": [0.0, 0.0], "heading": 0.5, "speed": 270.0},
    "lead": {"position": [-4000.0, 5000.0], "heading": 2.0, "speed": 300.0},
    "wingman": {"position": [9000.0, 9000.0], "heading": 4.0, "speed": 350.0},
}


def three(**changes: Any) -> jaxsafe.Environment:
    """Return rejoin2d whose lead is flown by the policy of rejoin2d, after a guide."""
    rejoin = jaxsafe.make("rejoin2d")
    lead = rejoin.platform("lead")
    platforms = [lead.replace(name="guide"), lead, rejoin.platform("wingman")]
    controller = {**PILOT, **changes}
    return jaxsafe.make("rejoin2d", {"platforms": platforms, "lead.controller": controller})


@pytest.mark.thorough
def test_a_policy_flies_the_lead_as_it_flies_in_its_own_task() -> None:
    def coast(key: jax.Array, observation: jax.Array) -> jax.Array:
        return jnp.zeros(2)

    flight = jaxsafe.fly(three(), coast, start=START)
    start = {"lead": START["guide"], "wingman": START["lead"]}
    policy = jaxsafe.load_policy("rejoin2d")
    alone = jaxsafe.fly(jaxsafe.make("rejoin2d"), policy, start=start)
    assert alone.outcome == "success"
    flown, expected = flight.platforms["lead"], alone.platforms["wingman"]
    for name in ("position", "heading", "speed"):
        known = np.asarray(getattr(expected, name))
        atol = 1.0 if name == "position" else 1e-2
        found = np.asarray(getattr(flown, name))[: len(known)]
        np.testing.assert_allclose(found, known, atol=atol, err_msg=name)


def test_a_pilot_may_be_a_file_beside_that_of_the_environment(tmp_path: Path) -> None:
    shutil.copy(find_policy("rejoin2d"), tmp_path / "mine.npz")
    text = jaxsafe.dump(three())
    assert "policy: rejoin2d" in text
    assert jaxsafe.load(text) == three()
    file = tmp_path / "formation.yaml"
    file.write_text(text.replace("policy: rejoin2d", "policy: mine.npz"))
    assert jaxsafe.load(file).platform("lead").controller.names == ("heading_rate", "acceleration")


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        (
            {"platforms": ["guide"]},
            "expected platforms in the places of lead, wingman, found guide",
        ),
        (
            {"platforms": ["lead", "guide"]},
            "expected 'lead' in the place of wingman, found 'guide'",
        ),
        ({"platforms": ["guide", "leed"]}, "nothing is called 'leed'. Did you mean 'lead'"),
        ({"policy": "rejoin4d"}, "'rejoin4d' is no .npz file and not pretrained"),
        ({"policy": "docking2d"}, "dubins2d has no control 'thrust_x'"),
    ],
)
def test_a_pilot_that_does_not_fit_is_refused(changes: dict[str, Any], fault: str) -> None:
    with pytest.raises(jaxsafe.ConfigError, match=r"lead\.controller") as error:
        three(**changes)
    assert fault in str(error.value)


def test_a_policy_of_the_plane_is_refused_in_space() -> None:
    docking = jaxsafe.make("docking3d")
    pilot = Pilot(policy="docking2d", platforms=("chief", "chaser"))
    chaser = docking.agent_platform.replace(name="chaser", start=(), controller=pilot)
    with pytest.raises(jaxsafe.ConfigError) as error:
        jaxsafe.make("docking3d", {"platforms": [*docking.platforms, chaser]})
    place = "platforms.chaser.controller.policy"
    assert str(error.value) == (
        f"{place}: docking2d flies in a space of dimension 2, and the platforms have 3"
    )


def test_a_policy_that_remembers_is_refused(tmp_path: Path) -> None:
    env = jaxsafe.make("rejoin2d")
    agent = normalise(Agent(actor=jaxsafe.agents.GRU(hidden=(), units=2)))
    save_policy(tmp_path / "gru.npz", env, agent, agent.init(jax.random.key(0), env), {})
    assert read_policy(tmp_path / "gru.npz").agent.recurrent
    pilot = Pilot(policy=str(tmp_path / "gru.npz"), platforms=("guide", "lead"))
    with pytest.raises(jaxsafe.ConfigError, match="remembers, and a controller has no memory"):
        three(**vars(pilot))
