"""From an observation to the state that it shows, for control laws."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.environment import Environment
from jaxsafe.processors.observation import Observation, Observe, ObserveAngle, ObserveRegion
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.cwh import Anchor
from jaxsafe.simulation.geometry import to_global
from jaxsafe.types import RegionState, Sim

Needs = Iterable[tuple[str, str]]
"""Pairs of a platform or region and a quantity of it, such as `("deputy", "position")`."""

VECTORS = ("position", "velocity")
"""The observed quantities that are vectors. All others are numbers or angles."""


class Quantity(NamedTuple):
    """A quantity that an observation shows."""

    of: str  # name of a platform or region
    what: str  # name of the quantity, such as `position`
    relative_to: str | None  # name of the platform or region from which it is seen


def observed_sim(env: Environment, observation: Float[Array, " o"]) -> Sim:
    """Return the simulation that an observation shows.

    A quantity that is not observed has its value in `rest`. If only relative positions are
    observed, the agent is therefore at the origin. If its heading is not observed, the heading is
    0. So the world is shifted and turned about the vertical, and a control law returns the same
    control. What an observation clips stays clipped.

    Args:
        env: the environment.
        observation: one observation, shape (o,).

    Returns:
        A simulation with platforms, and with those regions whose position is observed relative to
        the agent. Its time is 0, and statuses are empty.
    """
    seen = _seen(env, observation)
    states = {
        platform.name: _observed_numbers(env, platform.name, seen) for platform in env.platforms
    }
    own = states[env.agent]
    vectors = {
        quantity: to_global(own.orientation, value) if _framed(item, env.agent) else value
        for item, quantity, value in seen
        if quantity.what in VECTORS
    }
    for platform in env.platforms:
        velocity = vectors.get(Quantity(platform.name, "velocity", None))
        if velocity is not None:
            states[platform.name] = platform.with_velocity(states[platform.name], velocity)
    position = _own_position(env, vectors)
    for name, state in states.items():
        apart = _between(vectors, of=name, to=env.agent)
        if name == env.agent:
            states[name] = state.replace(position=position)
        elif apart is not None:
            states[name] = state.replace(position=position + apart)
    regions = {}
    for region in env.regions:
        apart = vectors.get(Quantity(region.name, "position", env.agent))
        if apart is not None:
            regions[region.name] = RegionState(position=position + apart, inside={})
    return Sim(
        time=jnp.zeros((), position.dtype),
        platforms=states,
        regions=regions,
        status={},
        ended={},
        intervening=jnp.zeros((), bool),
    )


def require_observed(env: Environment, needs: Needs, law: str) -> None:
    """Refuse an environment that does not observe what a law needs.

    Args:
        env: the environment.
        needs: what the law must see, pairs of a platform or region and a quantity of it.
        law: the name of the law, for the message.

    Raises:
        ConfigError: a quantity is not observed.
    """
    shown = set()
    for item in env.observation:
        quantity = _quantity(item)
        if quantity:
            shown |= {(quantity.of, quantity.what), (quantity.relative_to, quantity.what)}
    for name, what in needs:
        if (name, what) not in shown:
            raise ConfigError(
                f"observation: controller {law} needs the {what} of {name}, which is not observed"
            )


def _seen(env: Environment, observation: Array) -> list[tuple[Observation, Quantity, Array]]:
    """Return each observation that shows the state, with its vector in physical units."""
    labels = [name.partition(".")[0] for name in env.observation_names]
    seen = []
    for item in env.observation:
        quantity = _quantity(item)
        if quantity is None:
            continue
        first = labels.index(item.name)
        value = observation[first : first + labels.count(item.name)] * item.scale
        value = value if item.offset is None else value + item.offset
        if getattr(item, "form", "rectangular") == "magnorm":
            value = value[0] * value[1:]
        seen.append((item, quantity, value))
    return seen


def _quantity(item: Observation) -> Quantity | None:
    """Return the quantity that an observation shows, or None if it is not one of the state."""
    if isinstance(item, Observe):
        return Quantity(item.of, item.what, item.relative_to)
    if isinstance(item, ObserveRegion):
        return Quantity(item.region, "position", item.relative_to)
    return Quantity(item.of, item.what, None) if isinstance(item, ObserveAngle) else None


def _framed(item: Observation, agent: str) -> bool:
    """Return whether a vector is observed in the agent's body frame."""
    return getattr(item, "frame", None) == agent


def _observed_numbers(
    env: Environment, name: str, seen: list[tuple[Observation, Quantity, Array]]
) -> Any:
    """Return the state of a platform at rest, but with the numbers and angles that are observed."""
    state = env.platform(name).rest()
    values = {}
    for item, quantity, value in seen:
        if quantity.of == name and quantity.what in vars(state) and quantity.what not in VECTORS:
            angle = isinstance(item, ObserveAngle)
            values[quantity.what] = jnp.arctan2(value[1], value[0]) if angle else value[0]
    return state.replace(**values)


def _between(vectors: Mapping[Quantity, Array], of: str, to: str) -> Array | None:
    """Return the position of one platform relative to another, if it is observed."""
    position = vectors.get(Quantity(of, "position", to))
    if position is not None:
        return position
    opposite = vectors.get(Quantity(to, "position", of))
    return None if opposite is None else -opposite


def _own_position(env: Environment, vectors: Mapping[Quantity, Array]) -> Array:
    """Return the agent's position: the observed one, or that relative to an anchor at the origin.

    If neither is observed, it is the position in `rest`.
    """
    observed = vectors.get(Quantity(env.agent, "position", None))
    anchors = [platform.name for platform in env.platforms if type(platform) is Anchor]
    apart = [_between(vectors, of=env.agent, to=name) for name in anchors]
    return next(
        (position for position in [observed, *apart] if position is not None),
        env.agent_platform.rest().position,
    )
