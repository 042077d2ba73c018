from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from default_cases import thorough
from PIL import Image

import jaxsafe
from jaxsafe.evaluate.episodes import begin_recording, record_steps
from jaxsafe.plot.animation import Scene, animate


def recorded(env: jaxsafe.Environment, steps: int) -> Any:
    """Return the record of an episode of random actions."""
    policy = lambda key, o: jax.random.uniform(key, (*o.shape[:-1], env.action_size), minval=-1.0)  # noqa: E731
    key = jax.random.key(0)
    position, start = jax.jit(begin_recording, static_argnums=(1, 3))(env, policy, key, 1)
    _, later = jax.jit(record_steps, static_argnums=(1, 4))(env, policy, key, position, steps)
    return jax.tree.map(
        lambda x, y: np.concatenate([np.asarray(x), np.asarray(y)[:, 0]]), start, later
    )


@pytest.mark.parametrize(("task", "maps"), [thorough("docking2d_oriented", 1), ("rejoin3d", 2)])
def test_a_scene_shows_the_agent_where_it_is(task: str, maps: int) -> None:
    env = jaxsafe.make(task)
    states, timesteps = recorded(env, 12)
    scene = Scene(env, states.sim, timesteps.info.margins, task)
    assert len(scene.maps) == maps
    first = scene.draw(0)
    last = scene.draw(12)
    assert first.dtype == np.uint8
    assert first.shape == last.shape
    assert (first != last).any()
    shown = scene.moving[0]["platforms"][env.agent][1].get_xydata()[0]
    sim = scene.sim
    other = next(name for name in sim.platforms if name != env.agent)
    expected = sim.platforms[env.agent].position[12] - sim.platforms[other].position[12]
    np.testing.assert_allclose(shown, expected[:2], rtol=1e-5)
    assert all(abs(expected[i]) < scene.maps[0].get_xlim()[1] for i in (0, 1))


def test_names_and_titles_are_drawn_letter_by_letter() -> None:
    env = jaxsafe.make("docking2d")
    regions = tuple(region.replace(name="$\\frac{$") for region in env.regions)
    status = tuple(
        part.replace(region="$\\frac{$") if hasattr(part, "region") else part for part in env.status
    )
    constraints = tuple(part.replace(name="_$\\frac{$") for part in env.constraints)
    env = jaxsafe.config.build(env.replace(regions=regions, status=status, constraints=constraints))
    states, timesteps = recorded(env, 2)
    scene = Scene(env, states.sim, timesteps.info.margins, "$\\frac{$")
    scene.draw(2)
    legend = scene.curves[1].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["\u200b_\\$\\frac{\\$"]


def test_an_animation_repeats_and_rests_at_the_end(tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 10.0})
    with Image.open(animate(env, recorded(env, 11), tmp_path / "x.gif", "docking2d")) as image:
        assert image.n_frames == 12  # type: ignore[attr-defined]
        assert image.info["loop"] == 0
        image.seek(11)
        assert image.info["duration"] == 1500
