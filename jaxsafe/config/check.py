"""Checks that the parts of a composed environment fit together.

Names must refer to parts that exist, and to earlier parts where order matters. The environment must
also be one that can be traced.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.stages import Compiled

from jaxsafe.config.tied import check_ties, one_number
from jaxsafe.environment import Environment, empty_sim, modelled, reset, step
from jaxsafe.metrics import OVER_STEPS
from jaxsafe.schema.component import Component, fields
from jaxsafe.schema.convert import to_value
from jaxsafe.schema.dotted_paths import join, references, set_path
from jaxsafe.schema.errors import ConfigError, choices_text, show, summarise_error
from jaxsafe.schema.ties import follow
from jaxsafe.schema.user_modules import modules
from jaxsafe.simulation.platform import Platform
from jaxsafe.transition import judge, regions_so_far
from jaxsafe.types import is_key

MAX_PARTS = 1000
"""Largest number of parts of a section.

Each part is traced by itself, which takes about ten seconds for this many.
"""

_SECTIONS = (
    "platforms",
    "regions",
    "status",
    "constraints",
    "uncertainty",
    "terminal",
    "reward",
    "observation",
)


def check(env: Environment, before: Environment | None = None) -> Environment:
    """Return the environment unchanged if its parts fit together.

    Args:
        env: the environment.
        before: an environment that has passed, if there is one. If `env` differs from it in numbers
            only, `env` is not traced again. Its filter is still checked, because it may not suit
            the new numbers.

    Raises:
        ConfigError: one line that names the part that does not fit and what it may refer to.
    """
    names = {section: [part.name for part in getattr(env, section)] for section in _SECTIONS}
    for section, part_names in names.items():
        _check_names(section, part_names)
    _check_names("outcomes", env.outcomes)
    names["outcomes"] = list(env.outcomes[1:])
    names["places"] = names["platforms"] + names["regions"]
    _check_reference("agent", env.agent, names["platforms"])
    for section in _SECTIONS:
        for index, part in enumerate(getattr(env, section)):
            earlier = names[section][:index]
            for place, refers, name in references(part, f"{section}.{part.name}"):
                # Later parts are not there yet when a start is drawn, a region is placed or a
                # status is evaluated.
                at_start = place.startswith(f"platforms.{part.name}.start")
                early = at_start or section in ("status", "regions")
                known = names[refers.section]
                which = ""
                if at_start and refers.section == "places":
                    known = earlier + [region.name for region in regions_so_far(env, earlier)]
                    which = " placed before it"
                elif early and refers.section == section:
                    known = earlier
                    which = " listed before it"
                elif section == "regions" and refers.section == "places":
                    known = names["platforms"] + earlier
                    which = " listed before it" if name in names["regions"] else ""
                _check_reference(place, name, known, which)
    for place, refers, name in references(env.rta, "rta") if env.rta else ():
        if refers.section != "parameters":
            _check_reference(place, name, names[refers.section])
    _check_measure(env, names["status"])
    _check_problems(env)
    for platform in env.platforms:
        _check_platform(platform, is_agent=platform.name == env.agent)
    _check_space(env)
    for required in ("terminal", "reward", "observation"):
        if not names[required]:
            raise ConfigError(f"{required}: an environment needs at least one")
    check_ties(env)
    _check_randomized(env)
    _check_model(env)
    if before is None or _shapes(env) != _shapes(before):
        _check_computable(*_shapes(env), jnp.result_type(float))
    # What a filter can prove depends on the numbers, so the filter is checked in either case.
    _check_suited(env)
    return env


def _check_problems(env: Environment) -> None:
    """Check each component by its own `problem`.

    A part with traced numbers is passed over, because they cannot be judged.
    """
    for part, place in _parts_and_filter(env):
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(part)):
            continue
        # JAX would compile each comparison of its own arrays.
        on_host = jax.tree.map(lambda x: x if is_key(x) else np.asarray(x), part)
        for component, component_place in _with_inner(on_host, place):
            try:
                # Inside a trace, comparisons of constants would be traced too.
                with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
                    problem = component.problem()
            except ConfigError:
                raise
            except Exception as error:
                reason = summarise_error(error, modules(component))
                raise ConfigError(f"{component_place}: cannot be checked: {reason}") from error
            if problem:
                raise ConfigError(f"{component_place}: {problem}")


def _parts(env: Environment) -> Iterator[tuple[Component, str]]:
    """Yield every part of every section, with its place."""
    for section in _SECTIONS:
        for part in getattr(env, section):
            yield part, f"{section}.{part.name}"


def _parts_and_filter(env: Environment) -> Iterator[tuple[Component, str]]:
    """Yield every part of every section and the filter, each with its place."""
    yield from _parts(env)
    if env.rta is not None:
        yield env.rta, "rta"


def _with_inner(component: Component, place: str) -> Iterator[tuple[Component, str]]:
    """Yield the components inside a component and then itself, each with its place."""
    for name in fields(type(component)):
        value = getattr(component, name)
        for inner in value if isinstance(value, tuple) else (value,):
            if isinstance(inner, Component):
                yield from _with_inner(inner, join(join(place, name), getattr(inner, "name", "")))
    yield component, place


def _check_reference(place: str, name: str, known: Iterable[str], which: str = "") -> None:
    """Refuse a name that refers to nothing.

    Args:
        place: where the name stands.
        name: the name.
        known: the names of all parts to which it may refer.
        which: words for the message that say which parts these are.
    """
    known = list(known)
    if name not in known:
        raise ConfigError(
            f"{place}: nothing{which} is called {show(name)}{choices_text(name, known)}"
        )


def _check_measure(env: Environment, statuses: Sequence[str]) -> None:
    """Refuse a metric of one's own that is of no status, or takes something unknown of it."""
    allowed = [f"{status}.{over_steps}" for status in statuses for over_steps in OVER_STEPS]
    for name in env.measure:
        if name not in allowed:
            raise ConfigError(
                f"measure: expected STATUS.{{{', '.join(OVER_STEPS)}}}, found {show(name)}"
                f"{choices_text(name, allowed)}"
            )


