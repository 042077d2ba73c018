"""The metrics of a policy, as a function."""

from __future__ import annotations

from typing import Any

import jax

from jaxsafe.devices.latest_programs import latest_programs
from jaxsafe.environment import Environment, require_environment
from jaxsafe.evaluate.cases import Cases, load_cases
from jaxsafe.evaluate.episodes import run_episodes
from jaxsafe.metrics import Episode, metrics_in
from jaxsafe.rollout import Policy, RecurrentPolicy, require_count, require_hashable
from jaxsafe.types import Key, require_key


def evaluate(
    env: Environment,
    policy: Policy | RecurrentPolicy,
    key: Key | None = None,
    num_episodes: int = 1000,
    *,
    episodes: int | None = None,
    cases: str | None = None,
) -> dict[str, float | None]:
    """Return the metrics of Section 5 over whole episodes of a policy.

    The program is compiled once for an environment, a policy and a number of episodes, whatever the
    numbers of the environment are. The 32 latest are kept.

    Args:
        env: the environment.
        policy: `policy(key, observation)` returns an action for each of a batch of observations, as
            the policies of `jaxsafe.load_policy` do. It may be a `RecurrentPolicy`.
        key: a typed PRNG key. It decides starts and noise. None stands for `jax.random.key(0)`.
        num_episodes: how many episodes run side by side.
        episodes: another name of `num_episodes`, which the command uses.
        cases: a CSV or YAML file of starts with a column for each field, such as
            `deputy.position.x`. There is an episode from each start, whatever `num_episodes` is.
            None stands for random starts.

    Returns:
        The metrics by name: rates as fractions in [0, 1], lengths in steps, Δv in the unit of the
        task. A metric is None if the environment does not measure it or it is not finite.

    Raises:
        ConfigError: the number of episodes is not a whole number of at least 1, the key is a
            plain number, the policy is no function or returns actions of another shape, or the
            cases do not fit.
    """
    count = num_episodes if episodes is None else episodes
    require_environment("evaluate: env", env)
    require_count("evaluate: episodes", count, least=1)
    require_key("evaluate: key", key)
    require_hashable(policy)
    key = jax.random.key(0) if key is None else key
    starts = None if cases is None else load_cases(env, cases)
    count = count if starts is None else starts.size
    sums = _run((policy, count), env, key, starts)
    return metrics_in(env, jax.device_get(sums))


@latest_programs
def _run(constants: tuple[Any, int], env: Environment, key: Key, cases: Cases | None) -> Episode:
    """Run the episodes of a policy. The constants are the policy and the number of episodes."""
    policy, num_episodes = constants
    return run_episodes(env, policy, key, num_episodes, cases)
