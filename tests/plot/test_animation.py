import sys
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
from jaxsafe.schema.errors import ConfigError


def recorded(env: jaxsafe.Environment, steps: int) -> Any:
    """Return the record of an episode of random actions."""
    policy = lambda key, o: jax.random.uniform(key, (*o.shape[:-1], env.action_size), minval=-1.0)  # noqa: E731
    key = jax.random.key(0)
    position, start = jax.jit(begin_recording, static_argnums=(1, 3))(env, policy, key, 1)
    _, later = jax.jit(record_steps, static_argnums=(1, 4))(env, policy, key, position, steps)
    return jax.tree.map(
        lambda x, y: np.concatenate([np.asarray(x), np.asarray(y)[:, 0]]), start, later
    )


def scene_of(env: jaxsafe.Environment, steps: int, title: str = "title") -> Scene:
    """Return the scene of an episode of random actions."""
    states, timesteps = recorded(env, steps)
    scene = Scene(env, title)
    for step in range(steps + 1):
        sim, info = jax.tree.map(lambda x, step=step: x[step], (states.sim, timesteps.info))
        scene.add(sim, info)
    return scene


def points(line: Any) -> np.ndarray:
    """Return the points of a line in the plane or in space, shape (points, d)."""
    return np.stack(line.get_data_3d() if hasattr(line, "get_data_3d") else line.get_data(), axis=1)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("task", "dimension"),
    [
        ("docking2d", 2),
        thorough("docking2d_oriented", 2),
        thorough("docking3d", 3),
        ("rejoin3d", 3),
    ],
)
def test_a_scene_shows_the_agent_where_it_is_and_what_its_thrusters_do(
    task: str, dimension: int
) -> None:
    env = jaxsafe.make(task)
    states, timesteps = recorded(env, 12)
    scene = scene_of(env, 12)
    first = scene.draw(0)
    last = scene.draw(12)
    assert first.dtype == np.uint8
    assert first.shape == last.shape == (460, 860, 3)
    assert (first != last).any()
    platforms = states.sim.platforms
    agent = platforms[env.agent]
    other = platforms[next(name for name in platforms if name != env.agent)]
    expected = agent.position[12] - other.position[12]
    if "heading" in vars(other):  # x is along the heading of the lead
        cosine, sine = np.cos(other.heading[12]), np.sin(other.heading[12])
        x, y, *z = expected
        expected = np.array([cosine * x + sine * y, cosine * y - sine * x, *z])
    [shown] = points(scene._trails[env.agent][2])
    assert shown.shape == (dimension,)
    np.testing.assert_allclose(shown, expected, rtol=1e-5, atol=1e-2)
    assert np.abs(expected).max() < scene.map.get_xlim()[1]
    labels = [getattr(scene.map, f"get_{letter}label")() for letter in "xyz"[:dimension]]
    unit = "[ft]" if task.startswith("rejoin") else "[m]"
    assert all(label.endswith(unit) for label in labels)
    arrow = points(scene._arrow)
    if task.startswith("rejoin"):
        assert len(arrow) == 0
        # Where the lead came from lies straight behind it, as it flies straight on.
        behind = points(scene._trails["lead"][0])
        flown = np.linalg.norm(other.position[:13] - other.position[12], axis=1)
        np.testing.assert_allclose(behind[:, 0], -flown, rtol=1e-5, atol=1e-2)
        np.testing.assert_allclose(behind[:, 1:], 0.0, atol=1e-1)
        assert flown[0] > 1000.0
        return
    thrust = timesteps.info.control_actual[12][:dimension]
    if task == "docking2d_oriented":
        angle = agent.attitude[12]
        largest = float(env.actuators[0].high)
        thrust = thrust[0] / largest * np.array([np.cos(angle), np.sin(angle)])
    tail, tip = arrow[:2]
    np.testing.assert_allclose(tail, shown)
    root = np.sqrt(np.linalg.norm(thrust))
    np.testing.assert_allclose((tip - tail) / scene._reach, 0.4 * thrust / root, atol=1e-5)