def _check_names(place: str, names: Sequence[str]) -> None:
    """Refuse too many names, a name that stands twice, and one that is empty or has a dot."""
    if len(names) > MAX_PARTS:
        raise ConfigError(f"{place}: expected at most {MAX_PARTS:,} parts, found {len(names):,}")
    for name, count in Counter(names).items():
        if count > 1:
            raise ConfigError(f"{place}: the name {show(name)} stands twice")
        if not name or "." in name:
            raise ConfigError(f"{place}: expected a name without dots, found {show(name)}")


def _check_space(env: Environment) -> None:
    """Check that all platforms have the same dimension, and that parts and filter fit them."""
    dimensions = {platform.name: platform.dimension for platform in env.platforms}
    if len(set(dimensions.values())) > 1:
        found = ", ".join(f"{name} {dimension}" for name, dimension in dimensions.items())
        raise ConfigError(f"platforms: expected the same dimension for all, found {found}")
    for part, place in _parts_and_filter(env):
        for component, component_place in _with_inner(part, place):
            for name, misfit in component.misfits(env).items():
                raise ConfigError(f"{join(component_place, name)}: {misfit}")


def _check_platform(platform: Platform, is_agent: bool) -> None:
    place = f"platforms.{platform.name}"
    controller = platform.controller
    parts = [name for name in ("actuators", "commands") if name in fields(type(controller))]
    control_place = ".".join([place, "controller", *parts])
    _check_names(control_place, controller.names)
    for name in controller.names:
        if name not in platform.inputs:
            raise ConfigError(
                f"{control_place}: {platform.type_name} has no control {name!r}"
                f"{choices_text(name, platform.inputs)}"
            )
    if is_agent and not (controller.takes_actions and controller.names):
        raise ConfigError(
            f"agent: {platform.name!r} cannot be the agent: its controller takes no actions"
        )
    if controller.takes_actions and not is_agent:
        raise ConfigError(
            f"{place}.controller ({controller.type_name}): only the agent takes actions; "
            "choose from pilot, scripted, uncontrolled"
        )
    first = [initializer for initializer in platform.start if not initializer.redraws]
    _check_names(f"{place}.start", [name for initializer in first for name in initializer.draws])
    rest = vars(platform.shapes())
    drawn: set[str] = set()
    for initializer in platform.start:
        start_place = f"{place}.start.{initializer.name}"
        for name in initializer.draws:
            if name not in rest:
                which = "" if name == initializer.name else f"{name}: "
                raise ConfigError(
                    f"{start_place}: {which}no such state field{choices_text(name, rest)}"
                )
        undrawn = sorted({*initializer.draws} - drawn)
        if initializer.redraws and undrawn:
            raise ConfigError(
                f"{start_place}: {undrawn[0]} must be drawn before it, and nothing draws it"
            )
        drawn |= {*initializer.draws}
        if getattr(initializer, "direction", None) is not None:
            count = initializer.direction.dimension  # type: ignore[attr-defined]
            if (count,) != rest[initializer.name].shape:
                raise ConfigError(
                    f"{start_place}.direction: draws {count} numbers, "
                    f"the platform has {platform.dimension} dimensions; "
                    "give a polar range in space, none in the plane, no azimuth on a line"
                )


