"""The pages `docs/tasks/<task>.md` and their figures, from the environments themselves.

So they cannot drift from the environments. Run `python docs/make_tasks.py` after a change to a
task. `tests/docs/test_docs.py` compares the committed pages with it. The paragraphs above and below
the figure are written by hand. Every table comes from the components of `jaxsafe.make`.
"""

from __future__ import annotations

import inspect
import sys
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path

import jax
import numpy as np

import jaxsafe
from jaxsafe.commands.catalogue import number
from jaxsafe.environment import control_unit, length_unit
from jaxsafe.envs import TASKS
from jaxsafe.processors.observation import Observation, Observe, ObserveAngle, ObserveRegion
from jaxsafe.schema.component import Component, fields
from jaxsafe.simulation.platform import Platform
from jaxsafe.types import units

TARGET = Path(__file__).parent / "tasks"

DOCKING = (
    "A deputy spacecraft flies to within 0.5 m of a chief that rests at the origin of Hill's"
    " frame, on a circular orbit. Its speed must stay below a limit that falls with the distance."
    " A deputy that arrives faster has crashed."
)
REJOIN = (
    "A wingman flies to a point behind and beside a lead aircraft and stays in a small region about"
    " it for 20 s. It must keep 100 ft away from the lead. The lead flies straight on unless its"
    " script says otherwise."
)
TEXT = {
    "rejoin2d": (
        f"{REJOIN} Both fly at one altitude. The wingman commands its heading rate and its"
        " acceleration."
    ),
    "rejoin3d": (
        f"{REJOIN} The wingman commands its roll rate, the rate of its flight path angle and its"
        " acceleration. It turns because it banks. A positive flight path angle lowers z."
    ),
    "docking2d": (
        f"{DOCKING} The motion is in the plane of the orbit. One thruster pair acts along each"
        " axis."
    ),
    "docking3d": f"{DOCKING} The motion is in space. One thruster pair acts along each axis.",
    "docking2d_oriented": (
        f"{DOCKING} The motion is in the plane of the orbit. One thruster acts along the body's x"
        " axis, stronger forwards than backwards. A reaction wheel turns the body, so the deputy"
        " must first point and then push."
    ),
}
"""A paragraph that says what a task is."""

CAPTION = {
    "deputy": (
        "Starts are drawn from the blue ranges (dots: three of them). A scripted policy flies to"
        " the chief at 90, 60 and 115 % of the speed limit. The last one crashes. x points away"
        " from the Earth, y along the orbit."
    ),
    "wingman": (
        "A scripted policy flies to the rejoin point and ignores the lead. One wingman succeeds,"
        " the other crashes into the lead. Dots and squares are starts."
    ),
}
"""A caption that says what the figure shows, by agent."""

FILM = {
    "deputy": "A trained policy docks. The margin h to the speed limit stays above 0.",
    "wingman": "A trained policy flies to the rejoin point and stays there.",
}
"""A caption of the film, by agent."""