@pytest.mark.thorough
def test_a_picture_while_the_episode_goes_on_shows_what_that_of_the_whole_episode_shows() -> None:
    env = jaxsafe.make("docking2d")
    states, timesteps = recorded(env, 70)
    live = Scene(env, "title")
    for step in range(71):
        sim, info = jax.tree.map(lambda x, step=step: x[step], (states.sim, timesteps.info))
        live.add(sim, info)
        live.draw()
    whole = scene_of(env, 70)
    whole.draw()
    for line, other in zip(live._moving[0][1], whole._moving[0][1], strict=True):
        if hasattr(line, "get_data"):
            np.testing.assert_allclose(points(line), points(other))
    assert live.curves[0].get_xlim()[1] > 70.0  # it began with room for fewer steps
    live.clear()
    assert not live.moments


def test_what_stands_still_is_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(jaxsafe.make("docking2d"), 12)
    drawn = []
    monkeypatch.setattr(scene.figure.canvas, "draw", lambda: drawn.append(1))
    monkeypatch.setattr(scene.figure.canvas, "copy_from_bbox", lambda box: object())
    monkeypatch.setattr(scene.figure.canvas, "restore_region", lambda region: None)
    monkeypatch.setattr(scene.figure, "draw_artist", lambda artist: None)
    for panel in scene.figure.axes:
        monkeypatch.setattr(panel, "draw_artist", lambda artist: None)
    monkeypatch.setattr(scene.figure.canvas, "buffer_rgba", lambda: np.zeros((4, 4, 4)))
    for step in range(13):
        scene.draw(step)
    assert len(drawn) == 1


@pytest.mark.thorough
def test_names_and_titles_are_drawn_letter_by_letter() -> None:
    env = jaxsafe.make("docking2d")
    regions = tuple(region.replace(name="$\\frac{$") for region in env.regions)
    status = tuple(
        part.replace(region="$\\frac{$") if hasattr(part, "region") else part for part in env.status
    )
    constraints = tuple(part.replace(name="_$\\frac{$") for part in env.constraints)
    env = jaxsafe.config.build(env.replace(regions=regions, status=status, constraints=constraints))
    scene = scene_of(env, 2, "$\\frac{$")
    scene.draw(2)
    assert scene.curves[1].get_ylabel() == "h of\n\u200b_\\$\\frac{\\$ [m/s]"


@pytest.mark.thorough
def test_an_animation_repeats_and_rests_at_the_end(tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 10.0})
    with Image.open(animate(env, recorded(env, 11), tmp_path / "x.gif", "docking2d")) as image:
        assert image.n_frames == 12  # type: ignore[attr-defined]
        assert image.info["loop"] == 0
        image.seek(11)
        assert image.info["duration"] == 1500


@pytest.mark.thorough
def test_ffmpeg_makes_an_mp4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = jaxsafe.make("docking2d")
    episode = recorded(env, 3)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="render: mp4 needs the program ffmpeg"):
        animate(env, episode, tmp_path / "x.mp4", "title")
    # This stands for ffmpeg: it writes its options, and the number of bytes that it has got.
    program = tmp_path / "ffmpeg"
    count = "import sys; print(*sys.argv[1:], len(sys.stdin.buffer.read()))"
    program.write_text(f"#!/bin/sh\nexec '{sys.executable}' -c '{count}' \"$@\"\n")
    program.chmod(0o755)
    *options, size = animate(env, episode, tmp_path / "x.mp4", "title").read_text().split()
    assert "860x460" in options
    assert int(size) == 860 * 460 * 3 * (4 + 20)  # the last frame rests
    program.write_text("#!/bin/sh\necho broken >&2\nexit 1\n")
    with pytest.raises(ConfigError, match="render: ffmpeg failed: broken"):
        animate(env, episode, tmp_path / "x.mp4", "title")