def _check_randomized(env: Environment) -> None:
    """Check the numbers that are drawn at random.

    Every path must lead to one number, and the numbers of its interval must be allowed there. Both
    bounds are tried, and 0 if it lies between them.
    """
    leaves: dict[int, str] = {}
    for path, interval in env.randomize.items():
        if path.split(".")[0] == "randomize":
            raise ConfigError(
                f"randomize.{path}: expected the path of a number outside `randomize`"
            )
        if isinstance(interval, Tracer):
            continue
        # Inside a trace, an element of a constant JAX array would be traced too.
        low, high = np.asarray(interval).tolist()
        if not np.isfinite(low) or not np.isfinite(high):
            raise ConfigError(f"randomize.{path}: expected finite bounds, found [{low}, {high}]")
        for value in (low, high, *([0.0] if low < 0.0 < high else [])):
            try:
                changed = set_path(env, path, value, _as_one_number)
                changed = follow(changed, env.tied, [path], to_value)
                if _shapes(changed) != _shapes(env):
                    raise ConfigError(
                        f"{path}: expected the path of one number, found that of a list"
                    )
                _check_problems(changed)
            except ConfigError as error:
                raise ConfigError(f"randomize: {error}") from None
        mark = object()
        index = next(
            i for i, leaf in enumerate(jax.tree.leaves(set_path(env, path, mark))) if leaf is mark
        )
        if index in leaves:
            raise ConfigError(
                f"randomize: {path} and {leaves[index]} are the same number; leave one out"
            )
        leaves[index] = path


def _as_one_number(value: Any, field: Any, place: str) -> Any:
    """Convert a value for `set_path`. The field must hold one number, or a mapping to numbers."""
    return to_value(one_number(value, field, place), field, place)


def _check_model(env: Environment) -> None:
    """Check that each number of `rta.model` may replace a number of the environment."""
    for path, value in env.rta.model.items() if env.rta else ():
        if isinstance(value, Tracer):
            continue
        try:
            if path.split(".")[0] in ("rta", "randomize", "tied", "uncertainty"):
                raise ConfigError(
                    f"{path}: expected the path of a number that a filter predicts with"
                )
            changed = set_path(env, path, np.asarray(value).tolist(), _as_one_number)
            if _shapes(changed) != _shapes(env):
                raise ConfigError(f"{path}: expected the path of one number, found that of a list")
            _check_problems(changed)
        except ConfigError as error:
            raise ConfigError(f"rta.model: {error}") from None


def _shapes(env: Environment) -> tuple[Any, tuple]:
    """Return all that decides whether an environment can be traced: its structure and its shapes.

    Ties are part of it only if numbers are random.
    """
    leaves, structure = jax.tree.flatten(_as_traced(env))
    return structure, tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)


def _as_traced(env: Environment) -> Environment:
    """Return an environment without its ties, unless numbers are random."""
    return env if env.randomize else env.replace(tied={})


@lru_cache(maxsize=256)
def _check_computable(structure: Any, shapes: tuple, precision: Any) -> None:
    """Check everything that does not depend on numbers.

    Environments that differ in numbers only are traced once, because the result is cached.

    Args:
        structure: the tree structure of the environment.
        shapes: the shape and dtype of each leaf.
        precision: the dtype of a new number. It decides what comes out of the trace, so it is part
            of the cache's key.
    """
    env = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    _check_kinds(env)
    _check_tracing(env)