HILL = (
    "r = (x, y) is the deputy's position relative to the chief, with x away from the Earth and y"
    " along the orbit."
)
EQUATIONS = {
    "docking2d": (
        r"""
        \ddot x &= 2n\dot y + 3n^2 x + F_x/m \\
        \ddot y &= -2n\dot x + F_y/m
        """,
        f"These are the Clohessy-Wiltshire equations, Eq. (12). {HILL} The thrust is held over a"
        " step, and the step is the exact solution.",
    ),
    "docking3d": (
        r"""
        \ddot x &= 2n\dot y + 3n^2 x + F_x/m \\
        \ddot y &= -2n\dot x + F_y/m \\
        \ddot z &= -n^2 z + F_z/m
        """,
        f"These are the Clohessy-Wiltshire equations, Eq. (16). {HILL} z completes the frame. The"
        " thrust is held over a step, and the step is the exact solution.",
    ),
    "docking2d_oriented": (
        r"""
        \ddot x &= 2n\dot y + 3n^2 x + F\cos\theta/m \\
        \ddot y &= -2n\dot x + F\sin\theta/m \\
        \ddot\theta &= u
        """,
        f"This is Eq. (20). {HILL} θ is the angle from the x axis to the body's x axis, F the"
        " thrust along it, and u the acceleration that the reaction wheel gives. θ̇ rests at its"
        " limit where it reaches it.",
    ),
    "rejoin2d": (
        r"""
        \dot x &= v\cos\psi \\
        \dot y &= v\sin\psi \\
        \dot\psi &= \omega \\
        \dot v &= a
        """,
        "This is Eq. (5), for both aircraft. ψ is the heading, ω the commanded heading rate and a"
        " the commanded acceleration. They are held over a step, the speed v rests at a limit where"
        " it reaches it, and the step is the exact solution.",
    ),
    "rejoin3d": (
        r"""
        \dot x &= v\cos\psi\cos\gamma \\
        \dot y &= v\sin\psi\cos\gamma \\
        \dot z &= -v\sin\gamma \\
        \dot\psi &= (g/v)\tan\phi \\
        \dot\phi &= p, \quad \dot\gamma = q, \quad \dot v = a
        """,
        "This is Eq. (9), for both aircraft. ψ is the heading, γ the flight path angle and φ the"
        " roll. p, q and a are the commanded rates and the commanded acceleration. They are held"
        " over a step, and γ, φ and v rest at a limit where they reach it. Positions follow by"
        " Gauss-Legendre quadrature of order 6.",
    ),
}
"""The equations of motion, and what their symbols mean."""

SAFE = {
    "deputy": (
        r"h = \nu_0 + \nu_1\lVert r\rVert - \lVert v\rVert \ge 0",
        "Here ν₀ = 0.2 m/s and ν₁ = 2n, Eqs. (14), (17).",
    ),
    "wingman": (
        r"h = \lVert r_\text{wingman} - r_\text{lead}\rVert - 100\,\text{ft} \ge 0",
        "This is Eqs. (8), (11).",
    ),
}
"""The safety constraint, and what its symbols mean, by agent."""

SECTIONS = (
    ("Regions", "", "regions"),
    (
        "Statuses",
        "Statuses are facts about the state, in this order. A status may use those above.",
        "status",
    ),
    ("Rewards", "The reward of a step is the sum of these terms.", "reward"),
    (
        "Ends of an episode",
        "The first condition that holds is the outcome. A bound of a reward term comes last.",
        "terminal",
    ),
    (
        "Safety constraints",
        "A state is safe where h ≥ 0. `cost` is 1 on a step on which a constraint is violated.",
        "constraints",
    ),
)
"""Heading, explanation and field of the sections that list parts."""


def page(task: str) -> str:
    """Return the Markdown page of a task."""
    env = jaxsafe.make(task)
    length = length_unit(env) or ""
    paths = (
        f"`jaxsafe.make({task!r}, {{path: value}})` takes a path from these tables, followed by a"
        " dot and the number's name."
    )
    blocks = [
        f"<!-- Written by docs/make_tasks.py. -->\n# {task}",
        TEXT[task],
        f"![A film of {task}](../baselines/{task}.gif)",
        f"*{FILM[env.agent]}*",
        "## Try it",
        try_it(task),
        "## Equations",
        *equations(task, env),
        "## Starts and ends",
        f"![Where {task} starts and how it ends]({task}.png)",
        CAPTION[env.agent],
        "## Numbers",
        (
            "The tables and equations named here are those of the [paper](index.md). Lengths are in"
            f" {length}, and the time step is {number(env.dt)} s. {paths}"
            " [Deviations](../deviations.md) says where the published code differs."
            f" [configs/envs/{task}.yaml](../../configs/envs/{task}.yaml) is the same task as one"
            " file."
        ),
        "## Platforms",
        *(block for platform in env.platforms for block in platform_blocks(platform, length)),
        "## Actions",
        (
            "Continuous actions lie in [−1, 1]. With"
            f" `jaxsafe.make({task!r}, actions='discrete')` they are indices of points."
        ),
        table(
            ("index", "actuator", "unit", "low", "high", "[−1, 1] maps to", "points"), actions(env)
        ),
        "## Observation",
        "Each element is divided by its divisor and then clipped.",
        table(("index", "element", "what it is", "divisor", "clip"), observation(env)),
    ]
    for title, about, section in SECTIONS:
        blocks += [
            f"## {title}",
            about,
            table(("path", "type", "what it is", "numbers"), parts(env, section, length)),
        ]
    return "\n\n".join(wrapped(block) for block in blocks if block) + "\n"


