"""Starts of a training from the boxes of a certificate."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.environment import Environment
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host.options import resolve
from jaxsafe.verify.certificate import save_certificate
from jaxsafe.verify.verify import verify

BOX = {"position": [[300.0, 310.0], [80.0, 90.0]], "velocity": [-0.1, 0.1]}


@pytest.fixture(scope="module")
def unproved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a certificate in which every box is open, because there was no time."""
    path = tmp_path_factory.mktemp("certificates") / "proof.npz"

    def still(key: Any, observation: Any) -> Any:
        return 0.0 * observation[..., :2]

    save_certificate(path, verify(jaxsafe.make("docking2d"), still, BOX, 1, seconds=0.0), {})
    return path


def starts(env: Environment, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    keys = jax.random.split(jax.random.key(0), count)
    state, _ = jax.vmap(env.reset)(keys)
    own = state.sim.platforms["deputy"]
    return np.asarray(own.position), np.asarray(own.velocity)


def test_every_second_start_is_in_a_box_that_is_not_proved(unproved: Path) -> None:
    config, env, _ = resolve({"env": "docking2d", "starts": str(unproved)})
    assert config.starts == str(unproved)
    position, velocity = starts(env)
    inside = position[:, 0] > 299.0
    assert 160 < inside.sum() < 240
    assert np.all((position[inside] >= [300, 80]) & (position[inside] <= [310, 90]))
    assert np.all(np.abs(velocity[inside]) <= 0.1)
    assert np.all(np.linalg.norm(position[~inside], axis=1) < 151.0)
    assert jaxsafe.load(jaxsafe.dump(env)) == env


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"env": "docking3d"},
            "velocity.y; the start of 'deputy' draws position, velocity in 3 axes",
        ),
        ({"env": "rejoin2d"}, "the start of 'wingman' draws position, heading, speed in 2 axes"),
        ({"env": "docking2d", "starts": "missing.npz"}, "missing.npz"),
    ],
)
def test_a_certificate_that_does_not_fit_is_told_in_one_line(
    options: dict[str, Any], message: str, unproved: Path
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        resolve({"starts": str(unproved), **options})
    assert "\n" not in str(caught.value)


def test_a_certificate_without_an_open_box_has_no_starts(
    unproved: Path, tmp_path: Path, rewrite: Callable[[Path, Path], None]
) -> None:
    rewrite(unproved, tmp_path / "done.npz")
    with pytest.raises(ConfigError, match=r"done\.npz has no box that is open or refuted"):
        resolve({"env": "docking2d", "starts": str(tmp_path / "done.npz")})


@pytest.fixture
def rewrite() -> Callable[[Path, Path], None]:
    def without_boxes(source: Path, target: Path) -> None:
        arrays = dict(np.load(source))
        np.savez(target, **{k: x[:0] if "/" in k and "open" in k else x for k, x in arrays.items()})

    return without_boxes


def test_a_box_of_a_certificate_is_a_number_of_the_environment(unproved: Path) -> None:
    _, env, _ = resolve({"env": "docking2d", "starts": str(unproved)})
    always = jaxsafe.override(env, {"deputy.start.boxes.share": 1.0})
    position, _ = starts(always, 50)
    assert np.all(position[:, 0] >= 300.0)
    assert jnp.isfinite(position).all()