def _check_kinds(env: Environment) -> None:
    """Check that parts which need a boolean status refer to one, and likewise for numbers."""

    def statuses(env: Environment) -> Mapping[str, Any]:
        platforms = {platform.name: platform.rest() for platform in env.platforms}
        return judge(env, empty_sim(env).replace(platforms=platforms)).status

    try:
        shapes = jax.eval_shape(statuses, env)
    # The error is reported later with its place, when a reset and a step are traced.
    except Exception:
        return
    for part, part_place in _parts(env):
        for place, refers, name in references(part, part_place):
            if refers.section != "status" or refers.boolean is None:
                continue
            if refers.boolean != (shapes[name].dtype == bool):
                wanted = "true or false" if refers.boolean else "a number"
                raise ConfigError(
                    f"{place}: expected a status that is {wanted}, found {name!r}, which is not"
                )


def _check_tracing(env: Environment) -> None:
    """Trace one reset and one step, and report what does not fit together with its place."""

    def episode(env: Environment) -> Any:
        start, first = reset(env, jax.random.key(0))
        action = jnp.zeros(env.action_size, int if env.action_kind == "discrete" else None)
        return (start, first), step(env, start, action)

    try:
        begin, after = jax.eval_shape(episode, env)
    except ConfigError:
        raise
    except Exception as error:
        notes = getattr(error, "__notes__", ())
        place = next(
            (note.removeprefix("in ") for note in notes if note.startswith("in ")), "environment"
        )
        raise ConfigError(
            f"{place}: cannot be computed: {summarise_error(error, modules(env))}"
        ) from error
    memory = vars(begin[0].memory)
    later = vars(after[0].memory)
    for section in ("status", "reward", "observation"):
        for name, first in memory[section].items():
            if jax.tree.structure(first) != jax.tree.structure(later[section][name]):
                raise ConfigError(
                    f"{section}.{name}: its memory has another structure "
                    "after a step than after reset"
                )
    if jax.tree.structure(memory["rta"]) != jax.tree.structure(later["rta"]):
        raise ConfigError("rta: its memory has another structure after a step than after reset")
    for (path, old), new in zip(
        jax.tree_util.tree_leaves_with_path(begin), jax.tree.leaves(after), strict=True
    ):
        if (old.shape, old.dtype) != (new.shape, new.dtype):
            # The first entry of the path only says in which record the leaf is.
            place = jax.tree_util.keystr(path[1:], simple=True, separator=".").removeprefix("sim.")
            raise ConfigError(
                f"{place}: is {old.dtype}{list(old.shape)} after reset "
                f"and {new.dtype}{list(new.shape)} after a step"
            )


def _check_suited(env: Environment) -> None:
    """Reject a filter that reports a fault at every one of eight sampled starts.

    The filter judges the starts by the numbers that it predicts with, which are those of
    `rta.model`. An environment with traced numbers passes, because they cannot be judged.
    """
    if env.rta is None or any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(env)):
        return
    program = _fault_finder(*_shapes(env), jnp.result_type(float))
    if program is None:
        return
    # Inside a trace, what the program returns would be traced too.
    with jax.ensure_compile_time_eval():
        for fault, present in program(jax.tree.map(np.asarray, _as_traced(env))).items():
            if np.asarray(present).all():
                raise ConfigError(fault if fault.startswith("rta.") else f"rta: {fault}")


@lru_cache(maxsize=256)
def _fault_finder(structure: Any, shapes: tuple, precision: Any) -> Compiled | None:
    """Return the program that looks for faults of a filter, or None if it can report none.

    Args:
        structure: the tree structure of the environment.
        shapes: the shape and dtype of each leaf.
        precision: the dtype of a new number. It is part of the cache's key.
    """
    env = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    traced = jax.jit(_faults_of_starts).trace(env)
    return traced.lower().compile() if traced.out_info else None


def _faults_of_starts(env: Environment) -> Mapping[str, jax.Array]:
    """Return which of eight random starts have each of the faults that the filter knows."""
    return jax.vmap(_faults, in_axes=(None, 0))(env, jax.random.split(jax.random.key(0), 8))


def _faults(env: Environment, key: jax.Array) -> Mapping[str, jax.Array]:
    """Return whether the filter has each of the faults that it knows, at a random start."""
    assert env.rta is not None
    start, _ = reset(env.replace(rta=None, randomize=_without_filter(env.randomize)), key)
    return env.rta.unsuited(modelled(env), start.sim)


def _without_filter(paths: Mapping[str, Any]) -> dict[str, Any]:
    """Return the intervals of the random numbers that are not the filter's."""
    return {path: interval for path, interval in paths.items() if not path.startswith("rta.")}