def try_it(task: str) -> str:
    """Return commands and a short program."""
    return textwrap.dedent(f"""\
        ```
        jaxsafe evaluate pretrained/{task} episodes=10 render=gif
        jaxsafe train {task} seeds=10
        ```

        ```python
        import jax
        import jaxsafe

        env = jaxsafe.make("{task}")
        policy = jaxsafe.load_policy("{task}")
        flights = jaxsafe.rollout(env, policy, jax.random.key(0), num_steps=600, num_envs=100)
        successes = env.succeeded(flights.info.outcome)
        print(int(successes.sum()), "successes,", int(flights.cost.sum()), "violating steps")
        ```""")


def equations(task: str, env: jaxsafe.Environment) -> Iterator[str]:
    """Yield the equations of motion and the safety constraint, with their symbols."""
    lines, about = EQUATIONS[task]
    yield f"$$\n\\begin{{aligned}}\n{inspect.cleandoc(lines)}\n\\end{{aligned}}\n$$"
    agent = env.agent_platform
    symbols = {"mean_motion": "n", "mass": "m", "gravity": "g"}
    numbers = [
        f"{symbols[name]} = {number(getattr(agent, name))} {field.unit.symbol}"
        for name, field in fields(type(agent)).items()
        if name in symbols and field.unit
    ]
    yield about + (f" {' and '.join(numbers)}." if numbers else "")
    constraint, meaning = SAFE[env.agent]
    yield "A state is safe where"
    yield f"$$\n{constraint}.\n$$"
    yield meaning


