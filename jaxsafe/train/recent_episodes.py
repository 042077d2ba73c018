"""The latest finished episodes of a seed, kept inside the compiled training step.

The training curve of Table 2 and the cost of the training come from them.
"""

from __future__ import annotations

import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.metrics import Episode, over_episode
from jaxsafe.types import Record

SIZE = 100
"""Number of episodes in the window, as in the paper's training curves."""

COST_EPISODES = 25
"""Number of episodes that the latest cost is averaged over."""


class Window(Record):
    """A ring of the last `SIZE` finished episodes, and counts over all episodes."""

    episodes: Episode
    """The finished episodes, each field [SIZE]. Slots that were never filled are zero."""
    count: Int[Array, ""]
    """Number of finished episodes since the start of the training."""
    cost: Int[Array, ""]
    """Number of steps with a violation in all finished episodes."""
    running_cost: Int[Array, ""]
    """Number of steps with a violation in the episodes that still run."""


def empty_window(like: Episode) -> Window:
    """Return a window in which no episode has finished yet.

    Args:
        like: episodes whose fields have the dtypes of the window.
    """
    episodes = jax.tree.map(lambda x: jnp.zeros(SIZE, x.dtype), like)
    zero = jnp.zeros((), jnp.int32)
    return Window(episodes=episodes, count=zero, cost=zero, running_cost=zero)


def push(
    window: Window,
    episodes: Episode,
    done: Bool[Array, "t n"],
    counts: Bool[Array, "t n"] | None = None,
) -> Window:
    """Add the episodes that ended to the window, in order of time.

    Args:
        window: the window.
        episodes: sums of the episodes after each step, each field [num_steps, num_envs].
        done: whether the episode ended with the step. Episodes that have not ended by the last step
            still run.
        counts: which steps are part of an episode that counts. The others are left out of the
            window and of the number of episodes, but their cost is added. No episode goes on after
            the last step then. None means that all steps count and that episodes go on.
    """
    finished = (done if counts is None else done & counts).ravel()
    order = jnp.cumsum(finished, dtype=jnp.int32) - 1
    latest = finished & (order >= order[-1] + 1 - SIZE)
    slot = jnp.where(latest, (window.count + order) % SIZE, SIZE)  # SIZE is out of range: dropped
    # One scatter serves all fields, because a scatter takes long to compile.
    row = jnp.full(SIZE, -1).at[slot].set(jnp.arange(slot.size), mode="drop")
    ring = jax.tree.map(
        lambda old, new: jnp.where(row < 0, old, new.ravel()[row]), window.episodes, episodes
    )
    cost = jnp.sum(jnp.where(done, episodes.violating_steps, 0), dtype=jnp.int32)
    running_cost = jnp.sum(jnp.where(done[-1], 0, episodes.violating_steps[-1]), dtype=jnp.int32)
    if counts is not None:
        cost = cost + running_cost
        running_cost = jnp.zeros_like(running_cost)
    return Window(
        episodes=ring,
        count=window.count + order[-1] + 1,
        cost=window.cost + cost,
        running_cost=running_cost,
    )


def total_cost(window: Window) -> Array:
    """Return the number of violating steps since the start of the training.

    Finished episodes and episodes that still run count.
    """
    return window.cost + window.running_cost


def latest_cost(window: Window, costs: Float[Array, "episodes ..."]) -> Array:
    """Return the mean cost of the latest finished episodes. It is 0 while there are none.

    Args:
        window: the window.
        costs: the cost of each episode in the window [SIZE], or its cost by constraint [SIZE, c].
    """
    available = jnp.minimum(window.count, COST_EPISODES)
    age = (window.count - 1 - jnp.arange(SIZE)) % SIZE
    latest = (age < available).reshape(SIZE, *(1,) * (costs.ndim - 1))
    total = jnp.sum(jnp.where(latest, costs, jnp.zeros_like(costs)), axis=0)
    dtype = jnp.result_type(float)
    return total.astype(dtype) / jnp.maximum(available, 1).astype(dtype)


def means(
    window: Window,
    outcomes: tuple[str, ...],
    successes: tuple[str, ...],
    severity: bool = False,
) -> dict[str, Array]:
    """Return averages over the episodes in the window, by column of the progress log.

    They are 0 while the window is empty. A share of steps is an average over episodes, and every
    episode counts alike, however long it is. The rates of `metrics.summarise` are other numbers
    with other names, because in them every step counts alike.

    Args:
        window: the window.
        outcomes: names of the outcomes, as `env.outcomes`. The first one means that the episode
            still runs.
        successes: names of the outcomes that count as success.
        severity: whether the severity of the violations is averaged too.
    """
    filled = (jnp.arange(SIZE, dtype=window.count.dtype) < window.count).astype(
        jnp.result_type(float)
    )
    weight = filled / jnp.maximum(jnp.minimum(window.count, SIZE), 1).astype(filled.dtype)
    episodes = window.episodes
    lengths = jnp.maximum(episodes.length, 1).astype(weight.dtype)

    def each(values: Array) -> Array:
        return weight * values.astype(weight.dtype)

    def share_of_steps(steps: Array) -> Array:
        return weight * steps.astype(weight.dtype) / lengths

    weighted = {
        "return": each(episodes.episode_return),
        "length": each(episodes.length),
        "delta_v": each(episodes.delta_v),
        "control_effort": share_of_steps(episodes.control_effort),
        "violating_share": share_of_steps(episodes.violating_steps),
        "episode_cost": each(episodes.violating_steps),
        **({"episode_severity": each(episodes.severity_sum)} if severity else {}),
        "intervention_share": share_of_steps(episodes.interventions),
        **{
            f"outcome/{name}": each(episodes.outcome == index)
            for index, name in enumerate(outcomes)
            if index
        },
        **{f"reward/{name}": each(total) for name, total in episodes.reward_totals.items()},
        **{f"episode_cost/{name}": each(total) for name, total in episodes.costs.items()},
        **{
            f"measured/{name}": each(over_episode(name, value, lengths))
            for name, value in episodes.measured.items()
        },
    }
    # One sum over all rows compiles to fewer loops than a sum for each.
    sums = jnp.sum(jnp.stack(list(weighted.values())), axis=1)
    columns = dict(zip(weighted, sums, strict=True))
    reached = [columns[f"outcome/{name}"] for name in successes]
    success = functools.reduce(operator.add, reached) if reached else jnp.zeros(())
    return {"success_rate": success, **columns}