def wrapped(block: str) -> str:
    """Return a paragraph in lines of the house's width. Other blocks stay as they are."""
    if block.startswith(("#", "|", "<", "!", "$", "```", "- ")):
        return block
    return textwrap.fill(block, 124, break_on_hyphens=False, break_long_words=False)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    lines = [list(head), *map(list, rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def platform_blocks(platform: Platform, length: str) -> Iterator[str]:
    """Yield what a platform is, its parameters, and its state with how each field starts."""
    yield f"### `{platform.name}`: {platform.type_name}"
    yield summary(platform)
    own = [name for name in fields(type(platform)) if name not in fields(Platform)]
    if own:
        yield "Parameters: " + settings(platform, length, own) + "."
    start = {item.name: item for item in platform.start}
    rest = platform.rest()

    def begin(name: str, unit: str) -> tuple[str, ...]:
        if name not in start:
            return "", "the same in every episode", number(np.unique(getattr(rest, name)).squeeze())
        return (
            f"`{start[name].type_name}`",
            summary(start[name]),
            settings(start[name], length, physical=unit),
        )

    rows = (
        (f"`{name}`", unit, str(size), *begin(name, unit))
        for name, unit, size in state_fields(platform)
    )
    yield table(("state", "unit", "size", "start", "how it is drawn", "numbers"), rows)
    commands = getattr(platform.controller, "commands", ())
    if commands:
        script = "; ".join(
            f"`{command.name}` {command.type_name} {settings(command, length)}"
            for command in commands
        )
        yield f"It follows a script: {script}."


def state_fields(platform: Platform) -> list[tuple[str, str, int]]:
    """Return name, unit and number of components of each field of a platform's state."""
    rest = platform.rest()
    return [(name, unit, np.size(getattr(rest, name))) for name, unit in units(type(rest)).items()]


def actions(env: jaxsafe.Environment) -> Iterator[tuple[str, ...]]:
    """Yield a row for each actuator."""
    for index, actuator in enumerate(env.agent_platform.controller.actuators):  # type: ignore[attr-defined]
        unit = control_unit(actuator.name, length_unit(env))
        assert unit, f"no unit is known for {actuator.name}"
        mapped = (
            "[low, 0] and [0, high], so that 0 stays 0" if actuator.zero_centred else "[low, high]"
        )
        yield (
            str(index),
            f"`{actuator.name}`",
            unit,
            number(actuator.low),
            number(actuator.high),
            mapped,
            str(actuator.points),
        )


def observation(env: jaxsafe.Environment) -> list[tuple[str, ...]]:
    """Return a row for each element of the observation."""
    labels: dict[str, tuple[str, ...]] = {}

    def probe(key: jax.Array) -> None:
        sim = jaxsafe.reset(env, key)[0].sim
        labels.update({item.name: item.labels(sim) for item in env.observation})

    jax.eval_shape(probe, jax.random.key(0))
    rows = []
    for item in env.observation:
        divisors = np.broadcast_to(np.asarray(item.scale), len(labels[item.name]))
        clip = "none" if item.clip is None else number(item.clip)
        for label, divisor in zip(labels[item.name], divisors, strict=True):
            rows.append((str(len(rows)), f"`{label}`", seen(item, label), number(divisor), clip))
    return rows


def seen(item: Observation, label: str) -> str:
    """Return what one element of an observation is, in words."""
    element = label.removeprefix(item.name).removeprefix(".")
    if isinstance(item, ObserveAngle):
        return f"{'cosine' if element == 'cos' else 'sine'} of the `{item.what}` of `{item.of}`"
    if not isinstance(item, (Observe, ObserveRegion)):
        return f"status `{item.status}`"  # type: ignore[attr-defined]
    of, what = (item.of, item.what) if isinstance(item, Observe) else (item.region, "position")
    relative = f" relative to `{item.relative_to}`" if item.relative_to else ""
    turned = (
        f", in the body frame of `{item.frame}`" if item.frame and element != "magnitude" else ""
    )
    piece = "magnitude of " if element == "magnitude" else f"{element} of " if element else ""
    unit = "the direction of " if item.form == "magnorm" and element != "magnitude" else ""
    return f"{piece}{unit}the `{what}` of `{of}`{relative}{turned}"


def parts(env: jaxsafe.Environment, section: str, length: str) -> Iterator[tuple[str, ...]]:
    """Yield a row for each part of a section: the docstring of its class, and its numbers."""
    for part in getattr(env, section):
        yield (
            f"`{section}.{part.name}`",
            f"`{part.type_name}`",
            summary(part),
            settings(part, length),
        )
    if section == "terminal":
        for term in env.reward:
            if term.bound:
                yield (
                    f"`reward.{term.name}.bound`",
                    "",
                    summary(term.bound),
                    settings(term.bound, length),
                )


def summary(component: Component) -> str:
    """Return the docstring of a component in one line."""
    return " ".join(inspect.cleandoc(type(component).__doc__ or "").split())


def settings(
    component: Component, length: str, only: Iterable[str] = (), physical: str = ""
) -> str:
    """Return the fields of a component in words, with units.

    What is not set is left out, and so is what a base class sets.
    """
    units = {"m or ft": length, "physical": physical, "1": "", "as observed": ""}
    words = []
    for name, field in fields(type(component)).items():
        value = getattr(component, name)
        inherited = (
            name not in type(component).__annotations__ and field.static and value == field.default
        )
        if name == "name" or value is None or inherited or (only and name not in only):
            continue
        if field.unit:
            words.append(
                f"{name} {number(value)} {units.get(field.unit.symbol, field.unit.symbol)}".strip()
            )
        elif isinstance(value, Component):
            words.append(
                f"{name} ({', '.join(filter(None, (value.type_name, settings(value, length))))})"
            )
        elif isinstance(value, dict):
            words += [f"{key} {number(item)}" for key, item in value.items()]
        else:
            words.append(
                f"{name} {str(value).lower() if isinstance(value, bool) else f'`{value}`'}"
            )
    return ", ".join(words)


if __name__ == "__main__":
    import draw_tasks

    TARGET.mkdir(exist_ok=True)
    for task in sys.argv[1:] or TASKS:
        (TARGET / f"{task}.md").write_text(page(task), encoding="utf-8")
        draw_tasks.draw(task).savefig(TARGET / f"{task}.png", dpi=100)
